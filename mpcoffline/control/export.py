"""A learned MPC as self-contained C99: no allocation, no dependency but the C library's ``math.h``."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.core.text import c_comment, c_identifiers
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.rest import at_rest
from mpcoffline.solvers import DDPSolver, starts
from mpcoffline.solvers.ddp.codegen import algorithm, generated, text
from mpcoffline.solvers.scaling import input_units

from . import export_observer as observing
from .export_observer import array as _array, number as _number
from .loading import Acting, load_policy
from .output_feedback import OutputFeedbackPolicy
from .policy import MPCPolicy

_log = logging.getLogger(__name__)

_FILES = ("mpc_controller.h", "mpc_controller.c", "mpc_test.c", "test_vectors.txt", "CMakeLists.txt")
_EPISODES, _STEPS = 4, 20
# How a start of the test vectors is chosen, see _unambiguous_starts.
_SIZES = (1.0, 1e-3, 1e-6, 1e-9)  # of what is reached: bounds may be so wide that they say nothing
_DRAWS = 10  # of each size
_NEARBY, _NEIGHBOURS = 0.05, 32  # how far from a start its neighbours are, in widths of what is reached; how many
_ALIKE = 1e-3  # costs that differ by less, relative to how much those of the draws do, are almost as good
_SAME_PLAN = 1e-3  # inputs that differ by less, relative to their range, are one plan: a minimum can be flat


def export_c(policy: Acting | str | PathLike[str], folder: str | PathLike[str]) -> list[Path]:
    """Writes a policy as C99 code that a microcontroller's compiler takes.

    ``mpc_controller.h`` declares ``mpc_step(parameters, state, y, u)`` and documents every parameter with its unit;
    ``mpc_controller.c`` solves with the algorithm of the ddp solver, one problem at a time and within a fixed number of
    iterations; the warm start lives in ``mpc_state``, theta in ``mpc_parameters``. ``mpc_test.c`` replays
    ``test_vectors.txt``, closed loops of the policy on its own model. y is the observation; past inputs that the MPC's
    state holds besides are kept in ``mpc_state``. Corners of the model are not rounded in C: it acts as the policy with
    ``round_corners=False`` does.

    A policy that sees outputs comes with its observer: ``mpc_observer.h`` and ``mpc_observer.c``, whose
    ``mpc_observer_step(parameters, observer, state, measured, u)`` estimates the states and calls ``mpc_step``, with a
    test and vectors of their own.

    Args:
        policy: The policy, or the file of one or of a learner.
        folder: Where to write; made if missing. Files of the same names are overwritten.

    Returns:
        The files written.

    Raises:
        InvalidArgumentError: For functions that C99 lacks.
        FileFormatError: If the file is damaged or foreign.
        CompilerError: If there is no working C compiler; the test vectors need one.
        StorageError: If nothing could be written there, before anything is compiled.
    """
    check_output_folder(folder, (*_FILES, *observing.FILES))
    if not isinstance(policy, Acting):
        policy = load_policy(policy)
    mpc, inner = policy.mpc, policy.policy if isinstance(policy, OutputFeedbackPolicy) else policy
    options = inner.solver_options if inner.solver_name == "ddp" else {}
    solver = DDPSolver(mpc, **options)
    rows = _vectors(
        MPCPolicy(mpc, "ddp", **(options | {"round_corners": False}))
    )  # as the C, which has no corners rounded
    test = _TEST.replace("@RANGES@", ", ".join(map(_number, _ranges(mpc, rows))))
    vectors = "".join(" ".join([str(int(reset)), *map(_number, row)]) + "\n" for reset, *row in rows)
    observed = isinstance(policy, OutputFeedbackPolicy)
    cmake = _CMAKE.replace("@OBSERVER@", " mpc_observer.c" * observed) + _CMAKE_OBSERVER * observed
    texts = (_header(mpc, solver), _source(mpc, solver), test, vectors or "\n", cmake)
    contents = dict(zip(_FILES, texts, strict=True))
    if isinstance(policy, OutputFeedbackPolicy):
        contents |= observing.observer_files(policy, options)
    return [write_file(Path(folder) / name, content) for name, content in contents.items()]


def _header(mpc: MPC, solver: DDPSolver) -> str:
    fields, identifiers = [], c_identifiers(block.name for block in mpc.space)
    for block in mpc.space:
        meaning = f"shape {block.shape}" if block.shape else "number"
        meaning += ", row by row" if len(block.shape) == 2 else ""
        if block.kind == "psd":
            meaning = f"lower triangle, row by row, of C in {block.name} = C C', shape {block.shape}"
        size = f"[{block.size}]" if block.shape else ""
        unit = f", in {block.unit}" if block.unit else ""
        comment = c_comment(f"{block.name}: {meaning}{unit}")
        fields.append(f"    double {identifiers[block.name]}{size}; /* {comment} */")
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    labels = mpc.layout.labels
    names = [f", {c_comment(str(label))}" if labels.inputs else "" for label in mpc.layout.u_labels]
    known = labels.states or mpc.layout.signals
    columns = [f" *   y[{i}]: {c_comment(str(label))}" for i, label in enumerate(mpc.layout.y_labels) if known]
    bounds = [f" *   u[{a}]{names[a]}: from {low[a]:g} to {high[a]:g}" for a in range(mpc.nu)]
    replaced = {
        "NX": str(mpc.nx),
        "NY": str(mpc.ny),
        "NU": str(mpc.nu),
        "NP": str(mpc.space.size),
        "HORIZON": str(mpc.horizon),
        "STARTS": str(solver.n_starts),
        "ITERATIONS": str(solver.max_iterations),
        "DT": f"{mpc.model.dt:g}",
        "BOUNDS": "\n".join(columns + bounds),
        "FIELDS": "\n".join(fields),
        "LIMITS": _limit_fields(solver.limit_names),
    }
    return re.sub(r"@(\w+)@", lambda match: replaced[match[1]], _HEADER)


def _limit_fields(names: Sequence[str]) -> str:
    """What ``mpc_state`` holds besides where there are limits."""
    if not names:
        return ""
    listed = c_comment(", ".join(names))
    along = "(MPC_HORIZON + 1) * MPC_LIMITS"
    return f"""    /* Of the limits, with their multipliers and weights: {listed}. */
#define MPC_LIMITS {len(names)}
#define MPC_SURVEY {256 * (len(names) + 1) + 64}
    int has_limits;
    double limits[(MPC_HORIZON + 4) * MPC_LIMITS], work_limits[(MPC_HORIZON + 4) * MPC_LIMITS];
    double work_h[{along}], work_h_new[{along}], work_multiplier[{along}];
    double work_survey[MPC_SURVEY];
"""


def _source(mpc: MPC, solver: DDPSolver) -> str:
    theta = mpc.theta
    values = []
    for block in mpc.space:
        numbers = ", ".join(_number(v) for v in theta[mpc.space.slices[block.name]])
        values.append(f"    {'{' + numbers + '}' if block.shape else numbers}, /* {c_comment(block.name)} */")
    segments = starts.candidate_inputs(mpc)[:, :: starts.SEGMENT]
    constants = [
        f"#define DISCOUNT {_number(mpc.discount)}",
        f"#define TOLERANCE {_number(solver.tolerance)}",
        f"#define N_CANDIDATES {len(segments)}",
        f"#define SEGMENT {starts.SEGMENT}",
        f"#define SEGMENTS {segments.shape[1]}",
        _array("low", mpc.action_low),
        _array("high", mpc.action_high),
        _array("unit", input_units(mpc)),
        _array("rest", mpc.usual_input),
        _array("candidates", segments),
        "/* What counts as applied before the first step; where each past input comes from: past inputs, then u. */",
        _array("usual", np.append(mpc.layout.filled(mpc.usual_input), 0.0)),
        f"static const int sources[] = {{{', '.join(map(str, [*mpc.layout.memory_sources, 0]))}}};",
        "const mpc_parameters mpc_learned_parameters = {\n" + "\n".join(values) + "\n};",
        "/* mpc_parameters is nothing but MPC_NP numbers: the size of this array is negative if it were not. */",
        "typedef char mpc_parameters_are_numbers[sizeof(mpc_parameters) == MPC_NP * sizeof(double) ? 1 : -1];",
    ]
    parts = ['#include "mpc_controller.h"', text("scalar.h"), generated(mpc), algorithm(mpc)]
    return "\n\n".join([*parts, "\n".join(constants), text("controller.c")])


def _vectors(policy: MPCPolicy) -> list[list[float]]:
    """Closed loops on the policy's own model: per step 1 after a reset, the observation, the action."""
    mpc = policy.mpc
    rows: list[list[float]] = []
    for start in _unambiguous_starts(policy):
        z, state = start, None
        for step in range(_STEPS):
            solution = policy.solver.solve(z, warm_start=state)
            if not solution.success:  # its action would say nothing
                break
            state = solution.plan.shifted(mpc)
            rows.append([float(step == 0), *z[: mpc.ny].tolist(), *solution.u0.tolist()])
            z = mpc.model(z, solution.u0)
    if not rows:
        _log.warning(
            "No test vectors: of %d starts each was unsolved or had plans that are as good as its own.",
            _DRAWS * len(_SIZES),
        )
    return rows


def _ranges(mpc: MPC, rows: list[list[float]]) -> Array:
    """The range of each input that errors are measured by: never so large that no input at all would pass."""
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    largest = np.abs(np.array([row[-mpc.nu :] for row in rows])).max(axis=0) if rows else np.zeros(mpc.nu)
    ranges = np.where(np.isfinite(width), np.minimum(width, 1e3 * largest), largest)
    return np.where(ranges > 0.0, ranges, np.where(np.isfinite(width), width, 1.0))


def _unambiguous_starts(policy: MPCPolicy) -> list[Array]:
    """States with one best plan: no plan of a state nearby leads to another minimum that is almost as good.

    Python drops a start that is nearly beaten, C has no rivals to compare it with, and rounding differs too: which of
    two minima alike is found would say nothing of the code.
    """
    rng, shaking = np.random.default_rng(0), np.random.default_rng(1)
    found: list[Array] = []
    width = np.asarray(policy.mpc.action_high) - np.asarray(policy.mpc.action_low)
    (centre, low, high), mpc = _reached(policy.mpc), policy.mpc
    for size in _SIZES:
        draws = mpc.state(centre + size * (rng.uniform(low, high, (_DRAWS, mpc.ny)) - centre))
        solved = policy.solver.solve(draws)
        alike = _ALIKE * float(np.ptp(solved.value[solved.success])) if solved.success.any() else 0.0
        for y, plan, value in zip(*(a[solved.success] for a in (draws, solved.u, solved.value)), strict=True):
            moved = size * _NEARBY * (high - low) * shaking.uniform(-0.5, 0.5, (_NEIGHBOURS, mpc.ny))
            nearby = y + np.pad(moved, ((0, 0), (0, mpc.nx - mpc.ny)))
            others = policy.solver.solve(np.tile(y, (_NEIGHBOURS, 1)), warm_start=policy.solver.solve(nearby).plan)
            rivals = others.u[others.value < value + alike]
            same = _SAME_PLAN * np.where(np.isfinite(width), width, np.abs(plan).max())
            if np.all(np.abs(rivals - plan) < same):
                found.append(y)
            if len(found) == _EPISODES:
                return found
    return found


def _reached(mpc: MPC) -> tuple[Array, Array, Array]:
    """Where the plant rests, and between which observations the starts are: where the inputs take the model.

    That is the middle half of what an episode reaches from there, widened to twice its size; so it is in the plant's
    own units. A signal that a state tracks goes as far as that, another as far as its own size, 1 where that is zero.
    """
    inputs, rest = starts.candidate_inputs(mpc), at_rest(mpc)
    states = [np.tile(rest, (len(inputs), 1))]
    for k in range(min(_STEPS, mpc.horizon)):
        states.append(mpc.model(states[-1], inputs[:, k]))
    reached = np.concatenate(states)[:, : mpc.ny]
    low, high = np.quantile(reached[np.isfinite(reached).all(axis=1)], [0.25, 0.75], axis=0)
    tracks = {name: i for i, name in (getattr(mpc.stage_cost, "tracks", None) or {}).items()}
    for signal, first in zip(mpc.layout.signals, mpc.layout.present, strict=True):
        state, size, part = tracks.get(signal.name), abs(signal.usual) or 1.0, slice(first, first + signal.size)
        away = (-size, size) if state is None else (low[state] - rest[state], high[state] - rest[state])
        low[part], high[part] = signal.usual + away[0], signal.usual + away[1]
    return rest[: mpc.ny], low - (high - low) / 2, high + (high - low) / 2


_HEADER = """\
/* A model predictive controller, written by mpcoffline. C99; needs math.h and nothing else, allocates nothing.
 *
 *   static mpc_state state;
 *   mpc_reset(&state);
 *   every @DT@ s:  mpc_step(&mpc_learned_parameters, &state, y, u);
 *
 * y: the policy's observation, @NY@ numbers. u: the action, @NU@ numbers:
@BOUNDS@
 * Past inputs that the MPC needs besides (dead time, prices on changes) are kept in mpc_state: those that mpc_step
 * returned, so apply them as they are.
 *
 * A step warm-started from the step before takes at most MPC_MAX_ITERATIONS iterations. The first after a reset, and
 * one that is not solved from its warm start, add at most 4 for each of MPC_STARTS starts, MPC_MAX_ITERATIONS + 4 for a
 * quarter of them, rounded up, and MPC_MAX_ITERATIONS for a plan that stays where the plant is. An iteration costs the
 * same each time, up to the 10 trial steps of its line search.
 */
#ifndef MPC_CONTROLLER_H
#define MPC_CONTROLLER_H

#ifdef __cplusplus
extern "C" {
#endif

#define MPC_NY @NY@
#define MPC_NX @NX@
#define MPC_NU @NU@
#define MPC_NP @NP@
#define MPC_HORIZON @HORIZON@
#define MPC_STARTS @STARTS@
#define MPC_MAX_ITERATIONS @ITERATIONS@

/* theta: the parameters of model and costs. */
typedef struct {
@FIELDS@
} mpc_parameters;

extern const mpc_parameters mpc_learned_parameters;

/* The plan from which the next step starts, past inputs, and work space. */
typedef struct {
    int has_plan;
    double past[MPC_NX - MPC_NY + 1];
    double x[(MPC_HORIZON + 1) * MPC_NX], u[MPC_HORIZON * MPC_NU];
    double old_x[(MPC_HORIZON + 1) * MPC_NX], old_u[MPC_HORIZON * MPC_NU];
    double work_x[(MPC_HORIZON + 1) * MPC_NX], work_u[MPC_HORIZON * MPC_NU];
    double work_x_new[(MPC_HORIZON + 1) * MPC_NX], work_u_new[MPC_HORIZON * MPC_NU];
    double work_k[MPC_HORIZON * MPC_NU], work_K[MPC_HORIZON * MPC_NU * MPC_NX];
@LIMITS@} mpc_state;

/* Forgets the plan and the past inputs: call it before the first step and when an episode begins. */
void mpc_reset(mpc_state *state);

/* The action u for the observation y, always within its bounds. Returns where it comes from:
 *   0  the problem was solved, from the plan of the step before or else from all starts;
 *   1  it was not; the best plan that was found is applied: the model run with inputs within their bounds;
 *   2  no plan was found that is finite: the next input of the plan before;
 *   3  nor was there one before: zero, within the bounds. */
int mpc_step(const mpc_parameters *parameters, mpc_state *state, const double y[MPC_NY], double u[MPC_NU]);

#ifdef __cplusplus
}
#endif
#endif
"""

_TEST = """\
/* Replays test_vectors.txt: mpc_test FILE. Returns 0 if every action is within 1e-6 of the expected one, relative to
 * the input's range: from its lower to its upper bound or, where it has none, up to the largest expected one. */
#include <math.h>
#include <stdio.h>

#include "mpc_controller.h"

int main(int argc, char **argv) {
    static mpc_state state;
    double y[MPC_NY], u[MPC_NU], expected, worst = 0.0;
    const double range[MPC_NU] = {@RANGES@};
    int reset, steps = 0, unsolved = 0;
    FILE *file = fopen(argc > 1 ? argv[1] : "test_vectors.txt", "r");
    if (!file) {
        fprintf(stderr, "cannot open the test vectors\\n");
        return 2;
    }
    while (fscanf(file, "%d", &reset) == 1) {
        for (int i = 0; i < MPC_NY; ++i)
            if (fscanf(file, "%lf", &y[i]) != 1) return 2;
        if (reset) mpc_reset(&state);
        unsolved += mpc_step(&mpc_learned_parameters, &state, y, u) != 0;
        for (int a = 0; a < MPC_NU; ++a) {
            if (fscanf(file, "%lf", &expected) != 1) return 2;
            double error = fabs(u[a] - expected) / range[a];
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

_CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project(mpc_controller C)

set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library(mpc_controller STATIC mpc_controller.c@OBSERVER@)
target_include_directories(mpc_controller PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
find_library(MATH_LIBRARY m)
if(MATH_LIBRARY)
  target_link_libraries(mpc_controller PUBLIC ${MATH_LIBRARY})
endif()

enable_testing()
add_executable(mpc_test mpc_test.c)
target_link_libraries(mpc_test PRIVATE mpc_controller)
add_test(NAME replay COMMAND mpc_test ${CMAKE_CURRENT_SOURCE_DIR}/test_vectors.txt)
"""

_CMAKE_OBSERVER = """\
add_executable(mpc_observer_test mpc_observer_test.c)
target_link_libraries(mpc_observer_test PRIVATE mpc_controller)
add_test(NAME observer COMMAND mpc_observer_test ${CMAKE_CURRENT_SOURCE_DIR}/observer_vectors.txt)
"""
