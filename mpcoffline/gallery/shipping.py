"""Making the data sets that ship with the package: train, record, pack, describe, sign."""

from __future__ import annotations

from pathlib import Path

from mpcoffline.datasets.recipes import Recipe
from mpcoffline.datasets.store.manifest import write_manifest
from mpcoffline.datasets.store.packed import pack

from .cards import write_card
from .collection import collect_with, score_agent


def make_shipped(task: str, folder: Path, *, progress: bool = True) -> list[Path]:
    """Makes the packed file, the card and the figures of a task, and brings ``SHA256SUMS`` up to date.

    The recording itself goes into the local Minari store under the recipe's id, which must be free.

    Args:
        task: Name of the task.
        folder: The catalogue's folder.
        progress: Whether to show a progress bar.

    Returns:
        The files written.

    Raises:
        UnknownIdError: For an unknown task.
        InvalidArgumentError: Where the store holds a data set of that id.
    """
    recipe = Recipe.load(task)
    dataset, agent = collect_with(recipe, progress=progress)
    scores = score_agent(agent, recipe.make_env())
    packed = folder / f"{task}.h5"
    pack(dataset, packed)
    card = write_card(dataset, recipe, scores, folder)
    return [packed, card, write_manifest(folder, sorted(file.name for file in folder.glob("*.h5")))]
