"""What an explicit policy is worth, measured against the MPC it was distilled from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.text import figure


@dataclass(frozen=True)
class Comparison:
    """Costs of episodes of the explicit policy and of the MPC, from the same starts.

    Attributes:
        cost: Mean cost of an episode of the explicit policy, undiscounted; inf where one was lost.
        mpc_cost: The MPC's.
        loss: What the policy costs more, relative to the MPC's cost above ``floor``.
        worst: The most that an episode cost more, relative to the MPC's mean cost above ``floor``.
        floor: What an episode costs at least, from which cost is measured: on the model, the least stage cost that
            either met in each step, so that a constant in the cost changes nothing; in an environment 0.
        episodes: Number of episodes.
        n_steps: Their length; of an environment, the MPC's mean.
    """

    cost: float
    mpc_cost: float
    loss: float
    worst: float
    floor: float
    episodes: int
    n_steps: int

    @classmethod
    def of(cls, costs: Any, mpc_costs: Any, n_steps: int, floor: float = 0.0) -> Self:
        """From the costs of each episode."""
        ours, theirs = np.asarray(costs, dtype=np.float64), np.asarray(mpc_costs, dtype=np.float64)
        scale = abs(float(theirs.mean()) - floor)
        more = ours - theirs
        with np.errstate(divide="ignore", invalid="ignore"):
            loss, worst = (float(np.divide(value, scale)) for value in (more.mean(), more.max()))
        loss, worst = (0.0 if np.isnan(value) else value for value in (loss, worst))  # nothing of nothing
        return cls(float(ours.mean()), float(theirs.mean()), loss, worst, float(floor), len(ours), int(n_steps))

    def __str__(self) -> str:
        return (
            f"{figure(self.cost, 4)} for {figure(self.mpc_cost, 4)}, {self.loss:+.2%}, in {self.episodes} episodes of"
            f" {self.n_steps} steps; {self.worst:+.1%} in the worst"
        )


@dataclass(frozen=True)
class DistillationReport:
    """What :func:`mpcoffline.control.distill` has measured.

    Attributes:
        multiply_adds: Multiplications with additions that an action takes.
        n_labels: MPCs that were solved for it.
        fit_error: Root mean square of the difference of its inputs from the MPC's in the states that the MPC meets from
            starts of its own, of each input's unit: half its range, or how far it varies where it has no bounds.
        model: Closed loops on the MPC's model, from starts that had no part in the fit where there were enough.
        env: Closed loops in an environment, where one was given.
        dt: Sampling time in s.
        discount: The MPC's.
        seed: With which it was distilled.
    """

    multiply_adds: int
    n_labels: int
    fit_error: tuple[float, ...]
    model: Comparison
    env: Comparison | None
    dt: float
    discount: float
    seed: int

    def __str__(self) -> str:
        lines = [
            f"{self.multiply_adds} multiply-adds an action, from {self.n_labels} solved MPCs",
            f"inputs differ by {', '.join(f'{error:.1%}' for error in self.fit_error)} of their unit (rms)",
            f"cost on the MPC's model: {self.model}",
        ]
        if self.env is not None:
            lines.append(f"cost in the environment: {self.env}")
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """As JSON; inf becomes null."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`.

        Raises:
            FileFormatError: For other numbers than a report has.
        """
        given = dict(data)
        model, env = (None if given[name] is None else _comparison(given[name]) for name in ("model", "env"))
        if model is None:
            raise FileFormatError("report", expected="a comparison on the model", actual="none")
        errors = tuple(float(error) for error in given["fit_error"])
        n, solved, seed = (int(given[name]) for name in ("multiply_adds", "n_labels", "seed"))
        return cls(n, solved, errors, model, env, float(given["dt"]), float(given["discount"]), seed)


def _comparison(data: Mapping[str, Any]) -> Comparison:
    names = ("cost", "mpc_cost", "loss", "worst")
    numbers = {name: float("inf" if data[name] is None else data[name]) for name in names}
    return Comparison(
        **numbers, floor=float(data["floor"]), episodes=int(data["episodes"]), n_steps=int(data["n_steps"])
    )
