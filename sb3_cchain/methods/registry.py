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


def _optimizer(name: str, label: str, color: str, optimizer_class: type[OptimizerWrapper], **fields: Any) -> Method:
    """PPO with a wrapper around its optimiser."""
    fields = {"page": OPTIMIZER_PAGE, "callbacks": (OptimizerMetrics,), **fields}
    return Method(name, f"ppo_{name}", PPO, label, color, optimizer_class=optimizer_class, **fields)


def _callback(name: str, label: str, color: str, callback: type[BaseCallback], **fields: Any) -> Method:
    """PPO with a callback."""
    return Method(name, f"ppo_{name}", PPO, label, color, callbacks=(callback,), **{"page": PLASTICITY_PAGE, **fields})


def _network(name: str, label: str, color: str, policy: type[BasePolicy], **fields: Any) -> Method:
    """PPO with a network of another kind."""
    return Method(name, f"ppo_{name}", PPO, label, color, PLASTICITY_PAGE, policy=policy, **fields)


# In the order of the report's tables
REGISTRY = (
    _callback("oracle", "Oracle", "tab:brown", Oracle, suites=PPO_SUITES),
    Method(
        "oracle", "double_dqn_oracle", DoubleDQN, "Oracle", "tab:brown", PLASTICITY_PAGE, ("minatar",), callbacks=(Oracle,)
    ),
    Method("vanilla", "ppo", PPO, "PPO", "tab:gray", "modules/ppo_cchain", PPO_SUITES),
    Method("vanilla", "double_dqn", DoubleDQN, "Double DQN", "tab:gray", "modules/dqn_cchain", ("minatar",)),
    _optimizer("trac", "TRAC", "tab:orange", TRAC, suites=("gym_control", "procgen")),
    _optimizer(
        "weight_clipping",
        "Weight clipping",
        "tab:green",
        WeightClipping,
        suites=("gym_control", "procgen"),
        grid={KAPPA.argument: KAPPA.paper_values},
        strength=KAPPA,
    ),
    _optimizer(
        "l2_init",
        "L2 Init",
        "tab:red",
        L2Init,
        suites=("gym_control", "procgen"),
        grid={C.argument: C.paper_values},
        strength=C,
    ),
    _network("layer_norm", "LayerNorm", "tab:purple", LayerNormPolicy, suites=("procgen",)),
    _callback(
        "redo",
        "ReDo",
        "tab:pink",
        ReDo,
        suites=("procgen",),
        # The paper has no grid. τ: dead units alone, the value of ReDo's DQN, and four times that. Interval in iterations:
        # Plasticine's, a tenth and ten times that
        grid={"tau": [0.0, 0.025, 0.1], "interval": [1, 10, 100]},
    ),
    _callback("adam_rel", "AdamRel", "tab:olive", AdamRel, page=OPTIMIZER_PAGE, suites=("procgen",)),
    _optimizer(
        "parseval",
        "Parseval",
        "tab:cyan",
        Parseval,
        optimizer_kwargs={"n_output_layers": 2},
        grid={"coef": [1e-5, 1e-4, 1e-3, 1e-2]},  # a decade around those of its code
    ),
    _callback(
        "shrink_and_perturb",
        "Shrink and perturb",
        "darkkhaki",
        ShrinkAndPerturb,
        # After every update (Plasticine's), and the same shrinkage at once after a hundred
        grid={"shrink": [0.9999, 0.99999, 0.999999], "interval": [1, 100]},
    ),
    _network("crelu", "CReLU", "teal", CReLUPolicy, policy_kwargs={"activation_fn": CReLU}),
    _callback(
        "layer_reset",
        "Layer reset",
        "indigo",
        LayerReset,
        # Of the four layers of the Gym Control networks. 20, 4 and 2 resets in a task
        grid={"n_layers": [1, 2, 4], "interval": [8_000, 40_000, 80_000]},
    ),
    _callback(
        "plasticity_injection",
        "Plasticity injection",
        "gold",
        PlasticityInjection,
        policy=InjectionPolicy,
        grid={"timestep": [160_000, 320_000, 640_000]},  # the first switch of Gym Control's tasks, and later ones
    ),
    _optimizer(
        "normalize_and_project",
        "Normalize and project",
        "yellowgreen",
        NormalizeAndProject,
        optimizer_kwargs={"n_output_layers": 2},
        policy=LayerNormPolicy,
    ),
    _network("fourier", "Deep Fourier features", "blue", FourierPolicy, policy_kwargs={"activation_fn": FourierFeatures}),
    _callback(
        "continual_backprop",
        "Continual backprop",
        "olivedrab",
        ContinualBackprop,
        grid={"replacement_rate": [1e-5, 1e-4, 1e-3], "maturity_threshold": [1000, 10_000]},  # a decade around the paper's
    ),
    _callback(
        "regrama",
        "ReGraMa",
        "darkorchid",
        ReGraMa,
        # τ: the paper's, units without any gradient, and ten times the paper's. Interval in iterations, as of ReDo
        grid={"tau": [0.0, 0.01, 0.1], "interval": [1, 10, 100]},
    ),
    _callback(
        "self_normalized_resets",
        "Self-normalized resets",
        "peru",
        SelfNormalizedResets,
        grid={"eta": [0.01, 0.02, 0.04, 0.08]},
    ),
    _callback("fire", "FIRE", "orangered", FIRE, grid={"n_iterations": [5, 10]}),
    _optimizer(
        "spectral_regularization",
        "Spectral regularisation",
        "tomato",
        SpectralRegularization,
        grid={"coef": [1e-5, 1e-4, 1e-3, 1e-2], "power": [1, 2]},
    ),
    _optimizer(
        "ewc",
        "EWC",
        "mediumseagreen",
        EWC,
        callbacks=(EWCConsolidation, OptimizerMetrics),
        grid={"coef": [1.0, 100.0, 10_000.0], "decay": [0.5, 1.0]},
    ),
    _optimizer("upgd", "UPGD", "rebeccapurple", UPGD, grid={"sigma": [0.0, 0.001, 0.01], "beta": [0.99, 0.999]}),
    _optimizer("muon", "Muon", "deeppink", Muon, optimizer_kwargs={"n_output_layers": 2}, grid={"lr_factor": [0.3, 1.0, 3.0]}),
    _optimizer("kron", "Kron", "springgreen", Kron, callbacks=(), grid={"update_probability": [0.03, 0.1, 1.0]}),
    _network("spectral_norm", "Spectral normalisation", "black", SpectralNormPolicy),
    _network("simba", "SimBa", "chocolate", SimBaPolicy, policy_kwargs={"net_arch": {"pi": [128], "vf": [512, 512]}}),
    Method("cchain", "ppo_cchain", CChainPPO, "C-CHAIN PPO", "tab:blue", "modules/ppo_cchain", PPO_SUITES, strength=BETA),
    Method("cchain", "dqn_cchain", CChainDQN, "C-CHAIN DQN", "tab:blue", "modules/dqn_cchain", ("minatar",), strength=BETA),
    *_family(),
)

METHOD_NAMES = tuple(dict.fromkeys(method.name for method in REGISTRY))
BY_ALGO = {method.algo: method for method in REGISTRY}
