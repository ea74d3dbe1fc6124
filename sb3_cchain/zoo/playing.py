"""What RL Zoo's commands that play saved models leave out."""

from pathlib import Path
from typing import Any

import rl_zoo3.utils
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_cchain.checkpoint import check_model_file, load_statistics
from sb3_cchain.envs import TaskCaption
from sb3_cchain.zoo.statistics import statistics_beside

_create_test_env = rl_zoo3.utils.create_test_env


class Playing:
    """
    A command of RL Zoo's makes an environment, loads a model and plays. This adds the ``env_kwargs`` of the settings, the
    statistics of normalisation that belong to a checkpoint, and the masks of actions. It allocates no replay buffer.
    """

    def __init__(self) -> None:
        self._env: VecEnv | None = None

    def create_env(self, env_id: str, hyperparams: dict[str, Any], env_kwargs: dict[str, Any], **kwargs: Any) -> VecEnv:
        """
        RL Zoo's ``create_test_env``, with the ``env_kwargs`` of the settings, too. RL Zoo adds them in ``enjoy`` alone.

        :param env_id: Environment id
        :param hyperparams: Settings of the training
        :param env_kwargs: Arguments of the environment, besides those of the settings
        :param kwargs: Other arguments of RL Zoo's
        :return: The vectorised environment
        """
        env_kwargs = {**(hyperparams.get("env_kwargs") or {}), **env_kwargs}
        self._env = _create_test_env(env_id, hyperparams=hyperparams, env_kwargs=env_kwargs, **kwargs)
        return self._env

    def create_captioned_env(self, env_id: str, hyperparams: dict[str, Any], **kwargs: Any) -> VecEnv:
        """
        :meth:`create_env`, with the task on each frame.

        :param env_id: Environment id
        :param hyperparams: Settings of the training
        :param kwargs: Other arguments of :meth:`create_env`
        :return: The vectorised environment
        """
        wrappers = hyperparams.get("env_wrapper") or []
        wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
        return self.create_env(env_id, hyperparams={**hyperparams, "env_wrapper": [*wrappers, TaskCaption]}, **kwargs)

    def algorithm(self, algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
        """
        :param algorithm: An algorithm
        :return: The same, whose ``load()`` checks that the file is whole, and whose models play as this class says
        """
        loaded = algorithm if not issubclass(algorithm, MaskablePPO) else self._with_masks(algorithm)

        def load(path: str, *args: Any, **kwargs: Any) -> BaseAlgorithm:
            check_model_file(path)
            if issubclass(algorithm, OffPolicyAlgorithm):  # RL Zoo does so for a list of names only
                kwargs.update(buffer_size=1, optimize_memory_usage=False)
            self._take_statistics_of(Path(path))
            return loaded.load(path, *args, **kwargs)

        return _subclass(algorithm, load=staticmethod(load))

    def _with_masks(self, algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
        def predict(model: Any, observation: Any, *args: Any, **kwargs: Any) -> Any:
            if self._env is not None and is_masking_supported(self._env):
                kwargs.setdefault("action_masks", get_action_masks(self._env))
            return algorithm.predict(model, observation, *args, **kwargs)

        return _subclass(algorithm, predict=predict)

    def _take_statistics_of(self, model_path: Path) -> None:
        normalize = None if self._env is None else unwrap_vec_normalize(self._env)
        statistics = statistics_beside(model_path)
        if normalize is not None and statistics is not None and statistics.is_file():
            load_statistics(normalize, statistics)


def _subclass(algorithm: type[BaseAlgorithm], **methods: Any) -> Any:
    """Of the same name."""
    return type(algorithm.__name__, (algorithm,), {**methods, "__module__": algorithm.__module__})
