"""PPO with churn reduction."""

from typing import Any

from stable_baselines3 import PPO

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.algorithms.on_policy import PolicyChurnOptions
from sb3_cchain.networks.lean_distributions import make_lean
from sb3_cchain.validation import check_bool


class CChainPPO(ChurnAlgorithm, PPO):
    """
    Proximal Policy Optimization with Continual Churn Approximated Reduction (C-CHAIN).

    Paper: https://arxiv.org/abs/2506.00592 (Tang et al., ICML 2025)

    It is SB3's :class:`~stable_baselines3.PPO`, with all of its arguments, plus λ·L_churn in the loss of each update, where
    L_churn is the change that the update before made to the policy's outputs on a reference batch: the cross-entropy for
    discrete actions, the mean squared difference of the action means for continuous ones.

    Deviations from the code released with the paper:

    - the reference batch shares no sample with the minibatch whose update is measured, as the paper demands; the released
      code draws both independently;
    - λ is adapted to the mean losses over an iteration's updates; in DeepMind Control the released code takes those of the
      last minibatch, as ``churn_base_loss="last"`` does: the surrogate there is greater in absolute value;
    - the old outputs are computed before the update instead of by a copy of the network after it, with the same result.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param args: Further arguments of PPO
    :param churn_target: What is held still: ``"policy"``, which ``"auto"`` is, too, the state ``"value"``, or ``"both"``.
        Without ``"policy"``, ``churn_base_loss`` has no effect.
    :param churn_coef: λ, the weight of the churn loss: a number, ``"auto"`` to keep the churn loss at
        ``target_churn_ratio`` times ``churn_base_loss``, or ``"auto_10"`` to use 10 instead of 1 during the warm-up.
        With 0 it is PPO, to the bit. One for all targets, or a dict, ``{"policy": ..., "value": ...}``.
    :param target_churn_ratio: β, the size of λ·L_churn relative to that loss. ``"auto"`` is 1e4 for discrete actions
        (the paper takes the best of 1e3, 1e4 and 1e5), 0.05 for continuous ones (the paper: 0.05 or 0.5) and 0.01 for values.
        One for all targets, or a dict.
    :param churn_warmup: Iterations (rollout and ``train()``) until λ adapts
    :param churn_window: Iterations that the running means of both losses cover
    :param churn_coef_min: Least value of λ once it adapts
    :param reset_churn_coef: Whether λ starts over (warm-up included) when the task switches, as in the released
        code. Off by default, because C-CHAIN does not need to be told of a switch.
    :param churn_base_loss: ``"actor"`` for the clipped surrogate and the entropy bonus, as in the released code's Gym Control;
        ``"surrogate"`` for the clipped surrogate alone, as in its ProcGen; ``"last"`` for that of the last minibatch, with the
        churn loss of that minibatch, as in its DeepMind Control
    :param churn_component: Which component of the churn gradient is used: ``"full"``, or, as the paper's ablation does
        (Section 5.2), only its ``"projection"`` on PPO's gradient of the actor's parameters or the ``"orthogonal"`` rest.
        It is added before the gradient is clipped.
    :param churn_reference: Where reference batches are taken from, always outside the minibatch whose update they measure:
        ``"independent"`` for other random samples of the rollout, ``"next"`` for the minibatch that is trained on next, which
        costs less because its outputs are needed anyway
    :param churn_batch_size: Size of a reference batch in minibatches: 2, 4 or 8 in the paper's Appendix A.1
    :param lean: Whether the policy gets a lean action distribution (:func:`~sb3_cchain.networks.make_lean`), without checks
        that take as long as a small network. The results are the same, to the bit.
    :param kwargs: Further keyword arguments of PPO
    :raises ValueError: Naming the churn argument that is out of its range; during training, for NaN or infinite rewards,
        observations and churn losses, before an update is made with them
    """

    def __init__(
        self,
        *args: Any,
        churn_base_loss: str = "actor",
        churn_component: str = "full",
        churn_reference: str = "independent",
        churn_batch_size: float = 1.0,
        lean: bool = True,
        **kwargs: Any,
    ):
        self.churn_base_loss = churn_base_loss
        self.churn_component = churn_component
        self.churn_reference = churn_reference
        self.churn_batch_size = churn_batch_size
        self.lean = lean
        check_bool("lean", lean)
        super().__init__(*args, **kwargs)

    def _churn_options(self) -> PolicyChurnOptions:
        if self.churn_component != "full" and self.churn_target in ("value", "both"):
            raise ValueError(
                f'`churn_component` must be "full" unless `churn_target` is "policy", got {self.churn_component!r}'
            )
        if self.churn_base_loss == "last" and self.churn_target in ("value", "both"):
            raise ValueError(
                '`churn_base_loss` must be "actor" or "surrogate" unless `churn_target` is "policy", got \'last\''
            )
        return PolicyChurnOptions(self.churn_base_loss, self.churn_component, self.churn_reference, self.churn_batch_size)

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.lean:
            make_lean(self)
