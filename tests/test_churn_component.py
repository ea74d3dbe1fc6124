"""The ablation of the churn gradient: its component along PPO's gradient, and the orthogonal one."""

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_cchain import CChainCallback, CChainPPO
from sb3_cchain.churn import component_backward, cross_entropy, gradient_component
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.sb3_source import COEF, NUMBERED_MINIBATCHES, PPO_SETTINGS, rewritten


def test_components_by_hand():
    # g = (3, 0, 4), ḡ = (1, 2, 3): gᵀḡ = 15, gᵀg = 25, so the projection is 0.6 g
    base = [th.tensor([3.0]), th.tensor([0.0, 4.0])]
    churn = [th.tensor([1.0]), th.tensor([2.0, 3.0])]
    projection = gradient_component(churn, base, "projection")
    orthogonal = gradient_component(churn, base, "orthogonal")
    th.testing.assert_close(th.cat(projection), th.tensor([1.8, 0.0, 2.4]))
    th.testing.assert_close(th.cat(orthogonal), th.tensor([-0.8, 2.0, 0.6]))
    assert th.equal(th.cat(gradient_component(churn, base, "full")), th.cat(churn))


@pytest.mark.parametrize("base", [[], [th.ones(3)], [th.ones(1, 2)], [th.ones(2), th.ones(2)]])
def test_gradients_of_other_parameters_are_refused(base):
    with pytest.raises(ValueError, match=r"a gradient of each parameter, got shapes \[\(2,\)\] and "):
        gradient_component([th.ones(2)], base, "projection")


def test_no_component_hides_a_gradient_that_is_not_a_number():
    nan = [th.tensor([float("nan"), 1.0])]
    assert gradient_component(nan, [th.ones(2)], "projection")[0].isnan().all()


def test_nothing_lies_along_a_gradient_of_zeros():
    churn, base = [th.tensor([1.0, 2.0])], [th.zeros(2)]
    assert gradient_component(churn, base, "projection")[0].tolist() == [0.0, 0.0]
    assert gradient_component(churn, base, "orthogonal")[0].tolist() == [1.0, 2.0]


def test_a_component_that_there_is_not():
    with pytest.raises(ValueError, match="`component` must be one of 'full', 'projection', 'orthogonal', got 'projecton'"):
        gradient_component([th.ones(1)], [th.ones(1)], "projecton")


@pytest.mark.parametrize("argument", ["churn_component", "churn_base_loss"])
def test_a_choice_that_there_is_not_is_refused_on_loading(argument, tmp_path):
    CChainPPO("MlpPolicy", "CartPole-v1", **PPO_SETTINGS).save(tmp_path / "model")
    with pytest.raises(ValueError, match=f"`{argument}` must be one of .*got 'none'"):
        CChainPPO.load(tmp_path / "model", **{argument: "none"})


def test_added_during_the_backward_pass_of_the_base_loss():
    shared, only_churn, only_base, unused = (th.tensor([value], requires_grad=True) for value in (1.0, 2.0, 3.0, 4.0))
    with component_backward([shared, only_churn, only_base, unused], "orthogonal") as backward:
        # ḡ = (2, 1) over (shared, only_churn), and g = (4, 0) there: the orthogonal rest is (0, 1)
        backward((2 * shared + only_churn).sum())
        assert all(parameter.grad is None for parameter in (shared, only_churn, only_base))
        (4 * shared + 100 * only_base).sum().backward()
        assert [shared.grad.item(), only_churn.grad.item(), only_base.grad.item()] == [4.0, 1.0, 100.0]
        assert unused.grad is None
        # Once in an update, however many backward passes it has
        shared.sum().backward()
        assert [shared.grad.item(), only_churn.grad.item()] == [5.0, 1.0]
        # The next update
        for parameter in (shared, only_churn, only_base):
            parameter.grad = None
        backward((shared + only_churn).sum())
        (4 * shared).sum().backward()
        assert [shared.grad.item(), only_churn.grad.item()] == [4.0, 1.0]
        backward(2 * shared.sum())
    (4 * shared).sum().backward()
    assert shared.grad.item() == 8.0


class WrittenOutPPO(PPO):
    """SB3's, with the two gradients computed apart."""

    train = rewritten(
        PPO.train,
        NUMBERED_MINIBATCHES,
        (
            "loss.backward()",
            "self.set_gradients(loss, minibatches[(position + (len(minibatches) + 1) // 2) % len(minibatches)].observations)",
        ),
    )
    pending = None
    component = "full"

    def set_gradients(self, loss, reference):
        names, parameters = zip(*self.policy.named_parameters(), strict=True)
        ppo = th.autograd.grad(loss, parameters, retain_graph=True)
        for parameter, gradient in zip(parameters, ppo, strict=True):
            parameter.grad = gradient.clone()
        if self.pending is not None:
            of_actor = [name.startswith(("mlp_extractor.policy_net", "action_net")) for name in names]
            actor = [parameter for parameter, is_actors in zip(parameters, of_actor, strict=True) if is_actors]
            old_reference, old = self.pending
            churn_loss = COEF * cross_entropy(old, policy_outputs(self.policy, old_reference))
            churn = th.cat([g.flatten() for g in th.autograd.grad(churn_loss, actor)])
            base = th.cat([g.flatten() for g, is_actors in zip(ppo, of_actor, strict=True) if is_actors])
            unit = base / base.norm()
            part = (unit @ churn) * unit
            if self.component == "orthogonal":
                part = churn - part
            start = 0
            for parameter in actor:
                parameter.grad += part[start : start + parameter.numel()].reshape(parameter.shape)
                start += parameter.numel()
        with th.no_grad():
            self.pending = reference, policy_outputs(self.policy, reference)


@pytest.mark.parametrize("component", ["projection", "orthogonal"])
@pytest.mark.parametrize("max_grad_norm", [0.5, 0.05])
def test_equals_sb3_source_with_the_component_written_out(component, max_grad_norm):
    settings = dict(PPO_SETTINGS, max_grad_norm=max_grad_norm)
    written_out = WrittenOutPPO("MlpPolicy", "CartPole-v1", **settings)
    written_out.component = component
    written_out.learn(64 * 2)
    ours = CChainPPO("MlpPolicy", "CartPole-v1", churn_coef=COEF, churn_component=component, **settings).learn(64 * 2)
    full = CChainPPO("MlpPolicy", "CartPole-v1", churn_coef=COEF, **settings).learn(64 * 2)
    for name, parameter in ours.policy.named_parameters():
        th.testing.assert_close(parameter, written_out.policy.get_parameter(name), rtol=0, atol=2e-6, msg=name)
    differences = [(p - q).abs().max().item() for p, q in zip(ours.policy.parameters(), full.policy.parameters(), strict=True)]
    assert max(differences) > 1e-3


class GradientRecorder(CChainPPO):
    """The gradients of the second update, which is the first with a churn loss, as the optimiser gets them."""

    def _setup_model(self):
        super()._setup_model()
        self.gradients = []
        self.policy.optimizer.register_step_pre_hook(
            lambda *_: self.gradients.append(th.cat([p.grad.flatten() for p in self.policy.parameters()]))
        )


@pytest.mark.parametrize("env_id, policy", [("CartPole-v1", "MlpPolicy"), ("Pendulum-v1", "MlpPolicy")])
def test_the_parts_sum_to_the_whole(env_id, policy):
    settings = dict(PPO_SETTINGS, max_grad_norm=1e9)

    def second_gradient(**kwargs):
        return GradientRecorder(policy, env_id, **kwargs, **settings).learn(64).gradients[1]

    plain = second_gradient(churn_coef=0.0)
    full, projection, orthogonal = (
        second_gradient(churn_coef=COEF, churn_component=component) - plain
        for component in ("full", "projection", "orthogonal")
    )
    th.testing.assert_close(projection + orthogonal, full, rtol=1e-4, atol=1e-6)
    for part in (projection, orthogonal):
        assert part.norm() > 1e-3 * full.norm()
    assert abs(projection @ orthogonal) < 1e-4 * projection.norm() * orthogonal.norm()


@pytest.mark.parametrize("component", ["projection", "orthogonal"])
def test_save_load_and_the_callback_form(component, tmp_path):
    model = CChainPPO("MlpPolicy", "CartPole-v1", churn_component=component, **PPO_SETTINGS).learn(128)
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=model.get_env(), device="cpu")
    assert loaded.churn_component == component
    loaded.learn(64)

    stock = PPO("MlpPolicy", "CartPole-v1", **PPO_SETTINGS).learn(128, callback=CChainCallback(churn_component=component))
    for name, parameter in stock.policy.named_parameters():
        assert th.equal(parameter, model.policy.get_parameter(name)), name
    assert not stock.policy.action_net.weight._backward_hooks  # nothing stays behind


@pytest.mark.parametrize("make", [lambda **kw: CChainPPO("MlpPolicy", "NoSuchEnv-v0", **kw), CChainCallback])
def test_unknown_component(make):
    with pytest.raises(ValueError, match="`churn_component` must be one of 'full', 'projection', 'orthogonal', got 'proj'"):
        make(churn_component="proj")


def test_small_gradients_are_projected_too():
    # The square of 1e-25 is 0 in single precision
    base, churn = [th.tensor([3e-25, 4e-25])], [th.tensor([1.0, 2.0])]
    projection = gradient_component(churn, base, "projection")[0]
    th.testing.assert_close(projection, th.tensor([1.32, 1.76]))


@pytest.mark.parametrize("component", ["full", "projection", "orthogonal"])
@pytest.mark.parametrize("n_frozen", [1, 4])
def test_frozen_layers(component, n_frozen):
    model = CChainPPO("MlpPolicy", "CartPole-v1", churn_coef=COEF, churn_component=component, **PPO_SETTINGS)
    actor = [*model.policy.mlp_extractor.policy_net.parameters(), *model.policy.action_net.parameters()]
    before = [parameter.clone() for parameter in actor]
    for parameter in actor[:n_frozen]:
        parameter.requires_grad_(False)
    model.learn(64)
    moved = [not th.equal(parameter, old) for parameter, old in zip(actor, before, strict=True)]
    assert moved == [False] * n_frozen + [True] * (4 - n_frozen)
