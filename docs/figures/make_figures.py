"""Makes the figures and the film that stand beside this file; takes about a minute.

.venv/bin/python docs/figures/make_figures.py

``mpcoffline learn pendulum --steps 3000`` and ``mpcoffline plot learner.zip --animate swing_up.gif`` make the same, as
PDF too.
"""

from pathlib import Path

from mpcoffline import MPCPolicy, OfflineMPCLearner, evaluate, nominal_mpc, plotting

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
STARTS = [{"start": "hanging"}] + [{"start": "broad"}] * 3
SEED = 2


def main(folder: Path = Path(__file__).parent) -> None:
    """Learns a controller of the pendulum and draws it."""
    nominal = nominal_mpc(PENDULUM, alpha=1.0, seed=0)
    learner = OfflineMPCLearner(nominal, preset="default", value_n_steps=3000)
    learner.fit("mpcoffline/pendulum/ddpg-v0")
    policies = {"MPC_1": MPCPolicy(nominal), "MPC_3": learner.policy}
    loops = {name: evaluate(p, PENDULUM, len(STARTS), SEED, options=STARTS) for name, p in policies.items()}
    figures = {
        "pendulum_cost": plotting.cost_figure(nominal, learner.mpc, PENDULUM),
        "pendulum_phase_portrait": plotting.phase_portrait(learner.value_function.predict, loops, PENDULUM),
    }
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=130, metadata={"Software": None})
    start = loops["MPC_1"].states[0][0]
    plotting.animate(policies, PENDULUM, start, folder / "pendulum_swing_up.gif", seconds=4.0)


if __name__ == "__main__":
    main()
