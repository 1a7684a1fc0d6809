"""An explicit policy as self-contained C99: some kilobytes of numbers and forty lines of code."""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path

import numpy as np

from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.core.text import c_comment
from mpcoffline.core.types import Array

from .network import DIGITS
from .policy import DistilledPolicy

_FILES = ("explicit_policy.h", "explicit_policy.c", "explicit_test.c", "CMakeLists.txt")
_EPISODES, _STEPS = 4, 6  # of the test vectors
_REACH = 2.0  # spreads from the centre


def export_explicit_c(policy: DistilledPolicy | str | PathLike[str], folder: str | PathLike[str]) -> list[Path]:
    """Writes an explicit policy as C99 code: no allocation, no loop but over its layers, ``math.h`` for a square root.

    ``explicit_policy.h`` declares ``policy_reset(state)`` and ``policy_step(state, y, u)``; past inputs that the policy
    sees are kept in ``policy_state``. With 2,000 multiply-adds, header and source are below 20 kB. Numbers are
    ``double``, or ``float`` where ``POLICY_FLOAT`` is defined. ``explicit_test.c`` holds test vectors, and compares.

    Args:
        policy: The policy, or its file.
        folder: Where to write; made if missing. Files of the same names are overwritten.

    Returns:
        The files written.

    Raises:
        FileFormatError: If the file is damaged or foreign.
        StorageError: If nothing could be written there.
    """
    check_output_folder(folder, _FILES)
    if not isinstance(policy, DistilledPolicy):
        policy = DistilledPolicy.load(policy)
    contents = zip(_FILES, (_header(policy), _source(policy), _test(policy), _CMAKE), strict=True)
    return [write_file(Path(folder) / name, content) for name, content in contents]


def _header(policy: DistilledPolicy) -> str:
    low, high = policy.network.low, policy.network.high
    replaced = {
        "DT": f"{policy.report.dt:g}",
        "MACS": str(policy.network.multiply_adds),
        "NY": str(len(policy.y_labels)),
        "NU": str(policy.network.nu),
        "NM": str(policy.n_memory),
        "Y": "\n".join(f" *   y[{i}]: {c_comment(str(label))}" for i, label in enumerate(policy.y_labels)),
        "U": "\n".join(
            f" *   u[{i}]: {c_comment(str(label))}, from {low[i]:g} to {high[i]:g}"
            for i, label in enumerate(policy.u_labels)
        ),
    }
    return _filled(_HEADER, replaced)


def _source(policy: DistilledPolicy) -> str:
    net = policy.network
    layers = [
        _array(f"{kind}{k}", array)
        for k, pair in enumerate(zip(net.weights, net.biases, strict=True))
        for kind, array in zip("Ab", pair, strict=True)
    ]
    n = len(net.weights) - 1
    passes = [
        f"    layer({net.hidden[k]}, {(net.nz, *net.hidden)[k]}, A{k}, b{k}, {'v' if k == 0 else f'h{k - 1}'}, h{k});"
        for k in range(n)
    ]
    replaced = {
        "ARRAYS": "\n".join(
            [
                _array("mean", net.mean, exact=True),
                _array("spread", net.spread),
                *layers,
                _array("K", net.direct),
                _array("centre", net.centre, exact=True),
                _array("unit", net.unit, exact=True),
                _array("low", net.low, exact=True),
                _array("high", net.high, exact=True),
                _array("rest", np.clip(np.zeros(net.nu), net.low, net.high), exact=True),
                _array("usual", np.append(policy.usual_memory, 0.0), exact=True),
            ]
        ),
        "SOURCES": ", ".join(map(str, [*policy.memory_sources.tolist(), 0])),
        "HIDDEN": "".join(f", h{k}[{width}]" for k, width in enumerate(net.hidden)),
        "PASSES": "\n".join(passes),
        "LAST": f"h{n - 1}" if n else "v",
        "N_LAST": str((net.nz, *net.hidden)[-1]),
        "AN": f"A{n}",
        "BN": f"b{n}",
    }
    return _filled(_SOURCE, replaced)


def _test(policy: DistilledPolicy) -> str:
    rows = _vectors(policy)
    net = policy.network
    bounded = np.isfinite(net.high - net.low)
    replaced = {
        "N": str(len(rows)),
        "ROW": str(1 + len(policy.y_labels) + net.nu),
        "RANGES": ", ".join(_number(v) for v in np.where(bounded, 2.0 * net.unit, net.unit)),
        "VECTORS": ",\n".join(f"    {{{', '.join(map(_number, row))}}}" for row in rows),
    }
    return _filled(_TEST, replaced)


def _vectors(policy: DistilledPolicy) -> list[list[float]]:
    """Made-up episodes: per step 1 after a reset, the observation, the action in double precision."""
    rng, net, rows = np.random.default_rng(0), policy.network, []
    ny = len(policy.y_labels)
    for _ in range(_EPISODES):
        memory = policy.usual_memory
        for step in range(_STEPS):
            y = net.mean[:ny] + _REACH * net.spread[:ny] * rng.uniform(-1.0, 1.0, ny)
            u: Array = net(np.concatenate([y, memory]))
            rows.append([float(step == 0), *y.tolist(), *u.tolist()])
            memory = np.concatenate([memory, u])[policy.memory_sources]
    return rows


def _number(value: float) -> str:
    return repr(float(value)) if np.isfinite(value) else "HUGE_VAL" if value > 0 else "-HUGE_VAL"


def _short(value: float) -> str:
    """A number of few digits in few letters."""
    text = f"{value:.{DIGITS}g}"
    text = re.sub(r"^(-?)0\.", r"\1.", text)
    return text if re.search(r"[.e]", text) else f"{text}."


def _array(name: str, values: Array, *, exact: bool = False) -> str:
    numbers = [(_number if exact else _short)(v) for v in values.ravel().tolist()]
    lines = [",".join(numbers[k : k + 16]) for k in range(0, len(numbers), 16)]
    return f"static const policy_number {name}[] = {{\n" + ",\n".join(lines) + "};"


def _filled(template: str, values: dict[str, str]) -> str:
    return re.sub(r"@([A-Z_]+)@", lambda match: values[match[1]], template)


_HEADER = """\
/* An explicit policy, distilled from a model predictive controller by mpcoffline. C99; needs sqrt of math.h, allocates
 * nothing: @MACS@ multiply-adds an action. Define POLICY_FLOAT for float in place of double.
 *
 *   static policy_state state;
 *   policy_reset(&state);
 *   every @DT@ s:  policy_step(&state, y, u);
 *
 * y: the observation, u: the action:
@Y@
@U@
 * Past inputs that it sees besides (dead time, prices on changes) are kept in policy_state: those that policy_step
 * returned, so apply them as they are.
 */
#ifndef EXPLICIT_POLICY_H
#define EXPLICIT_POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

#define POLICY_NY @NY@
#define POLICY_NU @NU@
#define POLICY_NM @NM@

#ifdef POLICY_FLOAT
typedef float policy_number;
#else
typedef double policy_number;
#endif

typedef struct {
    policy_number past[POLICY_NM + 1];
} policy_state;

/* Forgets past inputs: call it before the first step and when an episode begins. */
void policy_reset(policy_state *state);

/* The action u for the observation y, always within its bounds. Returns 0; or 1 where y is not finite: u is then zero,
 * within the bounds. */
int policy_step(policy_state *state, const policy_number y[POLICY_NY], policy_number u[POLICY_NU]);

#ifdef __cplusplus
}
#endif
#endif
"""

_SOURCE = """\
#include "explicit_policy.h"

#include <math.h>

#ifdef POLICY_FLOAT
#define ROOT sqrtf
#else
#define ROOT sqrt
#endif
#define NZ (POLICY_NY + POLICY_NM)

@ARRAYS@
/* Where each past input comes from: past inputs, then u. */
static const int sources[] = {@SOURCES@};

static policy_number product(int n, const policy_number *a, const policy_number *x) {
    policy_number sum = 0;
    for (int j = 0; j < n; ++j) sum += a[j] * x[j];
    return sum;
}

static void layer(int m, int n, const policy_number *A, const policy_number *b, const policy_number *x,
                  policy_number *h) {
    for (int i = 0; i < m; ++i) {
        policy_number a = product(n, A + i * n, x) + b[i];
        h[i] = a / ROOT(1 + a * a);
    }
}

void policy_reset(policy_state *state) {
    for (int i = 0; i <= POLICY_NM; ++i) state->past[i] = usual[i];
}

int policy_step(policy_state *state, const policy_number y[POLICY_NY], policy_number u[POLICY_NU]) {
    policy_number v[NZ]@HIDDEN@, every[POLICY_NM + POLICY_NU];
    int wrong = 0;
    for (int i = 0; i < NZ; ++i) {
        policy_number z = i < POLICY_NY ? y[i] : state->past[i - POLICY_NY];
        v[i] = (z - mean[i]) / spread[i];
        wrong |= !(v[i] - v[i] == 0);
    }
@PASSES@
    for (int i = 0; i < POLICY_NM; ++i) every[i] = state->past[i];
    for (int i = 0; i < POLICY_NU; ++i) {
        policy_number o = product(NZ, K + i * NZ, v) + product(@N_LAST@, @AN@ + i * @N_LAST@, @LAST@) + @BN@[i];
        u[i] = wrong ? rest[i] : centre[i] + unit[i] * o;
        u[i] = u[i] > high[i] ? high[i] : u[i] >= low[i] ? u[i] : low[i];
        every[POLICY_NM + i] = u[i];
    }
    for (int i = 0; i < POLICY_NM; ++i) state->past[i] = every[sources[i]];
    return wrong;
}
"""

_TEST = """\
/* Compares the actions with those expected, relative to the range of each input: 1e-6 at most, in float 1e-3. */
#include "explicit_policy.h"

#include <math.h>
#include <stdio.h>

static const double vectors[@N@][@ROW@] = { /* 1 after a reset, y, u */
@VECTORS@};
static const double range[] = {@RANGES@};

int main(void) {
    static policy_state state;
    policy_number y[POLICY_NY], u[POLICY_NU];
    double worst = 0.0, most = sizeof(policy_number) == sizeof(float) ? 1e-3 : 1e-6;
    int failed = 0;
    for (int k = 0; k < @N@; ++k) {
        for (int i = 0; i < POLICY_NY; ++i) y[i] = (policy_number)vectors[k][1 + i];
        if (vectors[k][0] > 0.0) policy_reset(&state);
        failed += policy_step(&state, y, u);
        for (int i = 0; i < POLICY_NU; ++i) {
            double error = fabs((double)u[i] - vectors[k][1 + POLICY_NY + i]) / range[i];
            if (!(error <= worst)) worst = error;
        }
    }
    int passed = !failed && worst <= most;
    printf("%d steps, largest relative difference %.3g (at most %g): %s\\n", @N@, worst, most,
           passed ? "passed" : "FAILED");
    return passed ? 0 : 1;
}
"""

_CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project(explicit_policy C)

set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library(explicit_policy STATIC explicit_policy.c)
target_include_directories(explicit_policy PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
find_library(MATH_LIBRARY m)
if(MATH_LIBRARY)
  target_link_libraries(explicit_policy PUBLIC ${MATH_LIBRARY})
endif()

enable_testing()
add_executable(explicit_test explicit_test.c)
target_link_libraries(explicit_test PRIVATE explicit_policy)
add_test(NAME vectors COMMAND explicit_test)
"""
