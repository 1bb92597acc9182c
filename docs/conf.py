"""Builds the documentation site: ``make docs``."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import site_reference
import versions

project = "ESCAPE"
author = "the ESCAPE authors"
release, commit = versions.describe_checkout()
version = release
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx-mathjax-offline",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
myst_enable_extensions = ["dollarmath"]
# GitHub's fences for mathematics.
myst_fence_as_directive = ["math"]
myst_heading_anchors = 3
autosummary_generate = True
autodoc_typehints = "none"
autodoc_default_options = {"members": True, "show-inheritance": True, "inherited-members": "Bench"}
napoleon_google_docstring = False
napoleon_use_rtype = False
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"ESCAPE {release}"
html_context = {"commit": commit}
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"


def setup(app: object) -> None:
    """Write the pages that come from the code before Sphinx reads the folder."""
    site_reference.write_pages(Path(__file__).parent)
