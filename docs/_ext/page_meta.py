"""What each page has besides its text: a description for search engines, and of a notebook the file to download."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import nbformat
from docutils import nodes
from myst_nb.core.read import is_myst_markdown_notebook, read_myst_markdown_notebook
from sphinx.application import Sphinx

_LONGEST = 160  # characters of a description that search engines show
_FOLDER = "notebooks"  # of the site


def description(doctree: nodes.document) -> str:
    """The first paragraph that is prose, shortened at a word."""
    for paragraph in doctree.findall(nodes.paragraph):
        if isinstance(paragraph.parent, nodes.section | nodes.document):
            text = " ".join(paragraph.astext().split())
            if len(text) > _LONGEST:
                text = text[:_LONGEST].rsplit(" ", 1)[0].rstrip(",;:") + " …"
            return text
    return ""


def _describe(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None) -> None:
    if doctree is not None and (text := description(doctree)):
        tag = app.builder.templates.environment.from_string(
            '<meta name="description" content="{{ text | e }}"><meta property="og:title" content="{{ title | e }}">'
            '<meta property="og:description" content="{{ text | e }}">'
        )
        context["metatags"] = context.get("metatags", "") + tag.render(text=text, title=context.get("title", ""))
    if page in _notebooks(app):
        depth = "../" * page.count("/")
        context["body"] = _with_link(context["body"], f"{depth}{_FOLDER}/{page}.ipynb")


def _with_link(body: str, address: str) -> str:
    """The page's HTML with a link behind its heading."""
    head, sign, rest = body.partition("</h1>")
    link = f'<p class="notebook-link"><a href="{address}" download>Download as a notebook</a> (.ipynb, for Jupyter)</p>'
    return head + sign + link + rest if sign else link + body


@functools.cache
def _is_notebook(source: Path) -> bool:
    return source.suffix == ".md" and is_myst_markdown_notebook(source.read_text(encoding="utf-8"))


def _notebooks(app: Sphinx) -> list[str]:
    return sorted(page for page in app.env.found_docs if _is_notebook(Path(app.env.doc2path(page))))


def _write_notebooks(app: Sphinx, exception: Exception | None) -> None:
    if exception is not None or app.builder.format != "html":
        return
    for page in _notebooks(app):
        source = Path(app.env.doc2path(page))
        notebook = read_myst_markdown_notebook(source.read_text(encoding="utf-8"), path=source)
        target = Path(app.outdir) / _FOLDER / f"{page}.ipynb"
        target.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(notebook, target)


def setup(app: Sphinx) -> dict[str, bool]:
    """Adds both to every page."""
    app.connect("html-page-context", _describe)
    app.connect("build-finished", _write_notebooks)
    return {"parallel_read_safe": True}
