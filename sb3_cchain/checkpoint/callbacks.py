"""Callbacks that save models during training."""

from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_cchain.checkpoint.files import write_safely
from sb3_cchain.checkpoint.model_files import save_model, save_statistics


class SafeCheckpointCallback(CheckpointCallback):
    """
    Stable-Baselines3's ``CheckpointCallback``, whose files are whole or absent: training that is killed while it saves leaves
    no torn file. Names and arguments are those of ``CheckpointCallback``.
    """

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            # The model comes last, so that all that belongs to it is there by then
            if self.save_replay_buffer and getattr(self.model, "replay_buffer", None) is not None:
                with write_safely(self._checkpoint_path("replay_buffer_", "pkl")) as path:
                    self.model.save_replay_buffer(path)  # type: ignore[attr-defined]
            if self.save_vecnormalize:
                save_statistics(self.model, self._checkpoint_path("vecnormalize_", "pkl"))
            model_path = self._checkpoint_path(extension="zip")
            save_model(self.model, model_path)
            if self.verbose >= 2:
                print(f"Saving model checkpoint to {model_path}")
        return True


class SaveBestModel(BaseCallback):
    """
    Saves the model, and the statistics of its ``VecNormalize`` if there is one, whenever it is called: for ``EvalCallback``'s
    ``callback_on_new_best``. The files are whole or absent, which those of ``best_model_save_path`` are not.

    :param path: The zip file of the model
    :param statistics_path: The pickle file of the statistics
    """

    def __init__(self, path: str | Path, statistics_path: str | Path):
        super().__init__()
        self.path = path
        self.statistics_path = statistics_path

    def _on_step(self) -> bool:
        save_statistics(self.model, self.statistics_path)
        save_model(self.model, self.path)
        return True
