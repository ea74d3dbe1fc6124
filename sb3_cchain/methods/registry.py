"""
One row for each method that an experiment can run: C-CHAIN, the algorithms without it, and the related methods.

The command line, the search spaces, the benchmark, its report, its curves and its timings all read this table. To add a
method, add a row, its YAML file and its page; the tests say what is missing.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy

from sb3_cchain.algorithms import CChainA2C, CChainDDPG, CChainDQN, CChainPPO, CChainSAC, CChainTD3, DoubleDQN
from sb3_cchain.methods.adam_rel import AdamRel
from sb3_cchain.methods.continual_backprop import ContinualBackprop
from sb3_cchain.methods.ewc import EWC
from sb3_cchain.methods.ewc_consolidation import EWCConsolidation
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
from sb3_cchain.methods.plasticity_injection import PlasticityInjection
from sb3_cchain.methods.redo import ReDo
from sb3_cchain.methods.regrama import ReGraMa
from sb3_cchain.methods.self_normalized_resets import SelfNormalizedResets
from sb3_cchain.methods.shrink_and_perturb import ShrinkAndPerturb
from sb3_cchain.methods.spectral_regularization import SpectralRegularization
from sb3_cchain.methods.trac import TRAC
from sb3_cchain.methods.upgd import UPGD
from sb3_cchain.methods.weight_clipping import WeightClipping
from sb3_cchain.networks import (
    CReLU,
    CReLUPolicy,
    FourierFeatures,
    FourierPolicy,
    InjectionPolicy,
    LayerNormPolicy,
    SimBaPolicy,
    SpectralNormPolicy,
)


@dataclass(frozen=True)
class Strength:
    """
    The one number that says how strongly a method acts: what stands after ``@`` in ``l2_init@10``.

    :param argument: Its name: a hyperparameter, or an argument of the optimiser wrapper
    :param symbol: What papers call it
    :param paper_values: Those of which the paper reports the best in each environment of Gym Control and ProcGen
    """

    argument: str
    symbol: str
    paper_values: tuple[float, ...]


@dataclass(frozen=True)
class Method:
    """
    A method, as settings of an algorithm.

    :param name: Name of the method, the same for all algorithms: in the paper's tables, and of the folders of results
    :param algo: Name on the command line, and of the YAML file ``zoo_hyperparams/<algo>.yml``
    :param algorithm: Class of the algorithm
    :param label: Name in tables and legends
    :param color: Colour in plots, a name of matplotlib's
    :param page: Page of the documentation, without its suffix, below ``docs/``
    :param suites: Suites in which the paper compares it; none where the paper does not have it
    :param optimizer_class: Wrapper of the optimiser, where the method is one
    :param optimizer_kwargs: Those of its arguments that have no default
    :param callbacks: Callbacks of the method
    :param policy: Its policy for ``MlpPolicy``, where the method is a network
    :param policy_kwargs: Arguments of that policy
    :param grid: Values that ``-optimize`` searches, by argument of the optimiser wrapper or, where there is none, of the first
        of ``callbacks``
    :param strength: Its strength, where the paper takes the best of several
    """

    name: str
    algo: str
    algorithm: type[BaseAlgorithm]
    label: str
    color: str
    page: str
    suites: tuple[str, ...] = ()
    optimizer_class: type[OptimizerWrapper] | None = None
    optimizer_kwargs: Mapping[str, Any] = field(default_factory=dict)
    callbacks: tuple[type[BaseCallback], ...] = ()
    policy: str | type[BasePolicy] = "MlpPolicy"
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, Sequence[float]] = field(default_factory=dict)
    strength: Strength | None = None

    @property
    def in_paper(self) -> bool:
        """Whether the paper has it."""
        return bool(self.suites)

    @property
    def is_related(self) -> bool:
        """Whether it consists of settings of an algorithm, rather than being an algorithm."""
        return bool(self.optimizer_class or self.callbacks or self.policy != "MlpPolicy")


PPO_SUITES = ("gym_control", "procgen", "dmc")
OPTIMIZER_PAGE, PLASTICITY_PAGE, FAMILY_PAGE = "modules/optimizers", "modules/plasticity", "modules/family"

BETA = Strength("target_churn_ratio", "β", (1e3, 1e4, 1e5))
KAPPA = Strength("clip_ratio", "κ", (0.1, 0.5, 1.0, 10.0))
C = Strength("coef", "c", (0.1, 1.0, 10.0, 100.0, 1000.0))


def _family() -> Iterator[Method]:
    """The other algorithms of SB3 with churn reduction, and those of sb3-contrib where it is installed."""
    algorithms: dict[str, type[BaseAlgorithm]] = {
        "a2c": CChainA2C,
        "ddpg": CChainDDPG,
        "sac": CChainSAC,
        "td3": CChainTD3,
    }
    if find_spec("sb3_contrib") is not None:
        from sb3_cchain.algorithms import contrib

        algorithms |= {
            "crossq": contrib.CChainCrossQ,
            "ppo_lstm": contrib.CChainRecurrentPPO,
            "ppo_mask": contrib.CChainMaskablePPO,
            "qrdqn": contrib.CChainQRDQN,
            "tqc": contrib.CChainTQC,
            "trpo": contrib.CChainTRPO,
        }
    for name, algorithm in algorithms.items():
        label = f"C-CHAIN {algorithm.__name__.removeprefix('CChain')}"
        yield Method("cchain", f"{name}_cchain", algorithm, label, "tab:blue", FAMILY_PAGE, strength=BETA)


# In the order of the report's tables
REGISTRY = (
    Method("oracle", "ppo_oracle", PPO, "Oracle", "tab:brown", PLASTICITY_PAGE, PPO_SUITES, callbacks=(Oracle,)),
    Method(
        "oracle", "double_dqn_oracle", DoubleDQN, "Oracle", "tab:brown", PLASTICITY_PAGE, ("minatar",), callbacks=(Oracle,)
    ),
    Method("vanilla", "ppo", PPO, "PPO", "tab:gray", "modules/ppo_cchain", PPO_SUITES),
    Method("vanilla", "double_dqn", DoubleDQN, "Double DQN", "tab:gray", "modules/dqn_cchain", ("minatar",)),
    Method(
        *("trac", "ppo_trac", PPO, "TRAC", "tab:orange", OPTIMIZER_PAGE, ("gym_control", "procgen")),
        optimizer_class=TRAC,
        callbacks=(OptimizerMetrics,),
    ),
    Method(
        *("weight_clipping", "ppo_weight_clipping", PPO, "Weight clipping", "tab:green", OPTIMIZER_PAGE),
        suites=("gym_control", "procgen"),
        optimizer_class=WeightClipping,
        callbacks=(OptimizerMetrics,),
        grid={KAPPA.argument: KAPPA.paper_values},
        strength=KAPPA,
    ),
    Method(
        *("l2_init", "ppo_l2_init", PPO, "L2 Init", "tab:red", OPTIMIZER_PAGE, ("gym_control", "procgen")),
        optimizer_class=L2Init,
        callbacks=(OptimizerMetrics,),
        grid={C.argument: C.paper_values},
        strength=C,
    ),
    Method(
        *("layer_norm", "ppo_layer_norm", PPO, "LayerNorm", "tab:purple", PLASTICITY_PAGE, ("procgen",)),
        policy=LayerNormPolicy,
    ),
    Method(
        *("redo", "ppo_redo", PPO, "ReDo", "tab:pink", PLASTICITY_PAGE, ("procgen",)),
        callbacks=(ReDo,),
        # The paper has no grid. τ: dead units alone, the value of ReDo's DQN, and four times that. Interval in iterations:
        # Plasticine's, a tenth and ten times that
        grid={"tau": [0.0, 0.025, 0.1], "interval": [1, 10, 100]},
    ),
    Method(
        *("adam_rel", "ppo_adam_rel", PPO, "AdamRel", "tab:olive", OPTIMIZER_PAGE, ("procgen",)),
        callbacks=(AdamRel,),
    ),
    Method(
        *("parseval", "ppo_parseval", PPO, "Parseval", "tab:cyan", OPTIMIZER_PAGE),
        optimizer_class=Parseval,
        optimizer_kwargs={"n_output_layers": 2},
        callbacks=(OptimizerMetrics,),
        grid={"coef": [1e-5, 1e-4, 1e-3, 1e-2]},  # a decade around those of its code
    ),
    Method(
        *("shrink_and_perturb", "ppo_shrink_and_perturb", PPO, "Shrink and perturb", "darkkhaki", PLASTICITY_PAGE),
        callbacks=(ShrinkAndPerturb,),
        # After every update (Plasticine's), and the same shrinkage at once after a hundred
        grid={"shrink": [0.9999, 0.99999, 0.999999], "interval": [1, 100]},
    ),
    Method(
        *("crelu", "ppo_crelu", PPO, "CReLU", "teal", PLASTICITY_PAGE),
        policy=CReLUPolicy,
        policy_kwargs={"activation_fn": CReLU},
    ),
    Method(
        *("layer_reset", "ppo_layer_reset", PPO, "Layer reset", "indigo", PLASTICITY_PAGE),
        callbacks=(LayerReset,),
        # Of the four layers of the Gym Control networks. 20, 4 and 2 resets in a task
        grid={"n_layers": [1, 2, 4], "interval": [8_000, 40_000, 80_000]},
    ),
    Method(
        *("plasticity_injection", "ppo_plasticity_injection", PPO, "Plasticity injection", "gold", PLASTICITY_PAGE),
        callbacks=(PlasticityInjection,),
        policy=InjectionPolicy,
        grid={"timestep": [160_000, 320_000, 640_000]},  # the first switch of Gym Control's tasks, and later ones
    ),
    Method(
        *("normalize_and_project", "ppo_normalize_and_project", PPO, "Normalize and project", "yellowgreen", OPTIMIZER_PAGE),
        optimizer_class=NormalizeAndProject,
        optimizer_kwargs={"n_output_layers": 2},
        callbacks=(OptimizerMetrics,),
        policy=LayerNormPolicy,
    ),
    Method(
        *("fourier", "ppo_fourier", PPO, "Deep Fourier features", "crimson", PLASTICITY_PAGE),
        policy=FourierPolicy,
        policy_kwargs={"activation_fn": FourierFeatures},
    ),
    Method(
        *("continual_backprop", "ppo_continual_backprop", PPO, "Continual backprop", "olivedrab", PLASTICITY_PAGE),
        callbacks=(ContinualBackprop,),
        grid={"replacement_rate": [1e-5, 1e-4, 1e-3], "maturity_threshold": [1000, 10_000]},  # a decade around the paper's
    ),
    Method(
        *("regrama", "ppo_regrama", PPO, "ReGraMa", "darkorchid", PLASTICITY_PAGE),
        callbacks=(ReGraMa,),
        # τ: the paper's, units without any gradient, and ten times the paper's. Interval in iterations, as of ReDo
        grid={"tau": [0.0, 0.01, 0.1], "interval": [1, 10, 100]},
    ),
    Method(
        *("self_normalized_resets", "ppo_self_normalized_resets", PPO, "Self-normalized resets", "peru", PLASTICITY_PAGE),
        callbacks=(SelfNormalizedResets,),
        grid={"eta": [0.01, 0.02, 0.04, 0.08]},
    ),
    Method(
        *("fire", "ppo_fire", PPO, "FIRE", "orangered", PLASTICITY_PAGE),
        callbacks=(FIRE,),
        grid={"n_iterations": [5, 10]},
    ),
    Method(
        *("spectral_regularization", "ppo_spectral_regularization", PPO, "Spectral regularisation", "tomato", OPTIMIZER_PAGE),
        optimizer_class=SpectralRegularization,
        callbacks=(OptimizerMetrics,),
        grid={"coef": [1e-5, 1e-4, 1e-3, 1e-2], "power": [1, 2]},
    ),
    Method(
        *("ewc", "ppo_ewc", PPO, "EWC", "mediumseagreen", OPTIMIZER_PAGE),
        optimizer_class=EWC,
        callbacks=(EWCConsolidation, OptimizerMetrics),
        grid={"coef": [1.0, 100.0, 10_000.0], "decay": [0.5, 1.0]},
    ),
    Method(
        *("upgd", "ppo_upgd", PPO, "UPGD", "rebeccapurple", OPTIMIZER_PAGE),
        optimizer_class=UPGD,
        callbacks=(OptimizerMetrics,),
        grid={"sigma": [0.0, 0.001, 0.01], "beta": [0.99, 0.999]},
    ),
    Method(
        *("muon", "ppo_muon", PPO, "Muon", "deeppink", OPTIMIZER_PAGE),
        optimizer_class=Muon,
        optimizer_kwargs={"n_output_layers": 2},
        callbacks=(OptimizerMetrics,),
        grid={"lr_factor": [0.3, 1.0, 3.0]},
    ),
    Method(
        *("kron", "ppo_kron", PPO, "Kron", "steelblue", OPTIMIZER_PAGE),
        optimizer_class=Kron,
        grid={"update_probability": [0.03, 0.1, 1.0]},
    ),
    Method(
        *("spectral_norm", "ppo_spectral_norm", PPO, "Spectral normalisation", "slategray", PLASTICITY_PAGE),
        policy=SpectralNormPolicy,
    ),
    Method(
        *("simba", "ppo_simba", PPO, "SimBa", "chocolate", PLASTICITY_PAGE),
        policy=SimBaPolicy,
        policy_kwargs={"net_arch": {"pi": [128], "vf": [512, 512]}},
    ),
    Method("cchain", "ppo_cchain", CChainPPO, "C-CHAIN PPO", "tab:blue", "modules/ppo_cchain", PPO_SUITES, strength=BETA),
    Method("cchain", "dqn_cchain", CChainDQN, "C-CHAIN DQN", "tab:blue", "modules/dqn_cchain", ("minatar",), strength=BETA),
    *_family(),
)

METHOD_NAMES = tuple(dict.fromkeys(method.name for method in REGISTRY))
BY_ALGO = {method.algo: method for method in REGISTRY}
