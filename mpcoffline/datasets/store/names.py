"""What the columns of a data set are called: names with units, in its metadata beside what Minari keeps there."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.text import LONGEST, check_name
from mpcoffline.envs import find_plant

if TYPE_CHECKING:
    from minari import MinariDataset

#: Where they stand in the metadata: a list of texts, observations first.
NAMES = "mpcoffline_names"

_LONGEST = 2 * LONGEST + 20  # characters: a name, its unit, how many steps ahead


def checked_names(
    what: str,
    names: Iterable[object],
    size: int,
    error: type[InvalidArgumentError | FileFormatError] = InvalidArgumentError,
) -> tuple[str, ...]:
    """Names of columns, as ``"level [cm]"``.

    Args:
        what: Whose they are, for messages.
        names: The names.
        size: How many columns there are.
        error: What to raise; :class:`FileFormatError` for names out of a file.

    Raises:
        InvalidArgumentError: For another number of them, or what is no name.
    """
    found = tuple(check_name(f"{what}: name of a column", each, longest=_LONGEST, error=error) for each in names)
    if len(found) != size:
        raise error(f"{what}: names of columns", expected=f"{size}, one a column", actual=f"{len(found)}")
    return found


def names_of(dataset: MinariDataset) -> tuple[str, ...]:
    """Names and units of a data set's columns, observations first; none where nobody said any.

    Those that it was stored with, else those of its task, where that is one that is known here.

    Raises:
        FileFormatError: For stored names that are none, or as many as there are no columns.
    """
    shapes = [space.shape or () for space in (dataset.observation_space, dataset.action_space)]
    size, stored = sum(map(math.prod, shapes)), _stored(dataset)
    if stored is not None:
        what = f"data set {dataset.spec.dataset_id!r}"
        if not isinstance(stored, list):
            raise FileFormatError(f"{what}: {NAMES}", expected="a list of names", actual=type(stored).__name__)
        return checked_names(what, stored, size, FileFormatError)
    spec = dataset.env_spec
    plant = find_plant(str(spec.id)) if spec is not None else None
    if plant is None or [(len(plant.observations),), (len(plant.inputs),)] != shapes:
        return ()
    return tuple(_labelled(*entry) for entry in (*plant.entries, *((each.name, each.unit) for each in plant.inputs)))


def _stored(dataset: MinariDataset) -> Any:
    return dataset.storage.metadata.get(NAMES)


def _labelled(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name
