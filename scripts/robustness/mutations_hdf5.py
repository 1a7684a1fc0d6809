"""Ways in which the objects of an HDF5 file can be wrong."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import h5py
import numpy as np

WAYS = [
    "remove", "dtype", "dtype", "shape", "shape", "nan", "fill", "gzip", "chunk", "soft", "hard", "external",
    "raw", "virtual", "group", "move", "extra", "type", "reference", "compound", "text", "vlen", "hollow", "null",
    "big", "alone",
]  # fmt: skip
CHANGES = ["set", "set", "set", "remove", "odd"]


def mutated_hdf5(rng: random.Random, path: Path) -> str:
    """Changes objects of an HDF5 file, which stays an intact HDF5 file."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = rng.choice(names)
        if rng.random() < 0.2:
            return _attribute(rng, rng.choice((file, file[name])))
        way = rng.choice(WAYS)
        try:
            _changed(rng, file, name, way, names)
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:  # HDF5 does not take it
            return f"{name} {way} in part ({type(error).__name__})"
        return f"{name} {way}"


def _changed(rng: random.Random, file: Any, name: str, way: str, names: list[str]) -> None:
    others = [other for other in names if other != name and not other.startswith(f"{name}/")]
    if way == "move":
        file.move(name, rng.choice((f"{name}x", "episode_99", "x", f"{names[0]}/x")))
    elif way == "extra":
        file.create_dataset(f"{names[0]}/extra", data=np.zeros(3))
    elif way == "alone":
        for other in others:
            if other in file and not name.startswith(other):
                del file[other]
    else:
        values = file[name][()] if isinstance(file[name], h5py.Dataset) else np.zeros(3)
        del file[name]
        if way != "remove":
            _replace(rng, file, name, way, values, others)


def _attribute(rng: random.Random, holder: Any) -> str:
    keys = list(holder.attrs)
    way = rng.choice(CHANGES)
    key = rng.choice(keys) if keys and way != "odd" else rng.choice(("id", "seed", "total_steps", "format", "x"))
    if way == "remove" and key in holder.attrs:
        del holder.attrs[key]
        return f"{holder.name}@{key} removed"
    value: Any = rng.choice(
        (0, -1, 3, 2**62, 1.5, np.nan, "x", "0", b"\xff", True, np.arange(3), np.zeros((2, 2)), h5py.Empty("f"),
         np.array(["a", "b"], dtype="S1"), 1 + 2j, np.float16(2), np.array([], np.int64), holder.ref)
    )  # fmt: skip
    holder.attrs[key] = value
    return f"{holder.name}@{key} = {value!r:.20}"


def _replace(rng: random.Random, file: Any, name: str, way: str, values: Any, others: list[str]) -> None:
    n = len(values) if np.ndim(values) else 1
    if way == "dtype":
        kind = rng.choice(["i1", "u8", "f2", ">f8", "f4", "c16", "?", "S3", "i8"])
        file[name] = np.asarray(values).astype(kind)
    elif way == "shape":
        flat = np.asarray(values).reshape(-1)
        shapes = (flat, np.asarray(values)[:-1], np.asarray(values)[:0], np.asarray(values)[..., None], flat[:1],
                  np.concatenate([values, values]), np.asarray(values)[None])  # fmt: skip
        file[name] = rng.choice(shapes)
    elif way == "nan":
        changed = np.array(values, np.float64)
        changed.reshape(-1)[rng.randrange(changed.size)] = rng.choice((np.nan, np.inf, -np.inf, 1e39, 1e300))
        file[name] = changed
    elif way == "fill":  # nothing written: HDF5 gives what it is told to
        file.create_dataset(name, np.shape(values) or (n,), "f8", fillvalue=rng.choice((0.0, 7.0, np.nan)))
    elif way in ("gzip", "chunk"):
        file.create_dataset(
            name, data=np.atleast_1d(values), chunks=True, compression="gzip" if way == "gzip" else None
        )
    elif way == "soft":
        file[name] = h5py.SoftLink(rng.choice(("/" + rng.choice(others or ["x"]), f"/{name}", "/nowhere")))
    elif way == "hard" and others:
        file[name] = file[rng.choice(others)]
    elif way == "external":
        file[name] = h5py.ExternalLink(
            rng.choice((file.filename, "/dev/zero", "elsewhere.h5")), rng.choice(others or ["/"])
        )
    elif way == "raw":
        file.create_dataset(name, (n, 2), "f8", external=[(rng.choice(("/etc/passwd", "raw.bin")), 0, 16 * n)])
    elif way == "virtual":
        layout = h5py.VirtualLayout((n, 2), "f8")
        layout[:] = h5py.VirtualSource(rng.choice((".", "elsewhere.h5")), rng.choice(others or ["x"]), (n, 2))
        file.create_virtual_dataset(name, layout)
    elif way == "group":
        file.create_group(name)
    elif way == "type":
        file[name] = np.dtype("f8")
    elif way == "reference":
        file.create_dataset(name, data=np.array([file.ref] * n, dtype=h5py.ref_dtype))
    elif way == "compound":
        file[name] = np.zeros(n, dtype=[("a", "f8"), ("b", "S3")])
    elif way == "text":
        file.create_dataset(name, data=["text"] * n)
    elif way == "vlen":
        data = file.create_dataset(name, (n,), dtype=h5py.vlen_dtype("f8"))
        data[0] = np.arange(3.0)
    elif way == "null":
        file[name] = h5py.Empty("f8")
    elif way in ("hollow", "big"):  # rows that take no room
        rows = rng.choice((10**5, 10**7, 10**8))
        shape = (rows, *np.shape(values)[1:])
        file.create_dataset(name, shape, "f8", chunks=(min(rows, 10**5), *shape[1:]), compression="gzip")
