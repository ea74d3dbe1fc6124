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

# Captions of the sidebar, and the pages below them, some with a shorter title
CONTENTS = {
    "Get started": ["install", "quickstart", "faq"],
    "Guide": [
        "My world changes by itself <changing_world>",
        "environments",
        "which_method",
        "tuning",
        "diagnostics",
        "modules/doctor",
        "Monitors and inspection <modules/analysis>",
        "metrics",
        "callbacks",
        "resume",
        "zoo",
        "gpu",
        "On a cluster: the paper's experiments <cluster>",
    ],
    "Methods": [
        "modules/ppo_cchain",
        "modules/dqn_cchain",
        "C-CHAIN for the other algorithms <modules/family>",
        "modules/optimizers",
        "modules/plasticity",
        "Any training loop <modules/churn>",
        "modules/*",
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
        "Gym Control <results/gym_control>",
        "The demo <results/demo>",
        "Churn, NTK and networks <results/plasticity>",
        "Related methods <results/related>",
        "ProcGen <results/procgen>",
        "DeepMind Control <results/dm_control>",
        "MinAtar <results/minatar>",
        "Other algorithms <results/family>",
        "Reference batches <results/references>",
        "Speed <results/speed>",
    ],
    "Project": ["comparison", "contributing", "changelog", "citing"],
}
# Pages that need not be there
OPTIONAL = {"which_method", "modules/doctor", "modules/*"}


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the table of contents to the first page."""
    if page != "index":
        return
    for caption, pages in CONTENTS.items():
        there = [name for name in pages if name not in OPTIONAL or list(Path(app.srcdir).glob(f"{name}.md"))]
        source[0] += "\n".join(["", "```{toctree}", ":hidden:", ":glob:", f":caption: {caption}", "", *there, "```", ""])


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", add_contents)
