"""SB3's MLP policies whose heads can be given fresh parameters without a change of their outputs: plasticity injection."""

import copy
from typing import Any

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch import nn

from sb3_cchain.networks.dict_observations import DictObservations
from sb3_cchain.replaced import replaced


class Injectable(nn.Module):
    """
    A part of a head that is there three times: the old one, a new one, and a copy of the new one. Until the injection the old
    one alone is used and trained. Then it is frozen, as the copy, and the new one is trained.

    :param network: The part
    """

    is_injected: th.Tensor

    def __init__(self, network: nn.Module):
        super().__init__()
        self.old = network
        self.new: nn.Module = copy.deepcopy(network)
        self.copy: nn.Module = copy.deepcopy(network)
        # Saved with the parameters
        self.register_buffer("is_injected", th.tensor(False))
        self._freeze()

    def _freeze(self) -> None:
        # A boolean of Python, because reading a tensor would wait for the GPU in each pass
        self._injected = bool(self.is_injected)
        self.old.requires_grad_(not self._injected)
        self.copy.requires_grad_(False)

    def inject(self, fresh: nn.Module) -> None:
        """
        :param fresh: The same part with fresh parameters
        """
        for network in (self.new, self.copy):
            network.load_state_dict(fresh.state_dict())
        self.is_injected.fill_(True)
        self._freeze()

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._freeze()


class InjectableHidden(Injectable):
    """The hidden layers of a head. After the injection, the outputs of all three stand side by side."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: ``(batch_size, n_inputs)``
        :return: ``(batch_size, n_outputs)``, after the injection ``(batch_size, 3 * n_outputs)``
        """
        if not self._injected:
            return self.old(inputs)
        return th.cat([self.old(inputs), self.new(inputs), self.copy(inputs)], dim=1)


class InjectableOutput(Injectable):
    """The output layer of a head. After the injection, its output is that of the old head + the new one - the copy."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: What :class:`InjectableHidden` returns
        :return: ``(batch_size, n_outputs)``
        """
        if not self._injected:
            return self.old(inputs)
        old, new, copied = inputs.chunk(3, dim=1)
        # The difference first: it is exactly 0 at the injection
        return self.old(old) + (self.new(new) - self.copy(copied))


def _check_activation(policy: ActorCriticPolicy | DQNPolicy) -> None:
    name, activation = type(policy).__name__, policy.activation_fn
    if getattr(activation, "expansion", 1) != 1:  # SB3's MLPs do not know them
        raise ValueError(f"`activation_fn` must keep the number of features for {name}, got {activation.__name__}")


class InjectionPolicy(DictObservations, ActorCriticPolicy):
    """
    SB3's ``MlpPolicy`` for PPO and A2C, for :class:`~sb3_cchain.methods.PlasticityInjection`. Until the injection it computes
    what ``MlpPolicy`` computes, from the same initial parameters. The heads are all behind the features extractor: the hidden
    layers of actor and critic and their output layers.

    All parameters are in the optimiser from the beginning, so that models can be saved and loaded at any time; those that are
    not used, or frozen, have no gradient.

    :param args: Arguments of ``ActorCriticPolicy``
    :param kwargs: Keyword arguments of ``ActorCriticPolicy``
    :raises ValueError: With ``use_sde=True``, whose noise reads the hidden layers, and with CReLU or Fourier features
    """

    def _build(self, lr_schedule: Schedule) -> None:
        if self.use_sde:
            raise ValueError("`use_sde` must be False for InjectionPolicy, got True")
        _check_activation(self)
        # The optimiser is made below, for the layers that come now
        with replaced(self, "optimizer_class", th.optim.SGD), replaced(self, "optimizer_kwargs", {}):
            super()._build(lr_schedule)
        extractor = self.mlp_extractor
        extractor.policy_net = nn.Sequential(InjectableHidden(extractor.policy_net))
        extractor.value_net = nn.Sequential(InjectableHidden(extractor.value_net))
        self.action_net = InjectableOutput(self.action_net)
        self.value_net = InjectableOutput(self.value_net)  # type: ignore[assignment]
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]


class InjectionDQNPolicy(DictObservations, DQNPolicy):
    """
    SB3's ``MlpPolicy`` for DQN, for :class:`~sb3_cchain.methods.PlasticityInjection`, as :class:`InjectionPolicy`.

    :param args: Arguments of ``DQNPolicy``
    :param kwargs: Keyword arguments of ``DQNPolicy``
    :raises ValueError: With CReLU or Fourier features
    """

    def make_q_net(self) -> QNetwork:
        """
        :return: A Q-network
        """
        _check_activation(self)
        network = super().make_q_net()
        *hidden, output = network.q_net
        network.q_net = nn.Sequential(InjectableHidden(nn.Sequential(*hidden)), InjectableOutput(output))
        return network
