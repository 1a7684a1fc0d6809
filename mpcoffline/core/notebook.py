"""What notebooks show of an object: a heading, facts, sentences, tables, as plain HTML without style of its own."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from .tables import Table
from .text import visible


def html_of(
    title: str, facts: Iterable[tuple[str, str]] = (), tables: Iterable[Table] = (), sentences: Iterable[str] = ()
) -> str:
    """A heading and what stands below it; all text is escaped.

    Args:
        title: The heading.
        facts: Names and values.
        tables: Tables; of long ones the first rows.
        sentences: Items of a list.
    """
    parts = [f"<p><strong>{_text(title)}</strong></p>"]
    listed = "".join(f"<li>{_text(each)}</li>" for each in sentences)
    parts += [f"<ul>{listed}</ul>"] if listed else []
    rows = "".join(f'<tr><th scope="row">{_text(name)}</th><td>{_text(value)}</td></tr>' for name, value in facts)
    parts += [f"<table><tbody>{rows}</tbody></table>"] if rows else []
    return f"<div>{''.join([*parts, *(each._repr_html_() for each in tables)])}</div>"


def _text(text: str) -> str:
    return escape(visible(text))
