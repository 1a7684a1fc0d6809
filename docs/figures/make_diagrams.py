"""Makes the diagrams that stand beside this file, each for light and for dark pages.

.venv/bin/python docs/figures/make_diagrams.py            # writes them
.venv/bin/python docs/figures/make_diagrams.py --check    # says whether they are up to date

The arrows of ``architecture`` are the imports of the package, read by grimp. A module without a box, an arrow that does
not point down, or a box above one that the contract in pyproject.toml puts higher is an error, not a drawing.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path

import grimp

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent

Arrows = set[tuple[str, str]]
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

    def holds(self, point: Point) -> bool:
        """Whether a point lies inside."""
        return self.x < point[0] < self.x + self.width and self.y < point[1] < self.y + self.height

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


def arrow(points: Iterable[Point], color: str, *, dashed: bool = False) -> str:
    """Straight pieces from point to point with rounded corners, a head at the last."""
    corners = list(points)
    path = f"M{corners[0][0]:g},{corners[0][1]:g}"
    for before, here, after in zip(corners, corners[1:], corners[2:], strict=False):
        start, end = towards(here, before, 7), towards(here, after, 7)
        path += f" L{start[0]:g},{start[1]:g} Q{here[0]:g},{here[1]:g} {end[0]:g},{end[1]:g}"
    path += f" L{corners[-1][0]:g},{corners[-1][1]:g}"
    dashes = ' stroke-dasharray="5 4"' if dashed else ""
    return f'<path d="{path}" fill="none" stroke="{color}" stroke-width="1.5"{dashes} marker-end="url(#head)"/>'


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

#: The modules of each box; every module of the package is in one.
MODULES = {
    "cli": ("__main__", "cli", "cli_common", "cli_datasets", "cli_figures", "cli_learn", "cli_run", "cli_tools"),
    "doctor": ("doctor",),
    "export": ("export",),
    "sb3": ("sb3",),
    "diagnostics": ("diagnostics",),
    "study": ("study",),
    "learner": ("learner", "fitting", "checkpoint", "presets", "loggers"),
    "plotting": ("plotting",),
    "evaluation": ("evaluation",),
    "policy": ("policy", "predictors"),
    "solvers": ("solvers",),
    "learning": ("learning",),
    "tasks": ("tasks",),
    "mpc": ("mpc",),
    "datasets": ("datasets",),
    "base": ("errors", "core", "checks", "archive", "parallel"),
    "envs": ("envs",),
}
_ROWS = (20.0, 118.0, 216.0, 314.0, 412.0, 510.0, 608.0)
_HIGH = 62.0


def _box(row: int, x: float, width: float, title: str, line: str, kind: str) -> Box:
    return Box(x, _ROWS[row], width, _HIGH, title, tuple(line.split("\n")), kind)


BOXES = {
    "cli": _box(0, 20, 940, "cli", "the program mpcoffline, in seven modules", "use"),
    "doctor": _box(1, 20, 94, "doctor", "installation", "use"),
    "export": _box(1, 124, 94, "export", "C99", "control"),
    "sb3": _box(1, 236, 150, "sb3", "an SB3 algorithm", "control"),
    "diagnostics": _box(1, 416, 180, "diagnostics", "may I trust it?", "learn"),
    "study": _box(1, 626, 334, "study", "the paper's experiments", "use"),
    "learner": _box(2, 376, 230, "learner", "fitting, presets,\ncheckpoint, loggers", "learn"),
    "plotting": _box(2, 630, 130, "plotting", "figures, films", "use"),
    "evaluation": _box(2, 830, 130, "evaluation", "closed loops", "control"),
    "policy": _box(3, 166, 190, "policy, predictors", "an MPC as an SB3 policy", "control"),
    "solvers": _box(4, 166, 190, "solvers", "how it is optimised", "control"),
    "learning": _box(4, 426, 180, "learning", "from data to θ", "learn"),
    "tasks": _box(4, 720, 150, "tasks", "MPC_1 of each task", "control"),
    "mpc": _box(5, 166, 190, "mpc", "what is optimised", "control"),
    "datasets": _box(5, 426, 180, "datasets", "record, store, read", "data"),
    "base": _box(
        6,
        20,
        586,
        "errors, core, checks, archive, parallel",
        "imported by every box but envs: no arrows are drawn",
        "use",
    ),
    "envs": _box(6, 630, 330, "envs", "the plants, as Gymnasium environments", "data"),
}
#: Where an arrow leaves its box, where it enters the other, and how far above that box it runs across.
ROUTES: dict[tuple[str, str], tuple[float, float, float]] = {
    ("cli", "doctor"): (67, 67, 18), ("cli", "export"): (171, 171, 18), ("cli", "diagnostics"): (506, 506, 18),
    ("cli", "study"): (793, 793, 18), ("export", "learner"): (171, 400, 11), ("sb3", "learner"): (311, 420, 18),
    ("diagnostics", "learner"): (491, 491, 18), ("diagnostics", "plotting"): (560, 665, 18),
    ("study", "learner"): (650, 560, 11), ("study", "plotting"): (715, 715, 18), ("study", "tasks"): (795, 795, 18),
    ("study", "evaluation"): (895, 895, 18), ("learner", "policy"): (420, 310, 18),
    ("learner", "learning"): (516, 516, 18), ("policy", "solvers"): (261, 261, 18),
    ("doctor", "solvers"): (67, 210, 18), ("doctor", "datasets"): (67, 450, 10), ("solvers", "mpc"): (261, 261, 18),
    ("learning", "mpc"): (470, 316, 23), ("learning", "datasets"): (540, 540, 18),
    ("plotting", "mpc"): (665, 316, 23), ("tasks", "mpc"): (750, 316, 23), ("tasks", "envs"): (795, 795, 18),
    ("plotting", "envs"): (695, 695, 18), ("evaluation", "datasets"): (915, 590, 10),
    ("evaluation", "solvers"): (860, 330, 10), ("datasets", "envs"): (570, 670, 18),
}  # fmt: skip


def architecture(theme: Theme) -> str:
    """The boxes, the imports between them, and the import that must not be."""
    drawn = checked_arrows()
    gap = [(BOXES["learning"].x, 443.0), (BOXES["solvers"].x + BOXES["solvers"].width, 443.0)]
    cross = "M385,437 l12,12 m0,-12 l-12,12"
    return page(
        980, 690, "The packages of mpcoffline and what they import",
        [
            *(arrow(way(*pair), theme.line) for pair in sorted(drawn)),
            arrow(gap, theme.refused, dashed=True).replace("url(#head)", "none"),
            f'<path d="{cross}" stroke="{theme.refused}" stroke-width="2.4" fill="none"/>',
            label("never", (391, 429), theme.refused, 11.5, bold=True),
            *(box.svg(theme) for box in BOXES.values()),
        ],
        theme,
    )  # fmt: skip


def way(source: str, target: str) -> list[Point]:
    """The corners of an arrow: down, across above the target, down."""
    leaves, enters, above = ROUTES[source, target]
    start, end = (leaves, BOXES[source].y + _HIGH), (enters, BOXES[target].y)
    return [start, end] if leaves == enters else [start, (leaves, end[1] - above), (enters, end[1] - above), end]


def imports() -> Arrows:
    """Which box imports which, at run time; imports for type checking alone do not count."""
    graph = grimp.build_graph("mpcoffline", exclude_type_checking_imports=True, cache_dir=None)
    modules = {name for name in graph.modules if "." in name}  # without mpcoffline/__init__.py
    home = {module: box for box, members in MODULES.items() for module in members}
    found = {_top(name) for name in modules}
    if found != set(home):
        raise SystemExit(f"modules without a box: {sorted(found - set(home))}; gone: {sorted(set(home) - found)}")
    pairs = ((a, b) for a in modules for b in graph.find_modules_directly_imported_by(a) if b in modules)
    boxes = ((home[_top(a)], home[_top(b)]) for a, b in pairs)
    return {(a, b) for a, b in boxes if a != b}


def _top(name: str) -> str:
    """The name below ``mpcoffline``."""
    return name.split(".")[1]


def checked_arrows() -> Arrows:
    """The arrows to draw: imports that do not follow from others. Refuses what the drawing would get wrong."""
    every = imports()
    users = {source for source, target in every if target == "base"}
    if users != set(MODULES) - {"base", "envs"}:
        raise SystemExit(f"the text in 'base' is wrong: it is imported by {sorted(users)}")
    every = {pair for pair in every if "base" not in pair}
    arrows = {(a, b) for a, b in every if not any(b in reached(c, every) for x, c in every if x == a and c != b)}
    if arrows != set(ROUTES):
        raise SystemExit(
            f"arrows without a route: {sorted(arrows - set(ROUTES))}; gone: {sorted(set(ROUTES) - arrows)}"
        )
    for pair in arrows:
        if BOXES[pair[0]].y >= BOXES[pair[1]].y:
            raise SystemExit(f"the arrow {pair} does not point down")
        for name, box in BOXES.items():
            if name not in pair and any(box.holds(point) for point in along(way(*pair))):
                raise SystemExit(f"the arrow {pair} runs through {name}")
    check_contract()
    return arrows


def check_contract() -> None:
    """The boxes stand as the layers of import-linter's contract, and learning may not import solvers."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c["type"] == "layers")
    home = {module: box for box, modules in MODULES.items() for module in modules}
    names = [[name.removeprefix("mpcoffline.") for name in re.findall(r"[\w.]+", layer)] for layer in layers]
    rows = [[BOXES[home[name]].y for name in layer] for layer in names]
    for i, (above, below) in enumerate(pairwise(rows)):
        if max(below) < min(above):
            raise SystemExit(f"the boxes of {layers[i + 1]!r} stand above those of {layers[i]!r}")
    if not any(
        "mpcoffline.learning" in c.get("source_modules", ()) and "mpcoffline.solvers" in c["forbidden_modules"]
        for c in contracts
        if c["type"] == "forbidden"
    ):
        raise SystemExit("no contract forbids that learning imports solvers")


def reached(start: str, arrows: Arrows) -> set[str]:
    """All that can be reached from a box."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        here = waiting.pop()
        following = {b for a, b in arrows if a == here} - seen
        seen |= following
        waiting += following
    return seen


def along(corners: list[Point]) -> Iterator[Point]:
    """Points on the way from corner to corner."""
    for (x0, y0), (x1, y1) in pairwise(corners):
        yield from ((x0 + k / 100 * (x1 - x0), y0 + k / 100 * (y1 - y0)) for k in range(101))


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
