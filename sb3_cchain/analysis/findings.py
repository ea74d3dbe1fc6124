"""What the doctor looks for: one row for each finding, with its measure, its threshold and what to try."""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cchain.analysis import remedies as r
from sb3_cchain.analysis.remedies import Remedy
from sb3_cchain.analysis.symptoms import Symptoms

Certainty = Literal["likely", "possible"]
CERTAINTIES: tuple[Certainty, ...] = ("likely", "possible")


@dataclass(frozen=True)
class Check:
    """
    A finding that can be made.

    :param name: Its name, of which scripts may make use
    :param title: What is wrong, in a few words
    :param measure: Name of the symptom that it is found by, see ``sb3_cchain.analysis.symptoms``
    :param sick: On which side of the threshold the symptom is a finding
    :param threshold: The threshold, itself healthy
    :param certainty: ``likely`` where training that goes well has hardly ever such a value, ``possible`` where it may
    :param meaning: What the measure is, and what follows from it
    :param source: Where the threshold comes from
    :param remedies: What to try, the first one first
    """

    name: str
    title: str
    measure: str
    sick: Literal["above", "below"]
    threshold: float
    certainty: Certainty
    meaning: str
    source: str
    remedies: tuple[Remedy, ...]

    def is_sick(self, value: float) -> bool:
        """
        :param value: Value of its measure
        :return: Whether it is a finding
        """
        return value > self.threshold if self.sick == "above" else value < self.threshold

    def healthy_range(self) -> str:
        """
        :return: The values of its measure that are no finding, such as "at least 0.02"
        """
        return f"{'at most' if self.sick == 'above' else 'at least'} {self.threshold:g}"

    def worst(self, symptoms: Symptoms) -> tuple[str, float] | None:
        """
        :param symptoms: Symptoms of a model
        :return: The worst part of the networks, ``""`` for a measure that is not of parts, and the value of its measure; None
            where it was not measured
        """
        values = {
            name.partition("/")[2]: value
            for name, value in symptoms.items()
            if name.partition("/")[0] == self.measure and not math.isnan(value)
        }
        if not values:
            return None
        part = (max if self.sick == "above" else min)(values, key=lambda part: values[part])
        return part, values[part]


OWN = "own validation (benchmarks.doctor)"

CHECKS = (
    Check(
        *("collapsed_policy", "The policy always takes the same action", "action_diversity", "below", 0.02, "possible"),
        "How much its actions differ over the observations that it met, noise included: 0 where it always takes the same one, "
        "1 where it takes all equally often. Such an agent no longer reacts to what it sees, and collects data of one kind.",
        OWN,
        (r.ENTROPY_BONUS, r.ENTROPY_TARGET, r.EPSILON, r.SMALLER_RATE, r.CCHAIN, r.LAYER_NORM, r.FIRE),
    ),
    Check(
        *("no_exploration", "The agent does not explore", "exploration", "below", 0.005, "possible"),
        "How much of its actions is chance: the entropy or standard deviation of the policy, the action noise or ε, each as a "
        "share of the greatest possible. At the end of training it is wanted; before, nothing new is tried.",
        f"RL Zoo's settings have an ε of 0.01 or more, half of which is the threshold, and action noise of 0.1 or more; for "
        f"policies {OWN}",
        (r.ENTROPY_BONUS, r.ENTROPY_TARGET, r.EPSILON, r.ACTION_NOISE),
    ),
    Check(
        *("saturated_actions", "The actions are at their bounds", "saturated_actions", "above", 0.95, "possible"),
        "Share of the actions that are, without noise, within 1 % of a bound or beyond it. There the gradient of a squashed "
        "action is nearly 0, and a clipped action no longer follows the policy. Some tasks are solved best in this way.",
        OWN,
        (r.SMALLER_RATE, r.NORMALIZE, r.L2_INIT),
    ),
    Check(
        *("saturated_units", "Hidden units are saturated", "saturated_units", "above", 0.5, "likely"),
        "Share of the outputs of tanh and sigmoid units within 1 % of a bound, in the worst layer (but for the last one "
        "before values). They pass hardly any gradient. Often the observations are large, or the learning rate is.",
        OWN,
        (r.NORMALIZE, r.SMALLER_RATE, r.LAYER_NORM, r.RELU, r.CLIPPING),
    ),
    Check(
        *("rank_collapse", "The features have collapsed", "feature_rank", "below", 1, "likely"),
        "Number of directions that hold 99 % of what differs between the features of different observations (srank of the "
        "centred features of the last hidden layer), in the worst group. 0: all observations look alike to the network.",
        "1 is the least that lets observations be told apart. Rank collapse: Kumar et al. (ICLR 2021), arXiv 2010.14498",
        (r.CCHAIN, r.LAYER_NORM, r.LAYER_NORM_DQN, r.LAYER_RESET, r.SHRINK, r.SMALLER_RATE),
    ),
    Check(
        *("dormant_units", "Hidden units are dormant", "dormant_units", "above", 0.9, "likely"),
        "Share of the hidden units with a mean activation of at most 0.025 times that of their layer, in the worst group. "
        "They do nothing, and with ReLU they get no gradient.",
        f"Score of 0.025: Sokar et al. (ICML 2023), arXiv 2302.12902. Share: {OWN}",
        (r.REDO, r.CRELU, r.LAYER_NORM, r.LAYER_NORM_DQN, r.SHRINK, r.SMALLER_RATE, r.CCHAIN),
    ),
    Check(
        *("exploding_weights", "The weights have grown huge", "weight_gain", "above", 20, "likely"),
        "What the worst weight matrix makes of the size of random inputs; 1.4 or less after initialisation. Infinite where a "
        "parameter is no number any more. Then outputs are extreme, and updates of the usual size hardly change them.",
        OWN,
        (r.SMALLER_RATE, r.CLIPPING, r.L2_INIT, r.NORMALIZE),
    ),
    Check(
        *("vanishing_gradients", "The gradients have vanished", "gradient_size", "below", 1e-3, "likely"),
        "Root mean square of the gradient of the worst weight matrix, divided by the ε of its optimiser, at the greatest "
        "update. Far below 1, Adam and RMSprop move these weights much less than the learning rate says.",
        f"The step of Adam for gradients far below ε, Kingma & Ba (2015), arXiv 1412.6980; {OWN}",
        (r.VALUE_COEF, r.RELU, r.LAYER_NORM, r.LAYER_NORM_DQN, r.REDO, r.LAYER_RESET, r.NORMALIZE),
    ),
    Check(
        *("too_large_updates", "The updates change the policy too much", "policy_change", "above", 0.2, "likely"),
        "KL divergence of the policy before one iteration from that after it, on the rollout's observations, in nats. The "
        "data was collected by the policy before, and says little about one so different.",
        "Spinning Up in Deep RL: target_kl is usually small, 0.01 or 0.05; four times the latter",
        (r.TARGET_KL, r.SMALLER_RATE, r.CCHAIN),
    ),
    Check(
        *("dead_values", "The values are the same everywhere", "value_spread", "below", 5e-4, "likely"),
        "Standard deviation of the values over the observations, divided by that of their targets. Such a value function "
        "tells no state from another, so the policy learns from noise.",
        OWN,
        (r.VALUE_COEF, r.NORMALIZE, r.LAYER_NORM, r.LAYER_NORM_DQN, r.REDO, r.CCHAIN),
    ),
    Check(
        *("large_rewards", "The rewards are too large", "value_scale", "above", 5000, "likely"),
        "Root mean square of what the values are trained on. A network begins with values about 0, and a step of Adam moves "
        "it by little. Meanwhile the value loss swamps everything else that shares its gradient, its layers or its clipping.",
        OWN,
        (r.NORMALIZE,),
    ),
    Check(
        *("diverged_values", "The values are greater than any return", "value_excess", "above", 3, "likely"),
        "The greatest value, divided by the greatest that rewards as large as those met can add up to. Values beyond it were "
        "made by bootstrapping from themselves or, of SAC, TQC and CrossQ, by an entropy bonus that is large beside the "
        "rewards.",
        "van Hasselt et al. (2018), arXiv 1812.02648, count values above 1 as diverged; 3 leaves room for rewards not met",
        (r.SLOW_TARGET, r.DOUBLE_DQN, r.SMALLER_RATE, r.LAYER_NORM_DQN, r.CCHAIN),
    ),
    Check(
        *("short_horizon", "The agent looks only few steps ahead", "discount", "below", 0.8, "possible"),
        "The discount factor γ. Rewards further ahead than 1 / (1 - γ) steps hardly count.",
        "RL Zoo's tuned settings have 0.9 to 0.9999",
        (r.LONGER_HORIZON,),
    ),
)
BY_NAME = {check.name: check for check in CHECKS}


class Suggestion(NamedTuple):
    """
    A remedy for a model's algorithm.

    :param title: What it is, to follow the word "Try"
    :param line: Code to write
    :param method: Name in the registry of methods, where it is one of those
    """

    title: str
    line: str
    method: str | None


@dataclass(frozen=True)
class Finding:
    """
    Something that is wrong with a model.

    :param check: The row that it is of
    :param value: Value of its measure
    :param part: The part of the networks that it is about; ``""`` for all
    :param remedies: What to try with the model's algorithm
    """

    check: Check
    value: float
    part: str
    remedies: tuple[Suggestion, ...]

    def measured(self) -> str:
        """
        :return: The measure beside its threshold
        """
        where = f" in {self.part}" if self.part else ""
        measure = self.check.measure.replace("_", " ")
        return f"{measure} {number(self.value)}{where}; healthy: {self.check.healthy_range()}"

    def sentence(self) -> str:
        """
        :return: The finding, with its measure and the threshold
        """
        return f"{self.check.title}: {self.measured()}."

    def to_json(self) -> dict[str, Any]:
        """
        :return: It as plain values
        """
        check = self.check
        return {
            "name": check.name,
            "title": check.title,
            "certainty": check.certainty,
            "measure": check.measure,
            "value": as_json(self.value),
            "part": self.part,
            "sick": check.sick,
            "threshold": check.threshold,
            "meaning": check.meaning,
            "source": check.source,
            "remedies": [remedy._asdict() for remedy in self.remedies],
        }


def diagnose(symptoms: Symptoms, model: BaseAlgorithm) -> list[Finding]:
    """
    :param symptoms: Symptoms of a model, by name
    :param model: The model
    :return: What is wrong with it, likely findings first
    """
    findings = []
    for check in CHECKS:
        worst = check.worst(symptoms)
        if worst is not None and check.is_sick(worst[1]):
            remedies = [remedy for remedy in check.remedies if remedy.is_for(model)]
            suggestions = tuple(Suggestion(remedy.title, remedy.line_for(model), remedy.method) for remedy in remedies)
            findings.append(Finding(check, worst[1], worst[0], suggestions))
    return sorted(findings, key=lambda finding: CERTAINTIES.index(finding.check.certainty))


def number(value: float) -> str:
    """
    :param value: A number
    :return: It with three digits
    """
    return f"{value:.3g}"


def as_json(value: Any) -> Any:
    """
    :param value: A number
    :return: It, or None where JSON has no such number
    """
    return value if math.isfinite(value) else None
