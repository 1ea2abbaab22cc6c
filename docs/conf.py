"""Sphinx configuration."""

from __future__ import annotations

import sys
from pathlib import Path

from torchrl_tsallis.version import __version__

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "torchrl-tsallis"
author = "The torchrl-tsallis authors"
copyright = "2026 The torchrl-tsallis authors"
release = __version__
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_design",
    "mathml",
    "aliases",
]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
napoleon_custom_sections = [("Keyword Args", "params_style")]
# keys and parameters of the same name belong to several classes
suppress_warnings = ["ref.python"]
exclude_patterns = ["_build", "results"]  # tables of results are included by the pages that speak of them
html_theme = "furo"
html_title = "torchrl-tsallis"
html_static_path = ["static"]
html_css_files = ["pages.css"]
