"""The exported observer: it estimates and acts as the policy in Python does."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPCPolicy, Signal
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.control.export import export_c
from mpcoffline.estimation import KalmanObserver
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.mpc.labels import Label
from mpcoffline.solvers.ddp.build import find_compiler

STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")


def mpc_of(*, delay: int | list[int] = 0, signals: bool = False, price: float = 0.0) -> MPC:
    """Two tanks and a pump, of which the second input heats the second one."""

    def loaded(x: ca.SX, u: ca.SX, p: object, d: Any) -> ca.SX:
        return moved(x, u, p) - ca.vertcat(0.1 * d.load, 0.0)

    def moved(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        return ca.vertcat(0.9 * x[0] + 0.3 * ca.tanh(u[0]), 0.8 * x[1] + 0.2 * ca.sin(x[0]) + 0.1 * u[1])

    own = [Signal("load", usual=0.2)] if signals else []
    model = Model(loaded if signals else moved, 2, 2, 0.5, discrete=True, delay=delay, signals=own)
    prices = {"D": price * np.eye(2)} if price else {}
    stage = QuadraticCost(np.diag([0.1, 1.0]), 0.05 * np.eye(2), x_ref=[0.5, 0.6], **prices)
    return MPC(model, stage, QuadraticCost(np.eye(2), x_ref=[0.5, 0.6]), 15, 0.97, [-1.0, -2.0], [1.0, 2.0])


def fed(x: ca.SX, u: ca.SX) -> ca.SX:
    """A current, and the second tank as its heater disturbs the gauge."""
    return ca.vertcat(ca.exp(0.5 * u[0]) + 0.3 * x[0], x[1] + 0.2 * u[1] * x[0])


def policy_of(case: str) -> OutputFeedbackPolicy:
    mpc = {
        "late": lambda: mpc_of(delay=[2, 0]),
        "inputs, late, disturbed": lambda: mpc_of(delay=[2, 1], signals=True),
        "late, loads": lambda: mpc_of(delay=[2, 1], price=0.1),
        "signals": lambda: mpc_of(signals=True, delay=1),
    }.get(case, mpc_of)()
    spread = {"start": [0.3, 0.1], "start_spread": [0.5, 0.4]}
    if "loads" in case:
        outputs, noise, disturbance = [1, 0], [0.02, 0.03], [0.01, 0.02]
        observer = KalmanObserver(mpc, outputs, noise, 0.01, disturbance=disturbance, **spread)
    elif "inputs" in case:
        noise, disturbance = [0.02, 0.03], [0.01, 0.02] if "disturbed" in case else None
        observer = KalmanObserver(mpc, fed, noise, 0.01, disturbance=disturbance, **spread)
    else:
        known = {"labels": [Label("pressure", "bar")], **spread}
        observer = KalmanObserver(mpc, lambda x: x[1] ** 3 + 2.0 * x[1], 0.02, 0.01, **known)
    return OutputFeedbackPolicy(MPCPolicy(mpc), observer)


def program(folder: Path, main: str = "mpc_observer_test.c", *flags: str) -> Path:
    sources = [str(folder / name) for name in ("mpc_controller.c", "mpc_observer.c", main)]
    command = [find_compiler(), *STRICT, *flags, "-I", str(folder), *sources, "-o", str(folder / "program"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "program"


@pytest.mark.parametrize("case", ["plain", "late", "loads", "late, loads", "signals", "inputs, late, disturbed"])
def test_the_c_code_replays_its_vectors(case: str, tmp_path: Path) -> None:
    export_c(policy_of(case), tmp_path)
    sanitized = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    for flags in [(), sanitized] if case == "late, loads" else [()]:
        replay = [program(tmp_path, "mpc_observer_test.c", *flags), tmp_path / "observer_vectors.txt"]
        done = subprocess.run(replay, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        steps = re.match(r"(\d+) steps, 0 not solved", done.stdout)
        assert steps
        assert int(steps[1]) >= 60


_OFFSET = """\
#include <stdio.h>
#include "mpc_observer.h"
int main(void) {
    static mpc_observer observer;
    static mpc_state state;
    double measured[MPC_N_MEASURED], u[MPC_NU];
    mpc_observer_reset(&observer);
    mpc_reset(&state);
    while (scanf("%lf %lf", &measured[0], &measured[1]) == 2) {
        mpc_observer_step(&mpc_learned_parameters, &observer, &state, measured, u);
        printf("%.17g %.17g\\n", u[0], u[1]);
    }
    return 0;
}
"""


@pytest.mark.parametrize("case", ["loads", "inputs"])
def test_it_is_predict_where_sensors_fail_and_loads_are_unknown(case: str, tmp_path: Path) -> None:
    """On another plant than the model, with outputs that are missing at times: what it has not made its vectors of."""
    policy, rng = policy_of(case), np.random.default_rng(3)
    measured = np.array([0.6, 0.4]) + np.cumsum(0.05 * rng.normal(size=(50, 2)), axis=0)
    measured[rng.uniform(size=measured.shape) < 0.3] = np.nan
    export_c(policy, tmp_path)
    (tmp_path / "main.c").write_text(_OFFSET)
    text = "\n".join(" ".join(map(repr, row)) for row in measured.tolist())
    done = subprocess.run([program(tmp_path, "main.c")], input=text, capture_output=True, text=True, check=True)
    state, actions = None, []
    for y in measured:
        action, state = policy.predict(y, state)
        actions.append(action)
    np.testing.assert_allclose(np.fromstring(done.stdout, sep=" ").reshape(-1, 2), actions, atol=5e-6)


def test_the_header_says_what_is_measured_and_a_file_is_taken(tmp_path: Path) -> None:
    policy_of("signals").save(tmp_path / "policy.zip")
    export_c(tmp_path / "policy.zip", tmp_path)
    header = (tmp_path / "mpc_observer.h").read_text()
    assert "measured[0]: pressure [bar]\n *   measured[1]: load\n" in header
    assert "add_test(NAME observer" in (tmp_path / "CMakeLists.txt").read_text()
