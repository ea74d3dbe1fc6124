"""The tasks. Each of them follows from the seed and its number alone, so all methods learn the same ones."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch as th

from benchmarks.supervised.images import Images


@dataclass(frozen=True)
class Task:
    """
    What is learned before the next switch.

    :param pixels: ``(n_images, n_pixels)``
    :param labels: ``(n_images,)``
    """

    pixels: th.Tensor
    labels: th.Tensor


# Images, how many of them, randomness of the whole run, randomness of the task
TaskMaker = Callable[[Images, int, np.random.Generator, np.random.Generator], Task]


def random_labels(images: Images, n_images: int, of_run: np.random.Generator, of_task: np.random.Generator) -> Task:
    """
    The same images in all tasks, their labels dealt out anew: what an image shows says nothing about its label.

    :param images: What the images are drawn from
    :param n_images: Number of images
    :param of_run: Draws the images
    :param of_task: Deals out the labels
    :return: The task
    """
    chosen = draw(of_run, images, n_images)
    dealt = chosen[th.from_numpy(of_task.permutation(n_images))]
    return Task(images.pixels[chosen], images.labels[dealt])


def permuted_pixels(images: Images, n_images: int, of_run: np.random.Generator, of_task: np.random.Generator) -> Task:
    """
    Other images in each task, with the pixels of all of them in the same new order.

    :param images: What the images are drawn from
    :param n_images: Number of images
    :param of_run: Not used
    :param of_task: Draws images and order
    :return: The task
    """
    chosen = draw(of_task, images, n_images)
    order = th.from_numpy(of_task.permutation(images.pixels.shape[1]))
    return Task(images.pixels[chosen][:, order], images.labels[chosen])


def draw(generator: np.random.Generator, images: Images, n_images: int) -> th.Tensor:
    """
    :param generator: Source of randomness
    :param images: What is drawn from
    :param n_images: Number of images
    :return: Their indices, each only once where there are enough
    """
    n_all = len(images.labels)
    return th.from_numpy(generator.choice(n_all, n_images, replace=n_images > n_all))


@dataclass(frozen=True)
class Problem:
    """
    A sequence of tasks, with the lengths of Appendix A.4 of the C-CHAIN paper.

    :param title: The paper's name for it
    :param make: Makes a task
    :param n_tasks: Number of tasks
    :param n_images: Images of a task
    :param n_epochs: Passes through them
    """

    title: str
    make: TaskMaker
    n_tasks: int
    n_images: int
    n_epochs: int


PROBLEMS = {
    "permuted_mnist": Problem("Permuted-MNIST", permuted_pixels, n_tasks=500, n_images=10_000, n_epochs=1),
    "random_label_mnist": Problem("RandomLabel-MNIST", random_labels, n_tasks=50, n_images=1200, n_epochs=400),
}


def make_task(problem: Problem, images: Images, n_images: int, seed: int, index: int) -> tuple[Task, np.random.Generator]:
    """
    :param problem: The problem
    :param images: What the images are drawn from
    :param n_images: Number of images
    :param seed: Seed of the run
    :param index: Number of the task, from 0 on
    :return: The task, and the source of randomness for the order in which it is learned
    """
    of_task = np.random.default_rng([seed, 1 + index])
    return problem.make(images, n_images, np.random.default_rng([seed, 0]), of_task), of_task
