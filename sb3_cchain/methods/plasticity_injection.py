"""Plasticity injection."""

from stable_baselines3 import DQN
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.injection_policies import Injectable, InjectionDQNPolicy, InjectionPolicy
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.callback_tree import require_every_rollout
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Plasticity injection: whether it was done": "plasticity_injection/is_injected"})


class PlasticityInjection(TaskBoundary):
    r"""
    Gives the heads of the networks fresh parameters, once, without a change of their outputs: :math:`h_\theta(x)` becomes

    .. math:: h_\theta(x) + h_{\theta'_1}(x) - h_{\theta'_2}(x)

    where :math:`\theta'_1 = \theta'_2` is a fresh draw of the initialisation. From then on :math:`\theta` and
    :math:`\theta'_2` are frozen, and :math:`\theta'_1` is trained, which is as many parameters as before.

    Paper: "Deep reinforcement learning with plasticity injection", https://arxiv.org/abs/2305.15555 (Nikishin et al., NeurIPS
    2023). What the features extractor computes is the input :math:`x` of the head, and the extractor goes on
    being trained.

    The policy must be :class:`~sb3_cchain.networks.InjectionPolicy` (PPO, A2C) or
    :class:`~sb3_cchain.networks.InjectionDQNPolicy`, which has the parameters in its optimiser from the beginning. Those of
    the new heads have no moments at the injection. The head must have hidden layers: a linear head would stay the same linear
    function, with fresh moments.

    Assumed, where the paper is about one Q-network: PPO's actor and critic both get the injection; DQN's target network gets
    the same new parameters at the same time, so that its outputs do not change either. A second injection is not offered.

    It happens between rollouts, so up to a rollout late. C-CHAIN's reference stays, because the outputs do. Frozen parameters
    have no gradient and are left alone by optimisers and other methods. :class:`Oracle` undoes the injection, with everything
    else.

    It costs one construction of the policy, and from then on about three times the forward pass of the head.

    Logged: ``plasticity_injection/is_injected``, 0 or 1.

    :param timestep: Environment step at which it is done, in all environments together; None for the first task switch
    :raises ValueError: When ``timestep`` is neither None nor a positive integer
    :raises TypeError: When training starts, for another policy, and with ``timestep=None`` for an environment that is not
        continual
    """

    model: OnPolicyAlgorithm | DQN

    def __init__(self, timestep: int | None = None):
        super().__init__()
        if timestep is not None:
            check_number("timestep", timestep, 1, integer=True)
        self.timestep = timestep

    def _init_callback(self) -> None:
        policy = uncompiled(self.model.policy)
        if not isinstance(policy, (InjectionPolicy, InjectionDQNPolicy)):
            raise TypeError(
                f"PlasticityInjection needs the policy InjectionPolicy or InjectionDQNPolicy, got {type(policy).__name__}"
            )

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        if self.timestep is None:
            super()._on_training_start()

    def _on_rollout_start(self) -> None:
        if self.timestep is None:
            super()._on_rollout_start()
        elif self.num_timesteps >= self.timestep:
            self._on_task_switch()

    def _on_task_switch(self) -> None:
        policy = uncompiled(self.model.policy)
        if not _is_injected(policy):
            inject(policy, fresh_policy(self.model))

    def _on_rollout_end(self) -> None:
        self.logger.record("plasticity_injection/is_injected", int(_is_injected(uncompiled(self.model.policy))))


def inject(policy: nn.Module, fresh: nn.Module) -> None:
    """
    :param policy: A policy of which nothing was injected
    :param fresh: The same with fresh parameters, as it was made
    """
    for name, module in policy.named_modules():
        if isinstance(module, Injectable):
            # The target network gets what the Q-network gets
            source = fresh.get_submodule(name.replace("q_net_target.", "q_net.", 1))
            assert isinstance(source, Injectable)
            module.inject(source.old)


def _is_injected(policy: nn.Module) -> bool:
    return any(bool(module.is_injected) for module in policy.modules() if isinstance(module, Injectable))
