"""
Sphinx configuration: ``make doc``.

The table of contents is here and not in ``index.md``, because GitHub shows directives as they are typed.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the tests read this file without Sphinx
    from docutils import nodes
    from sphinx.application import Sphinx

project = "sb3_cchain"
copyright = "2026, sb3_cchain contributors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_typehints = "none"
html_theme = "furo"
html_title = "sb3_cchain"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_show_sphinx = False
exclude_patterns = ["_build"]
nitpicky = False
linkcheck_anchors = False  # GitHub makes them in the browser
linkcheck_timeout = 10

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
        "trackers",
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
    ],
    "Reference": [
        "reference/algorithms",
        "reference/churn",
        "reference/tasks",
        "reference/environments",
        "reference/networks",
        "reference/methods",
        "reference/callbacks",
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
        "The default β <results/betas>",
        "Supervised learning <results/supervised>",
        "Reference batches <results/references>",
        "β and size of the reference batch <results/sensitivity>",
        "Speed <results/speed>",
    ],
    "Project": ["comparison", "contributing", "changelog", "citing"],
}
# Pages that need not be there
OPTIONAL = {"modules/doctor"}


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the table of contents to the first page; further pages on algorithms and methods stand last among them."""
    if page != "index":
        return
    there = {path.relative_to(app.srcdir).with_suffix("").as_posix() for path in Path(app.srcdir).rglob("*.md")}
    named = {page_of(entry) for entries in CONTENTS.values() for entry in entries}
    others = sorted(name for name in there - named if name.startswith("modules/"))
    for caption, entries in {**CONTENTS, "Methods": [*CONTENTS["Methods"], *others]}.items():
        shown = [entry for entry in entries if page_of(entry) in there or page_of(entry) not in OPTIONAL]
        source[0] += "\n".join(["", "```{toctree}", ":hidden:", f":caption: {caption}", "", *shown, "```", ""])


def keep_numbers_together(app: Sphinx, page: nodes.document) -> None:
    """Let no line, and no narrow column, end within a number such as 160 000 or 3 ± 1."""
    from docutils import nodes

    for text in list(page.findall(nodes.Text)):
        whole = re.sub(r"(?<=\d) (?=\d{3}\b)|(?<=\d) (?=± \d)|(?<=\d ±) (?=\d)", "\N{NO-BREAK SPACE}", text)
        if whole != text and not isinstance(text.parent, (nodes.literal, nodes.literal_block, nodes.math, nodes.math_block)):
            text.parent.replace(text, nodes.Text(whole))


def page_of(entry: str) -> str:
    """The page of an entry, which may begin with a title."""
    return entry.split("<")[-1].rstrip(">")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", add_contents)
    app.connect("doctree-read", keep_numbers_together)
