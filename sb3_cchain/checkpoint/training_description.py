"""What a training is, in words that can be compared: to name what differs when it is resumed."""

import inspect
from collections.abc import Mapping

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_cchain.checkpoint.environment_state import env_layers
from sb3_cchain.checkpoint.resumable_env import ResumableEnv, describe_single_environment
from sb3_cchain.checkpoint.value_description import describe_value

# Arguments that do not change what is learned, that are described by themselves, and that callbacks change
_WITHOUT_EFFECT = frozenset({"device", "verbose", "tensorboard_log", "monitor_wrapper", "_init_setup_model"})
_DESCRIBED_OTHERWISE = frozenset({"policy", "env"})
_CHANGED_BY_CALLBACKS = frozenset({"learning_starts"})
_OTHER_ARGUMENTS = _WITHOUT_EFFECT | _DESCRIBED_OTHERWISE | _CHANGED_BY_CALLBACKS


def constructor_arguments(kind: type) -> set[str]:
    """
    :param kind: A class
    :return: Names of the arguments of its constructor, and of those of the classes that it derives from
    """
    constructors = [vars(base)["__init__"] for base in kind.__mro__ if "__init__" in vars(base)]
    return {name for constructor in constructors for name in inspect.signature(constructor).parameters}


def describe_model(model: BaseAlgorithm) -> dict[str, str]:
    """
    :param model: A model
    :return: Its class and policy, and its hyperparameters as they are now; those that cannot be described are left out
    """
    names = constructor_arguments(type(model))
    texts = {"algorithm": type(model).__name__, "policy": type(model.policy).__name__}
    for name in sorted((names & vars(model).keys()) - _OTHER_ARGUMENTS):
        text = describe_value(vars(model)[name], with_schedules=True)
        if text is not None:
            texts[name] = text
    return texts


def describe_env(env: VecEnv) -> dict[str, str]:
    """
    :param env: A vectorised environment
    :return: What it is made of, and its spaces
    """
    *wrappers, layer = env_layers(env)
    if isinstance(layer, DummyVecEnv):
        name = describe_single_environment(layer.envs[0])
    elif isinstance(layer, SubprocVecEnv) and all(env.env_is_wrapped(ResumableEnv)):
        name = env.env_method("description", indices=0)[0]
    else:  # not made of single environments, or out of reach
        name = type(layer).__name__
    return {
        "environment": name,
        "number of environments": str(env.num_envs),
        "observation space": str(env.observation_space),
        "action space": str(env.action_space),
        "vectorised wrappers": ", ".join(type(wrapper).__name__ for wrapper in wrappers) or "none",
    }


def describe_callbacks(callbacks: Mapping[str, BaseCallback]) -> dict[str, str]:
    """
    :param callbacks: All callbacks of ``learn()`` by names
    :return: Their classes
    """
    return {name: type(callback).__name__ for name, callback in callbacks.items()}


def check_same(saved: Mapping[str, str], present: Mapping[str, str], advice: str) -> None:
    """
    :param saved: A description of the training that was saved
    :param present: The same of the training that is to go on
    :param advice: What to do when they differ
    :raises ValueError: Naming all that differs
    """
    differences = [
        f"{name} was {saved.get(name, 'absent')} and is {present.get(name, 'absent')}"
        for name in sorted({*saved, *present})
        if saved.get(name) != present.get(name)
    ]
    if differences:
        raise ValueError(f"The training that was saved differs from this one: {'; '.join(differences)}. {advice}")
