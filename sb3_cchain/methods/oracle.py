"""An agent that learns each task from scratch."""

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.her import HerReplayBuffer

from sb3_cchain.methods.churn_reducers import churn_reducers
from sb3_cchain.methods.fresh_policy import fresh_policy, require_policy_optimizer
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_bool

add_charts("Related methods", {"Oracle: resets": "oracle/n_resets"})


class Oracle(TaskBoundary):
    """
    Re-initialises networks and optimiser whenever the task switches. Such an agent knows about the switches and carries
    nothing over from one task to the next; it is the oracle of the C-CHAIN paper (https://arxiv.org/abs/2506.00592, Section
    5).

    The parameters, frozen ones too, become a fresh draw of their initialisation, the same one for the target network. The
    optimiser becomes that of a fresh model, without moments or steps. C-CHAIN, where the model has it, forgets its reference
    batch and the history of λ. No object is replaced.

    It happens between rollouts. When tasks last for whole rollouts, that is before the first action in the new task. Otherwise
    it is up to a rollout late: the rollout that has data of both tasks trains the network that is then dropped.

    It costs one construction of the policy per task. Logged: ``oracle/n_resets``, the resets since ``learn()`` was called.

    Not reset: the exploration rate of DQN, the learning rate and other schedules, the statistics of ``VecNormalize``
    (:class:`~sb3_cchain.envs.TaskVecNormalize` restarts them). The released code makes a whole new agent for each task, which
    in MinAtar includes the replay buffer (``reset_replay_buffer=True`` here) and the exploration rate.

    :param reset_replay_buffer: Whether to empty the replay buffer too
    :raises TypeError: When ``reset_replay_buffer`` is not a boolean; when training starts, for an environment that is not
        continual, for algorithms with several optimisers, and where there is no replay buffer that can be emptied
    """

    changes_network = True  # between rollouts

    def __init__(self, reset_replay_buffer: bool = False):
        super().__init__()
        check_bool("reset_replay_buffer", reset_replay_buffer)
        self.reset_replay_buffer = reset_replay_buffer

    def _init_callback(self) -> None:
        require_policy_optimizer(self)
        if self.reset_replay_buffer:
            if not isinstance(self.model, OffPolicyAlgorithm):
                raise TypeError(f"`reset_replay_buffer=True` is for off-policy algorithms, got {type(self.model).__name__}")
            if isinstance(self.model.replay_buffer, HerReplayBuffer):
                raise TypeError("`reset_replay_buffer=True`: SB3 cannot empty a HerReplayBuffer")

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.n_resets: int = 0

    def _on_task_switch(self) -> None:
        policy, fresh = uncompiled(self.model.policy), fresh_policy(self.model)
        policy.load_state_dict(fresh.state_dict())
        policy.optimizer.load_state_dict(fresh.optimizer.state_dict())
        if isinstance(self.model, OnPolicyAlgorithm) and self.model.use_sde:
            # The rollout's exploration noise has been drawn from the standard deviation that is gone
            policy.reset_noise(self.model.n_envs)
        if self.reset_replay_buffer:
            assert isinstance(self.model, OffPolicyAlgorithm) and self.model.replay_buffer is not None
            self.model.replay_buffer.reset()
        for reducer in churn_reducers(self):
            reducer.forget_reference()
            reducer.coefficient.reset()
        self.n_resets += 1

    def _on_rollout_end(self) -> None:
        self.logger.record("oracle/n_resets", self.n_resets)
