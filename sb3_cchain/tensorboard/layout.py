"""The charts of TensorBoard's Custom Scalars tab."""

import re
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.logger import KVWriter

if TYPE_CHECKING:  # TensorBoard need not be installed
    from torch.utils.tensorboard import SummaryWriter


# Category → title of the chart → regular expression of the tags in it, whole tags. One unit a chart.
LAYOUT: dict[str, dict[str, str]] = {
    "Returns": {
        "Mean return on the task being trained": "continual/mean_return(_with_cut)?",
        "Reward per step on the task being trained": "continual/reward_per_step",
        "Average return of each task": r"continual/average_task_\d+",
        "Average performance over the tasks so far": "continual/average_performance",
        "Task being trained": "continual/task_id",
        "Reward per episode": "rollout/ep_rew_mean|eval/mean_reward",
    },
    "Evaluations on the tasks": {
        "Mean return on the task being trained": "evaluation/mean_return",
        "Mean return on each task": r"continual_eval/task_\d+",
        "Mean return over all tasks": "continual_eval/average",
        "Forgetting, mean over the tasks that were left": "continual_eval/forgetting",
        "Zero-shot transfer, mean over the tasks to come": "continual_eval/zero_shot_transfer",
    },
    "C-CHAIN": {
        "Policy churn of an update": "churn/policy_churn",
        "Value churn of an update": "churn/value_churn",
        "Greedy actions that an update changes, share": "churn/greedy_action_changes",
        # With several targets, one of each
        "Churn loss": "churn/((policy|value)/)?loss",
        "λ": "churn/((policy|value)/)?coef",
        "λ · churn loss / base loss": "churn/((policy|value)/)?relative_loss",
    },
    "Churn, monitored": {
        "Policy churn": "churn_monitor/(fixed|fresh)/policy_churn",
        "Value churn": "churn_monitor/(fixed|fresh)/value_churn",
        "Greedy actions that change, share": "churn_monitor/(fixed|fresh)/greedy_action_changes",
    },
    "Neural tangent kernel": {
        "srank and effective rank": "ntk/(srank|effective_rank)",
        "Sum of |off-diagonal|": "ntk/off_diagonal_sum",
        "Sum of |diagonal|": "ntk/diagonal_sum",
        "Condition number": "ntk/condition_number",
    },
    "Network health": {
        "Dormant units, share": "health/dormant_share(/.+)?",
        "Active units, share": "health/active_share(/.+)?",
        "srank of the features": "health/feature_srank(/.+)?",
        "Effective rank of the features": "health/feature_effective_rank(/.+)?",
        "Norm of the weights": "health/weight_norm(/.+)?",
        "Distance from initialisation": "health/distance_from_init(/.+)?",
        "Norm of the gradient, after clipping": "health/gradient_norm(/.+)?",
    },
    # Each method adds its charts by `add_charts`
    "Related methods": {},
}


def add_charts(category: str, charts: dict[str, str]) -> None:
    """
    Add charts to the layout, as each method does for what it logs.

    :param category: Category, which may be new
    :param charts: Title of the chart → regular expression of the tags in it, whole tags
    """
    LAYOUT.setdefault(category, {}).update(charts)


class TensorBoardLayout(KVWriter):
    """
    Lays out TensorBoard's Custom Scalars tab: the charts of ``LAYOUT`` that have a tag which was logged.

    It is another output of SB3's logger, next to the one for TensorBoard. The layout is written whenever a chart is added to
    it; TensorBoard shows the latest.

    :param writer: The writer of SB3's output for TensorBoard
    """

    def __init__(self, writer: "SummaryWriter"):
        self._writer = writer
        self._tags: set[str] = set()
        self._charts = 0

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """
        :param key_values: What is logged
        :param key_excluded: The outputs that each is not for
        :param step: Environment steps made
        """
        new = {key for key in key_values if "tensorboard" not in key_excluded[key]} - self._tags
        if not new:
            return
        self._tags |= new
        layout = layout_of(self._tags)
        charts = sum(map(len, layout.values()))
        if charts > self._charts:
            self._charts = charts
            # TensorBoard matches the beginning of a tag
            self._writer.add_custom_scalars(
                {
                    category: {title: ["Multiline", [f"({tags})$"]] for title, tags in charts.items()}
                    for category, charts in layout.items()
                }
            )
            self._writer.flush()

    def close(self) -> None:
        """Nothing to close: the writer belongs to SB3's output."""


def layout_of(tags: set[str]) -> dict[str, dict[str, str]]:
    """
    :param tags: What a run logs
    :return: ``LAYOUT`` without the charts and categories that would be empty
    """
    charts = {
        category: {title: regex for title, regex in charts.items() if any(re.fullmatch(regex, tag) for tag in tags)}
        for category, charts in LAYOUT.items()
    }
    return {category: shown for category, shown in charts.items() if shown}
