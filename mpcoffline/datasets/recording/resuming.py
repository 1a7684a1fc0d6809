"""Whether two recordings of one id are the same: what goes on, what is refused, what is put aside."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, StorageError
from mpcoffline.datasets.store.ids import backup_path, dataset_path, is_local
from mpcoffline.datasets.store.opening import read_metadata
from mpcoffline.datasets.store.recording_lock import log_files
from mpcoffline.datasets.store.writing import recording_of

from .episode_log import LogIndex, scan
from .log_format import LogHeader


def common_header(indices: list[LogIndex]) -> LogHeader:
    """The header that the logs share, or an error where they are of different recordings."""
    first = indices[0].header
    for index in indices:
        if index.header.recording != first.recording:
            raise FileFormatError(
                f"log {index.path}", expected=f"a log of recording {first.recording}", actual=index.header.recording
            )
    return first


def are_continued(indices: list[LogIndex], header: LogHeader, leftover: str) -> bool:
    """Whether a new recording goes on with these logs; where not, they are out of its way. See :class:`Recording`."""
    first, name = common_header(indices), header.dataset_id
    differences = _differences(first, header)
    if not differences and leftover != "restart" and first.recording != recording_of(name):
        return True
    found = sum(len(index.records) for index in indices)
    if found == 0 or first.recording == recording_of(name):
        remove_logs(name)
    elif not differences:
        remove_logs(name)
        warnings.warn(f"{found} episodes of an interrupted recording of {name!r} are recorded anew.", stacklevel=3)
    elif leftover == "refuse":
        what, theirs, ours = differences[0]
        raise InvalidArgumentError(
            what,
            expected=f"that of the interrupted recording of {name!r}: {theirs}",
            actual=ours,
            hint=f"Seal it first (`mpcoffline datasets repair {name}`), or pass resume=False.",
        )
    else:
        kept = set_aside(name)
        because = "; ".join(f"{what} {theirs}, now {ours}" for what, theirs, ours in differences)
        warnings.warn(
            f"An interrupted recording of {name!r} is another one ({because}): it is not continued."
            f" Its {found} episodes are kept in {kept}.",
            stacklevel=3,
        )
    return False


def _differences(first: LogHeader, second: LogHeader) -> list[tuple[str, str, str]]:
    """In what two recordings of one id are not the same: what, in the first, in the second."""
    pairs: dict[str, tuple[Any, Any]] = {
        "observation space": (first.observation_space, second.observation_space),
        "action space": (first.action_space, second.action_space),
        "environment": _plants(first.env_spec, second.env_spec),
        "algorithm": (first.algorithm_name, second.algorithm_name),
        "extends a data set": (first.mode == "extend", second.mode == "extend"),
    }
    theirs, ours = (json.loads(header.origin or "{}") for header in (first, second))
    # The plant's class is not known where it is in another process.
    keys = {*theirs, *ours} - ({"plant"} if "plant" not in theirs or "plant" not in ours else set())
    pairs |= {key: (theirs.get(key), ours.get(key)) for key in sorted(keys)}
    return [(what, str(a), str(b)) for what, (a, b) in pairs.items() if a != b]


def check_extends(header: LogHeader) -> None:
    """Refuses a recording that is to extend the data set of another plant, which stays as it is."""
    if header.mode != "extend" or not is_local(header.dataset_id):
        return
    stored = read_metadata(dataset_path(header.dataset_id))
    pairs = {
        "environment": _plants(stored.get("env_spec"), header.env_spec),
        "observation space": (stored.get("observation_space"), header.observation_space),
        "action space": (stored.get("action_space"), header.action_space),
    }
    for what, (theirs, ours) in pairs.items():
        if theirs != ours:
            raise InvalidArgumentError(
                f"{what} of what extends data set {header.dataset_id!r}",
                expected=f"that of the data set: {theirs}",
                actual=str(ours),
                hint="One data set holds one plant: record another plant under another id, with a recorder of its own.",
            )


def _plants(first: str | None, second: str | None) -> tuple[str | None, str | None]:
    """Two specs as short as they can be told apart: id and arguments, or all of it."""
    try:
        found = [None if spec is None else json.loads(spec) for spec in (first, second)]
        short = [None if spec is None else f"{spec['id']} with {spec['kwargs']}" for spec in found]
    except (ValueError, TypeError, KeyError):
        return first, second
    return (short[0], short[1]) if (short[0] == short[1]) == (first == second) else (first, second)


def set_aside(dataset_id: str) -> Path:
    """Moves the logs to where nobody continues them; moved back, they can be repaired."""
    kept = backup_path(dataset_id, "-recording")
    try:
        kept.mkdir(parents=True)
        for path in log_files(dataset_id):
            path.rename(kept / path.name)
    except OSError as error:
        raise StorageError.of(kept, error) from error
    return kept


def sealed_recordings() -> list[str]:
    """Ids of recordings whose logs are in their data set: the process was killed before it had removed them."""
    root, found = dataset_path("") / ".recording", []
    for folder in sorted({path.parent for path in root.rglob("env-*.log")} if root.is_dir() else ()):
        name = folder.relative_to(root).as_posix()
        sealed = recording_of(name)
        with suppress(FileFormatError, OSError):
            if sealed is not None and common_header([scan(path) for path in log_files(name)]).recording == sealed:
                found.append(name)
    return found


def remove_logs(dataset_id: str) -> None:
    """Deletes the logs."""
    for path in log_files(dataset_id):
        path.unlink()


def origin_json(origin: Mapping[str, Any] | None) -> str | None:
    """What makes a recording this one and no other, as its header keeps it."""
    return None if origin is None else json.dumps(origin, sort_keys=True, default=str)
