"""Results pages begin with a summary and a picture of one of their own tables, in light and dark."""

from __future__ import annotations

import re
import textwrap
import tomllib
from collections import Counter
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from sphinx.application import Sphinx

RESULTS = Path(__file__).resolve().parent.parent / "results"
PICTURES = Path(__file__).resolve().parents[2] / "build" / "static" / "results"
TONES = {"light": ("#1c1e21", "#d9dce0"), "dark": ("#e8eaed", "#3a3f45")}
COLORS = ("#D55E00", "#0072B2", "#009E73", "#767676")
_NUMBER = re.compile(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")
_SHARE = re.compile(r"^\* (.+?): .*?\*\*(\d+) of (\d+)\*\*", re.MULTILINE)

#: Rows of a picture: a label, and a number for each series.
Rows = dict[str, list[float]]


def glances() -> dict[str, dict[str, Any]]:
    """What stands first on each page, by its name."""
    return tomllib.loads((RESULTS / "at_a_glance.toml").read_text(encoding="utf-8"))


def rows_of(text: str, wanted: dict[str, Any]) -> tuple[list[str], Rows]:
    """Names of the series, and the rows of a page's picture; rows of one label are averaged, or added.

    Raises:
        ValueError: If the page has no such table or column.
    """
    if wanted.get("shares"):
        found = _SHARE.findall(text.partition("\n## ")[0])
        return ["share"], {what: [int(a) / int(b)] for what, a, b in found if int(b)}  # of none there is no share
    begin = text.index(wanted["after"]) if "after" in wanted else 0
    header, *lines = _table(text[begin:])
    if column := wanted.get("counts"):
        cells = [line[header.index(column)].strip("*") for line in lines]
        said = Counter(next(to for begin, to in wanted["words"].items() if cell.startswith(begin)) for cell in cells)
        return ["count"], {what: [n] for what, n in said.most_common()}
    found: dict[str, list[list[float]]] = {}
    columns = [header.index(name) for name in wanted["values"]]
    for line in lines:
        numbers = [_NUMBER.search(line[k]) for k in columns]
        if all(numbers) and ("%" in line[columns[0]]) == (wanted.get("unit") == "%"):
            row = [abs(float(n.group().replace(",", ""))) for n in numbers if n]
            label = line[header.index(wanted["label"])].strip("*` ")
            found.setdefault(label.partition("/")[0] if wanted.get("sum") else label, []).append(row)
    of = np.sum if wanted.get("sum") else np.mean
    return list(wanted["values"]), {label: of(rows, axis=0).tolist() for label, rows in found.items()}


def _table(text: str) -> list[list[str]]:
    """The cells of the first table in a Markdown text, without its rule."""
    lines = [line for line in text[text.index("\n|") + 1 :].split("\n\n", 1)[0].splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [cells[0], *cells[2:]]


def drawn(series: list[str], rows: Rows, *, log: bool, tone: str) -> Figure:
    """Bars, one below the other, their numbers beside them."""
    text, line = TONES[tone]
    settings = dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), text)
    with mpl.rc_context(settings | {"axes.edgecolor": line, "font.size": 9, "svg.hashsalt": "glance"}):
        n, width = len(series), 0.8 / len(series)
        labels = [textwrap.fill(label.replace("$", r"\$"), 30) for label in rows]
        lines = sum(max(1.0, 0.8 * (1 + label.count("\n"))) for label in labels)
        figure = Figure(figsize=(4.8, 0.55 + 0.26 * lines * max(1.0, 0.7 * n)), layout="constrained")
        axes = figure.subplots()
        for k, name in enumerate(series):
            values = np.array([row[k] for row in rows.values()])
            places = np.arange(len(rows)) + (k - (n - 1) / 2) * width
            bars = axes.barh(places, np.maximum(values, 1e-12), 0.9 * width, color=COLORS[(k + (n == 1)) % 4])
            axes.bar_label(bars, [f" {_shown(v, name)}" for v in values], fontsize=8, color=text)
            bars.set_label(name.strip("`"))
        axes.set_yticks(range(len(rows)), labels)
        axes.invert_yaxis()
        if log:
            axes.set_xscale("log")
            least = min(v for row in rows.values() for v in row if v > 0)
            axes.set_xlim(0.5 * least, 8 * max(v for row in rows.values() for v in row))
        else:
            axes.margins(x=0.15)
        axes.tick_params(length=0)
        axes.set_xticks([])
        axes.minorticks_off()
        for side in ("top", "right", "bottom"):
            axes.spines[side].set_visible(False)
        if n > 1:
            figure.legend(loc="outside upper left", ncols=n, frameon=False, handlelength=1)
    return figure


def _shown(value: float, name: str) -> str:
    if name == "share":
        return f"{value:.0%}"
    return f"{value:,.4g}" if value < 1e4 else f"{value:,.0f}"


def _begin(app: Sphinx, page: str, source: list[str]) -> None:
    name = page.removeprefix("results/")
    if not page.startswith("results/") or (wanted := glances().get(name)) is None:
        return
    series, rows = rows_of(source[0], wanted)
    PICTURES.mkdir(parents=True, exist_ok=True)
    images = ""
    in_words = "; ".join(f"{label}: {', '.join(f'{v:.4g}' for v in row)}" for label, row in rows.items())
    alt = escape(f"Bars. {', '.join(each.strip('`') for each in series)} of {in_words}.")
    for tone in TONES:
        file = PICTURES / f"{name}_{tone}.svg"
        figure = drawn(series, rows, log=wanted.get("log", False), tone=tone)
        figure.savefig(file, metadata={"Date": None}, transparent=True)
        images += f'<img class="only-{tone}" src="../_static/results/{file.name}" alt="{alt}">'
    figure_html = f'<figure class="glance">{images}<figcaption>{escape(wanted["title"])}.</figcaption></figure>'
    head, _, rest = source[0].partition("\n\n")
    source[0] = f"{head}\n\n{wanted['summary']}\n\n{figure_html}\n\n{rest}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Begins each page of results."""
    app.connect("source-read", _begin)
    return {"parallel_read_safe": True}
