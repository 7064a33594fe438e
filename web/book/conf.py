"""Sphinx's settings for the book; `stage.py` lays this file beside the pages that it writes."""

import re
from typing import Any

import fgtutor

project = "fgtutor"
author = "The fgtutor contributors"
version = release = fgtutor.__version__
html_title = "Feasibility-guided planning: the course"
copyright = "The fgtutor contributors, MIT licence"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
show_warning_types = True

# The notebooks are shown as they were committed.
nb_execution_mode = "off"
nb_ipywidgets_js = {}
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4
myst_dmath_double_inline = True

# Signatures show shapes as the code does, one argument a line where they are long.
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "ignore-module-all": True}
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88
default_role = "py:obj"
# A method named in a docstring may be that of two classes: the words then link to the first.
suppress_warnings = ["ref.python"]
add_module_names = False

html_theme = "furo"
html_favicon = "_static/favicon.svg"
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_js_files = [("slides.js", {"type": "module"})]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
# One file, its letters drawn as curves: no fonts to load.
mathjax_path = "mathjax/tex-svg.js"
mathjax3_config = {"options": {"enableMenu": False}}


def plain(_app: Any, _what: str, _name: str, _item: Any, _options: Any, lines: list[str]) -> None:
    """Let a docstring's bars and asterisks stand for themselves: |x|, [*batch, 2], a * b."""
    pieces = [re.split(r"(``?[^`]*``?)", line) for line in lines]
    lines[:] = [
        "".join(one if i % 2 else re.sub(r"([|*])", r"\\\1", one) for i, one in enumerate(line))
        for line in pieces
    ]


def setup(app: Any) -> None:
    """Read docstrings before napoleon does, whose priority is 500."""
    app.connect("autodoc-process-docstring", plain, priority=400)
