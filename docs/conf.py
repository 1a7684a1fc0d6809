"""Configuration of the documentation site; scripts/docs builds and checks it."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import sys
import tempfile
from importlib.metadata import metadata, version as installed_version
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(DOCS / "_ext"))

project = "mpcoffline"
author = "The mpcoffline developers"
copyright = "2026, the mpcoffline developers"
release = version = installed_version("mpcoffline")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "command_help",
    "markdown_docstrings",
    "page_meta",
    "results_pages",
    "several_notebooks",
]
exclude_patterns = ["**/make_*.py"]
nitpicky = True
# Types in signatures that have no page here: other libraries', and what our own return beside their results.
nitpick_ignore_regex = [
    ("py:class", r"(?!mpcoffline\.).*"),
    ("py:class", r"mpcoffline(\.\w+){3,}"),
    ("py:exc", r"(?!mpcoffline\.).*"),
]

# --- Text -----------------------------------------------------------------------------------------------------------

myst_enable_extensions = ["amsmath", "attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
suppress_warnings = [
    "mystnb.unknown_mime_type",
    "ref.python",  # types in signatures that two modules have a name for: their pages are linked by hand
]
copybutton_exclude = ".linenos, .gp, .go"

# --- Docstrings -----------------------------------------------------------------------------------------------------

napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "NDArray": "NDArray"}  # as they are written, not expanded
TypeAliasForwardRef.__repr__ = lambda self: self.name  # ... in unions, too
autodoc_typehints = "both"
python_maximum_signature_line_length = 88
autodoc_typehints_format = "short"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}

# --- Notebooks ------------------------------------------------------------------------------------------------------


# Executed once for each state of the package: a notebook's outputs depend on it, which the cache's keys do not know.
def _package_fingerprint() -> str:
    files = sorted(p for folder in ("mpcoffline", "envs", "datasets") for p in (ROOT / folder).rglob("*"))
    digest = hashlib.sha256()
    for file in files:
        if file.is_file() and file.suffix in {".py", ".c", ".h", ".toml", ".h5"}:
            digest.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks" / _package_fingerprint())
nb_execution_timeout = 300  # of a cell; a shared machine may take ten times its usual seconds
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_show_tb = True
nb_merge_streams = True

# What the notebooks' processes inherit: one thread, and a store of data sets that is not the user's.
os.environ.update(OMP_NUM_THREADS="1", MKL_NUM_THREADS="1", MPLBACKEND="agg", SDL_VIDEODRIVER="dummy")
_STORE = tempfile.TemporaryDirectory(prefix="mpcoffline-docs-")  # removed when the build ends
os.environ["MINARI_DATASETS_PATH"] = _STORE.name

# --- Pages ----------------------------------------------------------------------------------------------------------

html_theme = "furo"
html_title = f"mpcoffline {version}"
html_logo = html_favicon = "_static/logo.svg"
pygments_dark_style = "github-dark"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {}
# The address of the repository, where pyproject.toml has one: links to it, and to each page's text.
for _line in metadata("mpcoffline").get_all("Project-URL") or []:
    _name, _, _address = _line.partition(", ")
    if _name == "Repository":
        html_theme_options |= {"source_repository": _address, "source_branch": "main", "source_directory": "docs/"}

# MathJax from its installed package: pages load nothing from the network.
_MATHJAX = Path(importlib.util.find_spec("mathjax").submodule_search_locations[0]) / "static" / "mathjax" / "es5"
_STAGED = ROOT / "build" / "static"
for _name in ("tex-chtml-full.js", "output/chtml/fonts/woff-v2"):
    _source, _target = _MATHJAX / _name, _STAGED / "mathjax" / _name
    if not _target.exists():
        _target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if _source.is_dir() else shutil.copy)(_source, _target)
html_static_path.append(str(_STAGED))
mathjax_path = "mathjax/tex-chtml-full.js"


def _say_times(app: Sphinx, exception: Exception | None) -> None:
    """How long each notebook took when it was executed."""
    data = {page: found["exec_data"] for page, found in app.env.nb_metadata.items() if found.get("exec_data")}
    times = {page: found["runtime"] for page, found in data.items() if found["runtime"] is not None}
    lines = [f"{seconds:6.1f} s  {page}" for page, seconds in sorted(times.items())]
    print(*lines, f"{sum(times.values()):6.1f} s  all {len(times)} notebooks", sep="\n")


def setup(app: Sphinx) -> None:
    """Says the times when the site is built."""
    app.connect("build-finished", _say_times)
