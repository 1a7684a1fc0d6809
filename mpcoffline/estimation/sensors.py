"""What stands between a plant and its controller where not the state is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.expressions import function_to_json
from mpcoffline.mpc.labels import Label
from mpcoffline.mpc.outputs import outputs_from_json

from .observer import KalmanObserver
from .plant import state_rows

_ROWS = 5_000


@dataclass(frozen=True)
class Sensors:
    """Outputs of a plant, and all that an observer needs beside an MPC.

    Attributes:
        outputs: h, states ``(n_states, 1)`` -> outputs; with the inputs that acted in the step before, ``(nu, 1)``, as
            a second argument where some depend on these.
        noise: Standard deviation of the error of each output, ``(n_outputs,)``.
        process: Standard deviation of what the model misses of each state in a step, ``(n_states,)``.
        start: Mean of the states where episodes begin, ``(n_states,)``.
        start_spread: Standard deviation of their distance from it, ``(n_states,)``.
        disturbance: How much a disturbance of each input changes in a step, ``(nu,)``; None for none.
        undetermined: Names of parameters and states of which outputs hardly say anything.
        labels: What the outputs are called, with units; may be none.
    """

    outputs: ca.Function
    noise: Array
    process: Array
    start: Array
    start_spread: Array
    disturbance: Array | None = None
    undetermined: tuple[str, ...] = ()
    labels: tuple[Label, ...] = ()

    @classmethod
    def of(cls, observer: KalmanObserver) -> Sensors:
        """Those of an observer."""
        parts = observer.noise, observer.process, observer.start, observer.start_spread, observer.disturbance
        return cls(observer.function, *parts, labels=observer.labels)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.outputs.numel_out(0))

    def observer(self, mpc: MPC) -> KalmanObserver:
        """An observer for an MPC of this plant."""
        known = {name: getattr(self, name) for name in ("start", "start_spread", "disturbance", "labels")}
        return KalmanObserver(mpc, self.outputs, self.noise, self.process, **known)

    def with_disturbance(self, disturbance: ArrayLike | None) -> Sensors:
        """The same with constant disturbances of the inputs that are estimated, too, or with none."""
        given = None if disturbance is None else np.asarray(disturbance, dtype=np.float64)
        return replace(self, disturbance=given)

    def suited(self, mpc: MPC, table: TransitionTable) -> Sensors:
        """The same, for an observer with an MPC's model: what that misses of a table of states it is taken to miss.

        Args:
            mpc: Of this plant; its model may be a rough one.
            table: Transitions of smoothed states, as :func:`identify_from_outputs` gives them; past inputs beside them
                are left aside where the MPC has none.
        """
        n, plain = mpc.layout.n_states, mpc.nx == mpc.ny <= table.ny
        rows = (table if plain else state_rows(mpc, table)).sample(_ROWS, 0).values()
        s, s_next = (each[:, : mpc.nx] for each in (rows.observations, rows.next_observations))
        ahead = mpc.dynamics_function(s.T, rows.actions.T, mpc.theta).full().T
        missed = np.sqrt(np.mean((s_next - ahead)[:, :n] ** 2, axis=0))
        return replace(self, process=np.fmax(self.process, np.where(np.isfinite(missed), missed, 0.0)))

    def to_json(self) -> dict[str, Any]:
        """For a file.

        Raises:
            InvalidArgumentError: For outputs that are no plain arithmetic.
        """
        arrays = {name: getattr(self, name).tolist() for name in ("noise", "process", "start", "start_spread")}
        disturbance = None if self.disturbance is None else self.disturbance.tolist()
        rest = {"disturbance": disturbance, "undetermined": list(self.undetermined)}
        rest["labels"] = [list(label) for label in self.labels]
        return {"outputs": function_to_json(self.outputs), **arrays, **rest}

    @classmethod
    def from_json(cls, data: Mapping[str, Any], mpc: MPC) -> Sensors:
        """The inverse, for an MPC of the plant.

        Raises:
            InvalidArgumentError: For numbers that are no observer's.
        """
        known = dict(data)
        outputs, undetermined = known.pop("outputs"), tuple(str(name) for name in known.pop("undetermined", ()))
        observer = KalmanObserver(mpc, outputs_from_json(outputs, mpc.layout.n_states, mpc.nu), **known)
        return replace(cls.of(observer), undetermined=undetermined)

    def __str__(self) -> str:
        """What acts on what, in a sentence."""
        count = "1 output" if self.n_outputs == 1 else f"{self.n_outputs} outputs"
        load = "" if self.disturbance is None else ", and constant disturbances of the inputs"
        said = f"States are estimated from {count} with a noise of {listed(self.noise)}{load}"
        open_ = f"; the log hardly says anything of {', '.join(self.undetermined)}" if self.undetermined else ""
        return f"{said}{open_}."


def listed(values: Array) -> str:
    """Numbers with three digits, for a sentence."""
    return ", ".join(f"{v:.3g}" for v in values)


def steps_late(delay: Sequence[int]) -> str:
    """Dead times, for a sentence."""
    return f"{', '.join(map(str, delay))} {'step' if max(delay) == 1 else 'steps'} late"
