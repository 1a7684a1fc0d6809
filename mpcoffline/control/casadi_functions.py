"""The parts of an MPC as CasADi functions with all that was learned as numbers, and CasADi's files of them."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core.errors import StorageError
from mpcoffline.core.outputs import write_file
from mpcoffline.mpc import MPC
from mpcoffline.solvers.limits import Limits, limits_of

PLAIN = ("dynamics", "stage_cost", "terminal_cost")


class Parts(NamedTuple):
    """What the stages of (MPC) are made of, as functions of x ``(nx,)`` and v = [u, slacks] ``(nu + n_slacks,)``.

    A limit is imposed where something can be done about it: ``imposed`` is 0 at the first stage and 1 at all later
    ones, ``last`` 1 at stage N - 1 alone. What holds at the end is imposed on the successor of that stage.

    Attributes:
        ahead: ``(x, u) -> x+``.
        stage_cost: ``(x, v, imposed, last) -> cost``, of soft limits that are violated, too; without discount.
        terminal_cost: ``(x) -> cost``, without discount.
        limits: ``(x, v, imposed, last) -> h``, with h <= 0.
        n_slacks: Number of slacks, not negative, one for each element of h that is soft.
        soft: The element of h that each slack is of.
    """

    ahead: ca.Function
    stage_cost: ca.Function
    terminal_cost: ca.Function
    limits: ca.Function
    n_slacks: int
    soft: tuple[int, ...]

    @property
    def functions(self) -> dict[str, ca.Function]:
        """The functions by name."""
        return {each.name(): each for each in self[:4]}

    @property
    def n_limits(self) -> int:
        """Number of elements of h."""
        return int(self.limits.numel_out(0))


def parts_of(mpc: MPC) -> Parts:
    """The parts of a problem, with its theta."""
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX(mpc.theta)
    imposed, last = ca.SX.sym("imposed"), ca.SX.sym("last")
    reached, cost = mpc.dynamics_function(x, u, theta), mpc.stage_function(x, u, theta)
    h, slacks, soft = ca.SX(0, 1), ca.SX(0, 1), []
    limits = learned_limits(mpc, x, u)
    if limits is not None:
        n, bounds = limits.n_stage, limits.n_bounds
        stages = ca.vertsplit(limits.stage) if limits.stage.numel() else []
        # At the first stage, what no input changes is no matter of the controller.
        along = [each if free else imposed * each for each, free in zip(stages, limits.by_input, strict=False)]
        end = last * ca.substitute(limits.end, x, reached)
        h = ca.vertcat(*along, end)
        places = [*range(n + bounds), *range(n, len(limits.labels))]  # whose limit each element of h is
        soft = [i for i, j in enumerate(places) if np.isfinite(limits.l1[j])]
        slacks = ca.SX.sym("slacks", len(soft))
        for k, i in enumerate(soft):
            h[i] -= slacks[k]
            weight = mpc.discount if i >= n + bounds else 1.0  # at the end, a step later
            cost += weight * (limits.l1[places[i]] * slacks[k] + limits.l2[places[i]] * slacks[k] ** 2)
    v = ca.vertcat(u, slacks)
    given = [x, v, imposed, last]
    names = ["x", "v", "imposed", "last"]
    return Parts(
        ca.Function("ahead", [x, u], [ca.densify(reached)], ["x", "u"], ["x_next"]),
        ca.Function("stage_cost", given, [ca.densify(cost)], names, ["cost"]),
        ca.Function("terminal_cost", [x], [ca.densify(mpc.terminal_function(x, theta))], ["x"], ["cost"]),
        ca.Function("limits", given, [ca.densify(h)], names, ["h"]),
        slacks.numel(),
        tuple(soft),
    )


def learned_limits(mpc: MPC, x: ca.SX, u: ca.SX) -> Limits | None:
    """The limits in these symbols, with theta as numbers; None where there are none."""
    theta = ca.SX.sym("theta", len(mpc.theta))  # which limits are rates is found by derivatives, of symbols alone
    limits = limits_of(mpc, x, u, theta)
    if limits is None:
        return None
    numbers = ca.SX(mpc.theta)
    stage, end = (ca.substitute(h, theta, numbers) for h in (limits.stage, limits.end))
    return limits._replace(stage=stage, end=end)


def plain_functions(mpc: MPC) -> dict[str, ca.Function]:
    """Model and costs, theta as numbers: (x, u) -> x_next, (x, u) -> cost, (x) -> cost, the ones of ``PLAIN``.

    Costs are without discount and without the price of violated soft limits.
    """
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX(mpc.theta)
    parts = (
        ([x, u], mpc.dynamics_function(x, u, theta), ["x", "u"], "x_next"),
        ([x, u], mpc.stage_function(x, u, theta), ["x", "u"], "cost"),
        ([x], mpc.terminal_function(x, theta), ["x"], "cost"),
    )
    return {
        name: ca.Function(name, given, [ca.densify(value)], takes, [gives])
        for name, (given, value, takes, gives) in zip(PLAIN, parts, strict=True)
    }


def save_functions(functions: Mapping[str, ca.Function], folder: str | PathLike[str]) -> list[Path]:
    """Writes functions as ``NAME.casadi``, which any program with CasADi loads, and returns the files.

    Raises:
        StorageError: If nothing could be written there.
    """
    paths = []
    with TemporaryDirectory() as scratch:  # CasADi writes where it is told, a piece at a time
        for name, function in functions.items():
            path, made = Path(folder) / f"{name}.casadi", Path(scratch) / name
            try:
                function.save(str(made))
            except RuntimeError as error:
                raise StorageError(str(path), expected="a file that can be written", actual=str(error)[:200]) from error
            paths.append(write_file(path, made.read_bytes()))
    return paths
