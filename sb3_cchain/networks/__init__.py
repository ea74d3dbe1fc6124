"""Feature extractors, policies and activations, and how to read the networks of any Stable-Baselines3 model."""

from sb3_cchain.networks.activations import CReLU, FourierFeatures
from sb3_cchain.networks.extractors import ImpalaCNN, MinAtarCNN
from sb3_cchain.networks.impala_policy import ImpalaPolicy
from sb3_cchain.networks.injection_policies import InjectionDQNPolicy, InjectionPolicy
from sb3_cchain.networks.lean_distributions import make_lean
from sb3_cchain.networks.mlp_policies import (
    CReLUDQNPolicy,
    CReLUPolicy,
    FourierDQNPolicy,
    FourierPolicy,
    LayerNormDQNPolicy,
    LayerNormPolicy,
    SpectralNormDQNPolicy,
    SpectralNormPolicy,
)
from sb3_cchain.networks.simba import SimBaDQNPolicy, SimBaPolicy, SimBaSACPolicy
from sb3_cchain.networks.spectral_norm import SpectralNormLinear
from sb3_cchain.networks.transfer import Transferred, transfer

__all__ = [
    "CReLU",
    "CReLUDQNPolicy",
    "CReLUPolicy",
    "FourierDQNPolicy",
    "FourierFeatures",
    "FourierPolicy",
    "ImpalaCNN",
    "ImpalaPolicy",
    "InjectionDQNPolicy",
    "InjectionPolicy",
    "LayerNormDQNPolicy",
    "LayerNormPolicy",
    "MinAtarCNN",
    "SimBaDQNPolicy",
    "SimBaPolicy",
    "SimBaSACPolicy",
    "SpectralNormDQNPolicy",
    "SpectralNormLinear",
    "SpectralNormPolicy",
    "Transferred",
    "make_lean",
    "transfer",
]
