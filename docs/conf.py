"""Sphinx configuration."""

from __future__ import annotations

from torchrl_tsallis.version import __version__

project = "torchrl-tsallis"
author = "The torchrl-tsallis authors"
release = __version__
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "myst_parser",
]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
napoleon_custom_sections = [("Keyword Args", "params_style")]
# keys and parameters of the same name belong to several classes
suppress_warnings = ["ref.python"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "torchrl-tsallis"
