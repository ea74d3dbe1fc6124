"""Units with little gradient are recycled."""

import pytest
import torch as th
from gymnasium.spaces import Box
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_cchain.methods import ReGraMa
from sb3_cchain.methods.regrama import gradient_magnitude
from sb3_cchain.networks import InjectionPolicy
from tests.envs import RandomEnv
from tests.method_models import make_model, make_random_env, parameters

NET = dict(net_arch=[3], activation_fn=nn.ReLU)
HIDDEN = {"PPO": "mlp_extractor.policy_net.0", "DQN": "q_net.q_net.0"}


def test_magnitude_by_hand():
    linear, convolution = nn.Linear(2, 3), nn.Conv2d(1, 2, kernel_size=2)
    assert th.equal(gradient_magnitude(linear.weight), th.zeros(3))
    linear.weight.grad = th.tensor([[1.0, -3.0], [0.0, 0.0], [2.0, 2.0]])
    convolution.weight.grad = th.tensor([[[[1.0, -1.0], [1.0, -1.0]]], [[[0.0, 4.0], [0.0, 0.0]]]])
    assert th.equal(gradient_magnitude(linear.weight), th.tensor([2.0, 0.0, 2.0]))
    assert th.equal(gradient_magnitude(convolution.weight), th.tensor([1.0, 1.0]))


class GiveGradients(BaseCallback):
    """Replaces the gradients of the hidden layer by these, update by update."""

    def __init__(self, layer, gradients):
        super().__init__()
        self.layer, self.gradients = layer, gradients

    def _on_step(self):
        return True

    def _on_training_start(self):
        rows = iter(self.gradients)
        weight = self.model.policy.get_parameter(f"{self.layer}.weight")

        def give(*_):
            weight.grad = th.tensor(next(rows)).float()[:, None].expand_as(weight).clone()

        self.handle = self.model.policy.optimizer.register_step_pre_hook(give)

    def _on_training_end(self):
        self.handle.remove()


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_scores_are_of_all_updates_since_the_last_recycling(name):
    """Two updates with mean gradients 3, 0.06 and 0: scores 3 / 1.02, 0.06 / 1.02 = 0.0588 and 0."""
    gradients = [[4.0, 0.12, 0.0], [-2.0, 0.0, 0.0]]
    settings = dict(n_epochs=1) if name == "PPO" else dict(learning_starts=14)
    for tau, recycled in ((0.0, [2]), (0.058, [2]), (0.06, [1, 2])):
        model = make_model(name, env=make_random_env(), policy_kwargs=NET, learning_rate=0.0, **settings)
        before = parameters(model)[f"{HIDDEN[name]}.weight"]
        regrama = ReGraMa(tau=tau, interval=1 if name == "PPO" else 2)
        model.learn(16, callback=[GiveGradients(HIDDEN[name], gradients), regrama])
        after = parameters(model)[f"{HIDDEN[name]}.weight"]
        changed = (before != after).any(dim=1).nonzero().flatten().tolist()
        assert changed == recycled, tau
        assert regrama.n_recycled >= len(recycled)  # of the critic as well


def test_scores_begin_again_after_a_recycling():
    """A unit that got its last gradient before it."""
    model = make_model("PPO", env=make_random_env(), policy_kwargs=NET, learning_rate=0.0, n_epochs=1)
    gradients = GiveGradients(HIDDEN["PPO"], [[1.0, 1.0, 1.0]] * 2 + [[1.0, 1.0, 0.0]] * 2)
    before = parameters(model)[f"{HIDDEN['PPO']}.weight"]
    model.learn(32, callback=[gradients, ReGraMa(tau=0.0, interval=1)])
    after = parameters(model)[f"{HIDDEN['PPO']}.weight"]
    assert (before != after).any(dim=1).tolist() == [False, False, True]


def test_active_units_that_are_saturated_are_found():
    """Tanh of a large input, which ReDo's activations do not tell."""
    model = make_model("PPO", env=make_random_env(), policy_kwargs=dict(net_arch=[4]))
    hidden = model.policy.mlp_extractor.policy_net[0]
    with th.no_grad():
        hidden.bias[1] = 100.0
    regrama = ReGraMa(tau=1e-6, interval=1)
    model.learn(16, callback=regrama)
    assert hidden.bias[1] == 0 and (model.policy.action_net.weight[:, 1] == 0).all() and regrama.n_recycled == 1


def test_a_layer_without_gradient_is_left_alone():
    model = make_model("PPO", env=make_random_env(), policy_kwargs=NET)
    for parameter in model.policy.parameters():
        parameter.register_hook(th.zeros_like)
    regrama = ReGraMa(tau=1.0, interval=1)
    model.learn(32, callback=regrama)
    assert regrama.n_recycled == 0


def test_interval_and_several_calls():
    model, regrama = make_model("PPO", env=make_random_env(), policy_kwargs=NET), ReGraMa(tau=100.0, interval=2)
    counts = []
    for _ in range(4):
        model.learn(16, callback=regrama, reset_num_timesteps=False)
        counts.append(regrama.n_recycled)
    assert counts == [0, 6, 0, 6]


def test_what_it_refuses():
    for argument, value in [("tau", -1), ("interval", 0)]:
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value}"):
            ReGraMa(**{argument: value})
    box = RandomEnv(action_space=Box(-1, 1, (2,)))
    with pytest.raises(TypeError, match="ReGraMa is for on-policy algorithms and DQN, got SAC"):
        SAC("MlpPolicy", box, buffer_size=10, device="cpu").learn(10, callback=ReGraMa())
    with pytest.raises(TypeError, match="ReGraMa does not know heads for plasticity injection, got InjectionPolicy"):
        make_model("PPO", policy=InjectionPolicy).learn(10, callback=ReGraMa())
