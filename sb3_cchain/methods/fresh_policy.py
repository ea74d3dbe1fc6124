"""Another draw of a model's initialisation."""

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy


def fresh_policy(model: BaseAlgorithm) -> BasePolicy:
    """
    The policy as it was made when training began, but from other random numbers: those that PyTorch draws next. It has the
    same kind of initialisation as the policy (orthogonal, Xavier, PyTorch's).

    :param model: A model
    :return: A policy of the same class and arguments, on the same device, with an optimiser of its own
    """
    # As SB3's `_setup_model()` makes it
    policy_kwargs = dict(model.policy_kwargs)
    if isinstance(model, OnPolicyAlgorithm) and model.use_sde:
        policy_kwargs["use_sde"] = True
    policy = model.policy_class(model.observation_space, model.action_space, model.lr_schedule, **policy_kwargs)
    return policy.to(model.device)


def require_policy_optimizer(callback: BaseCallback) -> None:
    """
    :param callback: A callback of a model
    :raises TypeError: When the model has several optimisers, as SAC and TD3 have
    """
    if not hasattr(callback.model.policy, "optimizer"):
        name, algorithm = type(callback).__name__, type(callback.model).__name__
        raise TypeError(f"{name} is for algorithms with a single optimiser (PPO, A2C, DQN), got {algorithm}")
