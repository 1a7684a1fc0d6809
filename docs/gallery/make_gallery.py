"""Makes the pages' reports and pictures: ``python docs/gallery/make_gallery.py [NAME ...]``; some minutes each.

A plant is simulated with parameters that its file does not know, under the controller that "runs today"; the log goes
through ``tune`` as a user's would. Written are the report and NAME.png, closed loops on that plant.
"""

from __future__ import annotations

import csv
import io
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

import mpcoffline
from mpcoffline import MPCPolicy, Plant, plotting
from mpcoffline.plants import load_plant
from mpcoffline.tune import tune

HERE = Path(__file__).resolve().parent
SITE = HERE.parent / "_static" / "gallery"  # where pages of their own stand
EPISODES, STEPS = 12, 150

#: What acts today: from observation and the sum of the errors so far to the error, and the input.
Rule = Callable[[dict[str, float], float], tuple[float, float]]
TODAY: dict[str, Rule] = {
    "heated_tank": lambda o, s: ((e := o["set_point"] - o["tank"]), 45.0 + 2.0 * e + 0.02 * s),
    "motor": lambda o, s: ((e := o["set_point"] - o["speed"]), 0.15 * o["set_point"] + 0.1 * e + 0.005 * s),
    "following": lambda o, s: (0.0, 0.08 * (o["gap"] - 5.0 - 1.4 * o["speed"]) + 0.6 * (o["lead"] - o["speed"])),
    "room": lambda o, s: ((e := o["wanted"] - o["air"]), 1.5 + 1.0 * e + 0.01 * s),
}


def true_parameters(plant: Plant) -> dict[str, float]:
    """Those of the plant behind the log: each off by 0.8 of its spread, upwards and downwards in turn."""
    named = enumerate(plant.parameters.items())
    return {name: float(p.value) * (1 + p.spread * (0.8 if i % 2 else -0.8)) for i, (name, p) in named}


def log_of(plant: Plant, rule: Rule, seed: int = 0) -> str:
    """A log of a plant that is not quite the described one, as CSV."""
    rng, env = np.random.default_rng(seed), plant.env(steps=STEPS + 1)
    columns = [*plant.states, *plant.signals, *plant.inputs]
    text, clock = io.StringIO(), 0.0
    rows = csv.writer(text)
    rows.writerow(["time [s]", *(f"{each.name} [{each.unit}]" for each in columns)])
    (low,), (high,) = plant.action_bounds
    for _ in range(EPISODES):
        observation, _ = env.reset(seed=int(rng.integers(2**31)), options={"parameters": true_parameters(plant)})
        total = off = 0.0
        for k in range(STEPS):
            by_name = dict(zip((each.name for each in columns), observation.tolist(), strict=False))
            error, action = rule(by_name, total)
            total += error
            off = 0.1 * (high - low) * rng.normal() if rng.random() < 0.15 else off
            u = float(np.clip(action + off, low, high))
            observation_before, (observation, *_, info) = observation, env.step(np.array([u], dtype=np.float32))
            rows.writerow([f"{clock + k * plant.dt:g}", *(f"{v:.5g}" for v in observation_before), *info["applied"]])
        clock += 2 * STEPS * plant.dt
    return text.getvalue()


def make(name: str) -> None:
    """Report and pictures of one plant."""
    plant = load_plant(HERE / f"{name}.py")
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.csv"
        log.write_text(log_of(plant, TODAY[name]))
        tuned = tune(plant, plant.read(log), Path(folder) / "tuned", tell=print, show_progress=False)
        print(tuned)
        shutil.copy(tuned.folder / "report.html", SITE / f"{name}.html")
        policies = {"MPC_1": MPCPolicy(plant.mpc()), "MPC_3": tuned.learner.policy}
    env, start = plant.env(), {"parameters": true_parameters(plant)}
    loops = {label: mpcoffline.evaluate(policy, env, 1, seed=3, options=start) for label, policy in policies.items()}
    figure = plotting.loop_figure(loops, env)
    figure.savefig(HERE / f"{name}.png", dpi=160, metadata={"Software": None})


if __name__ == "__main__":
    for each in sys.argv[1:] or sorted(TODAY):
        make(each)
