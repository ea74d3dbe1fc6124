"""The residual networks of SimBa, as policies for PPO, DQN and SAC."""

from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_cchain.networks.dict_observations import DictObservations
from sb3_cchain.networks.mlp_policies import ActorCriticVariant, DQNVariant


class SimBaBlock(nn.Module):
    """
    The input, plus a network of one hidden layer, four times as wide, of the normalised input.

    :param width: Number of inputs and outputs
    """

    def __init__(self, width: int):
        super().__init__()
        self.residual = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: ``(batch_size, width)``
        :return: The same shape
        """
        return inputs + self.residual(inputs)


class SimBaTrunk(nn.Sequential):
    """
    A linear layer, blocks, and a LayerNorm.

    :param n_inputs: Number of inputs
    :param net_arch: Width of each block, all the same
    :raises ValueError: When there is no block, or their widths differ
    """

    def __init__(self, n_inputs: int, net_arch: list[int]):
        if not net_arch or len(set(net_arch)) > 1:
            raise ValueError(
                f"`net_arch` must give each network one width or more, all the same, as [128, 128]; got {net_arch!r}"
            )
        width = net_arch[0]
        super().__init__(nn.Linear(n_inputs, width), *(SimBaBlock(width) for _ in net_arch), nn.LayerNorm(width))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw new weights: orthogonal before the blocks, He's normal ones in them."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.kaiming_normal_(module.weight)
                nn.init.zeros_(module.bias)
            elif isinstance(module, nn.LayerNorm):
                module.reset_parameters()
        nn.init.orthogonal_(self[0].weight)  # type: ignore[arg-type]


class SimBaPolicy(ActorCriticVariant):
    """
    SB3's ``MlpPolicy`` for PPO and A2C with the network of SimBa in place of the hidden layers: a linear layer, residual
    blocks that begin with a LayerNorm, and a LayerNorm at the end.

    Paper: "SimBa: simplicity bias for scaling up parameters in deep reinforcement learning",
    https://arxiv.org/abs/2410.09754 (Lee et al., ICLR 2025). ``net_arch`` gives the width of each block, all the same:
    ``dict(pi=[128], vf=[512, 512])``, the default, is one block of 128 for the actor and two of 512 for the critic, as the
    paper has for SAC. A block of width n has 8 n² weights. The layers have the initialisation of the paper's code, also
    with ``ortho_init``, which initialises the output layers; ``activation_fn`` has no effect.

    The paper's third part, the running normalisation of the observations, is the work of ``VecNormalize(norm_reward=False)``,
    or of :class:`~sb3_cchain.envs.TaskVecNormalize`.

    :param args: Arguments of ``ActorCriticPolicy``
    :param kwargs: Keyword arguments of ``ActorCriticPolicy``
    :raises ValueError: When a network has no block, or blocks of different widths
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"net_arch": dict(pi=[128], vf=[512, 512]), **kwargs})

    def _make_hidden(self, n_inputs: int, net_arch: list[int]) -> tuple[nn.Sequential, int]:
        return SimBaTrunk(n_inputs, net_arch), net_arch[-1]

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        for trunk in (self.mlp_extractor.policy_net, self.mlp_extractor.value_net):
            assert isinstance(trunk, SimBaTrunk)
            trunk.reset_parameters()  # which `ortho_init` has initialised otherwise


class SimBaDQNPolicy(DQNVariant):
    """
    SB3's ``MlpPolicy`` for DQN with the network of SimBa, as :class:`SimBaPolicy`. ``net_arch`` is a list of the blocks'
    widths; the default ``[512, 512]`` is that of the paper's critics.

    :param args: Arguments of ``DQNPolicy``
    :param kwargs: Keyword arguments of ``DQNPolicy``
    :raises ValueError: When the network has no block, or blocks of different widths
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"net_arch": [512, 512], **kwargs})

    def _make_hidden(self, n_inputs: int, net_arch: list[int]) -> tuple[nn.Sequential, int]:
        return nn.Sequential(SimBaTrunk(n_inputs, net_arch)), net_arch[-1]


class SimBaSACPolicy(DictObservations, SACPolicy):
    """
    SB3's ``MlpPolicy`` for SAC with the network of SimBa, as :class:`SimBaPolicy`, for the actor and each critic.
    ``net_arch`` is a list, or a dict as the default ``dict(pi=[128], qf=[512, 512])``, which is the paper's.

    :param args: Arguments of ``SACPolicy``
    :param kwargs: Keyword arguments of ``SACPolicy``
    :raises ValueError: When a network has no block, or blocks of different widths
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"net_arch": dict(pi=[128], qf=[512, 512]), **kwargs})

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """
        :param features_extractor: As for ``SACPolicy``
        :return: An actor
        """
        actor = super().make_actor(features_extractor)
        actor.latent_pi = SimBaTrunk(actor.features_dim, actor.net_arch).to(self.device)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """
        :param features_extractor: As for ``SACPolicy``
        :return: A critic
        """
        critic = super().make_critic(features_extractor)
        net_arch: Any = self.critic_kwargs["net_arch"]
        n_inputs = critic.features_extractor.features_dim + get_action_dim(self.action_space)
        for index in range(critic.n_critics):
            network = nn.Sequential(SimBaTrunk(n_inputs, net_arch), nn.Linear(net_arch[-1], 1)).to(self.device)
            critic.q_networks[index] = network
            critic.add_module(f"qf{index}", network)
        return critic
