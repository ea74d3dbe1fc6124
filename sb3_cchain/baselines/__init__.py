"""The methods that C-CHAIN is compared with, as parts for any Stable-Baselines3 algorithm."""

from sb3_cchain.baselines.adam_rel import AdamRel
from sb3_cchain.baselines.l2_init import L2Init
from sb3_cchain.baselines.mlp_policies import CReLUDQNPolicy, CReLUPolicy, LayerNormDQNPolicy, LayerNormPolicy
from sb3_cchain.baselines.optimizer_metrics import OptimizerMetrics
from sb3_cchain.baselines.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.baselines.oracle import Oracle
from sb3_cchain.baselines.parseval import Parseval
from sb3_cchain.baselines.penalty import Penalty
from sb3_cchain.baselines.redo import ReDo
from sb3_cchain.baselines.shrink_and_perturb import ShrinkAndPerturb
from sb3_cchain.baselines.trac import TRAC
from sb3_cchain.baselines.weight_clipping import WeightClipping
from sb3_cchain.common.activations import CReLU

__all__ = [
    "TRAC",
    "AdamRel",
    "CReLU",
    "CReLUDQNPolicy",
    "CReLUPolicy",
    "L2Init",
    "LayerNormDQNPolicy",
    "LayerNormPolicy",
    "OptimizerMetrics",
    "OptimizerWrapper",
    "Oracle",
    "Parseval",
    "Penalty",
    "ReDo",
    "ShrinkAndPerturb",
    "WeightClipping",
]
