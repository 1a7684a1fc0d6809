"""The main job: from a data set to MPC_1, MPC_2, MPC_3 in closed loop, as a table and a figure (arXiv:2301.01667)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mpcoffline.control.evaluation import Evaluation, evaluate
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.checks import check_integers
from mpcoffline.core.outputs import check_output_folder, make_folder
from mpcoffline.datasets import TransitionTable, load_dataset
from mpcoffline.learner.learner import Learn, OfflineMPCLearner
from mpcoffline.mpc import MPC
from mpcoffline.plotting import save_figure
from mpcoffline.solvers.fallback import SolverStats

from .figure import main_job_figure
from .results import REFERENCE, RESULTS, ControllerResult, TaskResult
from .setups import Setup, setup_of

if TYPE_CHECKING:
    from gymnasium import spaces
    from minari import MinariDataset

_LEARNED: dict[str, Learn] = {"MPC_2": "cost", "MPC_3": "cost+model"}
_LAST_EPISODES = 50
# Far from the seeds that a data set was recorded with: the starts of the comparison are not among those of the data.
FIRST_START = 1_000_000
OUTPUTS = (RESULTS, "results.md", "results.csv", "figure.pdf", "figure.png")


def run_task(
    task: str,
    *,
    alpha: float = 1.0,
    seed: int = 0,
    dataset: str | None = None,
    n_episodes: int = 24,
    output: str | Path,
    value: str | None = None,
    progress: bool = True,
    **learner_options: Any,
) -> TaskResult:
    """Learns MPC_2 and MPC_3 of a task from a data set and compares them with MPC_1 in closed loop.

    MPC_1 is the nominal controller (wrong model, nominal cost). One value function is learned, (VALUE), and from it the
    cost, (FIT) with a fixed model: MPC_2, and cost and model together: MPC_3. All run from the same starts, two thirds
    of the swing-ups' broad and one third hanging, next to the plant's reference: the closed-loop optimum in the linear
    task, MPC_1 with the true model in the others.

    The output folder receives ``results.json``, ``results.md``, ``results.csv``, ``figure.pdf``, ``figure.png``, and in
    ``controllers/`` the saved policies and learners; existing files of these names are replaced.

    Args:
        task: Short name of the plant.
        alpha: Size of the model error.
        seed: Seeds the model error, the learning and the starts.
        dataset: Minari id of the data; the task's DDPG data by default.
        n_episodes: Closed-loop episodes of each controller.
        output: Folder for table and figure.
        value: Name of a value method, see :class:`~mpcoffline.OfflineMPCLearner`; the preset's by default, which is
            ``"residual"``, the published one, for ``"paper"``.
        progress: Whether to draw progress bars.
        **learner_options: Further arguments of :class:`~mpcoffline.OfflineMPCLearner`, e.g. ``prior=1e-2``.

    Returns:
        The figures; ``result.table()`` is the table for a terminal.

    Raises:
        UnknownIdError: For an unknown task, data set or form of (VALUE).
        InvalidArgumentError: For a number out of range.
        InvalidDataError: For a data set that does not fit the task.
        StorageError: If nothing could be written there, before anything is learned.
    """
    check_integers(1, n_episodes=n_episodes)
    setup = setup_of(task, alpha, seed)
    seed = setup.seed
    data = load_dataset(dataset or setup.dataset_id)
    options: dict[str, Any] = {"preset": "paper", "seed": seed, "value": value} | learner_options
    OfflineMPCLearner(setup.nominal, **options)  # refuses wrong options before a folder is made
    folder = make_folder(Path(output) / "controllers")
    for place, names in ((Path(output), OUTPUTS), (folder, ())):  # nothing is computed in vain
        check_output_folder(place, names)

    learners = _learn(setup.nominal, data, progress, **options)
    mpcs = {"MPC_1": setup.nominal} | {name: learner.mpc for name, (learner, _) in learners.items()}
    mpcs[REFERENCE] = setup.reference
    # What says that the folder is complete goes first and comes last: no table beside another run's figure.
    (Path(output) / RESULTS).unlink(missing_ok=True)
    for name, (learner, _) in learners.items():
        learner.save(folder / f"{name}_learner.zip")
    starts = setup.starts(n_episodes)
    policies = _policies(mpcs, setup)
    for name, policy in policies.items():
        policy.save(folder / f"{name}.zip")
    loops = {
        name: evaluate(
            policy,
            setup.make_env(),
            n_episodes,
            FIRST_START + seed,
            discount=setup.nominal.discount,
            options=[{"start": start} for start in starts],
        )
        for name, policy in policies.items()
    }

    # The trajectories that are kept for the figure: those from the start that costs the reference most.
    example = int(np.argmax(loops[REFERENCE].cost))
    descriptions = {
        "MPC_1": "nominal cost, " + ("nominal model" if setup.env_kwargs else "model with parameter errors"),
        "MPC_2": "cost learned, model as in MPC_1",
        "MPC_3": "cost and model learned",
        REFERENCE: setup.reference_description,
    }
    times = {name: seconds for name, (_, seconds) in learners.items()}
    result = TaskResult(
        task=task,
        alpha=float(alpha),
        seed=seed,
        env_id=setup.env_id,
        dataset_id=str(data.spec.dataset_id),
        value=str(learners["MPC_2"][0].method.options["value"]),
        discount=setup.nominal.discount,
        dt=setup.nominal.model.dt,
        starts=starts,
        example=example,
        theta={name: {key: array.tolist() for key, array in mpc.values.items()} for name, mpc in mpcs.items()},
        controllers=[
            _controller_result(name, descriptions[name], loop, policies[name].solver_stats, times.get(name), example)
            for name, loop in loops.items()
        ],
        behaviour=_behaviour(TransitionTable.from_minari(data), setup.nominal.discount),
    )
    save_figure(main_job_figure(result), Path(output) / "figure")
    result.save(Path(output))
    return result


def _learn(
    nominal: MPC, data: MinariDataset, progress: bool, **options: Any
) -> dict[str, tuple[OfflineMPCLearner, float]]:
    """MPC_2 and MPC_3 from one value function, with the seconds that each took."""
    learners: dict[str, tuple[OfflineMPCLearner, float]] = {}
    value_function = None
    for name, learn in _LEARNED.items():
        learner = OfflineMPCLearner(nominal, learn, value_function=value_function, **{"candidate": "full"} | options)
        start = time.perf_counter()
        learner.fit(data, show_progress=progress)
        learners[name] = learner, time.perf_counter() - start
        value_function = learner.value_function
    return learners


def _policies(mpcs: dict[str, MPC], setup: Setup) -> dict[str, MPCPolicy]:
    """The controllers as policies of the task's environment."""
    env = setup.make_env()
    observation_space, action_space = (cast("spaces.Box", space) for space in (env.observation_space, env.action_space))
    return {
        name: MPCPolicy(mpc, observation_space=observation_space, action_space=action_space)
        for name, mpc in mpcs.items()
    }


def _controller_result(
    name: str, description: str, loop: Evaluation, stats: SolverStats, fit_time: float | None, example: int
) -> ControllerResult:
    return ControllerResult(
        name=name,
        description=description,
        costs=loop.cost.tolist(),
        discounted_costs=loop.discounted_cost.tolist(),
        successes=loop.success.tolist(),
        fit_time=fit_time,
        solve_time=stats.time / stats.n_solves,
        n_solves=stats.n_solves,
        n_failures=stats.n_failures,
        states=loop.states[example].tolist(),
        actions=loop.actions[example].tolist(),
    )


def _behaviour(table: TransitionTable, discount: float) -> ControllerResult:
    """The costs of the last episodes in the data: how good the agent that recorded them had become."""
    places = table.episodes
    last = range(len(places.ids))[-_LAST_EPISODES:]
    episodes = [table.take(places.rows(k)).costs.astype(np.float64) for k in last]
    return ControllerResult(
        name="behaviour",
        description=f"the agent that made the data, its last {len(last)} episodes (own starts, with exploration)",
        costs=[float(costs.sum()) for costs in episodes],
        discounted_costs=[float(discount ** np.arange(len(costs)) @ costs) for costs in episodes],
        successes=None,
    )
