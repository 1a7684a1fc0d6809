"""How well a model integrates its differential equation on a log, in numbers, and what to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mpcoffline.core.types import Array

from .integrators import Scheme
from .layout import Layout
from .scaling import increments_scale
from .substeps import Choice, Flow, choice_on, relative

ROWS = 2_000  # of a log that are looked at
_FINER = 4  # times as many substeps, at least _FINEST, are taken for the truth
_FINEST = 32


class Rows(Protocol):
    """Transitions, as a :class:`~mpcoffline.TransitionTable`."""

    @property
    def observations(self) -> Any:
        """States ``(B, nx)``."""

    @property
    def actions(self) -> Any:
        """Inputs ``(B, nu)``."""

    @property
    def next_observations(self) -> Any:
        """States after them ``(B, nx)``."""

    def sample(self, count: int, rng: Any, /) -> Rows:
        """Some of them at random."""


@dataclass(frozen=True)
class IntegrationCheck:
    """How a model's differential equation is integrated, and the error of one sampling step on the rows of a log.

    Attributes:
        scheme: ``"exact"``, ``"rk4"``, or ``"map"`` for a map in discrete time, which is not integrated.
        substeps: RK4's substeps a sampling step; 1 for the others.
        typical: 99 % of the rows have a smaller error, in spreads of the increments s+ - s.
        largest: The largest error, likewise; infinite where a step is not finite.
        n_rows: Rows looked at.
        advice: What to do, in words; empty where nothing is to be done.
    """

    scheme: str
    substeps: int
    typical: float
    largest: float
    n_rows: int
    advice: str

    def __str__(self) -> str:
        """In one or two lines."""
        if self.scheme == "map":
            return "A map in discrete time: it is taken as it is."
        how = "exact" if self.scheme == "exact" else f"RK4 with {self.substeps} substep{'s' * (self.substeps > 1)}"
        errors = f"99 % of them below {self.typical:.2g}, the largest {self.largest:.2g}"
        return (
            f"Integrated by {how}. Errors of a step on {self.n_rows} rows, in spreads of the increments: {errors}.\n"
            f"{self.advice or 'Nothing to do.'}"
        )


def checked(
    flow: Flow, scheme: Scheme, step: Callable[[Array, Array], Array], rows: Rows, layout: Layout, *, fixed: bool
) -> IntegrationCheck:
    """Measures the error of one step against a much finer one; of an affine ODE against scipy's ``expm``.

    Args:
        flow: The ODE's solution.
        scheme: How it is integrated.
        step: The step ``(x, u) -> x+`` for many states.
        rows: The log.
        layout: What its columns are.
        fixed: Whether the scheme is what the user asked for.
    """
    x, u, reached = sampled(rows, layout)
    known = flow.defined(x, u)
    x, u, reached = x[known], u[known], reached[known]
    exact = scheme.kind == "exact"
    truth = flow.exact(x, u) if exact else flow(x, u, max(_FINER * scheme.substeps, _FINEST))
    errors = relative(step(x, u) - truth, increments_scale(x, reached)) if len(x) else np.zeros(1)
    typical, largest = (float(np.quantile(errors, q, method="higher")) for q in (0.99, 1.0))
    advice = "" if exact else _advice(choice_on(flow, x, u, reached), scheme, fixed=fixed)
    if not known.all():
        advice = f"{np.sum(~known)} rows have no finite dx/dt: is the model right there? {advice}".strip()
    return IntegrationCheck(scheme.kind, 1 if exact else scheme.substeps, typical, largest, len(x), advice)


def sampled(rows: Rows, layout: Layout) -> tuple[Array, Array, Array]:
    """The plant's states, what acts on them, and the states after them of some of the rows.

    Args:
        rows: Observations or the MPC's states. Of observations inputs are taken as they are, also those that act late:
            they come from the same range.
        layout: What the columns are.
    """
    few = rows.sample(ROWS, 0)
    x, u, reached = (np.asarray(v, np.float64) for v in (few.observations, few.actions, few.next_observations))
    n, whole = layout.n_states, x.shape[1] == layout.nx
    start, acting = layout.split(x, u) if whole else (x[:, :n], np.hstack([u, x[:, layout.present]]))
    return start, acting, reached[:, :n]


def _advice(choice: Choice, scheme: Scheme, *, fixed: bool) -> str:
    """What to do about the errors on a log; nothing where the scheme is as good as what the log asks for."""
    text = ""
    if choice.substeps > scheme.substeps:
        how = f"take integrator='rk4:{choice.substeps}', or 'auto'" if fixed else "fit takes them"
        text = f"The log asks for {choice.substeps} substeps: {how}."
    return f"{text} {shortfall(choice)}".strip()


def shortfall(choice: Choice) -> str:
    """What to do where no number of substeps is enough; empty where it is."""
    if choice.reason == "kink":
        return (
            f"More than {choice.substeps} substeps do little good. The equations may have a kink or a jump (friction, a"
            " wall, a relay): smooth it over some hundredths of what is usual there."
        )
    if choice.reason == "fast":
        return (
            "As many substeps as can be solved with are too few. Take a shorter dt, or replace the fastest states by"
            " their steady state."
        )
    return ""
