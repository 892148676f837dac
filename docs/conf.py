"""Sphinx configuration. The reference pages of commands, keys and file formats are generated from the package."""

from __future__ import annotations

import os
import re
import sys
import warnings
from pathlib import Path
from typing import Any

# One thread: the tensors of the gallery are small.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from reference.generate import write_reference  # noqa: E402

project = "ccnn_torch"
author = "The ccnn_torch founders"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_gallery.gen_gallery",
    "sphinx_copybutton",
    "sphinx_design",
    "screens",
]
exclude_patterns = ["_build", "_screens", "gallery"]
html_theme = "furo"
html_title = "ccnn_torch"
html_static_path = ["_static"]
html_css_files = ["site.css"]
# The button copies commands without their prompt, and nothing that they print.
copybutton_prompt_text = "$ "
copybutton_line_continuation_character = "\\"
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"
# The column at the right has the packages, not hundreds of methods.
toc_object_entries = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "filename_pattern": r"plot_",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "within_subsection_order": "FileNameSortKey",
}
# Docstrings have Markdown-like backticks and mathematics in Unicode; nothing of them is a cross-reference.
default_role = "code"
# Attributes of one name in several classes are no references either.
suppress_warnings = ["config.cache", "ref.python"]
warnings.filterwarnings("ignore", category=DeprecationWarning)

write_reference(HERE / "reference")


def _escape(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """A bar is a magnitude or an or, never a substitution; of two names with one description the first is no type."""
    for i, line in enumerate(lines):
        line = re.sub(r"^(:(?:ivar|param) )([^:]*, [^:]*):", lambda m: f"{m[1]}{m[2].replace(', ', ',')}:", line)
        parts = line.split("`")
        lines[i] = "`".join(part if k % 2 else part.replace("|", "\\|") for k, part in enumerate(parts))


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", _escape)
