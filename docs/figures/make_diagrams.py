"""Makes the diagrams that stand beside this file, each for light and for dark pages.

.venv/bin/python docs/figures/make_diagrams.py            # writes them
.venv/bin/python docs/figures/make_diagrams.py --check    # says whether they are up to date

The rows of ``architecture`` are those of the contract in pyproject.toml, compared with the imports of the package as
grimp reads them: a room without a text, or an import that does not point down, is an error, not a drawing.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from html import escape
from pathlib import Path

import grimp

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent

Point = tuple[float, float]


# --- Drawing ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Theme:
    """Colours on a page: text, small text, lines, and of each kind of box its fill and its edge."""

    ink: str
    faint: str
    line: str
    refused: str
    kinds: dict[str, tuple[str, str]]


THEMES = {
    "light": Theme(
        "#1c2733", "#526070", "#8492a2", "#c2410c",
        {"control": ("#e4f0fb", "#0072b2"), "learn": ("#e2f5ee", "#009e73"), "data": ("#fdf1dc", "#c98a00"),
         "use": ("#f1f3f6", "#8492a2")},
    ),
    "dark": Theme(
        "#e8edf3", "#a9b5c2", "#7c8a99", "#ff8a5c",
        {"control": ("#12293d", "#56b4e9"), "learn": ("#10302a", "#35c79c"), "data": ("#352a14", "#e6ac3d"),
         "use": ("#23282f", "#7c8a99")},
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Box:
    """A box: where its upper left corner is, how large it is, what stands in it."""

    x: float
    y: float
    width: float
    height: float
    title: str
    lines: tuple[str, ...] = ()
    kind: str = "use"

    @property
    def middle(self) -> float:
        """Its horizontal middle."""
        return self.x + self.width / 2

    def svg(self, theme: Theme) -> str:
        """The box with its text, the title bold and the rest small."""
        fill, edge = theme.kinds[self.kind]
        step = 17
        top = self.y + self.height / 2 - step * len(self.lines) / 2 + 5
        parts = [
            f'<rect x="{self.x:g}" y="{self.y:g}" width="{self.width:g}" height="{self.height:g}" rx="9" '
            f'fill="{fill}" stroke="{edge}" stroke-width="1.4"/>',
            label(self.title, (self.middle, top), theme.ink, 15, bold=True),
        ]
        places = ((self.middle, top + step * (i + 1)) for i in range(len(self.lines)))
        parts += [label(line, place, theme.faint, 12.5) for line, place in zip(self.lines, places, strict=True)]
        return "".join(parts)


def label(text: str, place: Point, color: str, size: float, *, bold: bool = False, anchor: str = "middle") -> str:
    """A line of text; ``_x`` and ``_{...}`` are set lower."""
    spans = []
    for part in re.split(r"(_\{[^}]*\}|_[^\s_])", text):
        lowered = part.startswith("_") and len(part) > 1
        shown = escape(part[1:].strip("{}") if lowered else part)
        spans.append(f'<tspan dy="4" font-size="{0.75 * size:g}">{shown}</tspan><tspan dy="-4">&#8203;</tspan>'
                     if lowered else shown)  # fmt: skip
    weight = ' font-weight="600"' if bold else ""
    x, y = place
    return (
        f'<text x="{x:g}" y="{y:g}" font-size="{size:g}" fill="{color}" text-anchor="{anchor}"{weight}>'
        f"{''.join(spans)}</text>"
    )


def arrow(points: Iterable[Point], color: str) -> str:
    """Straight pieces from point to point with rounded corners, a head at the last."""
    corners = list(points)
    path = f"M{corners[0][0]:g},{corners[0][1]:g}"
    for before, here, after in zip(corners, corners[1:], corners[2:], strict=False):
        start, end = towards(here, before, 7), towards(here, after, 7)
        path += f" L{start[0]:g},{start[1]:g} Q{here[0]:g},{here[1]:g} {end[0]:g},{end[1]:g}"
    path += f" L{corners[-1][0]:g},{corners[-1][1]:g}"
    return f'<path d="{path}" fill="none" stroke="{color}" stroke-width="1.5" marker-end="url(#head)"/>'


def towards(start: Point, end: Point, most: float) -> Point:
    """The point at a distance from ``start`` on the way to ``end``, half of the way at most."""
    length = max(abs(end[0] - start[0]) + abs(end[1] - start[1]), 1e-9)
    share = min(most / length, 0.5)
    return start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])


def page(width: float, height: float, title: str, parts: Iterable[str], theme: Theme) -> str:
    """A whole SVG file."""
    head = (
        f'<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
        f'orient="auto-start-reverse"><path d="M0,1 L10,5 L0,9 z" fill="{theme.line}"/></marker></defs>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" role="img" '
        f"font-family=\"system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif\"><title>{escape(title)}"
        f"</title>{head}\n" + "\n".join(parts) + "\n</svg>\n"
    )


# --- The data flow ---------------------------------------------------------------------------------------------------


def data_flow(theme: Theme) -> str:
    """From the log to the controller; below the line nothing is learned any more."""
    log = Box(20, 24, 150, 84, "Log", ("s, a, L, s_+", "any controller's"), "data")
    rough = Box(20, 172, 150, 84, "Rough MPC", ("model, cost,", "bounds: θ_0"), "control")
    value = Box(
        270, 20, 260, 92, "(VALUE): regression", ("L + γ V(s_+)  →  V(s)", "what is each state worth?"), "learn"
    )
    fit = Box(
        270, 168, 260, 92, "(FIT): regression", ("L + γ V(s_+)  →  L̂_θ + γ V(f_θ)", "cost, or cost and model"), "learn"
    )
    mpc = Box(640, 168, 200, 92, "Learned MPC", ("θ,  T from V", "optimises N steps ahead"), "control")
    plant = Box(640, 334, 200, 66, "Plant", ("one input a sampling time",), "data")
    lines, small, bold = theme.line, theme.faint, theme.ink
    return page(
        860, 420, "The log gives V by regression, V gives the MPC's parameters by regression",
        [
            arrow([(170, 58), (270, 58)], lines),
            arrow([(170, 82), (220, 82), (220, 198), (270, 198)], lines),
            arrow([(170, 226), (270, 226)], lines), label("θ_0", (212, 246), bold, 14, bold=True),
            arrow([(400, 112), (400, 168)], lines), label("V", (414, 146), bold, 14, bold=True),
            arrow([(530, 214), (640, 214)], lines), label("θ", (584, 206), bold, 14, bold=True),
            arrow([(530, 66), (740, 66), (740, 168)], lines), label("terminal cost T", (640, 58), small, 12.5),
            f'<path d="M20,298 H840" stroke="{lines}" stroke-width="1.2" stroke-dasharray="2 5" fill="none"/>',
            label("learned once, from the log: no MPC is solved", (20, 290), small, 12.5, anchor="start"),
            label("in closed loop: one MPC is solved a sampling time", (20, 316), small, 12.5, anchor="start"),
            arrow([(700, 260), (700, 334)], lines), label("a", (688, 290), bold, 14, bold=True, anchor="end"),
            arrow([(780, 334), (780, 260)], lines), label("s", (792, 290), bold, 14, bold=True, anchor="start"),
            *(box.svg(theme) for box in (log, rough, value, fit, mpc, plant)),
        ],
        theme,
    )  # fmt: skip


# --- The architecture ------------------------------------------------------------------------------------------------

#: What each room is for, and its colour; which rooms there are, and in which order, is read from the contract.
ROOMS = {
    "cli": ("the program mpcoffline", "use"),
    "studies": ("the paper's experiments", "use"),
    "tune": ("own plants: log, check", "use"),
    "gallery": ("recipes, agents, data cards", "data"),
    "diagnostics": ("may I trust it?", "learn"),
    "simulation": ("models of the log, closed loops on them", "learn"),
    "sb3": ("where SB3 expects an algorithm", "control"),
    "plotting": ("figures, films", "use"),
    "learner": ("a method, its options, checkpoints, the policy", "learn"),
    "control": ("policy, evaluation, export as C", "control"),
    "solvers": ("how it is optimised: lqr, ddp, ipopt", "control"),
    "learning": ("from data to θ: stages and methods", "learn"),
    "estimation": ("identification, noise, smoothing", "learn"),
    "plants": ("MPC_1 of each plant", "control"),
    "datasets": ("record, store, read, share", "data"),
    "mpc": ("what is optimised: θ, model, costs, constraints", "control"),
    "core": ("errors, checks, limits, files, registries", "use"),
    "envs": ("the plants, as Gymnasium environments", "data"),
}
_LEFT, _WIDTH, _HIGH, _GAP = 20.0, 940.0, 52.0, 16.0


def architecture(theme: Theme) -> str:
    """The rooms in the rows of the contract: each may import those of the rows below it, and no other."""
    rows, parts = checked_rows(), []
    for i, row in enumerate(rows):
        width = (_WIDTH - _GAP * (len(row) - 1)) / len(row)
        for j, room in enumerate(row):
            line, kind = ROOMS[room]
            box = Box(_LEFT + j * (width + _GAP), 20 + i * (_HIGH + _GAP), width, _HIGH, room, (line,), kind)
            parts.append(box.svg(theme))
    height = 20 + len(rows) * (_HIGH + _GAP)
    line = [(_LEFT + _WIDTH + 22, 24.0), (_LEFT + _WIDTH + 22, height - _GAP - 4)]
    turned = f'<g transform="rotate(90 {line[0][0] + 14:g} {height / 2:g})">'
    words = label("imports", (line[0][0] + 14, height / 2 + 4), theme.faint, 12.5)
    return page(
        1010, height + 4, "The rooms of mpcoffline, each above those that it may import",
        [arrow(line, theme.line), f"{turned}{words}</g>", *parts], theme,
    )  # fmt: skip


def checked_rows() -> list[list[str]]:
    """The rows of the contract; refuses rooms without a text, texts without a room, and imports that go up."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c["type"] == "layers" and c["containers"] == ["mpcoffline"])
    rows = [[room for room in re.findall(r"\w+", layer) if room != "__main__"] for layer in layers]
    rows = [row for row in rows if row]
    graph = grimp.build_graph("mpcoffline", exclude_type_checking_imports=True, cache_dir=None)
    found = {name.split(".")[1] for name in graph.modules if "." in name} - {"__main__"}
    listed = [room for row in rows for room in row]
    if not found == set(listed) == set(ROOMS):
        raise SystemExit(f"rooms {sorted(found)}, in the contract {sorted(listed)}, with a text {sorted(ROOMS)}")
    place = {room: i for i, row in enumerate(rows) for room in row}
    for module in graph.modules - {"mpcoffline", "mpcoffline.__main__"}:
        for other in graph.find_modules_directly_imported_by(module) - {"mpcoffline"}:
            above, below = module.split(".")[1], other.split(".")[1]
            if above != below and place[above] >= place[below]:
                raise SystemExit(f"{module} imports {other}: that does not point down")
    return rows


DIAGRAMS: dict[str, Callable[[Theme], str]] = {"data_flow": data_flow, "architecture": architecture}


def main() -> None:
    """Writes the files, or says which differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1 if a file is out of date")
    check = parser.parse_args().check
    stale = []
    for name, draw in DIAGRAMS.items():
        for theme_name, theme in THEMES.items():
            path, text = HERE / f"{name}_{theme_name}.svg", draw(theme)
            if not check:
                path.write_text(text, encoding="utf-8")
            elif not path.exists() or path.read_text("utf-8") != text:
                stale.append(path.name)
    if stale:
        sys.exit(f"out of date: {', '.join(stale)}; run {Path(__file__).name}")


if __name__ == "__main__":
    main()
