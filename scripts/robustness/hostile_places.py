"""What is no regular file, folders that others may write, names that lead elsewhere, and packed files."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpcoffline import MPCPolicy
from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.datasets import dataset_from_arrays, list_datasets, verify
from mpcoffline.datasets.store.packed import unpack

from .cases import EQUAL, LET_IN, LIMITS, Finding
from .honest import PACKED, SET, Honest
from .hostile_data import read_all, spec
from .targets import Read, X, copy_store

FILES: dict[str, Callable[[Honest, Path], Read]] = {}


def made(name: str) -> Callable[[Callable[[Honest, Path], Read]], Callable[[Honest, Path], Read]]:
    """Registers a file made from scratch."""

    def register(make: Callable[[Honest, Path], Read]) -> Callable[[Honest, Path], Read]:
        FILES[name] = make
        return make

    return register


# --- special files ------------------------------------------------------------------------------------------------


def pipe(path: Path) -> None:
    """A pipe that nobody writes to."""
    path.unlink()
    os.mkfifo(path)


def zeros(path: Path) -> None:
    """A link to a device without end."""
    path.unlink()
    path.symlink_to("/dev/zero")


def loop(path: Path) -> None:
    """A link to itself."""
    path.unlink()
    path.symlink_to(path.name)


def directory(path: Path) -> None:
    """A folder of that name."""
    path.unlink()
    path.mkdir()


def nothing(path: Path) -> None:
    """An empty file."""
    path.write_bytes(b"")


def device(path: Path) -> None:
    """A device itself, where this user may make one."""
    path.unlink()
    os.mknod(path, 0o20666, os.makedev(1, 5))


def socket(path: Path) -> None:
    """A socket."""
    import socket as sockets

    path.unlink()
    os.chdir(path.parent)
    sockets.socket(sockets.AF_UNIX).bind(path.name)


SPECIAL = [pipe, zeros, loop, directory, nothing, device, socket]
PARTS = ("SHA256SUMS", "data/metadata.json", "data/main_data.hdf5")


def read_special(load: Callable[[Path], Any], path: Path) -> str:
    """What is no regular file must be refused."""
    load(path)
    raise Finding(LET_IN, "loaded")


def load_policy(path: Path) -> Any:
    """A policy's file."""
    return MPCPolicy.load(path)


def load_packed(path: Path) -> Any:
    """A packed file."""
    return unpack(path, PACKED)


for _special in SPECIAL:
    for _part in PARTS:

        @made(f"{_part.rpartition('/')[2]} that is a {_special.__name__}")
        def special_part(
            honest: Honest, folder: Path, part: str = _part, become: Callable[[Path], None] = _special
        ) -> Read:
            place = copy_store(honest, folder) / SET
            if part != "SHA256SUMS":
                (place / "SHA256SUMS").unlink()
            become(place / part)
            return partial(read_all, honest, True)

    for _name, _load in (("policy.zip", load_policy), ("packed.h5", load_packed)):

        @made(f"{_name} that is a {_special.__name__}")
        def special_file(
            honest: Honest,
            folder: Path,
            name: str = _name,
            load: Callable[[Path], Any] = _load,
            become: Callable[[Path], None] = _special,
        ) -> Read:
            copy_store(honest, folder)
            shutil.copy(honest.folder / name, folder / name)
            become(folder / name)
            return partial(read_special, load, folder / name)


def read_output(honest: Honest, path: Path, kind: int) -> str:
    """What exists and is no regular file must still be there after saving."""
    policy = MPCPolicy.load(honest.folder / "policy.zip")
    LIMITS.begin("save", 5)
    with suppress(MPCOfflineError):
        policy.save(path)
    if os.lstat(path).st_mode != kind:
        raise Finding(LET_IN, "replaced")
    return EQUAL


for _special in (pipe, device, socket):

    @made(f"output to a {_special.__name__}")
    def output(honest: Honest, folder: Path, become: Callable[[Path], None] = _special) -> Read:
        (folder / "out.zip").touch()
        become(folder / "out.zip")
        return partial(read_output, honest, folder / "out.zip", os.lstat(folder / "out.zip").st_mode)


# --- caches -------------------------------------------------------------------------------------------------------


def planted(cache: Path, folder: Path) -> None:
    """Makes every compiled solver of a cache one that says that it was loaded, sealed as the package seals them."""
    (folder / "evil.c").write_text(
        "int creat(const char *, unsigned);\n"
        f'__attribute__((constructor)) static void c(void) {{ creat("{folder / "canary"}", 0600); }}\n'
    )
    subprocess.run(["cc", "-shared", "-fPIC", "evil.c", "-o", "evil.so"], cwd=folder, check=True)
    content = (folder / "evil.so").read_bytes()
    for path in cache.rglob("*.so"):
        path.write_bytes(content + hashlib.sha256(content).digest())


def read_compiled(honest: Honest) -> str:
    """Acts by a solver; what was planted would have been loaded."""
    policy = MPCPolicy.load(honest.folder / "policy.zip")
    LIMITS.begin("predict", 60, wall=120, room=1 << 30)
    if not np.isfinite(policy.predict(X)[0]).all():
        raise Finding(LET_IN, "an action that is not finite")
    return EQUAL


def give_away(folder: Path, mode: int, files: bool) -> None:
    """Lets another user own a folder, and its files."""
    for path in [folder, *folder.rglob("*")]:
        if path.is_dir() or files:
            os.chown(path, 12_345, 12_345)
        if path.is_dir():
            path.chmod(mode)


@made("cache that others may write, with a planted solver")
def others_may_write(honest: Honest, folder: Path) -> Read:
    cache = folder / "solvers"
    shutil.copytree(honest.folder / "solvers", cache)
    planted(cache, folder)
    give_away(cache, 0o777, files=True)
    os.environ["MPCOFFLINE_CACHE"] = str(cache)
    return partial(read_compiled, honest)


@made("cache of another user, with a planted solver")
def of_another_user(honest: Honest, folder: Path) -> Read:
    cache = folder / "solvers"
    shutil.copytree(honest.folder / "solvers", cache)
    planted(cache, folder)
    give_away(cache, 0o755, files=True)
    os.environ["MPCOFFLINE_CACHE"] = str(cache)
    return partial(read_compiled, honest)


for _value, _place in (("", "mpcoffline"), (".", "mpcoffline"), ("x", "x/mpcoffline")):

    @made(f"XDG_CACHE_HOME of {_value!r}, with a planted solver in the current folder")
    def current_folder(honest: Honest, folder: Path, value: str = _value, place: str = _place) -> Read:
        shutil.copytree(honest.folder / "solvers", folder / place)
        planted(folder / place, folder)
        give_away(folder / place, 0o777, files=True)
        os.environ.pop("MPCOFFLINE_CACHE")
        os.environ["XDG_CACHE_HOME"], os.environ["HOME"] = value, str(folder / "home")
        return partial(read_compiled, honest)


# --- names --------------------------------------------------------------------------------------------------------


IDS = [
    "data/x-v0", "aa/data/x-v0", "aa/set-v0/part-v0", "../x-v0", "aa/../../x-v0", "/tmp/x-v0", "aa//x-v0", "aa/x-v0\n",
    "x\0-v0", "aa/.hidden-v0", "aa/" + "y" * 300 + "-v0", "/".join(["dd"] * 2000) + "/x-v0", "", None, 5, b"x-v0",
]  # fmt: skip


def read_id(dataset_id: Any) -> str:
    """Stores under an id; afterwards the store can still be listed, and an older set verified."""
    episode = (np.zeros((3, 1)), np.zeros((2, 1)), np.zeros(2))
    refused: Exception | None = None
    try:
        dataset_from_arrays(dataset_id, [episode])
    except MPCOfflineError as error:
        refused = error
    list_datasets()
    if not verify(SET).ok:
        raise Finding(LET_IN, "an older data set is damaged")
    if refused is None:
        raise Finding(LET_IN, "stored")
    raise refused


for _number, _id in enumerate(IDS):

    @made(f"id {_number}: {str(_id)[:24]!r}".replace("/", " "))
    def identifier(honest: Honest, folder: Path, dataset_id: Any = _id) -> Read:
        copy_store(honest, folder)
        return partial(read_id, dataset_id)


# --- packed files -------------------------------------------------------------------------------------------------


def read_unpacked(path: Path) -> str:
    """A packed file that must be refused."""
    unpack(path, PACKED)
    raise Finding(LET_IN, "unpacked")


def _lengths(values: Any) -> Callable[[Any, Path], None]:
    def change(file: Any, folder: Path) -> None:
        del file["lengths"]
        file["lengths"] = values

    return change


def _states(file: Any, folder: Path) -> None:
    shape = (10**8, file["states"].shape[1])
    del file["states"]
    file.create_dataset("states", shape, "f8", chunks=(10**5, shape[1]), compression="gzip")


def _spec(entry: str, **values: Any) -> Callable[[Any, Path], None]:
    def change(file: Any, folder: Path) -> None:
        file.attrs["env_spec"] = spec(entry, folder, **values)

    return change


PACKED_FILES: dict[str, Callable[[Any, Path], None]] = {
    "a shell command": _spec("os:system"),
    "an environment of a module": _spec("canary_module:Env"),
    "an id that imports": _spec("canary_module:Env", id="canary_module:Evil-v0"),
    "lengths below none": _lengths(np.array([8, 8, 8, 8, 24, -8], np.int32)),
    "lengths that wrap around": _lengths(np.array([2**31 - 1, 2**31 - 1, 50], np.int64)),
    "lengths of zero": _lengths(np.array([48, 0, 0, 0, 0, 0], np.int32)),
    "lengths that are no integers": _lengths(np.full(6, 8.0)),
    "100 million states that take no room": _states,
}
for _name, _change in PACKED_FILES.items():

    @made(f"packed: {_name}")
    def packed(honest: Honest, folder: Path, change: Callable[[Any, Path], None] = _change) -> Read:
        copy_store(honest, folder)
        shutil.copy(honest.folder / "packed.h5", folder / "packed.h5")
        with h5py.File(folder / "packed.h5", "r+") as file:
            change(file, folder)
        return partial(read_unpacked, folder / "packed.h5")
