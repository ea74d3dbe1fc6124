"""Policies for ``Dict`` observations."""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor


class DictObservations:
    """
    What a policy inherits before SB3's MLP policy: ``Dict`` observations get SB3's ``CombinedExtractor``, as in its
    ``MultiInputPolicy``, unless another features extractor is given.

    :param observation_space: Observation space
    :param args: Other arguments of the policy
    :param kwargs: Keyword arguments of the policy
    """

    def __init__(self, observation_space: spaces.Space[Any], *args: Any, **kwargs: Any):
        if isinstance(observation_space, spaces.Dict):
            kwargs = {"features_extractor_class": CombinedExtractor, **kwargs}
        super().__init__(observation_space, *args, **kwargs)  # type: ignore[call-arg]
