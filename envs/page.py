"""The documentation page of an environment: what its class says, completed with what the plant's description says."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence

import numpy as np

from .episode import EPISODE_STEPS
from .plant import Plant, Uniform

_SECTIONS = (
    *("Description", "Action Space", "Observation Space", "State Space", "Rewards", "Starting State"),
    *("Episode End", "Arguments", "Info", "Version History", "References"),
)

_TEXT = {
    "Action Space": "`Box({bounds}, ({nu},), float32)`. An action beyond the bounds is clipped to them.\n\n{actions}",
    "Observation Space": """`Box(float32)` of shape `({ny},)`. The bounds hold for any state that {steps} steps of the
default plant can reach from `state_space`; in longer episodes the state saturates at them.\n\n{observations}""",
    "State Space": """The state $s = [{state}]$ is in `info["state"]`.
`state_space`, a `Box(float64)`, holds the states that `reset` accepts{wrapped}.\n\n{states}""",
    "Starting State": """{starts}

`reset(options=...)` takes one of `{{"start": name}}`, `{{"state": s}}` (start at $s$) and `{{"low": l, "high": h}}`
(uniform between two states or scalars; an angle's bounds may reach to $\\pm 2\\pi$, its draw is wrapped).""",
    "Episode End": """1. Termination: never.
2. Truncation: after {steps} steps ({seconds:g} s); `gym.make(..., max_episode_steps=...)` sets another length.""",
    "Arguments": """`gym.make("{id}", measurement_noise=0.01)`. Lists instead of arrays keep `env.spec` storable as
JSON.\n\n{arguments}

Noise is Gaussian and off by default; `info` stays true under measurement noise. `ControlTask` states it precisely.""",
    "Info": """`reset` and `step` return `info["state"]` (float64, the true $s$ reached), `info["cost"]` (float, $L$ of
the step just taken, 0 at reset) and `info["is_success"]` (bool).""",
    "Version History": "* v0: first release.",
}
_ARGUMENTS = (
    ("`start`", "str, (low, high)", '`"{}"`', "starting states: a name, or bounds"),
    ("`process_noise`", "float, list", "0.0", "std of noise $w$, one or one a state: $s_+ + w$"),
    ("`measurement_noise`", "float, list", "0.0", "std of noise $v$, one or one a state: $y = h(s + v)$"),
    ("`render_mode`", "str", "None", '`"human"` (a window), `"rgb_array"` (pictures)'),
)


def page(plant: Plant, written: str) -> str:
    """A page in Markdown with Gymnasium's sections in their order.

    Args:
        plant: The plant.
        written: A summary, and the sections that the plant cannot give, ``## Description``, ``## Rewards`` and
            ``## References``. Others that are here replace the plant's; ``## Success`` is added to the end of episodes.
    """
    summary, *parts = ("\n" + inspect.cleandoc(written)).split("\n## ")
    own = {title.strip(): text.strip() for title, _, text in (part.partition("\n") for part in parts)}
    low, high = ([c.low for c in plant.inputs], [c.high for c in plant.inputs])
    limits = [pair for c in plant.states for pair in ([(1.0, "")] * 2 if c.angle else [(c.limit, c.unit)])]
    facts = {
        "bounds": ", ".join(str(bound if len(set(bound)) > 1 else bound[0]) for bound in (low, high)),
        "nu": len(low),
        "ny": len(limits),
        "steps": EPISODE_STEPS,
        "seconds": EPISODE_STEPS * plant.dt,
        "id": plant.id,
        "state": ", ".join(c.symbol for c in plant.states),
        "wrapped": r", the angle wrapped to $(-\pi,\pi]$" if plant.angle is not None else "",
        "actions": _numbered("Action", [(f"{c.quantity} ${c.symbol}$", c.low, c.high, c.unit) for c in plant.inputs]),
        "observations": _numbered(
            "Observation", [(y, -most, most, unit) for y, (most, unit) in zip(plant.observations, limits, strict=True)]
        ),
        "states": _numbered(
            "State", [(f"${c.symbol}$", -c.largest_start, c.largest_start, c.unit) for c in plant.states]
        ),
        "starts": _starts(plant),
        "arguments": _arguments(plant),
    }
    sections = {name: text.format(**facts) for name, text in _TEXT.items()} | own
    sections["Episode End"] += f"\n\n{own['Success']}" if "Success" in own else ""
    return "\n\n".join([summary.strip(), *(f"## {name}\n{sections.get(name, '')}" for name in _SECTIONS)]) + "\n"


def _starts(plant: Plant) -> str:
    rows: list[list[str]] = []
    for name, draw in plant.starts.items():
        entries = ["its own"] * len(plant.states)
        if isinstance(draw, Uniform):
            around = np.broadcast_to(np.asarray(draw.around, float), (len(entries),)).tolist()
            ranges = [f"U({_number(low)}, {_number(high)})" for low, high in zip(draw.low, draw.high, strict=True)]
            entries = [f"${_number(a)} + {u}$" if a else f"${u}$" for a, u in zip(around, ranges, strict=True)]
        rows.append([f'`"{name}"`' + " (default)" * (not rows), *entries])
    return _table(["`start`", *(f"${c.symbol}$" for c in plant.states)], rows)


def _arguments(plant: Plant) -> str:
    rows: list[Sequence[str]] = []
    if plant.max_alpha is not None:
        rows.append(("`alpha`", "float", "1.0", f"size of the model error, 0 to {plant.max_alpha:g}"))
    for p in plant.parameters:
        kind = " x ".join(map(str, np.shape(p.value))) + " list" if np.ndim(p.value) else "float"
        limits = "" if np.ndim(p.value) or callable(p.high) else f", {p.low:g} to {p.high:g}"
        default = "by `alpha`" if plant.max_alpha is not None else "the plant's" if np.ndim(p.value) else str(p.value)
        rows.append((f"`{p.name}`", kind, default, f"{p.meaning}{limits} {p.unit}".strip()))
    rows += [[cell.format(next(iter(plant.starts))) for cell in row] for row in _ARGUMENTS[:1]]
    return _table(["Argument", "Type", "Default", "Meaning and range"], [*rows, *_ARGUMENTS[1:]])


def _numbered(what: str, rows: Sequence[tuple[str, float, float, str]]) -> str:
    cells = [
        (str(i), name.strip(), f"${_number(low)}$", f"${_number(high)}$", unit)
        for i, (name, low, high, unit) in enumerate(rows)
    ]
    return _table(["Num", what, "Min", "Max", "Unit"], cells)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    first, *others = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in (head, *rows)]
    return "\n".join([first, "".join(f"|{'-' * (width + 2)}" for width in widths) + "|", *others])


def _number(value: float) -> str:
    """In LaTeX; whole multiples of pi as such."""
    turns = round(value / math.pi)
    if turns and math.isclose(value, turns * math.pi):
        return f"{turns}\\pi".replace("1\\pi", "\\pi")
    return f"{round(value, 3):g}"
