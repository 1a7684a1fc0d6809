"""What a policy hands from step to step in SB3's ``state``: its plan, and past inputs where the MPC holds some."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers import Plan


class Course(tuple[Array, ...]):
    """A plan and the inputs that were applied: the state of a policy whose MPC holds past inputs.

    Args:
        x: As in :class:`~mpcoffline.solvers.Plan`.
        u: Likewise.
        memory: Inputs applied in the steps before, ``(B, n_memory)`` in the order of ``mpc.layout.names``; a row of
            NaN is one that is not known.
        multipliers: As in :class:`~mpcoffline.solvers.Plan`: the last of four arrays, where there are any.
    """

    __slots__ = ()

    def __new__(cls, x: Array, u: Array, memory: Array, multipliers: Array | None = None) -> Self:
        """The arrays as they are."""
        return super().__new__(cls, (x, u, memory) if multipliers is None else (x, u, memory, multipliers))

    def __getnewargs__(self) -> tuple[Array, ...]:
        """For copies and pickles."""
        return tuple(self)

    @property
    def x(self) -> Array:
        """States."""
        return self[0]

    @property
    def u(self) -> Array:
        """Inputs."""
        return self[1]

    @property
    def memory(self) -> Array:
        """Past inputs."""
        return self[2]


def course_from(
    mpc: MPC, state: tuple[NDArray[Any], ...] | None, episode_start: ArrayLike | None, n_problems: int
) -> tuple[Plan, Array | None]:
    """The plan to start from and the past inputs ``(B, n_memory)``; None where the MPC holds none.

    Args:
        mpc: The MPC.
        state: What the call before returned; None for a cold start.
        episode_start: Which episodes have just begun, ``(B,)`` or one for all: their plans are forgotten, and
            ``mpc.usual_input`` stands for inputs of which nothing is known.
        n_problems: B.

    Raises:
        InvalidArgumentError: For a state of another MPC or batch size, or starts of another shape.
    """
    layout = mpc.layout
    remembers = layout.n_memory > 0
    if state is None:
        return Plan.none(n_problems, mpc), _usual(mpc, n_problems) if remembers else None
    least = 3 if remembers else 2
    most = least + (mpc.constraints is not None)  # the multipliers of its limits, if the solver knows them
    if not least <= len(state) <= most:
        what = "states, inputs and past inputs" if remembers else "states and inputs"
        raise InvalidArgumentError("state", expected=f"what predict returned: {what}", actual=f"{len(state)} arrays")
    plan = Plan(*state[:2], *state[least:])
    if len(plan.u) != n_problems:
        raise InvalidArgumentError(
            "state", expected=f"the state of {n_problems} environments", actual=f"that of {len(plan.u)}"
        )
    started = np.zeros(n_problems, dtype=bool)
    if episode_start is not None:
        started = np.asarray(episode_start, dtype=bool)
        if started.shape not in ((), (n_problems,)):
            raise InvalidArgumentError(
                "episode_start", expected=f"shape ({n_problems},)", actual=f"shape {started.shape}"
            )
        started = np.broadcast_to(started, (n_problems,))
    if started.any():  # hardly ever
        plan = plan.select(~started)
    if not remembers:
        return plan, None
    memory, shape = np.asarray(state[2], dtype=np.float64), (n_problems, layout.n_memory)
    if memory.shape != shape:
        raise InvalidArgumentError("state", expected=f"past inputs of shape {shape}", actual=f"shape {memory.shape}")
    unknown = started[:, None] | ~np.isfinite(memory)
    # What is usual takes as long to find as many a solve, and is hardly ever asked.
    return plan, np.where(unknown, _usual(mpc, n_problems), memory) if unknown.any() else memory


def _usual(mpc: MPC, n_problems: int) -> Array:
    """Past inputs of which nothing is known, ``(B, n_memory)``."""
    return np.tile(mpc.layout.filled(mpc.usual_input), (n_problems, 1))
