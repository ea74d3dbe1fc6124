"""Sets up TensorBoard: charts in groups, and the hyperparameters."""

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat

from sb3_cchain.tensorboard.hyperparameters import TensorBoardHyperparameters, hyperparameters
from sb3_cchain.tensorboard.layout import TensorBoardLayout


class TensorBoardOverview(BaseCallback):
    """
    Groups the charts of a run in TensorBoard's Custom Scalars tab, and writes the hyperparameters to its HPARAMS tab.

    There are charts of returns, C-CHAIN, monitored churn, the NTK, network health and related methods, as far as they are
    logged. The hyperparameters are the arguments of the model, and the names of its algorithm, policy and environment.

    The algorithms with churn reduction, ``CChainCallback``, ``ContinualMetrics`` and all callbacks that look at networks in
    training do the same by themselves, so give it to other algorithms without those callbacks. It does nothing twice, and
    nothing for a model that does not log to TensorBoard. Hyperparameters that the user logs by SB3's ``HParam`` take the place
    of these.
    """

    def _on_training_start(self) -> None:
        add_overview(self.model)

    def _on_step(self) -> bool:
        return True


def add_overview(model: BaseAlgorithm) -> None:
    """
    What :class:`TensorBoardOverview` does, once for each logger.

    :param model: A model that is about to be trained
    """
    outputs = getattr(model.logger, "output_formats", [])  # a logger of one's own need not derive from SB3's
    if any(isinstance(output, TensorBoardLayout) for output in outputs):
        return
    for output in outputs:
        if isinstance(output, TensorBoardOutputFormat):
            new = [TensorBoardLayout(output.writer), TensorBoardHyperparameters(output.writer, hyperparameters(model))]
            model.logger.output_formats = [*outputs, *new]  # the user's own list stays as it is
            return
