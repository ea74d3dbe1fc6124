"""The pictures of analysis. They import matplotlib when they are drawn, as the rest of the package works without it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import torch as th

from sb3_cchain.analysis.metrics.rank import singular_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


def import_matplotlib() -> ModuleType:
    """
    :return: The module ``matplotlib``, with its modules ``figure`` and ``style``
    :raises ImportError: When it cannot be imported, with the command that installs it
    """
    try:
        import matplotlib.figure
        import matplotlib.style
    except ImportError as error:
        raise ImportError(f'Pictures need matplotlib ({error}): pip install "sb3-cchain[plots]"') from error
    return matplotlib


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """
    :param width: In inches
    :param height: In inches
    :return: Yields an empty picture, to be drawn in matplotlib's own style: RL Zoo's plots leave that of seaborn behind
    :raises ImportError: Without matplotlib
    """
    matplotlib = import_matplotlib()
    with matplotlib.style.context("default"):
        yield matplotlib.figure.Figure(figsize=(width, height), dpi=100, layout="constrained")


def plot_ntk(matrix: th.Tensor, title: str) -> Figure:
    """
    :param matrix: An NTK
    :param title: Title
    :return: A picture of the matrix
    :raises ImportError: Without matplotlib
    """
    with new_figure(4.6, 4) as figure:
        figure.colorbar(draw_ntk(figure.add_subplot(), matrix, title), extend="both", label="inner product of gradients")
    return figure


def draw_ntk(axes: Axes, matrix: th.Tensor, title: str) -> AxesImage:
    """
    Red above 0, blue below, white 0. The 1 % of entries with the greatest absolute values lie beyond the ends of the colours;
    otherwise a few of them would leave everything else white.

    :param axes: Where to draw
    :param matrix: An NTK
    :param title: Title
    :return: The image
    """
    limit = float(np.quantile(matrix.abs().cpu().numpy(), 0.99))
    axes.set(title=title, xlabel="minibatch", ylabel="minibatch")
    return axes.imshow(matrix.cpu().numpy(), cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")


def draw_singular_values(axes: Axes, matrix: th.Tensor) -> None:
    """
    What share of the sum of its singular values the greatest k of them hold. It reaches 99 % at the matrix's srank.

    :param axes: Where to draw; nothing but its text for a matrix that is not finite
    :param matrix: An NTK
    """
    if not matrix.isfinite().all():
        axes.axis("off")
        axes.text(0.5, 0.5, "no singular values:\nthe matrix is not finite", ha="center", va="center")
        return
    sigma = singular_values(matrix)
    shares = (sigma.cumsum(dim=0) / sigma.sum().clamp(min=1e-300)).numpy()
    axes.plot(np.arange(1, len(shares) + 1), shares, marker=".")
    axes.axhline(0.99, color="0.35", linestyle="--", linewidth=1)
    axes.text(len(shares), 0.98, "0.99, reached at the srank", ha="right", va="top", color="0.35")
    axes.set(
        title="Singular values of the NTK", xlabel="k", ylabel="share of the sum that the k greatest hold", ylim=(0, 1.03)
    )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.spines[["top", "right"]].set_visible(False)


def plot_models(
    names: Sequence[str],
    ntks: Sequence[tuple[th.Tensor, str]],
    groups: Sequence[str],
    bars: Mapping[str, Sequence[Sequence[float]]],
) -> Figure:
    """
    Draw the NTKs of one model or two, where there are any, and bars for each group of their layers. Beside a single NTK its
    singular values are drawn.

    :param names: Names of the models
    :param ntks: For each model that has one, its NTK and the title of that picture
    :param groups: Names of the groups of layers
    :param bars: By title, for each model a value of each group; not a number where there is none
    :return: The picture
    :raises ImportError: Without matplotlib
    """
    heights = [*([4.4] if ntks else []), 1.2 + 0.3 * len(groups) * len(names)]
    with new_figure(11, sum(heights)) as figure:
        *above, below = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights).flat
        for part in above:
            panels = part.subplots(1, 2)
            for axes, ntk in zip(panels, ntks, strict=False):
                part.colorbar(draw_ntk(axes, *ntk), ax=axes, extend="both", label="inner product of gradients")
            if len(ntks) == 1:
                draw_singular_values(panels[1], ntks[0][0])
        height = 0.8 / len(names)
        all_axes = below.subplots(1, len(bars), sharey=True, squeeze=False)[0]
        for axes, (title, values) in zip(all_axes, bars.items(), strict=True):
            for i, (name, lengths) in enumerate(zip(names, values, strict=True)):
                axes.barh(np.arange(len(groups)) + i * height, lengths, height, label=name)
            axes.set_yticks(np.arange(len(groups)) + height * (len(names) - 1) / 2, groups)
            axes.set_title(title, fontsize=10)
            axes.spines[["top", "right"]].set_visible(False)
            axes.margins(x=0.1)
            axes.set_xlim(left=0)
            axes.locator_params(axis="x", nbins=4)
        all_axes[0].invert_yaxis()
        if len(names) > 1:
            below.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure
