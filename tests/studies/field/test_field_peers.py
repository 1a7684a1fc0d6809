"""What another package is handed, against transitions by hand; and a training that is not done twice."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mpcoffline import MPC, Model, QuadraticCost, TransitionTable
from mpcoffline.studies.field.peers import KNOBS, PeerError, Peers, handed_over, settings_to_try, time_mpcrl, train

ROOT = Path(__file__).parents[3]
LOW, HIGH = np.array([-2.0]), np.array([4.0])


@pytest.fixture
def log() -> TransitionTable:
    """Two episodes: the first terminates at its second step, the second is cut after its third."""
    s, a = [[0.0], [1.0], [5.0], [6.0], [7.0]], [[-2.0], [4.0], [1.0], [0.0], [2.0]]
    s_next, end = [[1.0], [2.0], [6.0], [7.0], [8.0]], [0, 1, 0, 0, 0]
    return TransitionTable.from_arrays(s, a, [10.0, 20.0, 1.0, 2.0, -3.0], s_next, end, [0, 0, 1, 1, 1])


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The program in the peers' environment, as a module; d3rlpy is not needed to look at its data."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    spec = spec_from_file_location("d3rlpy_peer", ROOT / "scripts" / "field_peers" / "d3rlpy_peer.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_log_is_handed_over_as_it_is(log: TransitionTable) -> None:
    data = handed_over(log, LOW, HIGH)
    assert sorted(data) == sorted(
        ["observations", "actions", "rewards", "next_observations", "terminals", "timeouts", "low", "high"]
    )
    np.testing.assert_array_equal(data["rewards"], [-10.0, -20.0, -1.0, -2.0, 3.0])
    np.testing.assert_array_equal(data["actions"][:, 0], [-2.0, 4.0, 1.0, 0.0, 2.0])  # in the plant's units
    np.testing.assert_array_equal(data["terminals"], [False, True, False, False, False])
    np.testing.assert_array_equal(data["timeouts"], [False, False, False, False, True])
    np.testing.assert_array_equal(data["next_observations"][:, 0], [1.0, 2.0, 6.0, 7.0, 8.0])


def test_an_episode_that_was_cut_keeps_its_last_transition(log: TransitionTable, script: Any) -> None:
    first, second = script.episodes_of(handed_over(log, LOW, HIGH))
    assert (first["terminated"], second["terminated"]) == (True, False)
    np.testing.assert_array_equal(first["observations"], [[0.0], [1.0]])
    np.testing.assert_array_equal(first["rewards"], [[-10.0], [-20.0]])
    np.testing.assert_array_equal(second["actions"], [[1.0], [0.0], [2.0]])
    np.testing.assert_array_equal(second["last_observation"], [8.0])
    assert all(column.dtype == np.float32 for column in (second["observations"], second["rewards"]))


def test_settings_are_those_of_the_authors_and_a_search_holds_them(script: Any) -> None:
    assert set(script.SETTINGS) == {"bc", "td3+bc", "iql", "cql"}
    defaults = {"gamma": 0.99}
    for algorithm in KNOBS:
        tried, own = settings_to_try(algorithm), script.SETTINGS[algorithm] | defaults
        assert len({tuple(each.items()) for each in tried}) == 10
        assert {knob: own[knob] for knob in KNOBS[algorithm]} in tried


class Thrice(torch.nn.Module):
    """Three times the first observation."""

    def forward(self, y: torch.Tensor) -> torch.Tensor:
        return 3.0 * y[:, :1]


@pytest.fixture
def peers(tmp_path: Path) -> Peers:
    """A peer that trains nothing: it hands out a policy that lies there."""
    torch.jit.script(Thrice()).save(str(tmp_path / "thrice.pt"))
    program = f"""
import json, shutil, sys
job = json.loads(sys.argv[3])
if job["seed"] == 13:
    sys.exit("first line\\nno luck")
shutil.copy({str(tmp_path / "thrice.pt")!r}, sys.argv[2])
print("some words")
print(json.dumps({{"train_s": job["steps"] / 10, "options": job["options"]}}))
"""
    for package in ("d3rlpy", "mpcrl"):
        python = tmp_path / f"env-{package}" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
        python.chmod(0o755)
    (tmp_path / "d3rlpy_peer.py").write_text(program)
    return Peers(tmp_path, tmp_path)


def test_a_training_is_done_once(log: TransitionTable, peers: Peers) -> None:
    job: dict[str, Any] = {"algorithm": "bc", "seed": 0, "steps": 50}
    trained = train(peers, "log", log, (LOW, HIGH), **job)
    assert trained.train_s == 5.0
    assert trained.file_kb > 0.1
    actions, state = trained.policy.predict(np.array([[0.5, 9.0], [-7.0, 9.0], [2.0, 9.0]]))
    np.testing.assert_allclose(actions, [[1.5], [-2.0], [4.0]])  # within bounds
    assert state is None
    np.testing.assert_allclose(trained.policy.predict(np.array([0.5, 9.0]))[0], [1.5])
    (peers.scripts / "d3rlpy_peer.py").write_text("raise SystemExit(1)")
    assert train(peers, "log", log, (LOW, HIGH), **job).train_s == 5.0  # it is there
    for change in ({"seed": 1}, {"steps": 51}, {"options": {"alpha": 1.0}}, {"algorithm": "iql"}):
        with pytest.raises(PeerError, match="exit code 1"):
            train(peers, "log", log, (LOW, HIGH), **(job | change))
    with pytest.raises(PeerError):
        train(peers, "another log", log, (LOW, HIGH), **job)


def test_what_fails_there_is_told_here(log: TransitionTable, peers: Peers) -> None:
    with pytest.raises(PeerError, match="bc: expected a run that ends well, got no luck"):
        train(peers, "log", log, (LOW, HIGH), algorithm="bc", seed=13, steps=1)
    nowhere = Peers(peers.home / "nothing", peers.scripts)
    with pytest.raises(PeerError, match="scripts/bench_field makes it"):
        train(nowhere, "log", log, (LOW, HIGH), algorithm="bc", seed=0, steps=1)


MASS = """
import json, sys
import casadi as ca, numpy as np
data = np.load(sys.argv[1])
x, u, theta = data["states"][0], data["actions"][0], data["theta"]
f, l, T = (ca.Function.deserialize(str(data[name])) for name in ("dynamics", "stage", "terminal"))
# One step of x+ = 0.9 x + b u from x = 2 under u = -1, with b = 0.5; costs x^2 + 3 u^2 and 4 x^2.
told = [f(x, u, theta), l(x, u, theta), T(x, theta), data["next_states"][0], data["costs"][0], data["horizon"]]
right = np.allclose([float(np.ravel(each)[0]) for each in told], [1.3, 7.0, 16.0, 1.2, 6.5, 9.0])
print(json.dumps({"train_s": 0.3, "transitions": len(data["states"]), "solved": 3 * right}))
"""


def test_mpcrl_is_handed_the_same_mpc(peers: Peers) -> None:
    model = Model(lambda x, u, p: 0.9 * x + p["b"] * u, nx=1, nu=1, dt=1.0, discrete=True, parameters={"b": 0.5})
    cost, end = QuadraticCost(W=[[1.0]], R=[[3.0]]), QuadraticCost(W=[[4.0]])
    mpc = MPC(model, cost, end, horizon=9, discount=0.9, action_low=[-1], action_high=[1])
    table = TransitionTable.from_arrays([[2.0]] * 7, [[-1.0]] * 7, [6.5] * 7, [[1.2]] * 7, [0] * 7)
    (peers.scripts / "mpcrl_peer.py").write_text(MASS)
    assert time_mpcrl(peers, mpc, table, 3) == pytest.approx(0.1)
    with pytest.raises(PeerError, match="expected most MPCs to be solved, got 3 of 7"):
        time_mpcrl(peers, mpc, table, 100)
