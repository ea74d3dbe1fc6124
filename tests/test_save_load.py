"""Saved and loaded, training goes on as if it had never stopped."""

import base64
import json
import warnings
import zipfile

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO, HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_cchain import CChainDQN, CChainPPO, ChurnMonitor, DoubleDQN
from tests.churn_models import (
    ACTION_SPACES,
    DICT,
    DQN_SETTINGS,
    FORMS,
    PPO_SETTINGS,
    Form,
    assert_equal,
    differ,
    each_algorithm,
    each_form,
    go_on,
)
from tests.envs import RandomEnv

ADAPTIVE = dict(churn_warmup=2, churn_window=4)


def learn(form, **kwargs):
    """λ has adapted at the end, and its window is full."""
    return form.learn(n_timesteps=2 * form.n_timesteps, **{**ADAPTIVE, **kwargs})


def save_and_load(model, folder, env=None, **kwargs):
    """With its replay buffer, where it has one."""
    model.save(folder / "model")
    loaded = type(model).load(folder / "model", env=env or RandomEnv(), device="cpu", **kwargs)
    if hasattr(model, "replay_buffer"):
        model.save_replay_buffer(folder / "buffer")
        loaded.load_replay_buffer(folder / "buffer")
    return loaded


DISCRETE, CONTINUOUS = ACTION_SPACES[0], ACTION_SPACES[-1]


@pytest.mark.parametrize(
    "name, action_space, observation_space, arguments",
    [
        *((name, DISCRETE, observation_space, {}) for name in FORMS for observation_space in (None, DICT)),
        *((name, CONTINUOUS, space, {}) for name in ("CChainPPO", "CChainCallback") for space in (None, DICT)),
        ("CChainDQN", DISCRETE, None, dict(loss="mse", double_q=False, n_steps=3)),
    ],
)
def test_continues_as_if_never_stopped(tmp_path, name, action_space, observation_space, arguments):
    form, policy = FORMS[name], "MultiInputPolicy" if observation_space else "MlpPolicy"

    def make_env():
        return RandomEnv(observation_space, action_space)

    model, *callbacks = form.make(make_env(), policy, **ADAPTIVE, **arguments)
    callbacks += [form.make(**ADAPTIVE)[1] for _ in range(2)]
    model.learn(2 * form.n_timesteps, callbacks[0])
    loaded, forgetful = (save_and_load(model, tmp_path, make_env()) for _ in range(2))
    assert {name: getattr(loaded, name) for name in arguments} == arguments
    assert_equal(model, loaded)
    # Without the reference batch the next update has no churn loss
    if form.callback:
        for state in forgetful.churn_state["reducers"].values():
            state["_extra_state"].update(reference=None, old_outputs=None)
    else:
        forgetful.churn_reducer.forget_reference()
    for each, callback in zip((model, loaded, forgetful), callbacks, strict=True):
        go_on(each, callback)
    assert_equal(model, loaded)
    assert (model.num_timesteps, model._n_updates) == (loaded.num_timesteps, loaded._n_updates)
    assert differ(forgetful, loaded)
    # λ had adapted
    coefficient = model.churn_state.reducers.first.coefficient
    assert coefficient.value != 1 and coefficient.base_losses.all()


def test_a_minibatch_that_was_drawn_ahead_is_not_saved(tmp_path):
    """Nothing else is lost: given it, training goes on as if it had never stopped."""
    form = FORMS["CChainDQN"]
    model = learn(form, churn_reference="next")
    loaded, without = (save_and_load(model, tmp_path) for _ in range(2))
    assert loaded.churn_reference == "next"
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert "_next_minibatch" not in data and loaded._next_minibatch is None
    loaded._next_minibatch = model._next_minibatch
    for each in (model, loaded):
        go_on(each)
    assert_equal(model, loaded)

    # Without it, the first update has no churn loss
    n_seen = int(without.churn_reducer.coefficient.n_seen)
    go_on(without)
    assert without.churn_reducer.coefficient.n_seen == n_seen + 39
    # Nor has one with other parameters
    for parameters in (model.get_parameters(), tmp_path / "model.zip"):
        without.set_parameters(parameters)
        assert without._next_minibatch is None
        n_seen = int(without.churn_reducer.coefficient.n_seen)
        without.train(gradient_steps=3, batch_size=8)
        assert without.churn_reducer.coefficient.n_seen == n_seen + 2


@each_algorithm
@pytest.mark.parametrize("trained", [False, True])
def test_predicts_without_an_environment(tmp_path, form, trained):
    model = form.learn() if trained else form.make()[0]
    model.save(tmp_path / "model")
    loaded = form.algorithm.load(tmp_path / "model", device="cpu")
    observations = np.random.default_rng(0).uniform(-1, 1, (20, 4)).astype(np.float32)
    assert np.array_equal(*(m.predict(observations, deterministic=True)[0] for m in (model, loaded)))


@each_algorithm
def test_arguments_can_be_changed_on_loading(tmp_path, form):
    loaded = save_and_load(learn(form), tmp_path, target_churn_ratio=5.0)
    assert loaded.churn_reducer.coefficient.target_ratio == 5.0
    loaded.learn(form.n_timesteps)


@each_algorithm
@pytest.mark.parametrize(
    "before, after, value", [("auto", 0.0, 0), ("auto", 0.5, 0.5), (0.0, "auto_3", 3), (0.5, "auto_3", 3)]
)
def test_another_kind_of_coefficient_starts_over(tmp_path, form, before, after, value):
    loaded = save_and_load(learn(form, churn_coef=before), tmp_path, churn_coef=after)
    coefficient = loaded.churn_reducer.coefficient
    assert coefficient.value == value and coefficient.is_zero == (value == 0)
    loaded.learn(form.n_timesteps)


@each_algorithm
def test_another_window_starts_over(tmp_path, form):
    model = learn(form)
    loaded = save_and_load(model, tmp_path, churn_window=9)
    assert loaded.churn_reducer.coefficient.value == 1 != model.churn_reducer.coefficient.value
    loaded.learn(form.n_timesteps)


@pytest.mark.parametrize("base, algorithm", [(PPO, CChainPPO), (DQN, DoubleDQN), (DQN, CChainDQN), (DoubleDQN, CChainDQN)])
def test_takes_a_checkpoint_of_its_base(tmp_path, base, algorithm):
    plain = base("MlpPolicy", RandomEnv(), **(PPO_SETTINGS if base is PPO else DQN_SETTINGS)).learn(40)
    plain.save(tmp_path / "model")
    model = algorithm.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    assert_equal(plain, model)
    model.learn(64)
    assert differ(plain, model)
    if algorithm is not DoubleDQN:
        assert model.churn_reducer.reference is not None
        model.set_parameters(plain.get_parameters())
        # The churn of the network that was replaced is forgotten
        assert model.churn_reducer.reference is None and model.churn_reducer.coefficient.n_seen == 0
    model.set_parameters(str(tmp_path / "model.zip"))
    assert_equal(plain, model)


@each_algorithm
@pytest.mark.parametrize("policy, observation_space", [("MlpPolicy", None), ("MultiInputPolicy", DICT)])
def test_reference_goes_to_the_models_device(form, policy, observation_space):
    """As when a model was saved on a GPU; "meta" stands for the other device."""
    reducer = form.learn(RandomEnv(observation_space), policy).churn_reducer
    reducer.move_reference("meta")
    references = reducer.reference.values() if observation_space else [reducer.reference]
    assert reducer.old_outputs.is_meta and all(tensor.is_meta for tensor in references)


@each_algorithm
def test_its_policy_loads_without_the_package(tmp_path, form):
    model = form.learn()
    model.policy.save(tmp_path / "policy")
    policy = type(model.policy).load(tmp_path / "policy", device="cpu")
    assert not type(policy).__module__.startswith("sb3_cchain")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), policy.parameters(), strict=True))


@each_algorithm
def test_set_parameters_from_a_path_and_from_a_dict(form, tmp_path):
    model = learn(form)
    model.save(tmp_path / "model")
    other, _ = form.make(**ADAPTIVE)
    other.set_parameters(tmp_path / "model.zip", device="cpu")
    assert other.churn_reducer.coefficient.n_seen == model.churn_reducer.coefficient.n_seen > 0
    assert th.equal(other.churn_reducer.old_outputs, model.churn_reducer.old_outputs)
    other.set_parameters(model.get_parameters())
    # A dict has no history: these are the parameters of a network that has not churned yet
    assert other.churn_reducer.reference is None and other.churn_reducer.coefficient.n_seen == 0
    other.save(tmp_path / "other")
    assert form.algorithm.load(tmp_path / "other", device="cpu").churn_reducer.coefficient.n_seen == 0


@each_algorithm
def test_the_task_is_kept(tmp_path, form):
    """So that λ starts over at a switch that a resumed training begins with."""
    model = form.learn(reset_churn_coef=True)
    model._task_switch.task_id = 1
    assert save_and_load(model, tmp_path)._task_switch.task_id == 1


@pytest.mark.parametrize(
    "form", [*FORMS.values(), Form(DoubleDQN, DQN, DQN_SETTINGS, 50, own_key="")], ids=[*FORMS, "DoubleDQN"]
)
@pytest.mark.parametrize("monitor", [False, True])
def test_a_compiled_policy_trains_and_loads_as_one_that_is_not(tmp_path, form, monitor):
    models, logged = [], []
    for compiled in (False, True):
        model, callback = form.make()
        if compiled:
            model.policy = th.compile(model.policy, backend="eager")
        callbacks = [callback] * (callback is not None) + [ChurnMonitor(interval=3)] * monitor
        models.append(model.learn(form.n_timesteps, callback=callbacks))
        logged.append(dict(model.logger.name_to_value))
    plain, compiled = models
    assert logged[0] == logged[1]
    assert any(key.startswith("churn/") for key in logged[0]) == (form.algorithm is not DoubleDQN)
    assert any(key.startswith("churn_monitor/") for key in logged[0]) == monitor
    loaded = save_and_load(compiled, tmp_path)
    for model in (compiled, loaded):
        for p, q in zip(plain.policy.parameters(), model.policy.parameters(), strict=True):
            assert th.equal(p, q)
    for model in (plain, loaded):
        go_on(model, form.make()[1])
    assert_equal(plain, loaded)


# --- What stock algorithms load, and the other way round -------------------------------------------------------------------


@each_form
def test_stock_algorithms_load_it(form, tmp_path):
    model = learn(form)
    model.save(tmp_path / "model")
    loaded = form.stock.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    assert not differ(model, loaded)
    loaded.learn(64)
    form.stock("MlpPolicy", RandomEnv(), **form.settings).set_parameters(tmp_path / "model")
    # Nothing of it needs this package
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    pickles = [base64.b64decode(value[":serialized:"]) for value in data.values() if ":serialized:" in str(value)]
    assert len(pickles) > 5
    assert not any(b"sb3_cchain" in pickled for pickled in pickles)


@each_form
def test_saved_again_by_a_stock_algorithm_the_history_is_kept(form, tmp_path):
    model = learn(form)
    model.save(tmp_path / "model")
    loaded = form.stock.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    loaded.save(tmp_path / "unchanged")
    loaded.learn(64, reset_num_timesteps=False).save(tmp_path / "trained")
    for name, has_reference in (("unchanged", True), ("trained", False)):
        again = form.algorithm.load(tmp_path / name, env=RandomEnv(), device="cpu")
        if form.callback:
            again.set_logger(configure(None, []))
            form.callback(**ADAPTIVE).init_callback(again)
        reducer = again.churn_state.reducers.first
        assert reducer.coefficient.value == model.churn_state.reducers.first.coefficient.value != 1
        # What changed on the reference batch in training without churn reduction is no churn
        assert (reducer.reference is not None) == has_reference


@each_form
@pytest.mark.parametrize("as_saved", [False, True])
def test_other_weights_are_no_churn(form, as_saved, tmp_path):
    model = form.learn()
    other = form.stock("MlpPolicy", RandomEnv(), **dict(form.settings, seed=1))
    with th.no_grad():
        for parameter in other.policy.parameters():
            parameter.mul_(2)
    model.policy.load_state_dict(other.policy.state_dict())
    if as_saved:
        model = save_and_load(model, tmp_path)
    references = []

    class Watch(BaseCallback):
        def _on_training_start(self):
            references.append(self.model.churn_state.reducers.first.reference)

        def _on_step(self):
            return True

    _, callback = form.make()
    model.learn(form.n_timesteps // 2, [*filter(None, [callback]), Watch()], reset_num_timesteps=False)
    assert references == [None]


@each_form
def test_parameters_are_tensors_by_the_names_of_the_stock_algorithm(form):
    model = form.learn()
    parameters = model.get_parameters()
    assert set(parameters) == {"policy", "policy.optimizer"}
    assert all(th.is_tensor(tensor) for tensor in parameters["policy"].values())
    form.stock("MlpPolicy", RandomEnv(), **form.settings).set_parameters(parameters)
    for missing in parameters:
        some = {name: state for name, state in parameters.items() if name != missing}
        with pytest.raises(ValueError, match="Names of parameters do not match"):
            model.set_parameters(some)
        model.set_parameters(some, exact_match=False)


# --- Double DQN ------------------------------------------------------------------------------------------------------------

each_dqn = pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])


def test_arguments_of_double_dqn_can_be_changed_on_loading(tmp_path):
    loaded = save_and_load(FORMS["CChainDQN"].learn(), tmp_path, loss="mse", double_q=False)
    assert (loaded.loss, loaded.double_q) == ("mse", False)
    loaded.learn(50)


@pytest.mark.parametrize("argument, error", [({"loss": "mae"}, ValueError), ({"double_q": "yes"}, TypeError)])
def test_bad_arguments_on_loading(tmp_path, argument, error):
    DoubleDQN("MlpPolicy", RandomEnv(), device="cpu").save(tmp_path / "model")
    ((name, value),) = argument.items()
    with pytest.raises(error, match=f"`{name}` must be .* got {value!r}"):
        DoubleDQN.load(tmp_path / "model", env=RandomEnv(), device="cpu", **argument)


@each_dqn
def test_learning_rate_can_be_changed_on_loading(tmp_path, cls):
    cls("MlpPolicy", RandomEnv(), **DQN_SETTINGS).learn(40).save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu", learning_rate=0.5)
    loaded.learn(40)
    assert loaded.policy.optimizer.param_groups[0]["lr"] == 0.5


@each_dqn
def test_n_steps_can_be_changed_on_loading(tmp_path, cls):
    cls("MlpPolicy", RandomEnv(), **DQN_SETTINGS).learn(40).save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu", n_steps=3, replay_buffer_class=None)
    assert isinstance(loaded.replay_buffer, NStepReplayBuffer) and loaded.replay_buffer.n_steps == 3
    loaded.learn(40)
    assert loaded._n_updates == 40


class Watch(BaseCallback):
    """Lists the environment steps at which the target network is copied, and the exploration rate of each step."""

    def __init__(self):
        super().__init__()
        self.copies, self.rates = [], []

    def _on_step(self):
        # The model copies at the end of the step, after its callbacks
        if (self.model._n_calls + 1) % self.model.target_update_interval == 0:
            self.copies.append(self.num_timesteps)
        self.rates.append(self.model.exploration_rate)
        return True


@each_dqn
def test_exploration_and_target_updates_go_on_over_several_loads(tmp_path, cls):
    settings = {**DQN_SETTINGS, "target_update_interval": 30, "exploration_fraction": 0.5}
    watch = Watch()
    model = cls("MlpPolicy", RandomEnv(), **settings).learn(40, callback=watch)
    assert watch.rates[1] > 0.9
    for _ in range(4):
        model = save_and_load(model, tmp_path)
        model.learn(40, reset_num_timesteps=False, callback=watch)
    assert watch.copies == [30, 60, 90, 120, 150, 180]
    # In all later parts more than half of all the steps have been made
    assert watch.rates[40:] == [pytest.approx(0.05)] * 160


@each_dqn
@pytest.mark.parametrize(
    "make_env, policy, arguments",
    [
        (RandomEnv, "MlpPolicy", dict(train_freq=(1, "episode"), gradient_steps=2)),
        (
            RandomEnv,
            "MlpPolicy",
            dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
        ),
        (lambda: BitFlippingEnv(n_bits=4), "MultiInputPolicy", dict(replay_buffer_class=HerReplayBuffer)),
    ],
    ids=["episodes", "memory", "HER"],
)
def test_other_arguments_of_dqn_go_on_after_loading(tmp_path, cls, make_env, policy, arguments):
    model = cls(policy, make_env(), **{**DQN_SETTINGS, **arguments}).learn(60)
    loaded = save_and_load(model, tmp_path, make_env())
    n_updates = loaded._n_updates
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded.learn(40, reset_num_timesteps=False)
    assert loaded._n_updates > n_updates == model._n_updates > 0


@each_dqn
def test_a_lost_replay_buffer_is_warned_of(tmp_path, cls):
    model = cls("MlpPolicy", RandomEnv(), **DQN_SETTINGS).learn(50)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")

    def warned(reset_num_timesteps=False, load_buffer=False, times=1, **changed):
        loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu", **changed)
        if load_buffer:
            loaded.load_replay_buffer(tmp_path / "buffer")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(times):
                loaded.learn(10, reset_num_timesteps=reset_num_timesteps)
        return [str(warning.message) for warning in caught]

    (message,) = warned(times=2)
    assert "at step 50, after `learning_starts=20`, with 0 transitions in the replay buffer" in message
    assert warned(load_buffer=True) == []
    assert warned(reset_num_timesteps=True) == []  # random steps first, as at the beginning
    assert warned(learning_starts=100) == []


def test_a_short_training_that_goes_on_has_lost_nothing(recwarn):
    model = CChainDQN("MlpPolicy", RandomEnv(), **{**DQN_SETTINGS, "learning_starts": 0, "batch_size": 32})
    for _ in range(3):
        model.learn(5, reset_num_timesteps=False)
    assert len(recwarn) == 0
