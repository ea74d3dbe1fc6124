"""Tiny models of all algorithms that the baselines plug into."""

from functools import partial

from stable_baselines3 import DQN, PPO
from stable_baselines3.common.utils import set_random_seed

from sb3_cchain import CChainDQN, CChainPPO, ContinualEnv, DoubleDQN
from tests.envs import CountEnv, RandomEnv

STEPS_PER_TASK = 32
ON_POLICY = dict(n_steps=16, batch_size=8, n_epochs=2, policy_kwargs=dict(net_arch=[8]))
OFF_POLICY = dict(learning_starts=8, buffer_size=100, batch_size=8, train_freq=1, policy_kwargs=dict(net_arch=[8]))
ALGORITHMS = {
    "PPO": partial(PPO, **ON_POLICY),
    "CChainPPO": partial(CChainPPO, **ON_POLICY),
    "DQN": partial(DQN, **OFF_POLICY),
    "DoubleDQN": partial(DoubleDQN, **OFF_POLICY),
    "CChainDQN": partial(CChainDQN, **OFF_POLICY),
}


def make_env(n_tasks=3, steps_per_task=STEPS_PER_TASK):
    return ContinualEnv([partial(CountEnv, name=task) for task in range(n_tasks)], steps_per_task)


def make_model(name, env=None, policy="MlpPolicy", **kwargs):
    return ALGORITHMS[name](policy, env or make_env(), **{"seed": 0, "device": "cpu", **kwargs})


def make_random_env():
    return RandomEnv()


def parameters(model):
    return {name: parameter.detach().clone() for name, parameter in model.policy.named_parameters()}


def go_on(model, callback):
    """From the same random numbers and the same first observation."""
    set_random_seed(7)
    model.env.seed(7)
    model.action_space.seed(7)
    model._last_obs = None
    return model.learn(32, callback=callback, reset_num_timesteps=False)
