"""Hostile data sets: metadata and sums."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpcoffline import TransitionTable
from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.datasets import list_datasets, load_dataset, repair, show, verify

from .cases import EQUAL, LET_IN, LIMITS, RAW, WRONG, Finding
from .honest import SET, Honest
from .targets import Read, copy_store

FILES: dict[str, Callable[[Honest, Path], Read]] = {}


def read_all(honest: Honest, must_refuse: bool, numbers: bool = True) -> str:
    """Every reader of a data set in turn; none may do more than raise an error of ours.

    Args:
        honest: The original.
        must_refuse: Whether loading must raise.
        numbers: Whether the numbers must be those of the original where it loads.
    """
    refused: MPCOfflineError | None = None
    problem: Finding | None = None
    try:
        TransitionTable.from_minari(load_dataset(SET, download=False))
    except MPCOfflineError as error:
        if isinstance(error.__cause__, MemoryError):
            raise
        refused = error
    else:
        if must_refuse:
            problem = Finding(LET_IN, "loaded")
        elif numbers and not np.array_equal(TransitionTable.from_minari(SET).rows, honest.table.rows):
            problem = Finding(WRONG, "another table")
    LIMITS.begin("verify")
    try:
        verify(SET)
    except MemoryError:
        raise
    except Exception as error:
        raise Finding(RAW, f"verify raised {type(error).__name__}: {error}") from error
    for name, call in (("show", lambda: str(show(SET))), ("list", list_datasets), ("repair", lambda: repair(SET))):
        LIMITS.begin(name)
        try:
            call()
        except MPCOfflineError as error:
            if isinstance(error.__cause__, MemoryError):
                raise
    LIMITS.stage = "load"
    if problem is not None:
        raise problem
    if refused is not None:
        raise refused
    return EQUAL


def changed(name: str, *, refuse: bool = True, sums: bool = False, numbers: bool = True) -> Callable[..., Any]:
    """Registers a data set that a function changes; it gets the set's folder, and that of the case.

    Args:
        name: Name of the case.
        refuse: Whether loading must raise.
        sums: Whether the sums stay.
        numbers: Whether the numbers must be those of the original where it loads.
    """

    def register(change: Callable[[Path, Path], None]) -> Callable[[Path, Path], None]:
        def make(honest: Honest, folder: Path) -> Read:
            place = copy_store(honest, folder) / SET
            if not sums:
                (place / "SHA256SUMS").unlink()
            change(place, folder)
            return partial(read_all, honest, refuse, numbers)

        FILES[name] = make
        return change

    return register


def metadata(place: Path, **values: Any) -> None:
    """Sets keys of metadata.json; None removes one."""
    path = place / "data" / "metadata.json"
    document = json.loads(path.read_text()) | values
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}))


# --- metadata -----------------------------------------------------------------------------------------------------


def spec(entry_point: str, folder: Path, **values: Any) -> str:
    """The spec of an environment that runs what it names."""
    (folder / "canary_module.py").write_text(f"open({str(folder / 'canary')!r}, 'w')\nclass Env: pass\n")
    shell = {"command": f"touch {folder / 'canary'}"} if entry_point == "os:system" else {}
    empty = {"reward_threshold": None, "nondeterministic": False, "max_episode_steps": None, "order_enforce": True}
    rest = {"disable_env_checker": True, "additional_wrappers": [], "vector_entry_point": None}
    return json.dumps({"id": "Evil-v0", "entry_point": entry_point, "kwargs": shell, **empty, **rest, **values})


WRAPPER = {"name": "Evil", "entry_point": "canary_module:Env", "kwargs": {}}
OURS = "mpcoffline/LinearTracking-v0"
SPECS: dict[str, tuple[str, dict[str, Any]]] = {
    "a shell command": ("os:system", {}),
    "a class of a module": ("canary_module:Env", {}),
    "a known id and a foreign class": ("canary_module:Env", {"id": OURS}),
    "an id that imports": ("canary_module:Env", {"id": "canary_module:Evil-v0"}),
    "a namespace that imports": ("canary_module:Env", {"id": "canary_module:evil/Evil-v0"}),
    "a foreign vector class": ("mpcoffline.envs.linear_tracking:LinearTrackingEnv",
                               {"id": OURS, "vector_entry_point": "canary_module:Env"}),
    "a foreign wrapper": ("mpcoffline.envs.linear_tracking:LinearTrackingEnv",
                          {"id": OURS, "additional_wrappers": [WRAPPER]}),
}  # fmt: skip
for _name, (_entry, _values) in SPECS.items():
    for _spaces in ("both spaces", "no spaces", "no action space", "blank spaces"):

        @changed(f"env_spec with {_name}, {_spaces}", refuse=_spaces != "both spaces")
        def evil(
            place: Path, folder: Path, entry: str = _entry, values: dict[str, Any] = _values, which: str = _spaces
        ) -> None:
            metadata(place, env_spec=spec(entry, folder, **values))
            if which in ("no spaces", "no action space"):
                metadata(place, action_space=None)
            if which == "no spaces":
                metadata(place, observation_space=None)
            if which == "blank spaces":
                metadata(place, observation_space="", action_space=" ")


def box(**values: Any) -> str:
    """A space as Minari stores it."""
    return json.dumps({"type": "Box", "dtype": "float32", "shape": [4], "low": [-1e4] * 4, "high": [1e4] * 4} | values)


METADATA: dict[str, dict[str, Any]] = {
    "2 billion episodes": {"total_episodes": 2 * 10**9},
    "a billion steps": {"total_steps": 10**9},
    "1e30 steps": {"total_steps": 10**30},
    "steps that are a text": {"total_steps": "48"},
    "episodes below none": {"total_episodes": -1},
    "episodes that are a list": {"total_episodes": [6]},
    "fewer steps than there are": {"total_steps": 40},
    "fewer episodes than there are": {"total_episodes": 3, "total_steps": 24},
    "a space of shape 1e9": {"observation_space": box(shape=[10**9])},
    "a space of shape (-4,)": {"observation_space": box(shape=[-4])},
    "a space of 5 million bounds": {"observation_space": box(low=[0.0] * 5_000_000)},
    "a space of objects": {"observation_space": box(dtype="O")},
    "spaces nested 900 deep": {"observation_space": '{"type":"Tuple","subspaces":[' * 900 + "]}" * 900},
    "spaces nested 90,000 deep": {"observation_space": '{"type":"Tuple","subspaces":[' * 90_000},
    "discrete actions of 1e18": {
        "action_space": '{"type": "Discrete", "dtype": "int64", "n": 1000000000000000000, "start": 0}'
    },
    "a format that names a file": {"data_format": "../../x"},
    "the arrow format": {"data_format": "arrow"},
}  # fmt: skip
for _name, _values in METADATA.items():

    @changed(f"metadata: {_name}")
    def wrong(place: Path, folder: Path, values: dict[str, Any] = _values) -> None:
        metadata(place, **values)


@changed("metadata: another id", refuse=False)
def another_id(place: Path, folder: Path) -> None:
    metadata(place, dataset_id="bb/other-v0")


@changed("metadata padded with 400 MB", refuse=True)
def padded(place: Path, folder: Path) -> None:
    path = place / "data" / "metadata.json"
    text = path.read_bytes()
    with path.open("wb") as file:
        file.write(text[:1])
        for _ in range(400):
            file.write(b" " * (1 << 20))
        file.write(text[1:])


@changed("metadata that amplify", refuse=True)
def amplifying(place: Path, folder: Path) -> None:
    path = place / "data" / "metadata.json"
    path.write_text(path.read_text()[:-1] + ', "x": [' + "[]," * 6_000_000 + "0]}")


def read_shown(place: Path) -> str:
    """A description that would write on the terminal."""
    from typer.testing import CliRunner

    from mpcoffline.cli.main import app

    result = CliRunner().invoke(app, ["datasets", "show", SET])
    if result.exception is not None and not isinstance(result.exception, (SystemExit, MPCOfflineError)):
        raise result.exception
    if "\x1b]" in result.output or "\x1b[2J" in result.output or "\x1b[2J" in str(show(SET)):
        raise Finding(LET_IN, "terminal escapes are printed")
    return EQUAL


def escapes(honest: Honest, folder: Path) -> Read:
    place = copy_store(honest, folder) / SET
    (place / "SHA256SUMS").unlink()
    evil = "\x1b]0;evil\x07\x1b[2J[bold]x[/nonsense] \u202e"
    metadata(place, description=evil, algorithm_name=evil, author=[evil])
    return partial(read_shown, place)


def half(honest: Honest, folder: Path) -> Read:
    place = copy_store(honest, folder) / SET
    (place / "SHA256SUMS").unlink()
    metadata(place, description="\ud83d")
    return partial(read_shown, place)


FILES["metadata: terminal escapes in the card"] = escapes
FILES["metadata: half a character in the card"] = half


def hdf5(place: Path) -> Path:
    """The file of the episodes."""
    return place / "data" / "main_data.hdf5"


# --- sums ---------------------------------------------------------------------------------------------------------


def sums_of(name: str, refuse: bool = True) -> Callable[..., Any]:
    """Registers a data set whose sums a function changes: it gets the text and returns another."""

    def register(change: Callable[[str, Path], str | bytes]) -> Callable[..., Any]:
        @changed(f"sums: {name}", refuse=refuse, sums=True)
        def rewrite(place: Path, folder: Path) -> None:
            path = place / "SHA256SUMS"
            new = change(path.read_text(), folder)
            path.write_bytes(new if isinstance(new, bytes) else new.encode())

        return change

    return register


ZERO = "0" * 64
SUMS: dict[str, Callable[[str], str | bytes]] = {
    "a path upward": lambda text: f"{text}{ZERO}  ../../../etc/passwd\n",
    "an absolute path": lambda text: f"{text}{ZERO}  /etc/passwd\n",
    "a device": lambda text: f"{text}{ZERO}  /dev/zero\n",
    "every line twice": lambda text: text + text,
    "a path of 100 MB": lambda text: f"{text}{ZERO}  {'a' * 100_000_000}\n",
    "3 million lines": lambda text: text + "".join(f"{ZERO}  f{k}\n" for k in range(3_000_000)),
    "nothing": lambda text: "",
    "bytes of another encoding": lambda text: text.encode("utf-16"),
}
for _name, _change in SUMS.items():
    sums_of(_name)(lambda text, folder, change=_change: change(text))


@changed("sums: without the line of numbers that were changed", sums=True)
def unlisted(place: Path, folder: Path) -> None:
    path = place / "SHA256SUMS"
    path.write_text("".join(line for line in path.read_text().splitlines(True) if "hdf5" not in line))
    flip(place)


@changed("sums: a number changed in place, size and time kept", sums=True)
def flip(place: Path, folder: Path | None = None) -> None:
    path, stat = hdf5(place), hdf5(place).stat()
    with h5py.File(path, "r") as file:
        offset = path.read_bytes().index(file["episode_2/rewards"][()].tobytes())
    with path.open("r+b") as raw:
        raw.seek(offset + 6)
        raw.write(b"\x33")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def read_then_flipped(honest: Honest, place: Path) -> str:
    """What was right when it was first read is changed in place; the next reading must see it."""
    TransitionTable.from_minari(SET)
    flip(place)
    try:
        table = TransitionTable.from_minari(SET)
    except MPCOfflineError:
        return EQUAL
    if np.array_equal(table.rows, honest.table.rows):
        return EQUAL
    raise Finding(WRONG, "another table")


def later(honest: Honest, folder: Path) -> Read:
    return partial(read_then_flipped, honest, copy_store(honest, folder) / SET)


FILES["sums: a number changed after the first reading"] = later
