"""The policy of the ProcGen experiments."""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticCnnPolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_cchain.networks.extractors import ImpalaCNN


class ImpalaPolicy(ActorCriticCnnPolicy):
    """
    The actor-critic policy of the C-CHAIN paper's ProcGen experiments: the features of
    :class:`~sb3_cchain.networks.ImpalaCNN`, which keep the initialisation that it gives them (SB3's ``ortho_init``
    would make them orthogonal), and linear heads on them, orthogonal with gain 0.01 for the policy and 1 for the value.

    :param observation_space: Images; see :class:`~sb3_cchain.networks.ImpalaCNN`
    :param action_space: Action space
    :param lr_schedule: Learning rate, a function of the share of the training that remains
    :param net_arch: Layers between the features and the heads, by default none
    :param features_extractor_class: :class:`~sb3_cchain.networks.ImpalaCNN` or a class derived from it; its
        arguments, as ``dict(layer_norm=True)``, go into ``features_extractor_kwargs``
    :param kwargs: Keyword arguments of ``ActorCriticCnnPolicy``
    :raises TypeError: For another feature extractor
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        features_extractor_class: type[ImpalaCNN] = ImpalaCNN,
        **kwargs: Any,
    ):
        if not issubclass(features_extractor_class, ImpalaCNN):
            raise TypeError(f"`features_extractor_class` must be ImpalaCNN or derived from it, got {features_extractor_class}")
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=[] if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        for extractor in dict.fromkeys((self.pi_features_extractor, self.vf_features_extractor)):  # one where they share it
            assert isinstance(extractor, ImpalaCNN)
            extractor.reset_parameters()
