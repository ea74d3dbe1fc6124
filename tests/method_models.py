"""Tiny models of all algorithms, and of the methods of the registry."""

from functools import partial

from stable_baselines3 import DQN, PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

from sb3_cchain import CChainDQN, CChainPPO, ContinualEnv, TaskSync
from sb3_cchain.methods.registry import FAMILY_PAGE, REGISTRY
from tests.envs import CountEnv, RandomEnv

STEPS_PER_TASK = 32
ON_POLICY = dict(n_steps=16, batch_size=8, n_epochs=2, policy_kwargs=dict(net_arch=[8]))
OFF_POLICY = dict(learning_starts=8, buffer_size=100, batch_size=8, train_freq=1, policy_kwargs=dict(net_arch=[8]))
ALGORITHMS = {
    algorithm.__name__: partial(algorithm, **(ON_POLICY if issubclass(algorithm, OnPolicyAlgorithm) else OFF_POLICY))
    for algorithm in dict.fromkeys(
        [PPO, CChainPPO, DQN, *(method.algorithm for method in REGISTRY if method.page != FAMILY_PAGE)]
    )
}

# Arguments with which methods do something in a few updates of a tiny network. Others are tested with their defaults.
OPTIMIZER_ARGUMENTS = {
    "TRAC": dict(s_init=0.1),
    "WeightClipping": dict(clip_ratio=0.5),
    "L2Init": dict(coef=0.1, base_kwargs=dict(fused=True)),
    "Parseval": dict(coef=0.1),
    "SpectralRegularization": dict(coef=0.1),
    "UPGD": dict(sigma=0.1),
}
CALLBACK_ARGUMENTS = {
    "ContinualBackprop": dict(replacement_rate=0.1, maturity_threshold=2),
    "ReDo": dict(tau=0.3, interval=1),
    "ReGraMa": dict(tau=0.5, interval=1),
    "SelfNormalizedResets": dict(max_threshold=2, update_interval=2, interval=1),
    "FIRE": dict(interval=16),
    "LayerReset": dict(n_layers=1, interval=16),
    "PlasticityInjection": dict(timestep=16),
    "ShrinkAndPerturb": dict(shrink=0.999, interval=2),
}
# Those that go around others. tests/test_kron.py tests the other one
OPTIMIZERS = {m.name: m for m in REGISTRY if m.optimizer_class is not None and m.optimizer_class.has_arguments_of_base}
CALLBACKS = list(dict.fromkeys(cls for m in REGISTRY if m.optimizer_class is None for cls in m.callbacks))


def make_env(n_tasks=3, steps_per_task=STEPS_PER_TASK):
    return ContinualEnv([partial(CountEnv, name=task) for task in range(n_tasks)], steps_per_task)


def make_model(name, env=None, policy="MlpPolicy", **kwargs):
    return ALGORITHMS[name](policy, env or make_env(), **{"seed": 0, "device": "cpu", **kwargs})


def make_random_env():
    return RandomEnv()


def parameters(model):
    return {name: parameter.detach().clone() for name, parameter in model.policy.named_parameters()}


def go_on(model, callback=None, n_steps=32):
    """From the same random numbers and the same first observation."""
    set_random_seed(7)
    model.env.seed(7)
    model.action_space.seed(7)
    model._last_obs = None
    return model.learn(n_steps, callback=callback, reset_num_timesteps=False)


def optimizer_arguments(method):
    """Of the optimiser of a row."""
    return {**method.optimizer_kwargs, **OPTIMIZER_ARGUMENTS.get(method.optimizer_class.__name__, {})}


def nested_optimizers():
    """Policy arguments: all optimisers around each other, the first one of the registry outermost."""
    policy_kwargs = {}
    for method in reversed(OPTIMIZERS.values()):
        inside = (
            dict(base_class=policy_kwargs["optimizer_class"], base_kwargs=policy_kwargs["optimizer_kwargs"])
            if policy_kwargs
            else {}
        )
        policy_kwargs = dict(
            optimizer_class=method.optimizer_class, optimizer_kwargs={**optimizer_arguments(method), **inside}
        )
    return policy_kwargs


def make_callback(cls):
    return cls(**CALLBACK_ARGUMENTS.get(cls.__name__, {}))


def make_method(method, with_c_chain=False):
    """The model and the callbacks of a row of the registry, with C-CHAIN in place of its algorithm if wanted."""
    policy_kwargs = {**method.policy_kwargs, "net_arch": [8]}
    if method.optimizer_class is not None:
        policy_kwargs.update(optimizer_class=method.optimizer_class, optimizer_kwargs=optimizer_arguments(method))
    algorithm = method.algorithm
    if with_c_chain:
        algorithm = CChainPPO if issubclass(algorithm, PPO) else CChainDQN
    model = make_model(algorithm.__name__, policy=method.policy, policy_kwargs=policy_kwargs)
    return model, [TaskSync(), *map(make_callback, method.callbacks)]
