"""What notebooks show of a table of transitions."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpcoffline.core.notebook import html_of
from mpcoffline.core.tables import Table


class Shown:
    """What a table of transitions is called, and how notebooks show it.

    Attributes:
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        name: What error messages call it.
        names: Names and units of the columns, observations first; none where nobody said.
    """

    def __init__(self, ny: int, nu: int, name: str, names: tuple[str, ...]) -> None:
        self.ny: int = ny
        self.nu: int = nu
        self.name: str = name
        self.names: tuple[str, ...] = names

    def _repr_html_(self) -> str:
        return html_of_rows(self)


def html_of_rows(table: Any) -> str:
    """Columns, by name and unit where these are known, and what they range over.

    Args:
        table: A :class:`~mpcoffline.TransitionTable`.
    """
    s = table.statistics()
    parts = [
        np.concatenate([part.observations, part.actions, np.atleast_1d(part.costs)])
        for part in (s.low, s.mean, s.high, s.std)
    ]
    unnamed = [*(f"observation {i}" for i in range(table.ny)), *(f"action {j}" for j in range(table.nu))]
    names = [*(table.names or unnamed), "cost"]
    rows = [(label, *(f"{v:.4g}" for v in each)) for label, each in zip(names, zip(*parts, strict=True), strict=True)]
    shown = Table(("column", "least", "mean", "most", "spread"), rows, align="lr")
    episodes = f"{table.n_episodes:,} {'episode' if table.n_episodes == 1 else 'episodes'}"
    return html_of(f"{table.name}: {len(table):,} transitions in {episodes}", tables=[shown])
