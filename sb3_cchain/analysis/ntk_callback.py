"""Logs the neural tangent kernel during training."""

from pathlib import Path

import numpy as np
import torch as th
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MatplotlibFigure
from matplotlib.image import AxesImage
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.analysis.metrics.ntk import ntk_statistics
from sb3_cchain.analysis.ntk import policy_ntk, q_ntk
from sb3_cchain.analysis.random_state import unchanged_random_state
from sb3_cchain.analysis.training_interval import TrainingInterval
from sb3_cchain.validation import check_number


class NTKCallback(TrainingInterval):
    r"""
    Logs the empirical neural tangent kernel (NTK), Section 5.2 and Appendix B of the C-CHAIN paper
    (https://arxiv.org/abs/2506.00592), whose rank falls, by the paper, as plasticity is lost: of the policy over m minibatches
    of each rollout with on-policy algorithms (:func:`~sb3_cchain.analysis.ntk.policy_ntk`), of the action values over m
    transitions of the replay buffer with DQN and QRDQN (:func:`~sb3_cchain.analysis.ntk.q_ntk`).

    Logged, of the matrix :math:`N` of size m:

    - ``ntk/srank``: the least number of singular values that hold 1 − δ of their sum
      (:func:`~sb3_cchain.analysis.metrics.rank.srank`), the paper's "approximate rank"
    - ``ntk/effective_rank``: the exponential of the entropy of their shares of the sum
      (:func:`~sb3_cchain.analysis.metrics.rank.effective_rank`)
    - ``ntk/off_diagonal_sum``, ``ntk/diagonal_sum``: sums of :math:`|N(i, j)|` off and on the diagonal
    - ``ntk/condition_number``: greatest by least singular value
    - ``ntk/matrix``: a picture of the matrix, in TensorBoard; the same as a PNG file

    The paper's are m = 100 and δ = 0.01, at every iteration.

    It acts at the end of the first rollout after which the model learns, before that update; then at the end of each rollout
    in which a multiple of ``interval`` was reached. Training is the same with and without it. It costs m forward and backward
    passes of a minibatch, as much as an epoch of the policy's part of the update, vectorised where there are no convolutions;
    and m times the memory of the parameters. With large networks, take a greater ``interval``.

    :param n_minibatches: m, the size of the matrix; it is the rollout's size where that is smaller
    :param delta: δ
    :param interval: Between two matrices: calls of ``train()`` for on-policy algorithms, gradient updates for DQN; None for 1
        and 1000
    :param picture_interval: Matrices from one picture to the next, beginning with the first; 0 for no pictures
    :param path: Folder of the PNG files; by default ``ntk`` in the folder of the logs, if the model has ``tensorboard_log`` or
        was given a logger by ``set_logger()``
    :raises ValueError: Naming the argument that is out of its range
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN or QRDQN, and for recurrent
        policies
    """

    model: OnPolicyAlgorithm | DQN
    # The latest
    matrix: th.Tensor

    def __init__(
        self,
        n_minibatches: int = 100,
        delta: float = 0.01,
        interval: int | None = None,
        picture_interval: int = 50,
        path: str | Path | None = None,
    ):
        super().__init__(interval, default_on_policy=1, default_off_policy=1000)
        check_number("n_minibatches", n_minibatches, 2, integer=True)
        check_number("delta", delta, 0, 1)
        check_number("picture_interval", picture_interval, 0, integer=True)
        self.n_minibatches = n_minibatches
        self.delta = delta
        self.picture_interval = picture_interval
        self.path = None if path is None else Path(path)
        self._n_matrices = 0

    def _init_callback(self) -> None:
        if not isinstance(self.model, (OnPolicyAlgorithm, DQN)) and not hasattr(self.model, "quantile_net"):
            raise TypeError(f"NTKCallback is for on-policy algorithms, DQN and QRDQN, got {type(self.model).__name__}")
        if hasattr(self.model, "_last_lstm_states"):
            raise TypeError(f"NTKCallback does not know recurrent networks, got {type(self.model).__name__}")

    def _on_training_start(self) -> None:
        super()._on_training_start()
        # The logger of a model without `tensorboard_log` writes to a temporary folder, another at each `learn()`
        has_folder = self.model.tensorboard_log is not None or self.model._custom_logger
        folder = self.logger.get_dir() if has_folder else None
        self._folder = self.path or (Path(folder) / "ntk" if folder is not None else None)

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
            figure = plot_ntk(self.matrix, f"NTK at step {self.num_timesteps}")
            self.logger.record("ntk/matrix", Figure(figure, close=False), exclude=("stdout", "log", "json", "csv"))
            if self._folder is not None:
                self._folder.mkdir(parents=True, exist_ok=True)
                figure.savefig(self._folder / f"ntk_{self.num_timesteps}.png")
        self._n_matrices += 1


def plot_ntk(matrix: th.Tensor, title: str) -> MatplotlibFigure:
    """
    :param matrix: An NTK
    :param title: Title
    :return: A picture of the matrix
    """
    with style.context("default"):  # RL Zoo's plots leave seaborn's behind
        figure = MatplotlibFigure(figsize=(4.6, 4), dpi=100, layout="constrained")
        figure.colorbar(draw_ntk(figure.add_subplot(), matrix, title), extend="both", label="inner product of gradients")
    return figure


def draw_ntk(axes: Axes, matrix: th.Tensor, title: str) -> AxesImage:
    """
    Red above 0, blue below, white 0. The 1 % of entries of the greatest size are beyond the ends of the colours, or a few of
    them would leave everything else white.

    :param axes: Where to
    :param matrix: An NTK
    :param title: Title
    :return: The image
    """
    limit = np.quantile(matrix.abs().cpu().numpy(), 0.99)
    axes.set(title=title, xlabel="minibatch", ylabel="minibatch")
    return axes.imshow(matrix.cpu().numpy(), cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
