"""The methods that C-CHAIN is compared with, as parts for any Stable-Baselines3 algorithm; the table of all methods."""

from sb3_cchain.methods.adam_rel import AdamRel
from sb3_cchain.methods.churn_reducers import forget_references
from sb3_cchain.methods.continual_backprop import ContinualBackprop
from sb3_cchain.methods.ewc import EWC
from sb3_cchain.methods.ewc_consolidation import EWCConsolidation
from sb3_cchain.methods.exploration import EntropyBonusRestart, ExplorationRateRestart, LogStdRestart
from sb3_cchain.methods.fire import FIRE
from sb3_cchain.methods.kron import Kron
from sb3_cchain.methods.l2_init import L2Init
from sb3_cchain.methods.layer_reset import LayerReset
from sb3_cchain.methods.muon import Muon
from sb3_cchain.methods.normalize_and_project import NormalizeAndProject
from sb3_cchain.methods.optimizer_metrics import OptimizerMetrics
from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.methods.oracle import Oracle
from sb3_cchain.methods.parseval import Parseval
from sb3_cchain.methods.penalty import Penalty
from sb3_cchain.methods.plasticity_injection import PlasticityInjection
from sb3_cchain.methods.redo import ReDo
from sb3_cchain.methods.regrama import ReGraMa
from sb3_cchain.methods.self_normalized_resets import SelfNormalizedResets
from sb3_cchain.methods.shrink_and_perturb import ShrinkAndPerturb
from sb3_cchain.methods.spectral_regularization import SpectralRegularization
from sb3_cchain.methods.trac import TRAC
from sb3_cchain.methods.upgd import UPGD
from sb3_cchain.methods.weight_clipping import WeightClipping

__all__ = [
    "EWC",
    "FIRE",
    "TRAC",
    "UPGD",
    "AdamRel",
    "ContinualBackprop",
    "EWCConsolidation",
    "EntropyBonusRestart",
    "ExplorationRateRestart",
    "Kron",
    "L2Init",
    "LayerReset",
    "LogStdRestart",
    "Muon",
    "NormalizeAndProject",
    "OptimizerMetrics",
    "OptimizerWrapper",
    "Oracle",
    "Parseval",
    "Penalty",
    "PlasticityInjection",
    "ReDo",
    "ReGraMa",
    "SelfNormalizedResets",
    "ShrinkAndPerturb",
    "SpectralRegularization",
    "WeightClipping",
    "forget_references",
]
