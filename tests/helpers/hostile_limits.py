"""Problems with limits that nobody can keep, or state, from states far out; and the kernel under sanitizers."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from random_limits import RandomProblem

from mpcoffline.control.export import export_c
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.mpc import MPC, Constraint, Penalty, StateBounds
from mpcoffline.solvers import DDPSolver, Solution
from mpcoffline.solvers.ddp.build import flags_of
from mpcoffline.solvers.ddp.codegen import source
from mpcoffline.solvers.limits import limits_of
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


def hostile_thetas(mpc: MPC, n: int, rng: np.random.Generator) -> Array:
    """``(n, size)``, all within their bounds: half near the MPC's own, others by many orders of magnitude off, or 0."""
    theta = np.tile(mpc.theta, (n, 1)) * np.exp(rng.uniform(-1.0, 1.0, (n, mpc.space.size)))
    theta += 0.1 * np.abs(mpc.theta).max() * rng.normal(size=theta.shape)
    far = rng.uniform(size=n) < 0.5
    theta[far] *= 10.0 ** rng.uniform(-40.0, 40.0, (int(far.sum()), 1))
    theta[:: max(1, n // 5)] = 0.0
    return np.asarray(np.clip(theta, mpc.space.low, mpc.space.high))


def spoiled(values: Array, rng: np.random.Generator) -> Array:
    """The rows with NaN or an infinity in one place each."""
    bad = values.copy()
    places = rng.integers(values.shape[1], size=len(values))
    bad[np.arange(len(values)), places] = rng.choice([np.nan, np.inf, -np.inf], size=len(values))
    return bad


class Claims(NamedTuple):
    """What a solution claims to have solved, and is wrong about.

    Attributes:
        not_finite: NaN or inf in its plan or cost.
        not_model: The plan is not what the model does with its inputs, or these are out of their bounds.
        violated: A hard limit is violated by more than a millionth of what it is measured by.
        over_budget: Problems, solved or not, that took more iterations than they may.
    """

    not_finite: int
    not_model: int
    violated: int
    over_budget: int


def wrong_claims(solver: DDPSolver, x: Array, theta: Array, solution: Solution, budget: int) -> Claims:
    """Judges plans by the MPC's own functions in CasADi, which the solver's C does not share.

    Args:
        solver: Of the problem.
        x: States, ``(B, nx)``.
        theta: Parameters, ``(B, size)``.
        solution: What the solver found from there.
        budget: Iterations that a problem may take.
    """
    mpc, N = solver.mpc, solver.mpc.horizon
    rows = np.flatnonzero(solution.success)
    u, states, parameters = solution.u[rows], x[rows].T, theta[rows].T
    finite = np.isfinite(solution.value[rows]) & np.isfinite(solution.x[rows]).all(axis=(1, 2))
    finite &= np.isfinite(u).all(axis=(1, 2))
    inside = ((u >= np.asarray(mpc.action_low)) & (u <= np.asarray(mpc.action_high))).all(axis=(1, 2))
    limits = _limits(mpc)
    assert solution.multipliers is not None
    scales = solution.multipliers[rows, -1]
    along, kept = np.ones(len(rows), dtype=bool), np.ones(len(rows), dtype=bool)
    for k in range(N + 1):
        inputs = u[:, k].T if k < N else np.zeros((mpc.nu, len(rows)))
        h = limits(states, inputs, parameters, float(k == 0), float(k == N)).full().T
        kept &= (h <= 1.01e-6 * scales).all(axis=1)
        near = np.abs(states.T - solution.x[rows, k])
        along &= (near <= 1e-6 * (np.abs(states.T) + np.abs(solution.x[rows, :]).max(axis=1))).all(axis=1)
        if k < N:
            states = mpc.dynamics_function(solution.x[rows, k].T, inputs, parameters).full()
    over = solution.stats["iterations"] > budget
    return Claims(*(int(bad.sum()) for bad in (~finite, finite & ~(along & inside), finite & ~kept, over)))


def _limits(mpc: MPC) -> ca.Function:
    """``(x, u, theta, first, last) -> h`` of all limits, as multipliers, -inf where they are not imposed."""
    x, u, theta = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    first, last = ca.SX.sym("first"), ca.SX.sym("last")
    found = limits_of(mpc, x, u, theta)
    assert found is not None
    n, bounds = len(found.labels), slice(found.n_stage, found.n_stage + found.n_bounds)
    h = ca.SX.zeros(n)
    h[: bounds.stop], h[bounds.stop :] = found.stage, found.end[found.n_bounds :]
    hard = np.isinf(found.l1)
    for j in range(n):
        at_stage, at_end = j < bounds.stop, j >= bounds.start
        free = 1.0 - float(found.by_input[j])  # at stage 0
        imposed = (1 - last) * float(at_stage) * (1 - first * free) + last * float(at_end)
        h[j] = ca.if_else(imposed * float(hard[j]) > 0.5, h[j], -ca.inf)
    return ca.Function("limits", [x, u, theta, first, last], [h])


_CONTROLLER = """
#include <stdint.h>
#include <stdio.h>
#include "mpc_controller.h"
int64_t counted;
int main(void) {
    static mpc_state state;
    static double row[MPC_NP + MPC_NY + 2], u[MPC_NU];
    while (fread(row, sizeof row, 1, stdin) == 1) {
        if (row[0]) mpc_reset(&state);
        counted = 0;
        int answer = mpc_step((const mpc_parameters *)(row + 1), &state, row + 1 + MPC_NP, u);
        double found[2] = {answer, (double)counted};
        fwrite(found, sizeof found, 1, stdout);
        fwrite(u, sizeof u, 1, stdout);
    }
    return 0;
}
"""


class Exported:
    """The C of an MPC, compiled so that it counts its iterations.

    Args:
        mpc: The MPC.
        folder: For its files.
        flags: Of gcc.
    """

    def __init__(self, mpc: MPC, folder: Path, *flags: str) -> None:
        self._mpc, self._program = mpc, folder / "controller"
        export_c(MPCPolicy(mpc, "ddp"), folder)
        text = (folder / "mpc_controller.c").read_text()
        call = "iterate(m, w, -1, &converged, &moved, &stalled);"
        assert text.count(call) == 1
        text = "#include <stdint.h>\nextern int64_t counted;\n" + text.replace(call, f"++counted, {call}")
        (folder / "counting.c").write_text(text)
        (folder / "main.c").write_text(_CONTROLLER)
        command = ["gcc", "-std=c99", "-w", *flags, "-I.", "counting.c", "main.c", "-o", "controller", "-lm"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)

    def __call__(
        self, resets: Array, thetas: Array, y: Array, seconds: float | None = None
    ) -> tuple[Array, Array, Array]:
        """Steps one after another: what each returns, its iterations, and the inputs ``(B, nu)``.

        Raises:
            subprocess.TimeoutExpired: If they take longer than that.
            subprocess.CalledProcessError: If the program ends in another way than by its last line.
        """
        rows = np.hstack([resets[:, None], thetas, y, np.zeros((len(y), 1))])
        done = subprocess.run([self._program], input=rows.tobytes(), capture_output=True, check=True, timeout=seconds)
        found = np.frombuffer(done.stdout).reshape(len(y), 2 + self._mpc.nu)
        return found[:, 0], found[:, 1], found[:, 2:]


_MAIN = """
#include <stdio.h>
#define N {horizon}
#define B {n}
static const double x0[] = {{{x}}}, candidates[] = {{{candidates}}}, theta[] = {{{theta}}};
static const double low[] = {{{low}}}, high[] = {{{high}}};
static const double unit[] = {{{unit}}}, rest[] = {{{rest}}};
static double x[B * (N + 1) * NX], u[B * N * NU], J[B], predicted[B], y[B * MULTIPLIER_ROWS(N) * LIMITS];
static double violation[B], now[B], amount[B];
static int64_t iterations[B], status[B], worst[B];
int main(void) {{
    mpc_problem m = {{N, {discount}, low, high, unit, rest, 60, 1e-11, 0}};
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
        rest=numbers(mpc.usual_input),
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
