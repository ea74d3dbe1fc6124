"""After interrupted training no callback goes on acting, neither in training without it nor in that of another model."""

import inspect

import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import sb3_cchain
from sb3_cchain import ChurnMonitor, TaskSync, analysis, callbacks, methods
from sb3_cchain.analysis import NetworkHealth
from sb3_cchain.networks.model_optimizers import model_optimizers
from tests.method_models import go_on, make_env, make_model

# Where the defaults would do little within a few updates
ARGUMENTS = {
    "ChurnMonitor": dict(interval=1),
    "NetworkHealth": dict(interval=1),
    "NTKCallback": dict(n_minibatches=4, interval=1, picture_interval=0),
    "OverallSchedule": dict(total_timesteps=100),
    "ContinualBackprop": dict(replacement_rate=0.1, maturity_threshold=2),
    "FIRE": dict(interval=16),
    "LayerReset": dict(interval=16),
    "ReDo": dict(tau=0.5, interval=1),
    "ReGraMa": dict(tau=0.5, interval=1),
    "SelfNormalizedResets": dict(max_threshold=1, interval=1),
    "ShrinkAndPerturb": dict(shrink=0.5),
    "TaskLearningStarts": dict(learning_starts=4),
    "TaskSchedule": dict(steps_per_task=16),
    "TrainingCheckpoint": dict(save_freq=8, path="checkpoints"),
}
PUBLIC = {
    name: getattr(module, name)
    for module in (sb3_cchain, methods, analysis, callbacks)
    for name in module.__all__
    if inspect.isclass(getattr(module, name)) and issubclass(getattr(module, name), BaseCallback)
}


def make_callback(name):
    arguments = ARGUMENTS.get(name, {})
    if name in ("EvalAllTasks", "EvalTrainedTask"):
        arguments = dict(eval_env=make_env(), n_eval_episodes=1)
    return PUBLIC[name](**arguments)


class Interruption(BaseCallback):
    """As an error of the environment or Ctrl-C in one of its steps."""

    def _on_step(self):
        if self.n_calls == 40:
            raise KeyboardInterrupt
        return True


def interrupt_update(model):
    """Ctrl-C in the fourth update."""
    step, n_updates = model.policy.optimizer.step, 0

    def interrupted(*args, **kwargs):
        nonlocal n_updates
        n_updates += 1
        if n_updates == 4:
            model.policy.optimizer.step = step
            raise KeyboardInterrupt
        return step(*args, **kwargs)

    model.policy.optimizer.step = interrupted


# Callbacks that refuse these models
NOT_FOR = {
    *((name, "PPO") for name in ("ExplorationRateRestart", "TaskLearningStarts")),
    *((name, "DQN") for name in ("EntropyBonusRestart", "EpisodicRollouts", "RolloutNormalizedAdvantage")),
    *((name, algo) for name in ("EWCConsolidation", "LogStdRestart", "PlasticityInjection") for algo in ("PPO", "DQN")),
}
SUITED = sorted((name, algorithm) for name in PUBLIC for algorithm in ("PPO", "DQN") if (name, algorithm) not in NOT_FOR)


def attached(model):
    """Hooks, and methods that were replaced."""
    optimizers = model_optimizers(model).values()
    hooks = [
        hook for o in optimizers for hooks in (o._optimizer_step_pre_hooks, o._optimizer_step_post_hooks) for hook in hooks
    ]
    hooks += [hook for m in model.policy.modules() for hook in (*m._forward_hooks.values(), *m._forward_pre_hooks.values())]
    owners = (model, model.policy, model.env, getattr(model, "rollout_buffer", None))
    return hooks + [name for o in owners if o for name in vars(o) if callable(getattr(type(o), name, None))]


@pytest.mark.parametrize(
    "name, algorithm, where",
    [
        *((*suited, "update") for suited in SUITED),
        *((name, algorithm, "step") for name, algorithm in SUITED if algorithm == "PPO"),
    ],
)
def test_training_without_the_callback_is_plain_training(tmp_path, monkeypatch, name, algorithm, where):
    monkeypatch.chdir(tmp_path)
    settings = dict(normalize_advantage=False) if algorithm == "PPO" else {}
    model = make_model(algorithm, policy_kwargs=dict(net_arch=[8], optimizer_class=methods.L2Init), **settings)
    before = attached(model)
    interruption = [Interruption()] if where == "step" else []
    if where == "update":
        interrupt_update(model)
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callback=[TaskSync(), make_callback(name), *interruption])
    model.save(tmp_path / "model")
    plain = type(model).load(tmp_path / "model", env=make_env(), device="cpu")
    if algorithm == "DQN":
        model.save_replay_buffer(tmp_path / "buffer")
        plain.load_replay_buffer(tmp_path / "buffer")
    for each in (model, plain):
        each.env.env_method("set_clock", 0, 1)  # the environments then reset alike
        go_on(each, callback=TaskSync())
    for parameter, other in zip(model.policy.parameters(), plain.policy.parameters(), strict=True):
        assert th.equal(parameter, other)
    assert attached(model) == before


def model_and_callbacks(name, algorithm):
    settings = dict(normalize_advantage=False) if algorithm == "PPO" else {}
    model = make_model(algorithm, policy_kwargs=dict(optimizer_class=methods.L2Init), **settings)
    return model, [make_callback(name), *([] if name == "TaskSync" else [TaskSync()])]


@pytest.mark.parametrize("name, algorithm", sorted(NOT_FOR))
def test_the_end_of_a_training_that_was_refused_may_be_told(tmp_path, monkeypatch, name, algorithm):
    """As RL Zoo does with the first callback."""
    monkeypatch.chdir(tmp_path)
    model, callbacks = model_and_callbacks(name, algorithm)
    with pytest.raises(TypeError, match=rf"^{name} (is for|needs) "):
        model.learn(64, callback=callbacks)
    callbacks[0].on_training_end()


@pytest.mark.parametrize("name, algorithm", SUITED)
def test_the_end_of_training_may_be_told_twice(tmp_path, monkeypatch, name, algorithm):
    """As RL Zoo does with the first callback."""
    monkeypatch.chdir(tmp_path)
    model, callbacks = model_and_callbacks(name, algorithm)
    model.learn(64, callback=callbacks)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    kept = {name: len(value) for name, value in vars(model).items() if isinstance(value, list)}
    callbacks[0].on_training_end()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.csv")} == before
    assert {name: len(value) for name, value in vars(model).items() if isinstance(value, list)} == kept


def test_when_training_begins_again_and_reaches_the_same_step():
    """Where the number of steps alone does not tell the trainings apart."""
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=16, n_epochs=1, seed=0, device="cpu")
    monitors = [NetworkHealth(interval=1), ChurnMonitor(interval=1), shrink := methods.ShrinkAndPerturb(0.5)]
    step = model.policy.optimizer.step

    def interrupted(*args, **kwargs):
        step(*args, **kwargs)
        raise KeyboardInterrupt

    model.policy.optimizer.step = interrupted
    with pytest.raises(KeyboardInterrupt):
        model.learn(32, callback=monitors)
    model.policy.optimizer.step = step
    assert model.num_timesteps == 32 and shrink.n_steps == 1
    model.logger.name_to_value.clear()
    model.learn(32)
    assert shrink.n_steps == 1
    assert not any(key.startswith(("health/", "churn_monitor/")) for key in model.logger.name_to_value)
    assert attached(model) == []


def test_a_new_callback_acts_once():
    model = make_model("PPO")
    interrupt_update(model)
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callback=(first := methods.ShrinkAndPerturb(0.5)))
    n_steps = first.n_steps
    model.learn(16, callback=(second := methods.ShrinkAndPerturb(0.5)))
    assert (first.n_steps, second.n_steps) == (n_steps, 4)


def test_arguments_are_of_callbacks():
    assert ARGUMENTS.keys() <= PUBLIC.keys()


def test_ars_is_not_watched_after_an_interruption():
    """Whose observations the monitor sees in the environment's ``step_wait``."""
    contrib = pytest.importorskip("sb3_contrib")
    model, monitor = contrib.ARS("LinearPolicy", "CartPole-v1", n_delta=2, seed=0, device="cpu"), ChurnMonitor()
    with pytest.raises(KeyboardInterrupt):
        model.learn(200, callback=[monitor, Interruption()])
    seen = len(monitor._observations)
    assert "step_wait" in vars(model.env) and seen > 0
    model.learn(200)
    assert "step_wait" not in vars(model.env) and len(monitor._observations) == seen


def test_a_monitor_goes_on_with_another_model():
    """Whose observations have another shape."""
    monitor = ChurnMonitor(interval=1)
    first = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=16, seed=0, device="cpu")
    interrupt_update(first)
    with pytest.raises(KeyboardInterrupt):
        first.learn(64, callback=monitor)
    model = PPO("MlpPolicy", "MountainCar-v0", n_steps=32, batch_size=16, seed=0, device="cpu")
    model.learn(32, callback=monitor)
    assert "churn_monitor/fixed/policy_churn" in model.logger.name_to_value
    assert attached(first) == []
