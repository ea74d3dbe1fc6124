"""SB3's MLP policies with LayerNorm, with CReLU, with deep Fourier features or with spectral normalisation."""

from typing import Any, ClassVar

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch import nn

from sb3_cchain.networks.activations import CReLU, FourierFeatures
from sb3_cchain.networks.dict_observations import DictObservations
from sb3_cchain.networks.spectral_norm import SpectralNormLinear, settle_spectral_norms


class _Hidden(DictObservations):
    """
    What the variants of SB3's policies have in common: linear layers, each followed by a LayerNorm (on request) and the
    activation, which may have several outputs for each unit, as :class:`CReLU` has.
    """

    layer_norm: ClassVar[bool] = False
    linear: ClassVar[type[nn.Linear]] = nn.Linear
    activation_fn: type[nn.Module]

    def _make_hidden(self, n_inputs: int, net_arch: list[int]) -> tuple[nn.Sequential, int]:
        """The hidden layers, and the number of their outputs."""
        modules: list[nn.Module] = []
        for n_units in net_arch:
            modules.append(self.linear(n_inputs, n_units))
            if self.layer_norm:
                modules.append(nn.LayerNorm(n_units))
            modules.append(self.activation_fn())
            n_inputs = n_units * getattr(modules[-1], "expansion", 1)
        return nn.Sequential(*modules), n_inputs


class ActorCriticVariant(_Hidden, ActorCriticPolicy):
    """SB3's ``MlpPolicy`` for PPO and A2C with other hidden layers."""

    def _build_mlp_extractor(self) -> None:
        net_arch = self.net_arch if isinstance(self.net_arch, dict) else dict(pi=self.net_arch, vf=self.net_arch)
        extractor = MlpExtractor(self.features_dim, [], self.activation_fn, self.device)
        extractor.policy_net, extractor.latent_dim_pi = self._make_hidden(self.features_dim, net_arch.get("pi", []))
        extractor.value_net, extractor.latent_dim_vf = self._make_hidden(self.features_dim, net_arch.get("vf", []))
        self.mlp_extractor: MlpExtractor = extractor.to(self.device)


class LayerNormPolicy(ActorCriticVariant):
    """
    SB3's ``MlpPolicy`` for PPO and A2C with a LayerNorm (https://arxiv.org/abs/1607.06450; against the loss of plasticity:
    Lyle et al. 2024, https://arxiv.org/abs/2402.18762) in each hidden layer, after the linear map and before the activation.
    There is none on the observations, on the features (images: give their extractor ``layer_norm=True``) or on the outputs.

    All arguments are those of ``ActorCriticPolicy``, with the same defaults; ``net_arch`` is a list or a dict. ``ortho_init``
    initialises the linear layers as usual; the norms begin as the identity. ``Dict`` observations get a
    ``CombinedExtractor``.
    """

    layer_norm = True


class CReLUPolicy(ActorCriticVariant):
    """
    SB3's ``MlpPolicy`` for PPO and A2C with :class:`CReLU` as activation: a layer of ``n`` units in ``net_arch`` has ``2 n``
    outputs, so every layer but the first has twice as many weights.

    :param args: Arguments of ``ActorCriticPolicy``
    :param kwargs: Keyword arguments of ``ActorCriticPolicy``
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"activation_fn": CReLU, **kwargs})


class FourierPolicy(ActorCriticVariant):
    """
    SB3's ``MlpPolicy`` for PPO and A2C with :class:`FourierFeatures` as activation: a layer of ``n`` units in ``net_arch`` has
    ``2 n`` outputs, as with :class:`CReLUPolicy`.

    :param args: Arguments of ``ActorCriticPolicy``
    :param kwargs: Keyword arguments of ``ActorCriticPolicy``
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"activation_fn": FourierFeatures, **kwargs})


class SpectralNormPolicy(ActorCriticVariant):
    """
    SB3's ``MlpPolicy`` for PPO and A2C whose hidden layers are divided by their greatest singular value, as
    :class:`SpectralNormLinear` describes. The output layers are not, so the outputs can grow; neither are those of a features
    extractor.

    In reinforcement learning: Gogianu et al. (ICML 2021), https://arxiv.org/abs/2105.05246; Bjorck et al. (NeurIPS 2021),
    https://arxiv.org/abs/2106.01151. They normalise some of the layers; here it is all hidden ones.

    All arguments are those of ``ActorCriticPolicy``, with the same defaults; ``net_arch`` is a list or a dict.
    """

    linear = SpectralNormLinear

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        settle_spectral_norms(self)  # for the weights of `ortho_init`


class DQNVariant(_Hidden, DQNPolicy):
    """SB3's ``MlpPolicy`` for DQN with other hidden layers."""

    def make_q_net(self) -> QNetwork:
        """
        :return: A Q-network
        """
        network = super().make_q_net()
        hidden, n_features = self._make_hidden(network.features_dim, network.net_arch)
        network.q_net = nn.Sequential(*hidden, nn.Linear(n_features, int(network.action_space.n)))
        return network.to(self.device)


class LayerNormDQNPolicy(DQNVariant):
    """
    SB3's ``MlpPolicy`` for DQN with a LayerNorm in each hidden layer, as in :class:`LayerNormPolicy`. All arguments are those
    of ``DQNPolicy``, with the same defaults.
    """

    layer_norm = True


class SpectralNormDQNPolicy(DQNVariant):
    """
    SB3's ``MlpPolicy`` for DQN with hidden layers of spectral norm 1, as in :class:`SpectralNormPolicy`. All arguments are
    those of ``DQNPolicy``, with the same defaults.
    """

    linear = SpectralNormLinear


class CReLUDQNPolicy(DQNVariant):
    """
    SB3's ``MlpPolicy`` for DQN with :class:`CReLU` as activation, as in :class:`CReLUPolicy`.

    :param args: Arguments of ``DQNPolicy``
    :param kwargs: Keyword arguments of ``DQNPolicy``
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"activation_fn": CReLU, **kwargs})


class FourierDQNPolicy(DQNVariant):
    """
    SB3's ``MlpPolicy`` for DQN with :class:`FourierFeatures` as activation, as in :class:`FourierPolicy`.

    :param args: Arguments of ``DQNPolicy``
    :param kwargs: Keyword arguments of ``DQNPolicy``
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"activation_fn": FourierFeatures, **kwargs})
