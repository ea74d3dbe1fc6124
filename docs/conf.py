"""Sphinx configuration: ``make doc``."""

project = "sb3_cchain"
copyright = "2026, sb3_cchain contributors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.intersphinx", "sphinx.ext.mathjax", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "none"
html_theme = "furo"
exclude_patterns = ["_build"]
nitpicky = False
