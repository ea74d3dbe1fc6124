"""Layer reset."""

import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.methods.plain_networks import check_plain_networks
from sb3_cchain.methods.switch_or_interval import SwitchOrInterval
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.layers import LAYERS
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Layer reset: resets": "layer_reset/n_resets"})

# Parts of a network, in the order of the data
_ACTOR = ("pi_features_extractor", "mlp_extractor.policy_net", "action_net")
_CRITIC = ("vf_features_extractor", "mlp_extractor.value_net", "value_net")


class LayerReset(SwitchOrInterval):
    """
    Initialises the last layers of each network again, every ``interval`` environment steps or at each task switch, and keeps
    the data: DQN's replay buffer stays.

    Paper: "The primacy bias in deep reinforcement learning", https://arxiv.org/abs/2205.07802 (Nikishin et al., ICML 2022). It
    resets the last layer of the Q-network in Atari (SPR) and all layers in DeepMind Control (SAC).

    The layers become a fresh draw of their initialisation. The optimiser forgets the moments and step counts of their
    parameters, and keeps those of all others. No object is replaced, so the optimiser trains the same parameters as before.

    - The networks are the actor and the critic of on-policy algorithms, and the Q-network of DQN.
    - A layer is a linear or convolutional layer with its bias, and the LayerNorm behind it if there is one. Layers of the
      features extractor count, in the order of its modules.
    - DQN's target network gets the same draw. The paper's text does not fix this for all of its agents; it is assumed here,
      so that targets do not pull the fresh layer back to the old one.
    - Frozen layers count, and what is frozen is left alone.
    - The standard deviation of Gaussian actions (``log_std``) is in no layer and stays:
      :class:`~sb3_cchain.methods.LogStdRestart` restarts it.

    It happens between rollouts, so up to a rollout late; see :class:`Oracle` for task switches. C-CHAIN then forgets its
    reference batch, so that churn reduction does not undo the reset. It costs one construction of the policy per reset.

    Logged: ``layer_reset/n_resets``, the resets since ``learn()`` was called.

    :param n_layers: Layers to reset, counted from the output of each network; None for all
    :param interval: Environment steps between two resets, in all environments together, counted from the start of the
        training; None for one at each task switch. For PPO, whole rollouts are a good choice. The paper has 20 000 in Atari
        and 200 000 in DeepMind Control, with an update or two per step.
    :raises ValueError: When an argument is neither None nor a positive integer; when training starts, when a network has fewer
        layers than ``n_layers``
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN, for recurrent networks, for
        the policies of :class:`PlasticityInjection`, for networks that are not made of SB3's parts, and with
        ``interval=None`` for an environment that is not continual
    """

    name = "layer_reset"

    model: OnPolicyAlgorithm | DQN

    def __init__(self, n_layers: int | None = 1, interval: int | None = None):
        super().__init__(interval)
        if n_layers is not None:
            check_number("n_layers", n_layers, 1, integer=True)
        self.n_layers = n_layers

    def _init_callback(self) -> None:
        check_plain_networks("LayerReset", self.model)
        policy = uncompiled(self.model.policy)
        try:
            n_layers = min(map(len, network_layers(policy)))
        except AttributeError as error:
            raise TypeError(f"LayerReset does not know the networks of {type(policy).__name__}: {error}") from error
        if self.n_layers is not None and self.n_layers > n_layers:
            raise ValueError(f"`n_layers` must be at most {n_layers}, the layers of the network, got {self.n_layers!r}")

    def _act(self) -> None:
        reset_layers(uncompiled(self.model.policy), fresh_policy(self.model), self.n_layers)


def network_layers(policy: nn.Module) -> list[list[list[str]]]:
    """
    :param policy: A policy of an on-policy algorithm or of DQN
    :return: For each of its trained networks, for each layer in the order of the data, the names of its parameters and
        buffers, none that is frozen
    :raises AttributeError: For networks that are not made of SB3's parts
    """
    networks = [("q_net",)] if hasattr(policy, "q_net") else [_ACTOR, _CRITIC]
    found = []
    for parts in networks:
        layers: list[list[str]] = []
        for part in parts:
            for name, module in policy.get_submodule(part).named_modules(prefix=part):
                if isinstance(module, LAYERS):
                    layers.append([])
                parameters = dict(module.named_parameters(recurse=False))
                own = [key for key, parameter in parameters.items() if parameter.requires_grad]
                if own or not parameters:  # not frozen
                    own += dict(module.named_buffers(recurse=False))
                if own and not layers:
                    layers.append([])  # a norm or an embedding before the first layer
                for key in own:
                    layers[-1].append(f"{name}.{key}")
        found.append(layers)
    return found


def reset_layers(policy: nn.Module, fresh: nn.Module, n_layers: int | None) -> None:
    """
    Copy the last layers of another policy, and forget what the optimiser knows about them.

    :param policy: A policy of an on-policy algorithm or of DQN
    :param fresh: The same with fresh parameters
    :param n_layers: Number of layers at the end of each network; None for all
    """
    names = {name for layers in network_layers(policy) for layer in layers[-n_layers if n_layers else 0 :] for name in layer}
    tensors, draws = policy.state_dict(), fresh.state_dict()
    with th.no_grad():
        for name in names:
            tensors[name].copy_(draws[name])
            target = f"q_net_target.{name.removeprefix('q_net.')}"
            if target in tensors:
                tensors[target].copy_(draws[name])
    optimizer: th.optim.Optimizer = policy.optimizer  # type: ignore[assignment]
    for name, parameter in policy.named_parameters(remove_duplicate=False):
        if name in names:
            optimizer.state.pop(parameter, None)  # Adam begins again with what it has no state of
