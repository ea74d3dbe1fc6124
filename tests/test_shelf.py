"""What holds for each related method: it trains what its optimiser holds, repeats with the seed, and can be without effect."""

import pytest
import torch as th
from stable_baselines3 import DQN

from sb3_cchain.methods.registry import REGISTRY
from sb3_cchain.networks import InjectionDQNPolicy, InjectionPolicy
from tests.method_models import STEPS_PER_TASK, make_method, make_model, make_random_env, optimizer_arguments, parameters

METHODS = {method.algo: method for method in REGISTRY if method.is_related}
# Arguments with which nothing happens, of the optimiser or of the callback. TRAC, AdamRel, UPGD, Muon, Kron and networks have
# none
OFF = {
    "ppo_weight_clipping": dict(clip_ratio=1e9),
    "ppo_l2_init": dict(coef=0),
    "ppo_parseval": dict(coef=0),
    "ppo_normalize_and_project": dict(interval=10**9),
    "ppo_redo": dict(interval=10**9),
    "ppo_shrink_and_perturb": dict(shrink=0.5, interval=10**9),
    "ppo_layer_reset": dict(interval=10**9),
    "ppo_plasticity_injection": dict(timestep=10**9),
    "ppo_spectral_regularization": dict(coef=0),
    "ppo_ewc": dict(coef=0),
}


def trained(model):
    """The parameters that an update may change. The target network follows by itself."""
    return {id(p) for name, p in model.policy.named_parameters() if p.requires_grad and "target" not in name}


def held(model):
    return {id(p) for group in model.policy.optimizer.param_groups for p in group["params"]}


@pytest.mark.parametrize("algo", METHODS)
def test_trains_what_its_optimiser_holds_and_repeats_with_the_seed(algo):
    ends = []
    for _ in range(2):
        model, callbacks = make_method(METHODS[algo])
        before = held(model)
        assert trained(model) <= before
        model.learn(2 * STEPS_PER_TASK + 16, callback=callbacks)
        assert held(model) == before and trained(model) <= before
        ends.append(parameters(model))
    assert all(th.equal(ends[0][name], ends[1][name]) for name in ends[0])


@pytest.mark.parametrize("algorithm", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
@pytest.mark.parametrize("algo", OFF)
def test_without_effect_it_is_plain_training(algo, algorithm):
    method, off = METHODS[algo], OFF[algo]
    is_dqn = "DQN" in algorithm
    policy = (InjectionDQNPolicy if is_dqn else InjectionPolicy) if method.policy is InjectionPolicy else "MlpPolicy"
    policy_kwargs = dict(net_arch=[8, 8])
    callbacks = []
    if method.optimizer_class is None:
        callbacks += [method.callbacks[0](**off)]
    else:
        eps = {} if is_dqn else dict(eps=1e-5)  # SB3's
        kwargs = {**optimizer_arguments(method), **off, "base_kwargs": eps}
        policy_kwargs |= dict(optimizer_class=method.optimizer_class, optimizer_kwargs=kwargs)
    ends = []
    for arguments, with_method in (
        (dict(policy=policy, policy_kwargs=policy_kwargs), callbacks),
        (dict(policy_kwargs=dict(net_arch=[8, 8])), None),
    ):
        model = make_model(algorithm, env=make_random_env(), **arguments).learn(48, callback=with_method)
        ends.append(outputs(model))
    assert th.allclose(*ends, rtol=0, atol=1e-6)


def outputs(model):
    observations = th.linspace(-1, 1, 12).reshape(3, 4)
    with th.no_grad():
        if isinstance(model, DQN):
            return model.q_net(observations)
        policy = model.policy
        return th.cat([policy.get_distribution(observations).distribution.logits, policy.predict_values(observations)], dim=1)
