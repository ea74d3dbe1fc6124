"""Episodes that are cut count as ended."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm


class NoBootstrapAtCuts(BaseCallback):
    """
    Makes an algorithm take an episode that is cut, by a limit of time or by a switch, for one that ended: no value stands for
    the rest of it. SB3 bootstraps there. The code released with the paper does not in DeepMind Control, whose episodes are all
    cut after 1000 steps.

    Give it behind all callbacks that read ``TimeLimit.truncated``, which it changes. ``ContinualMetrics`` does.

    :raises TypeError: When training starts, for an algorithm that does not bootstrap: ARS
    """

    def _init_callback(self) -> None:
        if not isinstance(self.model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
            raise TypeError(f"NoBootstrapAtCuts is for algorithms that bootstrap, got {type(self.model).__name__}")

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            info["TimeLimit.truncated"] = False
        return True
