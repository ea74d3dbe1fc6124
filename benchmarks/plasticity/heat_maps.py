"""The neural tangent kernels (NTKs) of several methods, at several times, as pictures."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from benchmarks.grid.results import Result
from benchmarks.number_text import thousands
from benchmarks.plasticity.runs import snapshot_times
from benchmarks.plasticity.snapshots import read_snapshots
from benchmarks.report.task_tables import in_order
from sb3_cchain.analysis.metrics.ntk import ntk_statistics
from sb3_cchain.analysis.plots import import_matplotlib
from sb3_cchain.methods.registry import Method


def cosines(matrix: np.ndarray) -> np.ndarray:
    """
    :param matrix: An NTK
    :return: The cosines of the angles between its gradients: its entries without the gradients' lengths; not a number where a
        gradient is 0
    """
    lengths = np.sqrt(np.diagonal(matrix).astype(float))
    with np.errstate(invalid="ignore", divide="ignore"):
        return matrix / np.outer(lengths, lengths)


def plot_heat_maps(results: Sequence[Result], lines: Mapping[str, Method], path: Path, title: str) -> Any:
    """
    Draw a row for each method, of its first seed that has matrices, and a column for each time.

    :param results: Runs in one environment, of one length
    :param lines: Label of each method, in their order
    :param path: PNG file
    :param title: Title
    :return: The figure, None where there is no matrix to draw
    """
    rows: dict[str, tuple[Result, dict[int, np.ndarray]]] = {}
    for result in in_order(results, lines):
        if result.line not in rows and (matrices := read_snapshots(result)):
            rows[result.line] = result, matrices
    if not rows:
        return None
    times = snapshot_times(results[0])
    matplotlib = import_matplotlib()
    figure = matplotlib.figure.Figure(figsize=(2.9 * len(times) + 1, 3.1 * len(rows) + 0.7), dpi=100, layout="constrained")
    panels = figure.subplots(len(rows), len(times), squeeze=False)
    image = None
    for row, (line, (result, matrices)) in zip(panels, rows.items(), strict=True):
        row[0].set_ylabel(f"{lines[line].label}, seed {result.seed}")
        for panel, end in zip(row, times, strict=True):
            panel.set(xticks=[], yticks=[])
            panel.set_title(f"step {thousands(end)}\nno matrix", fontsize=9)
        for steps, matrix in matrices.items():
            panel = row[bisect_left(times, steps)]
            image = panel.imshow(cosines(matrix), cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
            numbers = ntk_statistics(th.as_tensor(matrix, dtype=th.float64))
            shown = f"srank {numbers['srank']}, off-diagonal sum {numbers['off_diagonal_sum']:.2g}"
            panel.set_title(f"step {thousands(steps)}\n{shown}", fontsize=9)
    figure.colorbar(image, ax=panels, label="cosine of two minibatches' gradients", shrink=0.6)
    figure.suptitle(title, parse_math=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return figure
