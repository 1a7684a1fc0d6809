"""The exported C: it compiles without a warning, needs nothing, and does what ``predict`` does."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import lq_plant
import numpy as np
import pytest
from mpc_problems import random_linear, random_states
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline import MPCPolicy, OfflineMPCLearner, Signal
from mpcoffline.control.export import export_c
from mpcoffline.core.errors import FileFormatError
from mpcoffline.mpc import MPC, Constraint, Model, NetworkCost, Penalty, QuadraticCost, StateBounds
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers.ddp.build import find_compiler

STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")


def mpc_of(case: str) -> MPC:
    if case == "late inputs":
        cost = QuadraticCost(np.diag([1.0, 0.1]), 0.1 * np.eye(2), u_ref=[0.1, 0.0], D=0.2 * np.eye(2))
        model = Model(
            lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], 0.9 * x[1] + u[0] - 0.3 * ca.sin(u[1])),
            2,
            2,
            0.1,
            discrete=True,
            delay=[2, 0],
        )
        return MPC(model, cost, QuadraticCost(np.eye(2)), 12, 0.95, [-1.0, -1.0], [1.0, 1.0])
    if case == "signals on time":
        signals = [Signal("set_point", preview=1), Signal("wind", usual=0.3)]
        model = Model(
            lambda x, u, p, d: ca.vertcat(x[0] + 0.1 * x[1], 0.9 * x[1] + ca.sin(u[0]) + 0.1 * d.wind),
            2,
            1,
            0.1,
            discrete=True,
            signals=signals,
        )
        cost, end = (QuadraticCost(np.eye(2), R, tracks={0: "set_point"}) for R in ([[0.1]], None))
        return MPC(model, cost, end, 12, 0.95, [-1.0], [1.0])
    if case == "rates":  # of one input of two, beside a soft limit

        def changes(x: ca.SX, u: ca.SX, before: ca.SX, p: object) -> ca.SX:
            change = u[0] - before[0]
            return ca.vertcat(change - 0.2, -change - 0.1)

        model = Model(lambda x, u, p: 0.9 * x + ca.vertcat(0.2 * u[0] + 0.1 * u[1], 0.1 * x[0] + 0.3 * u[1]), 2, 2, 1.0)
        cost, low = QuadraticCost(np.eye(2), 0.01 * np.eye(2), x_ref=[1.0, 2.0]), [-np.inf, -1.0]
        limits = [
            Constraint(changes, "rates", uses_previous=True),
            StateBounds(low, [0.9, np.inf], "level", Penalty(5.0)),
        ]
        return MPC(model, cost, QuadraticCost(np.eye(2)), 15, 0.97, [-1.0, -2.0], [1.0, 2.0], constraints=limits)
    if case == "turnpike":  # whose plans wait on their way
        model = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * u), 2, 1, 0.2, discrete=True)
        stage, goal = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]]), QuadraticCost(5.0 * np.eye(2), x_ref=[3.0, 0.0])
        return MPC(model, stage, goal, 40, 1.0, [-5.0], [5.0])
    if case == "economic turnpike":  # which they hold while something is used up
        model = Model(
            lambda x, u, p: ca.vertcat(x[0] + 0.2 * u, x[1] - 0.1 - 0.05 * x[0] ** 2), 2, 1, 0.2, discrete=True
        )
        stage, goal = QuadraticCost(np.diag([1.0, 0.0]), [[0.1]]), QuadraticCost(np.diag([5.0, 0.0]), x_ref=[3.0, 0.0])
        return MPC(model, stage, goal, 40, 1.0, [-5.0], [5.0])
    if case == "stiff motor":  # exact
        model = Model(
            lambda x, u, p: ca.vertcat(100.0 * (x[1] - x[0]), (u[0] - p["R"] * x[1] - 0.05 * x[0]) / p["L"]),
            2,
            1,
            0.02,
            {"R": 1.0, "L": 1e-3},
        )
        return MPC(
            model, QuadraticCost(np.eye(2), [[0.1]], [[0.0], [0.02]]), QuadraticCost(np.eye(2)), 12, 0.95, [-3], [3]
        )
    if case == "substeps":  # so many that its code comes in pieces
        model = Model(
            lambda x, u, p: ca.vertcat(x[1], 9.81 - x[2] ** 2 / x[0] ** 2, (u[0] - 2.0 * x[2]) / p["L"]),
            3,
            1,
            0.05,
            {"L": 0.02},
            integrator="rk4:16",
        )
        reference = [1.0, 0.0, np.sqrt(9.81)]
        cost = QuadraticCost(np.eye(3), [[0.1]], x_ref=reference, u_ref=[2.0 * reference[2]])
        return MPC(model, cost, QuadraticCost(np.eye(3), x_ref=reference), 12, 0.95, [0.0], [12.0])
    if case in {"signals", "signals, no bounds"}:  # of which a state tracks one that is previewed, and inputs act late
        signals, tracks = [Signal("set_point", preview=2, usual=0.8), Signal("inflow", usual=0.3)], {1: "set_point"}
        model = Model(
            lambda x, u, p, d: ca.vertcat(0.8 * x[0] + 0.2 * ca.tanh(u) + 0.1 * d.inflow, 0.9 * x[1] + 0.1 * x[0]),
            2,
            1,
            0.5,
            discrete=True,
            signals=signals,
            delay=2,
        )
        cost = QuadraticCost(np.diag([0.01, 1.0]), [[0.05]], D=[[0.1]], tracks=tracks)
        high = 2.0 if case == "signals" else np.inf
        return MPC(model, cost, QuadraticCost(np.diag([0.01, 3.0]), tracks=tracks), 12, 0.95, [-high], [high])
    if case == "three inputs":
        return random_linear(0, nu=3)
    if case == "limits":  # soft ones of each kind, and a mixed hard one that can always be kept
        limits = [
            StateBounds([-np.inf, -0.4], [np.inf, 0.4], "speed", Penalty(3.0)),
            Constraint(lambda x, u, p: ca.vertcat(x[1] * u[0] - 0.2, -x[1] * u[0] - 0.2), "power"),
            Constraint(lambda x, p: ca.vertcat(x[0] - 0.1, -x[0] - 0.1), "end", Penalty(1.0, 5.0), terminal=True),
        ]
        model = Model(
            lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * ca.sin(u[0])), 2, 1, 0.2, discrete=True
        )
        cost = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]])
        return MPC(model, cost, QuadraticCost(np.eye(2)), 15, 0.97, [-1.0], [1.0], constraints=limits)
    if case == "limits of stages":
        return nominal_mpc(PENDULUM).replace(
            constraints=Constraint(lambda x, u, p: ca.vertcat(x[2] - 2.5, -x[2] - 2.5), "speed", Penalty(20.0)),
            horizon=25,
        )
    if case == "network":
        network = NetworkCost.random(3, (6, 6), seed=0, scale=10.0, W=np.eye(3), x_ref=[1.0, 0.0, 0.0])
        return nominal_mpc(PENDULUM).replace(horizon=10, discount=0.95, terminal_cost=network)
    mpc = nominal_mpc(case)
    return mpc.replace(horizon=min(mpc.horizon, 50))


def compiled(folder: Path, *flags: str, main: str = "mpc_test.c") -> Path:
    sources = [str(folder / "mpc_controller.c"), str(folder / main)]
    command = [find_compiler(), *STRICT, *flags, "-I", str(folder), *sources, "-o", str(folder / "program"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "program"


@pytest.mark.parametrize(
    "case",
    [
        LINEAR,
        PENDULUM,
        CARTPOLE,
        "three inputs",
        "network",
        "late inputs",
        "limits",
        "limits of stages",
        "rates",
        "signals",
        "signals, no bounds",
        "signals on time",
        "stiff motor",
        "turnpike",
        "economic turnpike",
        pytest.param("substeps", marks=pytest.mark.slow),
    ],
)
def test_the_c_code_replays_its_vectors(case: str, tmp_path: Path) -> None:
    files = export_c(MPCPolicy(mpc_of(case)), tmp_path)
    assert {file.name for file in files} >= {"mpc_controller.c", "mpc_controller.h", "CMakeLists.txt"}
    program = compiled(tmp_path)
    done = subprocess.run([program, tmp_path / "test_vectors.txt"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    steps = re.match(r"(\d+) steps, 0 not solved", done.stdout)
    assert steps
    assert int(steps[1]) >= 40


def test_without_vectors_nothing_is_said_to_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("mpcoffline.control.export._unambiguous_starts", lambda policy: [])
    export_c(MPCPolicy(mpc_of(LINEAR)), tmp_path)
    assert "No test vectors" in caplog.text
    done = subprocess.run(
        [compiled(tmp_path), tmp_path / "test_vectors.txt"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "no test vectors: nothing was tested\n")


def heated(unit: float, offset: float) -> MPC:
    """A body under a heater, its temperatures in a unit and above an offset of one's choice."""

    def rates(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        t = (x - offset) / unit
        return unit * ca.vertcat(2.0 * u[0] - 0.4 * (t[0] - t[1]) - 0.2 * t[0], 0.3 * (t[0] - t[1]) - 0.05 * t[1] ** 2)

    goal, weight = offset + unit * np.array([0.6, 0.5]), np.diag([0.1, 1.0]) / unit**2
    stage, terminal = QuadraticCost(weight, [[0.01]], x_ref=goal), QuadraticCost(weight, x_ref=goal)
    return MPC(Model(rates, 2, 1, 0.2), stage, terminal, 15, 0.97, [0.0], [1.0])


@pytest.mark.parametrize(("unit", "offset"), [(1000.0, 0.0), (1.0, 293.15)])
def test_the_vectors_are_where_the_plant_is_in_any_unit(unit: float, offset: float, tmp_path: Path) -> None:
    rows = []
    for folder, mpc in ((tmp_path / "plain", heated(1.0, 0.0)), (tmp_path / "moved", heated(unit, offset))):
        export_c(MPCPolicy(mpc), folder)
        rows.append(np.loadtxt(folder / "test_vectors.txt"))
    plain, moved = rows
    np.testing.assert_allclose(moved[:, 1:3], offset + unit * plain[:, 1:3], rtol=1e-6, atol=1e-6 * unit)
    np.testing.assert_allclose(moved[:, 3], plain[:, 3], atol=1e-6)
    assert np.ptp(plain[:, 3]) > 0.5  # of the heater's range


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
        if (mpc_step(&mpc_learned_parameters, &state, y, u)) return 2;
        for (int a = 0; a < MPC_NU; ++a) printf("%.17g\\n", u[a]);
    }
    return 0;
}
"""


def test_it_is_predict_on_other_states(tmp_path: Path) -> None:
    """A saved policy, exported from its file; swing-ups with disturbances, step by step beside ``predict``."""
    policy = MPCPolicy(nominal_mpc(CARTPOLE, alpha=0.5, seed=1))
    policy.save(tmp_path / "policy.zip")
    export_c(tmp_path / "policy.zip", tmp_path)
    (tmp_path / "main.c").write_text(MAIN)
    program = compiled(tmp_path, main="main.c")
    rng = np.random.default_rng(0)
    lines, expected = [], []
    for start in random_states(CARTPOLE, 3):
        y, state = start, None
        for step in range(30):
            action, state = policy.predict(y, state)
            lines.append(" ".join([str(int(step == 0)), *map(repr, y.tolist())]))
            expected.append(float(action[0]))
            y = policy.mpc.model(y, action) + 1e-3 * rng.normal(size=5)
    done = subprocess.run([program], input="\n".join(lines), capture_output=True, text=True, check=True)
    np.testing.assert_allclose(np.array(done.stdout.split(), float), expected, rtol=0, atol=1e-6)


def test_the_header_documents_names_and_units(tmp_path: Path) -> None:
    export_c(MPCPolicy(nominal_mpc(PENDULUM)), tmp_path)
    header = (tmp_path / "mpc_controller.h").read_text()
    assert re.search(r"double model_m; /\* model.m: number, in kg \*/", header)
    assert re.search(r"double stage_cost_W\[6\]; /\* .*C C'", header)
    assert "every 0.05 s" in header
    about = header.split("*/")[0]
    assert re.findall(r"y\[\d\]: .*", about) == ["y[0]: cos phi", "y[1]: sin phi", "y[2]: phid [rad/s]"]
    assert "u[0], u [N m]: from -2 to 2" in about
    export_c(MPCPolicy(mpc_of("network")), tmp_path / "network")
    header = (tmp_path / "network" / "mpc_controller.h").read_text()
    assert re.search(r"double terminal_cost_weights_1\[36\]; /\* .*shape \(6, 6\), row by row \*/", header)
    export_c(MPCPolicy(mpc_of("late inputs")), tmp_path / "nameless")
    about = (tmp_path / "nameless" / "mpc_controller.h").read_text().split("*/")[0]
    assert "u[0]: from -1 to 1" in about
    assert "y[0]" not in about  # nobody gave names
    source = (tmp_path / "mpc_controller.c").read_text()
    assert "malloc" not in source
    assert set(re.findall(r"#include\s+(\S+)", source)) == {'"mpc_controller.h"', "<math.h>", "<stdint.h>"}


@pytest.mark.slow
@pytest.mark.parametrize("case", [PENDULUM, "network"])
def test_sanitizers_find_nothing(case: str, tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    export_c(MPCPolicy(mpc_of(case)), tmp_path)
    try:
        program = compiled(tmp_path, "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    except AssertionError as error:
        if "san" in str(error) and "cannot find" in str(error):
            pytest.skip("the compiler's sanitizer libraries are not installed")
        raise
    done = subprocess.run([program, tmp_path / "test_vectors.txt"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_state_that_overflows_is_said_and_bounded(tmp_path: Path) -> None:
    """The step returns that it has no plan, and an input within bounds."""
    export_c(MPCPolicy(nominal_mpc(PENDULUM)), tmp_path)
    (tmp_path / "main.c").write_text(
        MAIN.replace("return 2", 'printf("unsolved\\n")').replace("static mpc_state", "static mpc_state")
    )
    program = compiled(tmp_path, main="main.c")
    lines = "1 1e300 1e300 1e300\n0 1.0 0.0 0.0\n"
    done = subprocess.run([program], input=lines, capture_output=True, text=True, check=True)
    first, action, second = done.stdout.split()
    assert first == "unsolved"
    assert abs(float(action)) <= 2.0
    assert abs(float(second)) < 1e-6  # the next, sound state is solved as if nothing had been


def test_a_learners_file_is_taken_as_a_policys(tmp_path: Path) -> None:
    learner = OfflineMPCLearner(lq_plant.make_mpc(), preset="paper", value_n_steps=1, fit_n_steps=1, hidden=(4,))
    learner.fit(lq_plant.random_log(50), show_progress=False)
    learner.save(tmp_path / "learner.zip")
    learner.policy.save(tmp_path / "policy.zip")
    for name in ("learner", "policy"):
        export_c(tmp_path / f"{name}.zip", tmp_path / name)
    for name in ("mpc_controller.c", "test_vectors.txt"):
        assert (tmp_path / "learner" / name).read_text() == (tmp_path / "policy" / name).read_text()


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "policy.zip").write_bytes(b"no zip")
    with pytest.raises(FileFormatError):
        export_c(tmp_path / "policy.zip", tmp_path / "out")
