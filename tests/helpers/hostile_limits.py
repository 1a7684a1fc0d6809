"""Problems with limits that nobody can keep, or state, from states far out; and the kernel under sanitizers."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from random_limits import RandomProblem

from mpcoffline.mpc import MPC, Constraint, Penalty, StateBounds
from mpcoffline.solvers.ddp.build import flags_of
from mpcoffline.solvers.ddp.codegen import source
from mpcoffline.solvers.starts import candidate_inputs

Array = NDArray[np.float64]


def _everywhere(nx: int, value: float) -> Array:
    return np.full(nx, value)


#: ``(nx) -> constraints`` that are added to those of a problem.
ADDED: dict[str, Any] = {
    "none": lambda nx: [],
    "contradicting": lambda nx: [Constraint(lambda x, u, p: ca.vertcat(x[0] - 1.0, 1.001 - x[0]), "both")],
    "a single point": lambda nx: [StateBounds(_everywhere(nx, 0.1), _everywhere(nx, 0.1), "point")],
    "a constant": lambda nx: [Constraint(lambda x, u, p: ca.vertcat(1.0, x[0] - 1e3), "never")],
    "a root": lambda nx: [Constraint(lambda x, u, p: ca.sqrt(x[0]) - 1.0, "root")],
    "huge": lambda nx: [Constraint(lambda x, u, p: 1e200 * (x[0] - 0.5), "huge")],
    "tiny": lambda nx: [Constraint(lambda x, u, p: 1e-200 * (x[0] - 0.5), "tiny")],
    "a pole": lambda nx: [Constraint(lambda x, u, p: 1.0 / (x[0] - 0.3) - 5.0, "pole")],
    "a price beyond measure": lambda nx: [Constraint(lambda x, u, p: x[0] - 0.5, "dear", Penalty(1e250, 1e250))],
    "unreachable": lambda nx: [Constraint(lambda x, p: 1e6 - x[0], "goal", terminal=True)],
}


def hostile_problem(seed: int) -> tuple[str, MPC]:
    """What is wrong with it, and the problem."""
    kind = list(ADDED)[seed % len(ADDED)]
    mpc = RandomProblem(seed).mpc()
    return kind, mpc.replace(constraints=[*(mpc.constraints or ()), *ADDED[kind](mpc.nx)])


def hostile_states(nx: int, n: int, rng: np.random.Generator) -> Array:
    """Finite: a quarter as they should be, others small, large, beyond what squares can hold, and zero."""
    states = rng.normal(size=(n, nx))
    near = rng.uniform(size=n) < 0.5
    size = 10.0 ** np.where(near, rng.uniform(-12.0, 12.0, n), rng.uniform(-200.0, 200.0, n))
    states[n // 4 :] *= size[n // 4 :, None]
    states[:: max(1, n // 7)] = 0.0
    return states


_MAIN = """
#include <stdio.h>
#define N {horizon}
#define B {n}
static const double x0[] = {{{x}}}, candidates[] = {{{candidates}}}, theta[] = {{{theta}}};
static const double low[] = {{{low}}}, high[] = {{{high}}}, unit[] = {{{unit}}};
static double x[B * (N + 1) * NX], u[B * N * NU], J[B], predicted[B], y[B * MULTIPLIER_ROWS(N) * LIMITS];
static double violation[B], now[B], amount[B];
static int64_t iterations[B], status[B], worst[B];
int main(void) {{
    mpc_problem m = {{N, {discount}, low, high, unit, 60, 1e-11, 0}};
    mpc_batch b = {{.n = B, .x0 = x0, .theta = theta, .x = x, .u = u, .J = J, .predicted = predicted}};
    b.iterations = iterations, b.status = status, b.limits = y, b.violation = violation, b.now = now, b.worst = worst;
    b.amount = amount;
    if (mpc_limits(&m, &b, candidates, {n_candidates})) return 1;
    if (mpc_solve_cold(&m, &b, candidates, {n_candidates}, 8, 0, 1)) return 1;
    for (int i = 0; i < B; ++i) printf("%d %.17g\\n", (int)status[i], J[i]);
    b.x_guess = x, b.u_guess = u, b.limits_guess = y, b.limits_stride = MULTIPLIER_ROWS(N) * LIMITS;
    if (mpc_solve(&m, &b, 0, 1)) return 1;
    for (int i = 0; i < B; ++i) printf("%d %.17g\\n", (int)status[i], J[i]);
    return 0;
}}
"""


def sanitized(mpc: MPC, x: Array, folder: Path) -> tuple[NDArray[np.int64], Array]:
    """Statuses and costs ``(2, B)`` of cold and warm solves in a program that ends at any misuse of memory or numbers.

    Raises:
        AssertionError: What clang or the program said.
    """

    def numbers(values: Any) -> str:
        return (
            ", ".join(f"{v:.17g}" if np.isfinite(v) else f"{'-' * int(v < 0)}INFINITY" for v in np.ravel(values)) or "0"
        )

    candidates = candidate_inputs(mpc)
    main = _MAIN.format(
        horizon=mpc.horizon,
        n=len(x),
        x=numbers(x),
        candidates=numbers(candidates),
        n_candidates=len(candidates),
        theta=numbers(mpc.theta),
        low=numbers(mpc.action_low),
        high=numbers(mpc.action_high),
        unit=numbers(np.ones(mpc.nu)),
        discount=mpc.discount,
    )
    flags = [flag for flag in flags_of("clang") if flag not in ("-O3", "-shared", "-fPIC")]
    checks = ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-w"]
    program = folder / "sanitized"
    command = ["clang", *flags, *checks, "-x", "c", "-", "-o", str(program), "-lm"]
    for step, text in ((command, source(mpc) + main), ([str(program)], None)):
        done = subprocess.run(step, input=text, text=True, capture_output=True, check=False, timeout=300)
        if done.returncode:
            raise AssertionError(done.stderr[:2000])
    rows = np.array([line.split() for line in done.stdout.splitlines()], dtype=float).reshape(2, len(x), 2)
    return rows[..., 0].astype(np.int64), rows[..., 1]
