"""
Sphinx configuration: ``make doc``.

The table of contents is here and not in ``index.md``, because GitHub shows directives as they are typed.
"""

from pathlib import Path

from sphinx.application import Sphinx

project = "sb3_cchain"
copyright = "2026, sb3_cchain contributors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_typehints = "none"
html_theme = "furo"
html_title = "sb3_cchain"
html_show_sphinx = False
exclude_patterns = ["_build"]
nitpicky = False

# Captions of the sidebar, and the pages below them
CONTENTS = {
    "Get started": ["install", "quickstart", "faq"],
    "Guide": [
        "changing_world",
        "environments",
        "which_method",
        "tuning",
        "diagnostics",
        "modules/analysis",
        "modules/doctor",
        "metrics",
        "callbacks",
        "resume",
        "zoo",
        "gpu",
        "cluster",
    ],
    "Methods": [
        "modules/ppo_cchain",
        "modules/dqn_cchain",
        "modules/family",
        "modules/optimizers",
        "modules/plasticity",
        "modules/churn",
    ],
    "Reference": [
        "reference/algorithms",
        "reference/churn",
        "reference/tasks",
        "reference/environments",
        "reference/networks",
        "reference/callbacks",
        "reference/exploration",
        "reference/analysis",
        "reference/checkpoint",
    ],
    "Results": [
        "results/gym_control",
        "results/demo",
        "results/plasticity",
        "results/related",
        "results/procgen",
        "results/dm_control",
        "results/minatar",
        "results/family",
        "results/*",
    ],
    "Project": ["comparison", "contributing", "changelog", "citing"],
}
# Pages that there may be
OPTIONAL = {"which_method", "modules/doctor"}


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the table of contents to the first page."""
    if page != "index":
        return
    for caption, pages in CONTENTS.items():
        there = [name for name in pages if name not in OPTIONAL or Path(app.srcdir, f"{name}.md").exists()]
        source[0] += "\n".join(["", "```{toctree}", ":hidden:", ":glob:", f":caption: {caption}", "", *there, "```", ""])


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", add_contents)
