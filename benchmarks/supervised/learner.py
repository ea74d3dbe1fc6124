"""A network, and the four ways in which it is trained."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from benchmarks.supervised.images import N_CLASSES
from benchmarks.supervised.tasks import Task
from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, cross_entropy, make_coefficient
from sb3_cchain.methods import L2Init, WeightClipping
from sb3_cchain.validation import check_choice, check_number

# The paper's names, in its order
METHODS = {"vanilla": "Vanilla", "cchain": "C-CHAIN", "l2_init": "L2 Init", "weight_clipping": "Weight clipping"}

# Of the code of L2 Init, which the paper takes over
BATCH_SIZE = 16
WIDTH = 100

OPTIMIZERS: dict[str, tuple[type[th.optim.Optimizer], dict[str, Any]]] = {
    "adam": (th.optim.Adam, {"fused": True}),
    "sgd": (th.optim.SGD, {}),
}


@dataclass(frozen=True)
class Settings:
    """
    What the paper leaves open. ``docs/results/supervised.md`` says why the defaults are what they are.

    :param optimizer: ``"adam"`` or ``"sgd"``
    :param learning_rate: Learning rate
    :param target_churn_ratio: C-CHAIN: β
    :param churn_coef: C-CHAIN: λ, or ``"auto"`` to adapt it to β
    :param l2_init_coef: L2 Init: c, the factor of the sum of squares
    :param clip_ratio: Weight clipping: κ
    :raises ValueError: Naming the argument that is out of its range
    """

    optimizer: str = "adam"
    learning_rate: float = 1e-3
    target_churn_ratio: float = 2.0
    churn_coef: str = "auto"
    l2_init_coef: float = 5e-3
    clip_ratio: float = 1.0

    def __post_init__(self) -> None:
        check_choice("optimizer", self.optimizer, list(OPTIMIZERS))
        check_number("learning_rate", self.learning_rate, minimum=0, exclusive=True)
        check_number("l2_init_coef", self.l2_init_coef, minimum=0)
        check_number("clip_ratio", self.clip_ratio, minimum=0, exclusive=True)
        self.make_coefficient()

    def make_coefficient(self) -> ChurnCoefficient:
        """
        :return: λ, which adapts after each update, with warm-up and window as in C-CHAIN PPO
        :raises ValueError: Naming the argument that is out of its range
        """
        beta = self.target_churn_ratio
        return make_coefficient(self.churn_coef, beta, beta, warmup=10, window=50, minimum=0.0)

    def of_method(self, method: str) -> dict[str, Any]:
        """
        :param method: Key of ``METHODS``
        :return: The settings that matter to it
        """
        own = {
            "cchain": ("target_churn_ratio", "churn_coef"),
            "l2_init": ("l2_init_coef",),
            "weight_clipping": ("clip_ratio",),
        }
        return {name: getattr(self, name) for name in ("optimizer", "learning_rate", *own.get(method, ()))}


class Learner:
    """
    A network with two hidden layers, what trains it, and all that has to be saved.

    :param method: Key of ``METHODS``
    :param settings: Settings
    :param n_pixels: Pixels of an image
    :param seed: Seed of the initial parameters, which are the same for all methods
    """

    def __init__(self, method: str, settings: Settings, n_pixels: int, seed: int):
        th.manual_seed(seed)
        self.network = nn.Sequential(
            *(nn.Linear(n_pixels, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, N_CLASSES))
        )
        parameters, rate = list(self.network.parameters()), settings.learning_rate
        base_class, base_kwargs = OPTIMIZERS[settings.optimizer]
        self.optimizer: th.optim.Optimizer
        if method == "l2_init":
            self.optimizer = L2Init(
                parameters, rate, coef=settings.l2_init_coef, base_class=base_class, base_kwargs=base_kwargs
            )
        elif method == "weight_clipping":
            self.optimizer = WeightClipping(
                parameters, rate, clip_ratio=settings.clip_ratio, base_class=base_class, base_kwargs=base_kwargs
            )
        else:
            self.optimizer = base_class(parameters, lr=rate, **base_kwargs)  # type: ignore[call-arg]
        self.reducer: ChurnReducer | None = None
        if method == "cchain":
            self.reducer = ChurnReducer(
                lambda pixels: self.network(pixels).softmax(dim=1), cross_entropy, settings.make_coefficient()
            )

    def update(self, pixels: th.Tensor, labels: th.Tensor, reference: th.Tensor) -> th.Tensor:
        """
        :param pixels: Images of a minibatch, ``(batch_size, n_pixels)``
        :param labels: Their labels, ``(batch_size,)``
        :param reference: Other images, on which C-CHAIN holds the outputs still
        :return: How many of the images the network had right before the update
        """
        self.optimizer.zero_grad()
        if self.reducer is not None:
            self.reducer.backward(reference)
        logits = self.network(pixels)
        loss = F.cross_entropy(logits, labels)
        loss.backward()
        self.optimizer.step()
        if self.reducer is not None:
            self.reducer.end_iteration(loss.item())
        return (logits.detach().argmax(dim=1) == labels).sum()

    def learn(self, task: Task, n_epochs: int, generator: np.random.Generator) -> float:
        """
        Learn a task. The reference batch is the minibatch half an epoch away. It is as random as a drawn one, because the
        images are shuffled in each epoch, and it shares none with the minibatch that is trained on.

        :param task: The task
        :param n_epochs: Passes through its images
        :param generator: Shuffles the images
        :return: Online accuracy: that of each minibatch before its update, averaged over the updates
        """
        n_right = th.zeros((), dtype=th.int64)
        for _ in range(n_epochs):
            order = th.from_numpy(generator.permutation(len(task.labels)))
            pixels, labels = task.pixels[order].split(BATCH_SIZE), task.labels[order].split(BATCH_SIZE)
            half = len(labels) // 2
            for i in range(len(labels)):
                n_right += self.update(pixels[i], labels[i], pixels[i - half])
        return n_right.item() / (n_epochs * len(task.labels))

    def state_dict(self) -> dict[str, Any]:
        """
        :return: All that training goes on from
        """
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: What ``state_dict()`` returned
        """
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        parts = {"network": self.network, "optimizer": self.optimizer, "reducer": self.reducer}
        return {name: part for name, part in parts.items() if part is not None}
