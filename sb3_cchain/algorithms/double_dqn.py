"""Double DQN."""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from types import FunctionType, SimpleNamespace
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch.nn import functional as F

from sb3_cchain.networks.policy_outputs import as_it_acts, has_training_mode
from sb3_cchain.replaced import replaced

SelfDoubleDQN = TypeVar("SelfDoubleDQN", bound="DoubleDQN")

# SB3's own training step for another loss: the same code, for which the name `F` stands for something else. Whatever a release
# of SB3 changes there is changed here too; another function of `F` raises an AttributeError.
_train_mse = FunctionType(
    DQN.train.__code__,
    {**DQN.train.__globals__, "F": SimpleNamespace(smooth_l1_loss=F.mse_loss)},
    DQN.train.__name__,
    DQN.train.__defaults__,
    DQN.train.__closure__,
)


class DoubleDQN(DQN):
    r"""
    Deep Q-Network with Double Q-learning.

    Paper: https://arxiv.org/abs/1509.06461 (van Hasselt et al., AAAI 2016)

    It is SB3's :class:`~stable_baselines3.DQN`, with all of its arguments and its ``train()``; the greedy action in the next
    state is the online network's, its value the target network's:
    :math:`r + \gamma \, Q_{target}(s', \arg\max_a Q(s', a))`.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param args: Further arguments of DQN
    :param double_q: Whether to use Double Q-learning; with ``False`` and ``loss="huber"`` it is SB3's DQN, to the bit
    :param loss: Loss of the TD error: ``"huber"`` as SB3, or ``"mse"`` as the C-CHAIN paper's Double DQN
    :param kwargs: Further keyword arguments of DQN
    :raises ValueError: For a ``loss`` that is neither, or n-step returns with ``Dict`` observations
    :raises TypeError: When ``double_q`` is not a boolean or the actions are not ``Discrete``
    """

    def __init__(
        self,
        policy: str | type[DQNPolicy],
        env: GymEnv | str,
        *args: Any,
        double_q: bool = True,
        loss: str = "huber",
        **kwargs: Any,
    ):
        self.double_q = double_q
        self.loss = loss
        self._check_arguments()  # before an environment is made
        if env is not None:  # as when a model is loaded without one
            env = maybe_make_env(env, kwargs.get("verbose", 0))
            if not isinstance(env.action_space, spaces.Discrete):
                raise TypeError(f"{type(self).__name__} needs an environment with Discrete actions, got {env.action_space}")
        super().__init__(policy, env, *args, **kwargs)

    def _check_arguments(self) -> None:
        if not isinstance(self.double_q, bool):
            raise TypeError(f"`double_q` must be True or False, got {self.double_q!r}")
        if self.loss not in ("huber", "mse"):
            raise ValueError(f'`loss` must be "huber" or "mse", got {self.loss!r}')

    def _setup_model(self) -> None:
        self._check_arguments()  # again: `load()` may have changed them
        if self.n_steps > 1 and self.replay_buffer_class is None and isinstance(self.observation_space, spaces.Dict):
            raise ValueError(f"SB3 has n-step returns for Dict observations not yet: set `n_steps=1`, got {self.n_steps!r}")
        super()._setup_model()

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the Q-network, as DQN does, with Double Q-learning and the chosen loss.

        :param gradient_steps: Number of updates
        :param batch_size: Minibatch size
        """
        double_q = replaced(self, "q_net_target", self._double_q_values(self.q_net_target)) if self.double_q else nullcontext()
        with double_q:
            if self.loss == "mse":
                _train_mse(self, gradient_steps, batch_size)
            else:
                super().train(gradient_steps, batch_size)

    def _double_q_values(self, q_net_target: QNetwork) -> Callable[[PyTorchObs], th.Tensor]:
        # As the target network: with running BatchNorm statistics, which next observations do not move, and without dropout
        acting = partial(as_it_acts, self.policy) if has_training_mode(self.policy) else nullcontext

        def values(next_observations: PyTorchObs) -> th.Tensor:
            with acting():
                greedy_actions = self.q_net(next_observations).argmax(dim=1, keepdim=True)
            # (batch_size, 1): DQN takes the maximum over the columns, of which there is one
            return q_net_target(next_observations).gather(1, greedy_actions)

        return values

    def learn(
        self: SelfDoubleDQN,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DoubleDQN",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDoubleDQN:
        """
        As DQN's.

        :param total_timesteps: Environment steps to train for
        :param callback: Callback(s) called at every step
        :param log_interval: Episodes between two logs
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: Whether to count environment steps from 0
        :param progress_bar: Whether to show a progress bar
        :return: The trained model
        """
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
