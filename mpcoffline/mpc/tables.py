"""Look-up tables as arithmetic: what ``casadi.interpolant`` makes, linear or of B-splines, in any number of dimensions.

CasADi evaluates a table in compiled code of its own, which neither the C of a solver, nor torch, nor a file of
instructions can call. Written out, a table is a polynomial of its arguments' places on the grid: a piecewise linear one
of clipped ramps, a spline of its basis functions.
"""

from __future__ import annotations

import itertools
import re
from typing import Any, cast

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array

LARGEST = 20_000  # values of a table; a larger one stays a call, for ipopt alone
_KINDS = ("LinearInterpolant", "BSplineInterpolant")
_ARRAY = re.compile(r"static const casadi_(?:real|int) (casadi_\w+)\[\d+\] =\s*\{([^}]*)\};")
_LINEAR = re.compile(r"casadi_interpn\(res\[0\], *(\d+), *(\w+), *(\w+), *(\w+), *arg\[0\], *(\w+), *(\d+),")
_SPLINE = re.compile(r"nd_boor_eval\)?\([^,]+, *(\d+), *(\w+), *(\w+), *(\w+), *(\w+), *(\w+), *(\d+), *[^,]+, *(\w+),")


def as_arithmetic(call: ca.Function) -> ca.Function | None:
    """A table as an SX function of the same input and output, or None if the function is no table, or a large one."""
    if call.class_name() not in _KINDS or call.n_in() != 1 or call.n_out() != 1:
        return None
    code = _code(call)
    arrays: dict[str, Any] = {name: np.array(content.split(","), np.float64) for name, content in _ARRAY.findall(code)}
    x = ca.SX.sym("x", call.numel_in(0))
    linear, spline = _LINEAR.findall(code), _SPLINE.findall(code)
    if len(linear) + len(spline) != 1:
        return None
    if linear:
        _, grid, offset, values, _, m = linear[0]
        axes = np.split(arrays[grid], arrays[offset].astype(int)[1:-1])
        weights, sizes = [_ramps(x[d], axis) for d, axis in enumerate(axes)], [len(axis) for axis in axes]
    else:
        _, knots, offset, degrees, _, values, m, _ = spline[0]
        axes = np.split(arrays[knots], arrays[offset].astype(int)[1:-1])
        weights = [_basis(x[d], axis, int(p)) for d, (axis, p) in enumerate(zip(axes, arrays[degrees], strict=True))]
        sizes = [weight.numel() for weight in weights]
    if arrays[values].size > LARGEST:
        return None
    column = _contracted(arrays[values], int(m), sizes, weights, ramps=bool(linear))
    return ca.Function(call.name(), [x], [ca.reshape(column, *call.size_out(0))])


def _code(call: ca.Function) -> str:
    """The C that CasADi writes for a function: the only place where it shows a table's numbers."""
    generator = ca.CodeGenerator("table.c")
    generator.add(call)
    return str(generator.dump())


def _contracted(values: Array, m: int, sizes: list[int], weights: list[ca.SX], *, ramps: bool) -> ca.SX:
    """The table's m results ``(m, 1)``, summed up over one dimension after the other.

    Args:
        values: The numbers; the m results of a point first, then dimension by dimension.
        m: Results a point.
        sizes: Points a dimension.
        weights: The weights of a dimension's points, or the ramps between them.
        ramps: Whether they are ramps: then the sum is of the differences, behind the first point.
    """
    index = np.arange(values.size).reshape([m, *sizes], order="F")
    numbers = ca.SX(values)
    for weight in weights:  # the first dimension that is left is the second axis of index
        points = [numbers[row.ravel().tolist()] for row in np.moveaxis(index, 1, 0)]
        table = ca.horzcat(*points)  # a column a point of this dimension
        numbers = table[:, 0] + (table[:, 1:] - table[:, :-1]) @ weight if ramps else table @ weight
        index = np.arange(numbers.numel()).reshape(index[:, 0].shape)
    return numbers


def _ramps(x: ca.SX, grid: Array) -> ca.SX:
    """How far x is through each interval ``(n - 1, 1)``, from 0 to 1; beyond at the ends, so that lines go on."""
    ramps: list[ca.SX] = []
    for k, (low, high) in enumerate(itertools.pairwise(grid)):
        ramp = (x - low) / (high - low)
        ramp = ca.fmax(ramp, 0.0) if k > 0 else ramp
        ramps.append(ca.fmin(ramp, 1.0) if k < len(grid) - 2 else ramp)
    return ca.vertcat(*ramps)


def _basis(x: ca.SX, knots: Array, degree: int) -> ca.SX:
    """The B-splines of x ``(n, 1)``, by Cox and de Boor's recursion; all are 0 beyond the grid, as CasADi has it."""
    n = len(knots) - degree - 1
    steps = [x >= knots[0], *(x >= knot for knot in knots[degree + 1 : n]), x > knots[-1]]
    basis = [ca.SX(0)] * degree + [steps[k] - steps[k + 1] for k in range(n - degree)] + [ca.SX(0)] * degree
    for d in range(1, degree + 1):
        raised = []
        for i in range(len(basis) - 1):
            total = ca.SX(0)
            if knots[i + d] > knots[i]:
                total += (x - knots[i]) / (knots[i + d] - knots[i]) * basis[i]
            if knots[i + d + 1] > knots[i + 1]:
                total += (knots[i + d + 1] - x) / (knots[i + d + 1] - knots[i + 1]) * basis[i + 1]
            raised.append(total)
        basis = raised
    return cast(ca.SX, ca.vertcat(*basis))
