"""Tables, texts and pictures of what an inspection has found."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from sb3_cchain.analysis.inspection import Inspection
from sb3_cchain.analysis.metrics.norms import group_norms
from sb3_cchain.analysis.plots import plot_models

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Drawn for each group of layers, by their names after "health/"
GROUP_FIGURES = (
    "dormant_share",
    "active_share",
    "feature_srank",
    "feature_effective_rank",
    "weight_norm",
    "distance_from_init",
)


def report(inspections: Sequence[Inspection]) -> list[Table]:
    """
    :param inspections: Of one model, or of two to compare
    :return: Tables
    """
    tables = []
    for title, prefix in (
        ("Rollout", "rollout/"),
        ("Churn of an update, on the rollout's data", "churn_monitor/fresh/"),
        ("Neural tangent kernel", "ntk/"),
        ("Networks", "health/"),
    ):
        tags = [tag for tag in _tags(inspections, prefix) if "/" not in tag.removeprefix(prefix)]
        tables.append(_table(title, inspections, {_words(tag.removeprefix(prefix)): tag for tag in tags}))
    tags = sorted((tag for tag in _tags(inspections, "health/") if tag.count("/") > 1), key=_group)
    rows = {f"{_group(tag)}: {_words(tag.split('/')[1])}": tag for tag in tags}
    tables.append(_table("Groups of layers", inspections, rows))
    if len(inspections) == 2:
        tables.append(_distances(*inspections))
    return [table for table in tables if table.row_count]


def findings_text(inspection: Inspection) -> str:
    """
    :param inspection: Of a model
    :return: Its findings, with the code of what to try
    """
    lines = [f"{inspection.name}: {len(inspection.findings) or 'no'} finding{'' if len(inspection.findings) == 1 else 's'}"]
    for finding in inspection.findings:
        lines += ["", f"{finding.check.title} ({finding.check.certainty}: {finding.check.name})", f"  {finding.measured()}"]
        for remedy in finding.remedies:
            lines += [f"  Try {remedy.title}:", *(f"      {line}" for line in remedy.line.splitlines())]
    return "\n".join(lines)


def _distances(a: Inspection, b: Inspection) -> Table:
    table = Table("", "L2 distance", title=f"From {a.name}'s parameters to {b.name}'s", title_justify="left", min_width=60)
    shapes_of_a, shapes_of_b = (
        {group: [(name, p.shape) for name, p in parameters.items()] for group, parameters in inspection.parameters.items()}
        for inspection in (a, b)
    )
    differences = {
        group: [b.parameters[group][name] - parameter for name, parameter in parameters.items()]
        for group, parameters in a.parameters.items()
        if shapes_of_a[group] == shapes_of_b.get(group)
    }
    for name, distance in group_norms("together", differences).items():
        table.add_row(name.removeprefix("together/"), f"{distance:.4g}" if differences else "")
    for group in dict.fromkeys([*shapes_of_a, *shapes_of_b]):
        if group not in differences:
            table.add_row(group, "not of the same shape")
    return table


def _words(name: str) -> str:
    return "gradient norm, clipped" if name == "gradient_norm" else name.replace("_", " ")


def _group(tag: str) -> str:
    return tag.split("/", 2)[2]


def _tags(inspections: Sequence[Inspection], prefix: str) -> list[str]:
    return [tag for tag in dict.fromkeys(t for i in inspections for t in i.figures) if tag.startswith(prefix)]


def _table(title: str, inspections: Sequence[Inspection], rows: dict[str, str]) -> Table:
    table = Table("", title=title, title_justify="left", min_width=60)
    for inspection in inspections:
        table.add_column(inspection.name, justify="right")
    if len(inspections) == 2:
        table.add_column("ratio", justify="right")
    for name, tag in rows.items():
        values = [inspection.figures.get(tag, np.nan) for inspection in inspections]
        ratio = [f"{values[1] / values[0]:.3g}" if values[0] else ""] if len(values) == 2 else []
        table.add_row(name, *(f"{value:.4g}" for value in values), *ratio)
    return table


def draw(inspections: Sequence[Inspection]) -> "Figure":
    """
    Draw the NTKs, and the figures of each group of layers.

    :param inspections: Of one model, or of two to compare
    :return: The picture
    :raises ImportError: Without matplotlib
    """
    tags = [tag for tag in _tags(inspections, "health/") if tag.count("/") > 1]
    groups = list(dict.fromkeys(map(_group, tags)))
    bars = {
        name.replace("_", " ").replace("feature ", "feature\n"): [
            [inspection.figures.get(f"health/{name}/{group}", np.nan) for group in groups] for inspection in inspections
        ]
        for name in GROUP_FIGURES
        if any(tag.startswith(f"health/{name}/") for tag in tags)
    }
    ntks = [(i.ntk, f"{i.name}: NTK, srank {i.figures['ntk/srank']:.0f}") for i in inspections if i.ntk is not None]
    return plot_models([inspection.name for inspection in inspections], ntks, groups, bars)


def plot(inspections: Sequence[Inspection], path: Path) -> None:
    """
    Save the picture of :func:`draw`.

    :param inspections: Of one model, or of two to compare
    :param path: PNG file
    :raises ImportError: Without matplotlib
    """
    figure = draw(inspections)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
