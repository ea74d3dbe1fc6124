"""Takes what a model has learned to an environment whose spaces are others."""

from copy import deepcopy
from typing import NamedTuple

from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import nn

from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.injection_policies import Injectable
from sb3_cchain.validation import check_bool

# Attributes that callbacks keep with a model: the state of churn reduction, the parameters that training began with, and the
# fixed batch of ChurnMonitor
OF_FORMER_NETWORKS = ("churn_state", "initial_parameters", "churn_monitor_batch")


class Transferred(NamedTuple):
    """
    What became of the parameters and running statistics of a policy, by their names in its ``state_dict()``.

    :param kept: Those that are as they were
    :param new: Those that were drawn anew
    """

    kept: list[str]
    new: list[str]


def transfer(model: BaseAlgorithm, env: GymEnv | str, new_heads: bool = True) -> Transferred:
    """
    Train a model on in an environment with other observations or actions, from the same trunk: ``set_env()`` for spaces that
    differ. Call it between two calls of ``learn()``, the second with ``reset_num_timesteps=False``; that is a switch of task,
    as after ``set_env()``.

    Layers whose shape stays are kept, with the optimiser's state of their parameters (Adam's moments and step counts). All
    others are drawn anew, as a whole: a layer whose weights do not fit gets a new bias, too. Those are the first layers, if
    the observations differ, and the heads: the last layers, of actions, values and action values, and the standard deviation
    of continuous actions. In DQN the same goes for the target network.

    The model stays the same object. Its counters and schedules go on. Buffers are new and empty: DQN trains on few
    transitions at first. C-CHAIN starts over, with λ's history and its reference batch, and so does what optimiser wrappers
    remember beside their base's state. A policy that was compiled is not any more. If the model has a seed, the new layers,
    the actions and the environment are seeded with it plus the steps made so far.

    :param model: A model of PPO, A2C or DQN, or of a class that derives from them
    :param env: The environment to train in next (if registered in Gym, can be str)
    :param new_heads: Whether the heads are drawn anew even where they fit
    :return: The names of what was kept and of what is new
    :raises TypeError: For a model of another algorithm, and for a policy that plasticity can be injected into
    :raises ValueError: When the model cannot act in the environment, or no layer between its observations and the heads can be
        kept. The model is then as it was
    """
    if not isinstance(model, (PPO, A2C, DQN)):
        raise TypeError(f"`model` must be of PPO, A2C, DQN or a class that derives from them, got {type(model).__name__}")
    if any(isinstance(module, Injectable) for module in model.policy.modules()):
        raise TypeError(f"transfer() does not know heads for plasticity injection, got {type(model.policy).__name__}")
    check_bool("new_heads", new_heads)
    env = model._wrap_env(maybe_make_env(env, model.verbose), model.verbose)
    _check_spaces(model, env)
    old_policy = uncompiled(model.policy)
    before = dict(vars(model))
    try:
        _make_policy(model, env)
        kept, new = _compare(old_policy, model.policy, new_heads)
    except Exception:
        vars(model).clear()
        vars(model).update(before)
        raise
    _copy_state(old_policy, model.policy, kept)
    return Transferred(kept, new)


def _check_spaces(model: BaseAlgorithm, env: VecEnv) -> None:
    name, actions = type(model).__name__, env.action_space
    kinds = (
        (spaces.Discrete,)
        if isinstance(model, DQN)
        else (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    )
    if not isinstance(actions, kinds):
        raise ValueError(f"{name} needs actions that are {' or '.join(kind.__name__ for kind in kinds)}, `env` has {actions}")
    if isinstance(actions, spaces.Box) and not actions.is_bounded():
        raise ValueError(f"{name} needs bounded actions, `env` has {actions}")
    if getattr(model, "use_sde", False) and not isinstance(actions, spaces.Box):
        raise ValueError(f"{name} was made with `use_sde=True`, which needs Box actions, `env` has {actions}")
    if isinstance(env.observation_space, spaces.Dict) != isinstance(model.observation_space, spaces.Dict):
        raise ValueError(
            f"The policy is for observations like {model.observation_space}; `env` has {env.observation_space}. A policy is "
            "either for a Dict or for a single array"
        )


def _make_policy(model: BaseAlgorithm, env: VecEnv) -> None:
    """Give the model the environment, and buffers and a policy for it."""
    model.env = env
    model.observation_space, model.action_space, model.n_envs = env.observation_space, env.action_space, env.num_envs
    model._vec_normalize_env = unwrap_vec_normalize(env)
    model._last_obs = None  # the environment is reset before training
    for name in OF_FORMER_NETWORKS:
        vars(model).pop(name, None)
    if isinstance(model, DQN):
        model.replay_buffer = None
        if model.replay_buffer_class is NStepReplayBuffer:
            model.replay_buffer_class = None  # SB3 takes it for a class of the user's
    seed = model.seed
    if seed is not None:
        model.seed = seed + model.num_timesteps
    try:
        model._setup_model()
    except (AssertionError, TypeError, ValueError) as error:
        raise ValueError(
            f"{model.policy_class.__name__} cannot be made for the observations {env.observation_space} and the actions "
            f"{env.action_space} of `env`: {error}"
        ) from error
    finally:
        model.seed = seed


def _compare(old: BasePolicy, new: BasePolicy, new_heads: bool) -> tuple[list[str], list[str]]:
    """The names of what can be kept and of what is new."""
    old_shapes, new_shapes = ({name: value.shape for name, value in one.state_dict().items()} for one in (old, new))
    layers: dict[str, list[str]] = {}
    for name in new_shapes:
        layers.setdefault(_layer_of(name), []).append(name)
    heads = _heads(new)
    fits = {layer for layer, names in layers.items() if all(old_shapes.get(name) == new_shapes[name] for name in names)}
    if not fits - heads:
        pairs = [
            f"{name} {tuple(old_shapes[name])} and {tuple(shape)}" if name in old_shapes else f"{name}, which there was not"
            for name, shape in new_shapes.items()
            if _layer_of(name) not in heads | fits
        ]
        raise ValueError(f"No layer before the heads can be kept. What does not fit, as it is and as `env` needs it: {pairs}")
    kept_layers = fits - heads if new_heads else fits
    kept = [name for name in new_shapes if _layer_of(name) in kept_layers]
    return kept, [name for name in new_shapes if _layer_of(name) not in kept_layers]


def _layer_of(name: str) -> str:
    # A parameter of the policy itself, such as the standard deviation, is a layer of its own
    return name.rpartition(".")[0] or name


def _heads(policy: BasePolicy) -> set[str]:
    """Names of the last layers."""
    names = {"action_net", "value_net", "log_std"}
    for network in ("q_net", "q_net_target"):
        if hasattr(policy, network):
            last = [name for name, layer in getattr(policy, network).named_modules() if isinstance(layer, nn.Linear)][-1]
            names.add(f"{network}.{last}")
    return names


def _copy_state(old: BasePolicy, new: BasePolicy, kept: list[str]) -> None:
    """Copy what is kept, with the optimiser's state."""
    values = old.state_dict()
    new.load_state_dict({**new.state_dict(), **{name: values[name] for name in kept}})
    old_parameters, new_parameters = dict(old.named_parameters()), dict(new.named_parameters())
    for name in set(kept) & new_parameters.keys():
        state = old.optimizer.state.get(old_parameters[name])
        if state:
            new.optimizer.state[new_parameters[name]] = deepcopy(state)
