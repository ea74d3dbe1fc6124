"""Spectral normalisation of hidden layers, which target networks follow."""

import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_cchain import TaskSync
from sb3_cchain.methods import ReDo, ShrinkAndPerturb
from sb3_cchain.methods.layer_reset import LayerReset
from sb3_cchain.networks import SpectralNormDQNPolicy, SpectralNormLinear, SpectralNormPolicy
from sb3_cchain.networks.evaluation_mode import has_training_mode
from tests.method_models import STEPS_PER_TASK, make_model, make_random_env, parameters

NET = dict(net_arch=[8, 8])


def layers(module):
    return [each for each in module.modules() if isinstance(each, SpectralNormLinear)]


def test_by_hand():
    layer = SpectralNormLinear(2, 2)
    with th.no_grad():
        layer.weight.copy_(th.tensor([[4.0, 0.0], [0.0, 2.0]]))
        layer.bias.copy_(th.tensor([1.0, 0.0]))
        layer.running_u.copy_(th.tensor([0.6, 0.8]))
    inputs = th.tensor([[1.0, 1.0]])
    # Wᵀ u = (2.4, 1.6), of norm √8.32
    sigma = 8.32**0.5
    layer.eval()
    for _ in range(2):
        assert layer(inputs).tolist()[0] == pytest.approx([4 / sigma + 1, 2 / sigma])
    layer.train()
    assert layer(inputs).tolist()[0] == pytest.approx([4 / sigma + 1, 2 / sigma])
    # W Wᵀ u = (9.6, 3.2)
    assert layer.running_u.tolist() == pytest.approx([9.6 / 102.4**0.5, 3.2 / 102.4**0.5])
    layer.iterate(20)
    assert layer(inputs).tolist()[0] == pytest.approx([2, 0.5])


def test_the_gradient_is_that_of_the_quotient():
    layer = SpectralNormLinear(5, 3).double()
    layer.iterate(200)
    inputs = th.randn(4, 5, dtype=th.float64)
    layer(inputs).square().sum().backward()
    weight = layer.weight.detach().requires_grad_()
    normalised = weight / th.linalg.matrix_norm(weight, 2)
    (inputs @ normalised.T + layer.bias.detach()).square().sum().backward()
    assert th.allclose(layer.weight.grad, weight.grad, rtol=1e-6)
    # It is orthogonal to the weight, whose size has no effect
    assert (layer.weight.grad * layer.weight).sum().abs() < 1e-9


@pytest.mark.parametrize("ortho_init", [True, False])
def test_hidden_layers_have_norm_1_from_the_beginning_on(ortho_init):
    model = make_model("PPO", make_random_env(), SpectralNormPolicy, policy_kwargs=dict(**NET, ortho_init=ortho_init))
    policy = model.policy.eval()
    assert len(layers(policy)) == 4 and type(policy.action_net) is type(policy.value_net) is nn.Linear
    for layer in layers(policy):
        normalised = (layer(th.eye(layer.in_features)) - layer.bias).T
        assert th.linalg.matrix_norm(normalised, 2).item() == pytest.approx(1, rel=0.02)
    model.learn(64)
    policy.set_training_mode(False)
    for layer in layers(policy):
        normalised = (layer(th.eye(layer.in_features)) - layer.bias).T
        assert th.linalg.matrix_norm(normalised, 2).item() == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("name", ["DQN", "CChainDQN"])
def test_the_target_network_is_a_copy(name):
    model = make_model(name, make_random_env(), SpectralNormDQNPolicy, policy_kwargs=NET, target_update_interval=10)
    observations = th.linspace(-1, 1, 12).reshape(3, 4)

    def outputs():
        model.policy.set_training_mode(False)
        with th.no_grad():
            return model.q_net(observations), model.q_net_target(observations)

    model.learn(40, log_interval=1000)  # the target follows after step 40, and then the network learns once more
    target = model.q_net_target.state_dict()
    assert all(not th.equal(value, target[key]) for key, value in model.q_net.state_dict().items())
    model._n_calls = 9
    model._on_step()
    assert th.equal(*outputs())
    for online, copy in zip(layers(model.q_net), layers(model.q_net_target), strict=True):
        assert th.equal(online.running_u, copy.running_u)


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_saved_and_loaded_with_its_vectors(tmp_path, name):
    policy = SpectralNormDQNPolicy if name == "DQN" else SpectralNormPolicy
    model = make_model(name, make_random_env(), policy, policy_kwargs=NET).learn(32)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", device="cpu")
    state = loaded.policy.state_dict()
    assert all(th.equal(value, state[key]) for key, value in model.policy.state_dict().items())
    assert sum("running_u" in key for key in state) == 4


def test_ppo_starts_each_update_from_the_policy_that_acted():
    """The ratio of the first minibatch is 1, though the vectors change in training."""
    model = make_model("PPO", make_random_env(), SpectralNormPolicy, policy_kwargs=NET)
    for layer in layers(model.policy):
        layer.running_u.fill_(8**-0.5)
    observations, actions = th.linspace(-1, 1, 12).reshape(3, 4), th.tensor([0, 1, 2])
    model.policy.set_training_mode(False)
    acted = model.policy.evaluate_actions(observations, actions)[1]
    model.policy.set_training_mode(True)
    assert th.equal(model.policy.evaluate_actions(observations, actions)[1], acted)
    assert not th.equal(model.policy.evaluate_actions(observations, actions)[1], acted)


def test_c_chain_looks_at_it_as_it_acts():
    for policy, algorithm in ((SpectralNormPolicy, PPO), (SpectralNormDQNPolicy, DQN)):
        assert has_training_mode(algorithm(policy, make_random_env(), device="cpu").policy)


def test_c_chain_looks_at_pytorchs_hook_as_it_acts():
    policy = PPO("MlpPolicy", make_random_env(), device="cpu").policy
    assert not has_training_mode(policy)
    nn.utils.spectral_norm(policy.action_net)
    assert has_training_mode(policy)


def test_a_reset_layer_has_the_vector_of_its_draw():
    model = make_model("DQN", make_random_env(), SpectralNormDQNPolicy, policy_kwargs=NET, learning_rate=0.0)
    before = parameters(model)
    model.learn(32, callback=LayerReset(n_layers=None, interval=24))
    assert all(not th.equal(p, before[key]) for key, p in model.policy.named_parameters() if "q_net." in key)
    for layer, target in zip(layers(model.q_net), layers(model.q_net_target), strict=True):
        sigma = (layer.weight.T @ layer.running_u).norm().item()
        assert sigma == pytest.approx(th.linalg.matrix_norm(layer.weight, 2).item(), rel=0.02)
        assert th.equal(layer.weight, target.weight)


@pytest.mark.parametrize("method", [ShrinkAndPerturb(shrink=0.2, interval=None), ReDo(tau=0.5, interval=1)])
def test_a_method_that_changes_weights_leaves_norm_1(method):
    norms = []

    class Watch(BaseCallback):
        def _on_step(self):
            for layer in layers(self.model.policy):
                sigma = (layer.weight.T @ layer.running_u).norm()
                norms.append((th.linalg.matrix_norm(layer.weight, 2) / sigma).item())
            return True

    policy_kwargs = dict(net_arch=[16, 16], activation_fn=nn.ReLU)
    model = make_model("PPO", policy=SpectralNormPolicy, policy_kwargs=policy_kwargs)
    model.learn(3 * STEPS_PER_TASK, callback=[TaskSync(), method, Watch()])
    assert getattr(method, "n_steps", 0) or method.n_recycled
    assert max(norms) == pytest.approx(1, abs=0.03)
