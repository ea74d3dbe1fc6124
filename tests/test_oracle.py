"""Each task is learned from scratch."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainCallback, ContinualEnv, TaskSync
from sb3_cchain.methods import Oracle
from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.networks.impala_policy import ImpalaPolicy
from tests.envs import CountEnv, RandomEnv
from tests.method_models import ALGORITHMS, STEPS_PER_TASK, make_env, make_model, parameters


class Spy(BaseCallback):
    """Put behind Oracle: what the first action of each rollout is chosen with."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        buffer = getattr(self.model, "replay_buffer", None)
        self.seen.append(
            dict(
                timesteps=self.model.num_timesteps,
                parameters=parameters(self.model),
                n_moments=len(self.model.policy.optimizer.state),
                in_buffer=None if buffer is None else buffer.size(),
                reference=getattr(getattr(self.model, "churn_reducer", None), "reference", None),
            )
        )

    def at(self, timesteps):
        return next(seen for seen in self.seen if seen["timesteps"] == timesteps)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_fresh_draw_before_the_first_action_of_each_task(name):
    oracle, spy = Oracle(), Spy()
    model = make_model(name)
    held = [model.policy, model.policy.optimizer, *model.policy.parameters()]
    model.learn(3 * STEPS_PER_TASK, callback=[oracle, spy], log_interval=None)
    assert oracle.n_resets == model.logger.name_to_value["oracle/n_resets"] == 2
    starts = [spy.at(task * STEPS_PER_TASK) for task in range(3)]
    for start in starts:
        assert start["n_moments"] == 0
        assert start["reference"] is None
    weights = [name for name, tensor in starts[0]["parameters"].items() if "weight" in name]
    assert len(weights) >= 4
    for weight in weights:
        draws = [start["parameters"][weight] for start in starts]
        assert not any(th.equal(draws[i], draws[j]) for i, j in [(0, 1), (0, 2), (1, 2)]), weight
    # In the middle of a task there are moments, and the buffer has kept the old task's samples
    middle = spy.at(STEPS_PER_TASK + 16)
    assert middle["n_moments"] > 0
    assert middle["in_buffer"] in (None, STEPS_PER_TASK + 16)
    # Nobody holds a stale object
    assert all(a is b for a, b in zip(held, [model.policy, model.policy.optimizer, *model.policy.parameters()], strict=True))


@pytest.mark.parametrize("name", ["DQN", "CChainDQN"])
def test_target_network_and_replay_buffer(name):
    spy = Spy()
    model = make_model(name, target_update_interval=10_000)
    model.learn(3 * STEPS_PER_TASK, callback=[Oracle(reset_replay_buffer=True), spy])
    for task in (1, 2):
        start = spy.at(task * STEPS_PER_TASK)
        assert start["in_buffer"] == 0
        online = {k: v for k, v in start["parameters"].items() if k.startswith("q_net.")}
        for key, tensor in online.items():
            assert th.equal(tensor, start["parameters"][key.replace("q_net.", "q_net_target.", 1)])
    assert spy.at(STEPS_PER_TASK + 16)["in_buffer"] == 16
    assert model.q_net is model.policy.q_net


def test_gradients_of_the_fresh_network_are_its_own():
    """As Adam's first step after a reset: the learning rate, in the direction of the gradient's sign."""
    model = make_model("PPO", learning_rate=1e-3, n_epochs=1, batch_size=16, max_grad_norm=1e9, env=make_env(3, 16))
    spy = Spy()
    model.learn(48, callback=[Oracle(), spy])
    before, after = spy.at(32)["parameters"], parameters(model)
    steps = th.cat([(after[name] - before[name]).flatten().abs() for name in before if "bias" in name])
    assert steps.max() <= 1e-3 * 1.001 and (steps > 0.9e-3).any()


def test_a_switch_within_a_rollout_waits_for_its_end():
    spy = Spy()
    oracle = Oracle()
    model = make_model("PPO", env=make_env(3, 24))  # rollouts of 16 steps
    model.learn(64, callback=[oracle, spy])
    # Task 1 begins at 24, in the rollout from 16 to 32; task 2 at 48, where a rollout ends
    assert [seen["n_moments"] == 0 for seen in spy.seen] == [True, False, True, True]
    assert oracle.n_resets == 2
    off_policy = Spy()
    model = make_model("DQN", env=make_env(2, 25), train_freq=4)
    model.learn(40, callback=[Oracle(), off_policy])
    # Updates go on until 24, the switch is at 25
    assert [seen["n_moments"] == 0 for seen in off_policy.seen if seen["timesteps"] in (24, 28, 32)] == [False, True, False]


def test_environments_side_by_side():
    spy = Spy()
    env = make_vec_env(make_env, n_envs=2)
    model = make_model("CChainPPO", env=env, n_steps=8)
    model.learn(3 * STEPS_PER_TASK, callback=[Oracle(), spy])
    assert [seen["timesteps"] for seen in spy.seen if seen["n_moments"] == 0] == [0, STEPS_PER_TASK, 2 * STEPS_PER_TASK]


@pytest.mark.parametrize("n_before, expected", [(STEPS_PER_TASK, 2), (STEPS_PER_TASK + 16, 1)])
@pytest.mark.parametrize("name", ["CChainPPO", "CChainDQN", "PPO"])
def test_saved_at_a_switch_and_resumed(tmp_path, name, n_before, expected):
    callbacks = [TaskSync()]
    model = make_model(name)
    model.learn(n_before, callback=[*callbacks, Oracle()]).save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_env(), device="cpu")
    oracle, spy = Oracle(), Spy()
    loaded.learn(3 * STEPS_PER_TASK - n_before, callback=[TaskSync(), oracle, spy], reset_num_timesteps=False)
    assert oracle.n_resets == expected
    assert (spy.seen[0]["n_moments"] == 0) == (expected == 2)


def test_training_that_begins_anew_keeps_the_network():
    model = make_model("PPO")
    model.learn(2 * STEPS_PER_TASK, callback=Oracle())
    trained, spy = parameters(model), Spy()
    model.learn(16, callback=[Oracle(), spy])
    assert all(th.equal(trained[name], tensor) for name, tensor in spy.seen[0]["parameters"].items())


@pytest.mark.parametrize("name", ["PPO", "CChainPPO", "CChainDQN"])
def test_one_environment_after_the_other(name):
    """Each environment that set_env() gives is a task; the same one again is not."""
    worlds, n_resets, starts = [CountEnv(), CountEnv(1), CountEnv(2)], [], []
    model = make_model(name, env=worlds[0])
    for world in (worlds[0], worlds[0], worlds[1], worlds[1], worlds[2]):
        oracle, spy = Oracle(), Spy()
        model.set_env(world)
        model.learn(16, callback=[oracle, spy], reset_num_timesteps=False)
        n_resets.append(oracle.n_resets)
        starts.append(spy.seen[0]["n_moments"] == 0)
    assert n_resets == [0, 0, 1, 0, 1]
    assert starts == [True, False, True, False, True]


def test_a_loaded_model_goes_on_in_its_environment(tmp_path):
    model = make_model("PPO", env=CountEnv())
    model.learn(16, callback=Oracle(), reset_num_timesteps=False)
    model.save(tmp_path / "model")
    loaded, oracle = type(model).load(tmp_path / "model", env=CountEnv(), device="cpu"), Oracle()
    loaded.learn(16, callback=oracle, reset_num_timesteps=False)
    assert oracle.n_resets == 0
    loaded.set_env(CountEnv(1))
    loaded.learn(16, callback=oracle, reset_num_timesteps=False)
    assert oracle.n_resets == 1


def test_c_chain_forgets():
    model = make_model("CChainPPO", churn_warmup=1)
    seen = []

    class SpyReducer(Spy):
        def _on_rollout_start(self):
            reducer = self.model.churn_reducer
            seen.append((int(reducer.coefficient.n_seen), reducer.reference is None))

    model.learn(2 * STEPS_PER_TASK, callback=[Oracle(), SpyReducer()])
    assert seen == [(0, True), (1, False), (0, True), (1, False)]


def test_no_minibatch_of_the_old_task_waits_when_the_replay_buffer_was_emptied():
    model, tasks = make_model("CChainDQN", churn_reference="next"), {}
    td_loss = model._td_loss

    def watched_td_loss(replay_data, *args):
        tasks.setdefault(model.num_timesteps > STEPS_PER_TASK, set()).update(
            replay_data.observations.floor().flatten().tolist()
        )
        return td_loss(replay_data, *args)

    model._td_loss = watched_td_loss
    model.learn(2 * STEPS_PER_TASK, callback=Oracle(reset_replay_buffer=True))
    assert tasks == {False: {0}, True: {1}}


def test_c_chain_as_a_callback_forgets():
    model, c_chain, seen = make_model("PPO"), CChainCallback(churn_warmup=1), []

    class SpyReducer(Spy):
        def _on_rollout_start(self):
            seen.append((int(c_chain.churn_reducer.coefficient.n_seen), c_chain.churn_reducer.reference is None))

    model.learn(2 * STEPS_PER_TASK, callback=[c_chain, Oracle(), SpyReducer()])
    assert seen == [(0, True), (1, False), (0, True), (1, False)]


def test_evaluation_follows(tmp_path):
    eval_callback = EvalCallback(make_env(), eval_freq=16, n_eval_episodes=1, verbose=0)
    model = make_model("PPO")
    model.learn(2 * STEPS_PER_TASK, callback=[TaskSync(), Oracle(), eval_callback])
    assert eval_callback.model is model and eval_callback.last_mean_reward == 7


def test_state_dependent_exploration():
    env = ContinualEnv([lambda: RandomEnv(action_space=spaces.Box(-1, 1, (2,), np.float32))] * 2, 32)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=8, n_epochs=1, use_sde=True, seed=0, device="cpu")
    noise = []

    class SpyNoise(Spy):
        def _on_rollout_start(self):
            noise.append(self.model.policy.action_dist.exploration_mat.detach().abs().mean().item())

    model.policy.log_std.data.fill_(-9.0)
    model.learn(64, callback=[Oracle(), SpyNoise()])
    # The fresh network's own: exp(0), not exp(-9)
    assert noise[1] < 1e-3 < 0.1 < noise[2]


def test_fresh_policy_has_the_initialisation_of_its_class():
    space = spaces.Box(0, 255, (12, 12, 3), np.uint8)
    model = PPO(ImpalaPolicy, RandomEnv(space), n_steps=8, batch_size=8, seed=0, device="cpu")
    draws = [fresh_policy(model).state_dict() for _ in range(2)]
    key = "features_extractor.linear.1.weight"
    assert not th.equal(draws[0][key], draws[1][key])
    bound = (6 / sum(draws[0][key].shape)) ** 0.5  # Xavier's
    assert 0.99 * bound < draws[0][key].abs().max() <= bound
    q_model = DQN("MlpPolicy", RandomEnv(), policy_kwargs=dict(net_arch=[5]), seed=0, device="cpu")
    assert fresh_policy(q_model).q_net.q_net[0].weight.abs().max() <= 4**-0.5  # PyTorch's


def test_what_it_refuses():
    with pytest.raises(TypeError, match="`reset_replay_buffer` must be True or False, got 1"):
        Oracle(1)
    with pytest.raises(TypeError, match="the training environment is not one"):
        make_model("PPO", env=CountEnv()).learn(10, callback=Oracle())
    with pytest.raises(TypeError, match="`reset_replay_buffer=True` is for off-policy algorithms, got PPO"):
        make_model("PPO").learn(10, callback=Oracle(reset_replay_buffer=True))
    box = RandomEnv(action_space=spaces.Box(-1, 1, (2,), np.float32))
    with pytest.raises(TypeError, match=r"Oracle is for algorithms with a single optimiser .*, got SAC"):
        SAC("MlpPolicy", box, buffer_size=10, device="cpu").learn(10, callback=Oracle())
    oracle, model = Oracle(reset_replay_buffer=True), make_model("DQN")
    model.replay_buffer = HerReplayBuffer.__new__(HerReplayBuffer)
    with pytest.raises(TypeError, match="cannot empty a HerReplayBuffer"):
        oracle.init_callback(model)
