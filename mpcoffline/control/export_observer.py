"""The observer of a policy that sees outputs, as C99 beside its MPC."""

from __future__ import annotations

import re
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from gymnasium import spaces

from mpcoffline.core import limits
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.text import c_comment
from mpcoffline.core.types import Array
from mpcoffline.estimation.observer import KalmanObserver, disturbed_outputs, disturbed_plant
from mpcoffline.mpc import MPC
from mpcoffline.mpc.outputs import shown
from mpcoffline.solvers.ddp.codegen import text
from mpcoffline.solvers.ddp.elimination import value_and_jacobian
from mpcoffline.solvers.ddp.emission import emit

from .output_feedback import OutputFeedbackPolicy
from .policy import MPCPolicy

FILES = ("mpc_observer.h", "mpc_observer.c", "mpc_observer_test.c", "observer_vectors.txt")
_EPISODES, _DRAWS, _STEPS = 4, 40, 20
_ROUNDED = 1e-9  # of what is measured: what so little changes would say nothing of the code
_SAME = 1e-7  # of an input's range


def observer_files(policy: OutputFeedbackPolicy, options: dict[str, Any]) -> dict[str, str]:
    """Contents of :data:`FILES`, which stand beside those of the policy's MPC.

    Args:
        policy: The policy.
        options: Of its ddp solver.

    Raises:
        InvalidArgumentError: For functions that C99 lacks, or that no compiler is through with in minutes.
    """
    observer, mpc = policy.observer, policy.mpc
    rows, scale = _vectors(_in_double(policy, options))
    vectors = "".join(" ".join([str(int(reset)), *map(number, row)]) + "\n" for reset, *row in rows)
    test = _TEST.replace("@RANGES@", ", ".join(map(number, scale)))
    return dict(zip(FILES, (_header(observer, mpc), _source(observer, mpc), test, vectors or "\n"), strict=True))


def number(value: float) -> str:
    """A number in C."""
    return repr(float(value)) if np.isfinite(value) else "INFINITY" if value > 0 else "-INFINITY"


def array(name: str, values: object) -> str:
    """An array of numbers in C."""
    numbers = [number(v) for v in np.asarray(values, dtype=np.float64).ravel()]
    rows = [", ".join(numbers[k : k + 8]) for k in range(0, len(numbers), 8)]
    return f"static const double {name}[] = {{\n    " + ",\n    ".join(rows) + "};"


def _header(observer: KalmanObserver, mpc: MPC) -> str:
    layout = mpc.layout
    labels = (*observer.labels, *layout.y_labels[layout.n_states :])
    states = layout.y_labels[: layout.n_states]
    replaced = {
        "DT": f"{mpc.model.dt:g}",
        "NO": str(observer.n_outputs),
        "NM": str(len(labels)),
        "NS": str(layout.n_states),
        "ND": str(observer.n_disturbances),
        "NE": str(layout.n_states + observer.n_disturbances),
        "NA": str(len(layout.acting)),
        "MEASURED": "\n".join(f" *   measured[{i}]: {c_comment(str(label))}" for i, label in enumerate(labels)),
        "STATES": ", ".join(c_comment(str(label)) for label in states),
    }
    return re.sub(r"@(\w+)@", lambda match: replaced[match[1]], _HEADER)


def _source(observer: KalmanObserver, mpc: MPC) -> str:
    layout, known = mpc.layout, observer.begin(1)
    constants = [
        "#define N_ESTIMATED MPC_N_ESTIMATED",
        f"#define N_ACTING {len(layout.acting)}",
        array("low", mpc.action_low),
        array("high", mpc.action_high),
        array("noise", observer.noise),
        array(
            "missed", observer.process if observer.disturbance is None else [*observer.process, *observer.disturbance]
        ),
        array("begin", known.x[0]),
        array("begin_spread", np.sqrt(np.diag(known.P[0]))),
        "/* Where in [y, past inputs, u] what acts stands; where in [past inputs, u] each past input of the next step,",
        " * and of which input it is. */",
        f"static const int acting[] = {{{', '.join(map(str, layout.acting))}}};",
        f"static const int sources[] = {{{', '.join(map(str, [*layout.memory_sources, 0]))}}};",
        f"static const int input_of[] = {{{', '.join(map(str, [*layout.ages[0], 0]))}}};",
        "/* Which outputs depend on the inputs of the step before. */",
        f"static const int of_inputs[] = {{{', '.join(str(int(each)) for each in observer.feedthrough)}}};",
    ]
    parts = ['#include "mpc_observer.h"', text("scalar.h"), _functions(observer, mpc), "\n".join(constants)]
    return "\n\n".join([*parts, resources.files(__package__).joinpath("observer.c").read_text(encoding="utf-8")])


def _functions(observer: KalmanObserver, mpc: MPC) -> str:
    """The model with its disturbances, the outputs, and the Jacobians of both, column by column."""
    (z, acting, theta), reached = disturbed_plant(mpc, observer.n_disturbances)
    check_limit("mpc", "operations of a model", ca.n_nodes(reached), limits.COMPILED_NODES, error=InvalidArgumentError)
    value, slope = value_and_jacobian(reached, z, ca.vertcat(acting, theta))
    seen, seen_slope = value_and_jacobian(disturbed_outputs(observer.function, z, acting), z, acting)
    joined = [
        ca.cse(ca.vertcat(*(ca.vec(ca.densify(each)) for each in pair)))
        for pair in ((value, slope), (seen, seen_slope))
    ]
    return "\n\n".join(
        [emit("observed_ahead", [z, acting, theta], joined[0]), emit("observed_outputs", [z, acting], joined[1])]
    )


def _in_double(policy: OutputFeedbackPolicy, options: dict[str, Any]) -> OutputFeedbackPolicy:
    """The policy as the C is: its inputs are doubles, and corners are as they are."""
    mpc = policy.mpc
    space = spaces.Box(np.asarray(mpc.action_low), np.asarray(mpc.action_high), dtype=np.float64)
    acting = MPCPolicy(mpc, "ddp", action_space=space, **(options | {"round_corners": False}))
    return OutputFeedbackPolicy(acting, policy.observer)


def _vectors(policy: OutputFeedbackPolicy) -> tuple[list[list[float]], Array]:
    """Closed loops on the policy's own model: per step 1 after a reset, what is measured, the states, the action.

    An episode ends before the first step where a rounding of what was measured changes the action.

    Returns:
        The rows, and what errors of states and actions are measured by.
    """
    mpc, observer, rng = policy.mpc, policy.observer, np.random.default_rng(0)
    n, rows = mpc.layout.n_states, []
    usual = mpc.layout.usual_signals
    begun = 0
    for _ in range(_DRAWS):
        x = observer.start + observer.start_spread * rng.normal(size=n)
        noise = observer.noise * rng.normal(size=(_STEPS, observer.n_outputs))
        rounding = 1.0 + _ROUNDED * rng.uniform(-1.0, 1.0, (_STEPS, observer.n_outputs))
        episode = _episode(policy, x, usual, noise, rounding)
        rows += episode
        begun += len(episode) > 1
        if begun == _EPISODES:
            break
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    found = np.abs(np.array([row[-(n + mpc.nu) :] for row in rows])).max(axis=0) if rows else np.zeros(n + mpc.nu)
    sizes = np.append(observer.start_spread, np.where(np.isfinite(width), width, 0.0))
    scale = np.where(sizes > 0.0, np.maximum(sizes, 1e-3 * found), found)
    return rows, np.where(scale > 0.0, scale, 1.0)


def _episode(policy: OutputFeedbackPolicy, x: Array, usual: Array, noise: Array, rounding: Array) -> list[list[float]]:
    """A closed loop from a state: see :func:`_vectors`."""
    mpc, observer, stats = policy.mpc, policy.observer, policy.solver_stats
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    rows: list[list[float]] = []
    state, rounded, memory, acted = None, None, mpc.layout.filled(mpc.usual_input), np.asarray(mpc.usual_input)
    for k in range(len(noise)):
        y = shown(observer.function, x, acted) + noise[k]
        failed = stats.n_failures
        action, state = policy.predict(np.append(y, usual), state)
        other, rounded = policy.predict(np.append(y * rounding[k], usual), rounded)
        unit = np.where(np.isfinite(width), width, np.abs(action))
        if stats.n_failures > failed or not (np.abs(action - other) <= _SAME * unit).all():
            break
        states = policy.estimates(state)[0][0]
        rows.append([float(k == 0), *y.tolist(), *usual.tolist(), *states.tolist(), *action.tolist()])
        z = np.concatenate([x, usual, memory])
        x, acted = mpc.layout.split(z, action)
        x = mpc.plant_function(x, acted, mpc.theta).full()[:, 0]
        memory = mpc.layout.remembered(memory, action)
        if not np.isfinite(x).all():
            break
    return rows


_HEADER = """\
/* An observer for mpc_controller.h, written by mpcoffline: an extended Kalman filter that estimates the states of the
 * plant from what its sensors show. C99; needs math.h and nothing else, allocates nothing.
 *
 *   static mpc_observer observer;
 *   static mpc_state state;
 *   mpc_observer_reset(&observer);
 *   mpc_reset(&state);
 *   every @DT@ s:  mpc_observer_step(&mpc_learned_parameters, &observer, &state, measured, u);
 *
 * measured, MPC_N_MEASURED numbers, outputs first; an output that is NAN is not there, nor is one that depends on
 * inputs before any has acted:
@MEASURED@
 * The estimated states stand in observer.x after each step, the covariance of their errors in observer.P:
 *   @STATES@;
 * then a constant disturbance for each of the first MPC_N_DISTURBANCES inputs.
 */
#ifndef MPC_OBSERVER_H
#define MPC_OBSERVER_H

#include "mpc_controller.h"

#ifdef __cplusplus
extern "C" {
#endif

#define MPC_N_OUTPUTS @NO@
#define MPC_N_MEASURED @NM@
#define MPC_N_STATES @NS@
#define MPC_N_DISTURBANCES @ND@
#define MPC_N_ESTIMATED @NE@

typedef struct {
    int begun;
    double x[MPC_N_ESTIMATED], P[MPC_N_ESTIMATED * MPC_N_ESTIMATED];
    double acting[@NA@];
} mpc_observer;

/* Forgets what was measured: call it, and mpc_reset, before the first step and when an episode begins. */
void mpc_observer_reset(mpc_observer *observer);

/* The action u for what was measured, always within its bounds: apply it as it is, or change observer->acting to what
 * acts in its place. Returns what mpc_step does. */
int mpc_observer_step(
    const mpc_parameters *parameters, mpc_observer *observer, mpc_state *state, const double measured[MPC_N_MEASURED],
    double u[MPC_NU]
);

#ifdef __cplusplus
}
#endif
#endif
"""

_TEST = """\
/* Replays observer_vectors.txt: mpc_observer_test FILE. Returns 0 if every state and action is within 1e-6 of the
 * expected one, relative to how far states are spread where episodes begin and to the range of each input. */
#include <math.h>
#include <stdio.h>

#include "mpc_observer.h"

int main(int argc, char **argv) {
    static mpc_observer observer;
    static mpc_state state;
    const double range[MPC_N_STATES + MPC_NU] = {@RANGES@};
    double measured[MPC_N_MEASURED], u[MPC_NU], expected, worst = 0.0;
    int reset, steps = 0, unsolved = 0;
    FILE *file = fopen(argc > 1 ? argv[1] : "observer_vectors.txt", "r");
    if (!file) {
        fprintf(stderr, "cannot open the test vectors\\n");
        return 2;
    }
    while (fscanf(file, "%d", &reset) == 1) {
        for (int i = 0; i < MPC_N_MEASURED; ++i)
            if (fscanf(file, "%lf", &measured[i]) != 1) return 2;
        if (reset) {
            mpc_observer_reset(&observer);
            mpc_reset(&state);
        }
        unsolved += mpc_observer_step(&mpc_learned_parameters, &observer, &state, measured, u) != 0;
        for (int i = 0; i < MPC_N_STATES + MPC_NU; ++i) {
            double found = i < MPC_N_STATES ? observer.x[i] : u[i - MPC_N_STATES];
            if (fscanf(file, "%lf", &expected) != 1) return 2;
            double error = fabs(found - expected) / range[i];
            if (!(error <= worst)) worst = error;
        }
        ++steps;
    }
    fclose(file);
    if (!steps) {
        printf("no test vectors: nothing was tested\\n");
        return 2;
    }
    int passed = !unsolved && worst <= 1e-6;
    printf("%d steps, %d not solved, largest relative difference %.3g (at most 1e-6): %s\\n", steps, unsolved, worst,
           passed ? "passed" : "FAILED");
    return passed ? 0 : 1;
}
"""
