"""The paper's study in one call: the main job for all three tasks, on one page (arXiv:2301.01667)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.outputs import check_output_folder, write_file
from mpcoffline.envs import PLANTS

from .main_job import OUTPUTS, run_task
from .results import TaskResult
from .setups import setup_of

TASKS = tuple(plant.name for plant in PLANTS.values() if plant.published)


def reproduce(
    output: str | Path, *, alpha: float = 1.0, seed: int = 0, n_episodes: int = 24, progress: bool = True
) -> Iterator[TaskResult]:
    """Runs the main job of every task by the published recipe and gathers tables and figures on one page.

    Each task has its folder, written by :func:`run_task`; a task whose results lie there already, from the same
    arguments, is not run again, so that an interrupted study goes on. ``results.md`` holds what is done so far.

    Args:
        output: Folder for all of it.
        alpha: Size of the model error.
        seed: Seeds the model errors, the learning and the starts.
        n_episodes: Closed-loop episodes of each controller.
        progress: Whether to draw progress bars.

    Yields:
        The result of each task, as soon as it is there: linear, pendulum, cartpole.

    Raises:
        UnknownIdError: If the linear task has no data set for this alpha.
        InvalidArgumentError: For a number out of range.
        StorageError: If nothing could be written there, before the first task begins.
    """
    folder = Path(output)
    results: list[TaskResult] = []
    for place in (folder, *(folder / task for task in TASKS)):
        check_output_folder(place, OUTPUTS)
    for task in TASKS:
        result = _done(folder / task, task, alpha, seed, n_episodes)
        if result is None:
            result = run_task(
                task, alpha=alpha, seed=seed, n_episodes=n_episodes, output=folder / task, progress=progress
            )
        results.append(result)
        write_file(folder / "results.md", _page(results))
        yield result


def _done(folder: Path, task: str, alpha: float, seed: int, n_episodes: int) -> TaskResult | None:
    """What an earlier run with the same arguments left in a folder."""
    try:
        result = TaskResult.load(folder / "results.json")
    except (FileFormatError, FileNotFoundError):
        return None
    setup = setup_of(task, alpha, seed)
    wanted = (task, float(alpha), setup.seed, setup.dataset_id, "residual", setup.starts(n_episodes))
    found = (result.task, result.alpha, result.seed, result.dataset_id, result.value, result.starts)
    return result if found == wanted and (folder / "figure.png").exists() else None


def _page(results: list[TaskResult]) -> str:
    """Tables, notes and figures of the tasks, in Markdown."""
    parts = [f"{result.markdown()}\n![Closed loops]({result.task}/figure.png)\n" for result in results]
    return "\n".join(parts)
