"""What to try against a finding: settings of Stable-Baselines3, and the methods of this package, as lines of code."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn

from sb3_cchain.networks import CReLU
from sb3_cchain.networks.algorithm_kinds import is_recurrent
from sb3_cchain.networks.model_optimizers import model_optimizers

# By the names of the classes, as sb3-contrib need not be installed. A subclass of one of them counts as that one
PLAIN_ON_POLICY = ("PPO", "A2C")
PPO_LIKE = ("PPO", "MaskablePPO", "RecurrentPPO")
WITH_ENTROPY_BONUS = (*PPO_LIKE, "A2C")
ON_POLICY = (*WITH_ENTROPY_BONUS, "TRPO")
Q_LEARNING = ("DQN", "QRDQN")
WITH_ACTION_NOISE = ("TD3", "DDPG")
ENTROPY_TUNING = ("SAC", "TQC", "CrossQ")
ALL = (*ON_POLICY, *Q_LEARNING, *WITH_ACTION_NOISE, *ENTROPY_TUNING)


def _always(model: Any) -> bool:
    return True


def _can_be_normalized(model: Any) -> bool:
    space = model.observation_space
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return model.get_vec_normalize_env() is None and all(isinstance(part, spaces.Box) for part in parts)


def _has_no_churn_reduction(model: Any) -> bool:
    return not hasattr(model, "churn_state")


def _has_no_double_q(model: Any) -> bool:
    return not getattr(model, "double_q", False)


def _has_no_layer(kind: type[nn.Module]) -> Callable[[Any], bool]:
    return lambda model: not any(isinstance(module, kind) for module in model.policy.modules())


def _has_no_optimizer(name: str) -> Callable[[Any], bool]:
    return lambda model: name not in _names_of_optimizers(model)


def _names_of_optimizers(model: Any) -> set[str]:
    """With those inside of others."""
    names = set()
    for optimizer in model_optimizers(model).values():
        inner: Any = optimizer
        while inner is not None:
            names.add(type(inner).__name__)
            inner = getattr(inner, "base", None)
    return names


def _has_units_that_saturate(model: Any) -> bool:
    return any(isinstance(module, (nn.Tanh, nn.Sigmoid)) for module in model.policy.modules())


def _has_large_rate(model: Any) -> bool:
    return model.lr_schedule(1.0) > 1e-4


def _has_small_entropy_bonus(model: Any) -> bool:
    return model.ent_coef < 0.01


def _has_fixed_entropy_coefficient(model: Any) -> bool:
    return not isinstance(model.ent_coef, str)


def _has_small_epsilon(model: Any) -> bool:
    return model.exploration_final_eps < 0.05


def _has_small_value_coefficient(model: Any) -> bool:
    return model.vf_coef < 0.5


def _has_fast_target(model: Any) -> bool:
    return model.tau > 0.005


@dataclass(frozen=True)
class Remedy:
    """
    Something to try.

    :param title: What it is, to follow the word "Try"
    :param line: Code to write, with ``{algorithm}`` and ``{policy}`` for the names of the model's. It uses ``env``, ``model``
        and ``total_timesteps``
    :param algorithms: Names of the classes of the algorithms that it is for
    :param method: Name of the method in the registry of methods, where it is one of those
    :param is_new: Whether it would change anything in a model
    """

    title: str
    line: str
    algorithms: tuple[str, ...] = ALL
    method: str | None = None
    is_new: Callable[[Any], bool] = _always

    def is_for(self, model: BaseAlgorithm) -> bool:
        """
        :param model: A model
        :return: Whether it can be tried with the model's algorithm, and would change anything
        """
        return any(base.__name__ in self.algorithms for base in type(model).__mro__) and self.is_new(model)

    def line_for(self, model: BaseAlgorithm) -> str:
        """
        :param model: A model that it is for
        :return: The code
        """
        return self.line.format(algorithm=type(model).__name__, policy=policy_alias(model))


def policy_alias(model: BaseAlgorithm) -> str:
    """
    :param model: A model
    :return: What SB3 calls the standard policy for its observations, such as ``MlpPolicy``
    """
    space = model.observation_space
    kind = "MultiInput" if isinstance(space, spaces.Dict) else "Cnn" if is_image_space(space) else "Mlp"
    return f"{kind}{'Lstm' if is_recurrent(model) else ''}Policy"


_OPTIMIZER = (
    "from sb3_cchain.methods import {name}\n"
    'model = {{algorithm}}("{{policy}}", env, policy_kwargs=dict(optimizer_class={name}{arguments}))'
)


def _optimizer(name: str, arguments: str = "") -> str:
    return _OPTIMIZER.format(name=name, arguments=f", optimizer_kwargs=dict({arguments})" if arguments else "")


def _callback(name: str, arguments: str = "", package: str = "sb3_cchain.methods") -> str:
    return f"from {package} import {name}\nmodel.learn(total_timesteps, callback={name}({arguments}))"


def _setting(arguments: str) -> str:
    return f'model = {{algorithm}}("{{policy}}", env, {arguments})'


SMALLER_RATE = Remedy("a smaller learning rate", _setting("learning_rate=1e-4"), is_new=_has_large_rate)
TARGET_KL = Remedy("a limit on the size of updates", _setting("target_kl=0.02"), PPO_LIKE)
NORMALIZE = Remedy(
    "normalised observations and rewards",
    'from stable_baselines3.common.vec_env import VecNormalize\nmodel = {algorithm}("{policy}", VecNormalize(model.env))',
    is_new=_can_be_normalized,
)
ENTROPY_BONUS = Remedy("an entropy bonus", _setting("ent_coef=0.01"), WITH_ENTROPY_BONUS, is_new=_has_small_entropy_bonus)
ENTROPY_TARGET = Remedy(
    *("an entropy coefficient that adapts", _setting('ent_coef="auto"'), ENTROPY_TUNING),
    is_new=_has_fixed_entropy_coefficient,
)
EPSILON = Remedy("random actions now and then", _setting("exploration_final_eps=0.05"), Q_LEARNING, is_new=_has_small_epsilon)
ACTION_NOISE = Remedy(
    "noise on the actions",
    "import numpy as np\n"
    "from stable_baselines3.common.noise import NormalActionNoise\n"
    "size = model.action_space.shape\n"
    'model = {algorithm}("{policy}", env, action_noise=NormalActionNoise(np.zeros(size), np.full(size, 0.1)))',
    WITH_ACTION_NOISE,
)
LONGER_HORIZON = Remedy("a discount factor as usual", _setting("gamma=0.99"))
RELU = Remedy(
    "ReLU as the activation",
    'from torch import nn\nmodel = {algorithm}("{policy}", env, policy_kwargs=dict(activation_fn=nn.ReLU))',
    is_new=_has_units_that_saturate,
)
VALUE_COEF = Remedy(
    "SB3's weight of the value loss", _setting("vf_coef=0.5"), WITH_ENTROPY_BONUS, is_new=_has_small_value_coefficient
)
SLOW_TARGET = Remedy(
    "a slower target network", _setting("tau=0.005"), (*WITH_ACTION_NOISE, "SAC", "TQC"), is_new=_has_fast_target
)
REDO = Remedy(
    "ReDo, which draws the weights of dormant units again", _callback("ReDo"), (*PLAIN_ON_POLICY, "DQN"), method="redo"
)
SHRINK = Remedy(
    "shrink and perturb",
    _callback("ShrinkAndPerturb", "shrink=0.9999, interval=100"),
    (*PLAIN_ON_POLICY, "DQN"),
    method="shrink_and_perturb",
)
LAYER_RESET = Remedy(
    "output layers that are initialised again",
    _callback("LayerReset", "n_layers=1, interval=40_000"),
    (*PLAIN_ON_POLICY, "DQN"),
    method="layer_reset",
)
FIRE = Remedy(
    "FIRE, which makes the weights orthogonal", _callback("FIRE", "interval=40_000"), (*PLAIN_ON_POLICY, "DQN"), method="fire"
)
CCHAIN = Remedy(
    *("churn reduction", _callback("CChainCallback", package="sb3_cchain")),
    method="cchain",
    is_new=_has_no_churn_reduction,
)
LAYER_NORM = Remedy(
    "LayerNorm",
    "from sb3_cchain.networks import LayerNormPolicy\nmodel = {algorithm}(LayerNormPolicy, env)",
    PLAIN_ON_POLICY,
    method="layer_norm",
    is_new=_has_no_layer(nn.LayerNorm),
)
LAYER_NORM_DQN = Remedy(
    "LayerNorm",
    "from sb3_cchain.networks import LayerNormDQNPolicy\nmodel = {algorithm}(LayerNormDQNPolicy, env)",
    ("DQN",),
    method="layer_norm",
    is_new=_has_no_layer(nn.LayerNorm),
)
CRELU = Remedy(
    "CReLU, which has no dead units",
    "from sb3_cchain.networks import CReLUPolicy\nmodel = {algorithm}(CReLUPolicy, env)",
    PLAIN_ON_POLICY,
    method="crelu",
    is_new=_has_no_layer(CReLU),
)
CLIPPING = Remedy(
    *("weight clipping", _optimizer("WeightClipping")),
    method="weight_clipping",
    is_new=_has_no_optimizer("WeightClipping"),
)
L2_INIT = Remedy("L2 Init", _optimizer("L2Init", "coef=1e-3"), method="l2_init", is_new=_has_no_optimizer("L2Init"))
DOUBLE_DQN = Remedy(
    "Double Q-learning",
    'from sb3_cchain import DoubleDQN\nmodel = DoubleDQN("{policy}", env)',
    ("DQN",),
    method="vanilla",
    is_new=_has_no_double_q,
)
