"""Where a solve fails, the exported C does what the policy does, and says what it applies."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_plants import heater, kinked, vehicle
from limited_problems import integrator
from numpy.typing import NDArray

from mpcoffline import MPC, MPCPolicy
from mpcoffline.control.export import export_c
from mpcoffline.solvers.ddp.build import find_compiler

Array = NDArray[np.float64]

MAIN = """
#include <stdio.h>
#include "mpc_controller.h"
int main(void) {
    static mpc_state state;
    double y[MPC_NX], u[MPC_NU];
    int reset;
    while (scanf("%d", &reset) == 1) {
        for (int i = 0; i < MPC_NX; ++i) if (scanf("%lf", &y[i]) != 1) return 1;
        if (reset) mpc_reset(&state);
        printf("%d", mpc_step(&mpc_learned_parameters, &state, y, u));
        for (int a = 0; a < MPC_NU; ++a) printf(" %.17g", u[a]);
        printf("\\n");
    }
    return 0;
}
"""
CODES = {"solved": 0, "retried": 0, "best_plan": 1, "previous_plan": 2, "zero": 3}


def in_c(policy: MPCPolicy, folder: Path, steps: list[tuple[bool, Array]]) -> Array:
    """Code and action of each step, ``(n, 1 + nu)``; a step resets the controller, or not."""
    export_c(policy, folder)
    (folder / "main.c").write_text(MAIN)
    program = folder / "program"
    command = [find_compiler(), "-std=c99", "-O0", "-Wall", "-Werror", "-pedantic", str(folder / "main.c")]
    subprocess.run([*command, str(folder / "mpc_controller.c"), "-o", str(program), "-lm"], check=True)
    lines = "\n".join(" ".join([str(int(reset)), *map(repr, y.tolist())]) for reset, y in steps)
    done = subprocess.run([program], input=lines, capture_output=True, text=True, check=True)
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64)


def in_python(policy: MPCPolicy, steps: list[tuple[bool, Array]]) -> Array:
    rows, state = [], None
    for reset, y in steps:
        before = policy.solver_stats.answers
        action, state = policy.predict(y, None if reset else state)
        change = [name for name, count in policy.solver_stats.answers.items() if count > before[name]]
        rows.append([CODES[change[0] if change else "solved"], *action])
    return np.array(rows, dtype=np.float64)


def closed_loops(policy: MPCPolicy, starts: Array, n_steps: int) -> list[tuple[bool, Array]]:
    steps = []
    for start in starts:
        y, state = start, None
        for k in range(n_steps):
            steps.append((k == 0, y))
            action, state = policy.predict(y, state)
            y = policy.mpc.model(y, action.astype(np.float64))
    return steps


@pytest.mark.parametrize(
    ("mpc", "options", "starts"),
    [
        (heater(kink=False), {"max_iterations": 1}, [[1.5, 0.1], [0.0, 0.0]]),
        (vehicle(), {"max_iterations": 1}, [[1.0, 0.5, 0.0, 0.0]]),
        pytest.param(kinked(), {"max_iterations": 4}, [[0.5, -0.5]], marks=pytest.mark.slow),
    ],
)
def test_failures_are_answered_as_in_python(
    mpc: MPC, options: dict[str, Any], starts: list[list[float]], tmp_path: Path
) -> None:
    policy = MPCPolicy(mpc, "ddp", n_starts=4, round_corners=False, **options)
    steps = closed_loops(policy, np.array(starts), 25)
    expected = in_python(policy, steps)
    assert (expected[:, 0] == 1).any()
    found = in_c(policy, tmp_path, steps)
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    np.testing.assert_allclose(found[:, 1:], expected[:, 1:], rtol=0, atol=2e-6)


def test_without_any_finite_plan_the_previous_one_goes_on_and_else_zero(tmp_path: Path) -> None:
    policy, far = MPCPolicy(heater(kink=False), "ddp"), np.array([1e200, 1e300])
    steps = [(True, far), (True, np.array([0.0, 0.0])), (False, far), (False, far), (False, np.array([0.3, 0.2]))]
    expected = in_python(policy, steps)
    assert expected[:, 0].tolist() == [3, 0, 2, 2, 0]
    assert (expected[:, 1] >= 0.0).all()
    found = in_c(policy, tmp_path, steps)
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    np.testing.assert_allclose(found[:, 1:], expected[:, 1:], rtol=0, atol=2e-6)
    header = (tmp_path / "mpc_controller.h").read_text()
    for code in range(4):
        assert f" *   {code}  " in header


@pytest.mark.parametrize(("low", "high"), [(0.25, np.inf), (-np.inf, 0.3), (-np.inf, np.inf)])
def test_one_sided_bounds_in_c(low: float, high: float, tmp_path: Path) -> None:
    policy = MPCPolicy(heater(kink=False).replace(action_low=[low], action_high=[high]), "ddp")
    steps = closed_loops(policy, np.array([[1.5, 0.1], [0.0, 0.0]]), 15)
    expected = in_python(policy, steps)
    found = in_c(policy, tmp_path, steps)
    assert (found[:, 0] == 0).all()
    np.testing.assert_allclose(found[:, 1:], expected[:, 1:], rtol=1e-6, atol=2e-6)


def test_limits_that_cannot_be_kept(tmp_path: Path) -> None:
    """The plan that violates them the least is applied, and the next steps are solved as if nothing had been."""
    policy = MPCPolicy(integrator(), "ddp")
    states = [[1.2, 0.0], [1.2, -0.3], [1.0, -3.0], [0.4, -2.6], [0.1, -0.5], [0.0, -0.3], [0.0, 0.0]]
    steps = [(k == 0, np.array(state)) for k, state in enumerate(states)]
    ours, theirs = in_python(policy, steps), in_c(policy, tmp_path, steps)
    np.testing.assert_array_equal(theirs[:, 0], [0, 0, 1, 1, 0, 0, 0])
    np.testing.assert_array_equal(ours[:, 0], theirs[:, 0])
    np.testing.assert_allclose(ours[:, 1:], theirs[:, 1:], atol=1e-5)
