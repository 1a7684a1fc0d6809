"""What autodoc cannot read of our docstrings: the environments' Markdown, as Gymnasium writes it, and ``bool_``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from sphinx.application import Sphinx


def to_rst(lines: list[str]) -> list[str]:
    """Headings, tables, code, formulas and literals of a Markdown text, as reStructuredText."""
    out: list[str] = []
    rest = iter(lines)
    for line in rest:
        if line.startswith("|"):
            out += _table([line, *_while_row(rest, after := [])])
            line = after[0] if after else ""
        if line.startswith("## "):
            out += ["", f".. rubric:: {line[3:]}", ""]
        elif line.startswith("```"):
            out += ["", f".. code-block:: {line[3:] or 'text'}", ""]
            out += [f"   {code}" for code in iter(lambda: next(rest), "```")]
            out.append("")
        elif line.startswith("$$"):
            formula = [line]
            while not (len(formula[-1]) > 2 and formula[-1].endswith("$$")) and not (len(formula) > 1 and line == "$$"):
                formula.append(line := next(rest))
            out += ["", ".. math::", "", *(f"   {part.replace('$$', '')}" for part in formula), ""]
        else:
            out.append(_inline(line))
    return out


def _while_row(rest: Iterator[str], after: list[str]) -> Iterator[str]:
    """The lines that go on a table; the one behind it goes to ``after``."""
    for line in rest:
        if not line.startswith("|"):
            after.append(line)
            return
        yield line


def _table(rows: list[str]) -> list[str]:
    out = ["", ".. list-table::", "   :header-rows: 1", ""]
    for row in (rows[0], *rows[2:]):
        cells = [_inline(cell.strip()) for cell in re.split(r"(?<!\\)\|", row.strip().strip("|"))]
        out += [f"   {'* ' if i == 0 else '  '}- {cell}" for i, cell in enumerate(cells)]
    return [*out, ""]


def _inline(line: str) -> str:
    line = re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", line)
    return re.sub(r"\$([^$]+)\$", r":math:`\1`", line)


def _process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    if what == "class" and any(line.startswith("## ") for line in lines):
        lines[:] = to_rst(lines)


def _escape(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """``np.bool_`` is a type here, not a link."""
    lines[:] = [line.replace("np.bool_", r"np.bool\_") if line.startswith(":vartype") else line for line in lines]


def setup(app: Sphinx) -> dict[str, bool]:
    """One step before napoleon, the other after it."""
    app.connect("autodoc-process-docstring", _process, priority=400)
    app.connect("autodoc-process-docstring", _escape, priority=600)
    return {"parallel_read_safe": True}
