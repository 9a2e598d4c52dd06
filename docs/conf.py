"""Sphinx's settings: `python -m sphinx -W -b html docs build/docs` builds the pages, without a network."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "multidrop"
author = "multidrop developers"
copyright = "multidrop developers"
release = version = version_of("multidrop")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "plain_docstrings",
    "plain_pages",
    "public_names",
    "command_help",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"multidrop {release}"

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
add_module_names = False
maximum_signature_line_length = 100
