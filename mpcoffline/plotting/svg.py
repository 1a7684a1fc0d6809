"""Figures inside HTML: SVG without pixels, whose text is text and whose colours are those of the page."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FONT = "system-ui, 'DejaVu Sans', sans-serif"
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_BLACK = re.compile(r"#000000\b", re.IGNORECASE)
_FAMILY = re.compile(r"('[^']*'|sans-serif)(, ('[^']*'|[\w-]+))+")
_WIDEST = 1.9  # CSS pixels a point: letters are as large as the page's, no larger


def inline_svg(figure: Figure, key: str, text: str, colors: Mapping[str, str] | None = None) -> str:
    """A figure as an ``<svg>`` element for a page of HTML, which may hold several.

    Equal figures give equal text. Nothing in it refers to anything outside; what is black takes the text's colour, so
    that one picture serves light and dark pages and paper.

    Args:
        figure: The figure, made inside :func:`paper_style`; its ground becomes transparent.
        key: Stands in front of its ids, which must be others for each figure of the page.
        text: What a reader hears who does not see it.
        colors: CSS colours by the figure's own, ``{"#0072B2": "var(--proposal)"}``.
    """
    import matplotlib as mpl

    content = io.BytesIO()
    figure.patch.set_alpha(0.0)
    for axes in figure.axes:
        axes.patch.set_alpha(0.0)
    rc_context: Any = mpl.rc_context  # its stubs name every key
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": key}):
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(content, format="svg", metadata=metadata)
    root = ET.fromstring(content.getvalue())
    for element in root.iter():
        _freed(element, key, colors or {})
    for parent in list(root.iter()):
        for child in [c for c in parent if c.tag in ("metadata", "style")]:  # a style would be the whole page's
            parent.remove(child)
    _, _, width, _ = (float(v) for v in root.attrib["viewBox"].split())
    look = "stroke-linejoin:round;stroke-linecap:butt"  # what the style said
    root.attrib.update(role="img", style=f"{look};width:100%;max-width:{_WIDEST * width:.0f}px;height:auto")
    root.attrib["aria-label"] = text
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    return ET.tostring(root, encoding="unicode", short_empty_elements=False)


def _freed(element: ET.Element, key: str, colors: Mapping[str, str]) -> None:
    """Takes name spaces from an element; puts the key before ids, and the page's colours and font for its own."""
    element.tag = element.tag.rpartition("}")[2]
    element.tail = None if element.tail is not None and not element.tail.strip() else element.tail
    for name, value in list(element.attrib.items()):
        del element.attrib[name]
        plain = name.rpartition("}")[2]
        if plain == "id":
            value = f"{key}-{value}"
        elif plain == "href":
            value = f"#{key}-{value.removeprefix('#')}"
        elif plain in ("style", "clip-path", "fill", "stroke"):
            value = _BLACK.sub("currentColor", _REFERENCE.sub(rf"url(#{key}-\1)", value))
            for own, css in colors.items():
                value = re.sub(re.escape(own) + r"\b", css, value, flags=re.IGNORECASE)
            value = _FAMILY.sub(_FONT, value) if "font" in value else value
        element.attrib[plain] = value
