"""Logs the neural tangent kernel during training."""

import warnings
from pathlib import Path

import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.analysis.metrics.ntk import ntk_statistics
from sb3_cchain.analysis.ntk import has_ntk, policy_ntk, q_ntk
from sb3_cchain.analysis.plots import import_matplotlib, plot_ntk
from sb3_cchain.analysis.training_interval import TrainingInterval
from sb3_cchain.callbacks.log_folder import log_path
from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.validation import check_number

# When `picture_interval` is not given
DEFAULT_PICTURE_INTERVAL = 50


class NTKCallback(TrainingInterval):
    r"""
    Logs the empirical neural tangent kernel (NTK), Section 5.2 and Appendix B of the C-CHAIN paper
    (https://arxiv.org/abs/2506.00592). According to the paper, its rank falls as plasticity is lost. With on-policy algorithms
    it is the NTK of the policy over m minibatches of each rollout (:func:`~sb3_cchain.analysis.ntk.policy_ntk`), with DQN and
    QRDQN that of the action values over m transitions of the replay buffer (:func:`~sb3_cchain.analysis.ntk.q_ntk`).

    Logged, of the matrix :math:`N` of size m:

    - ``ntk/srank``: the least number of singular values that hold 1 − δ of their sum
      (:func:`~sb3_cchain.analysis.metrics.rank.srank`), the paper's "approximate rank"
    - ``ntk/effective_rank``: the exponential of the entropy of their shares of the sum
      (:func:`~sb3_cchain.analysis.metrics.rank.effective_rank`)
    - ``ntk/off_diagonal_sum``, ``ntk/diagonal_sum``: sums of :math:`|N(i, j)|` off and on the diagonal
    - ``ntk/condition_number``: greatest singular value divided by the least
    - ``ntk/matrix``: a picture of the matrix, in TensorBoard and as a PNG file. A file that cannot be written gives a warning,
      and training goes on.

    The paper has m = 100 and δ = 0.01, at every iteration.

    It acts at the end of the first rollout after which the model learns, before that update; then at the end of each rollout
    in which a multiple of ``interval`` was reached. Training is the same with and without it. It costs m forward and backward
    passes of a minibatch, as much as an epoch of the policy's part of the update, vectorised where there are no convolutions;
    and m times the memory of the parameters. With large networks, take a greater ``interval``.

    :param n_minibatches: m, the size of the matrix; limited by the size of the rollout
    :param delta: δ
    :param interval: Between two matrices: calls of ``train()`` for on-policy algorithms, gradient updates for DQN; None for 1
        and 1000
    :param picture_interval: Matrices from one picture to the next, beginning with the first; 0 for no pictures; None for 50,
        or for no pictures when matplotlib is not installed
    :param path: Folder of the PNG files; by default ``ntk`` in the folder of the logs, if the model has ``tensorboard_log`` or
        was given a logger by ``set_logger()``
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When ``picture_interval`` or ``path`` asks for pictures and matplotlib is not installed
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN or QRDQN, and for recurrent
        policies
    """

    model: OnPolicyAlgorithm | DQN
    # The latest NTK
    matrix: th.Tensor

    def __init__(
        self,
        n_minibatches: int = 100,
        delta: float = 0.01,
        interval: int | None = None,
        picture_interval: int | None = None,
        path: str | Path | None = None,
    ):
        super().__init__(interval, default_on_policy=1, default_off_policy=1000)
        check_number("n_minibatches", n_minibatches, 2, integer=True)
        check_number("delta", delta, 0, 1)
        if picture_interval is not None:
            check_number("picture_interval", picture_interval, 0, integer=True)
        if path is not None and Path(path).exists() and not Path(path).is_dir():
            raise ValueError(f"`path` must be a folder, got {str(path)!r}, which is a file")
        if picture_interval or (path is not None and picture_interval is None):
            import_matplotlib()  # fails now rather than in training
        self.n_minibatches = n_minibatches
        self.delta = delta
        self.picture_interval = picture_interval
        self.path = None if path is None else Path(path)
        self._n_matrices = 0

    def _init_callback(self) -> None:
        if not has_ntk(self.model):
            raise TypeError(
                "NTKCallback is for on-policy algorithms, DQN and QRDQN, without recurrent networks; got "
                f"{type(self.model).__name__}"
            )

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.picture_interval is None:
            self.picture_interval = self._default_picture_interval()
        self._folder = self.path or log_path(self.model, "ntk")

    def _default_picture_interval(self) -> int:
        try:
            import_matplotlib()
        except ImportError as error:
            warnings.warn(f"NTKCallback logs numbers and no pictures. {error}", stacklevel=2)
            return 0
        return DEFAULT_PICTURE_INTERVAL

    def _on_rollout_end(self) -> None:
        if not self._is_due_to_look():
            return
        with unchanged_random_state():
            if isinstance(self.model, OnPolicyAlgorithm):
                self.matrix = policy_ntk(self.model, self.n_minibatches)
            else:
                self.matrix = q_ntk(self.model, self.n_minibatches)
        for name, value in ntk_statistics(self.matrix, self.delta).items():
            self.logger.record(f"ntk/{name}", value)
        if self.matrix.isfinite().all() and self.picture_interval and self._n_matrices % self.picture_interval == 0:
            self._log_picture()
        self._n_matrices += 1

    def _log_picture(self) -> None:
        figure = plot_ntk(self.matrix, f"NTK at step {self.num_timesteps}")
        self.logger.record("ntk/matrix", Figure(figure, close=False), exclude=("stdout", "log", "json", "csv"))
        if self._folder is None:
            return
        file = self._folder / f"ntk_{self.num_timesteps}.png"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            figure.savefig(file)
        except OSError as error:
            warnings.warn(f"NTKCallback could not write {file} ({error}). Training goes on.", stacklevel=2)
