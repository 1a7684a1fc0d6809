"""Small files that claim to be large, or hold what must not get in: refused before anything is believed."""

from __future__ import annotations

import copy
import io
import json
import os
import re
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPC, Model, MPCPolicy, OfflineMPCLearner, Parameter, QuadraticCost
from mpcoffline.core import limits
from mpcoffline.core.archive import read_archive
from mpcoffline.core.documents import parsed_json
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.learning import ValueFunction
from mpcoffline.learning.bellman.potential import Potential
from mpcoffline.mpc import Constraint
from mpcoffline.mpc.parameters import Block

Document = dict[str, Any]


def small(name: str = "m", unit: str = "kg") -> MPC:
    def f(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[1], u[0] / p[name] - 0.5 * ca.sin(x[0]))

    model = Model(f, 2, 1, 0.1, {name: Parameter(1.0, low=0.1, unit=unit)})
    return MPC(model, QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(np.eye(2)), 5, 0.95, [-1.0], [1.0])


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Document:
    path = tmp_path_factory.mktemp("honest") / "policy.zip"
    MPCPolicy(small(), "ddp", max_iterations=50).save(path)
    return read_archive(path, "policy")[0]


def no_arrays(compression: int = zipfile.ZIP_STORED, **arrays: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", compression) as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data)
    return content.getvalue()


def written(path: Path, document: Document | str, arrays: bytes | None = None) -> Path:
    text = document if isinstance(document, str) else json.dumps(document)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mpcoffline.json", text)
        archive.writestr("arrays.npz", no_arrays() if arrays is None else arrays)
    return path


def npy(shape: tuple[int, ...], data: bytes, dtype: str = "<f8") -> bytes:
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": dtype, "fortran_order": False, "shape": shape})
    return content.getvalue() + data


def chain(document: Document, n: int) -> None:
    """A model of n more operations."""
    function = document["mpc"]["model"]["function"]
    outputs = [line for line in function["instructions"] if line[0] == "output"]
    program = [line for line in function["instructions"] if line[0] != "output"]
    program += [["sin", 10_000 + i, outputs[0][2] if i == 0 else 9_999 + i] for i in range(n)]
    outputs[0][2] = 9_999 + n
    function["instructions"] = program + outputs


def put(*path: Any) -> Callable[[Document], None]:
    """Sets what a path of keys leads to; the last is the value."""

    def change(document: Document) -> None:
        target: Any = document
        for key in path[:-2]:
            target = target[key]
        target[path[-2]] = path[-1]

    return change


def sizes(key: str, i: int) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        document["mpc"]["model"][key] = document["mpc"]["model"]["function"]["inputs"][i] = 10**8

    return change


def program_of(document: Document) -> list[Any]:
    program: list[Any] = document["mpc"]["model"]["function"]["instructions"]
    return program


BLOCK: Document = {"name": "z", "theta": [], "low": [], "high": [], "kind": "free", "group": "model", "unit": ""}
MODEL = ("mpc", "model")
HOSTILE: dict[str, Callable[[Document], None]] = {
    "states": sizes("nx", 0),
    "inputs": sizes("nu", 1),
    "true for a size": put(*MODEL, "nx", True),
    "horizon": put("mpc", "horizon", 10**9),
    "horizon of many digits": put("mpc", "horizon", 10**3000),
    "operations": lambda document: chain(document, limits.EXPRESSION_NODES),
    "a constant NaN": lambda document: document["mpc"]["model"]["function"]["instructions"].insert(
        0, ["const", 0, "nan"]
    ),
    "wide and empty": lambda document: document["mpc"]["model"]["blocks"].append(BLOCK | {"shape": [0, 10**9]}),
    "negative shape": lambda document: document["mpc"]["model"]["blocks"].append(BLOCK | {"shape": [-1, -1]}),
    "name of C": put(*MODEL, "blocks", 0, "name", "m */\n#ifdef X\n}; int system(const char *); /*"),
    "name of escapes": put(*MODEL, "blocks", 0, "name", "\x1b[2J"),
    "name that is none": put(*MODEL, "blocks", 0, "name", 5),
    "unit": put(*MODEL, "blocks", 0, "unit", "kg */ int x; /*"),
    "unit of a backslash": put(*MODEL, "blocks", 0, "unit", "kg\\"),
    "unit that is none": put(*MODEL, "blocks", 0, "unit", ["a"]),
    "group": put(*MODEL, "blocks", 0, "group", "x */"),
    "workers": put("solver_options", {"n_workers": 64}),
    "threads": put("solver_options", {"n_threads": 10**6}),
    "iterations": put("solver_options", {"max_iterations": 10**15}),
    "tolerance NaN": put("solver_options", {"tolerance": float("nan")}),
    "tolerance inf": put("solver_options", {"tolerance": float("inf")}),
    "tolerance 0": put("solver_options", {"tolerance": 0.0}),
    "tolerance text": put("solver_options", {"tolerance": "x"}),
    "another option": put("solver_options", {"hsllib": "x.so"}),
    "version true": put("version", True),
    "version 1.0": put("version", 1.0),
    "noise text": put("exploration_noise", "0.1"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_policies_are_refused(kind: str, honest: Document, tmp_path: Path) -> None:
    document = copy.deepcopy(honest)
    HOSTILE[kind](document)
    with pytest.raises(FileFormatError) as caught:
        MPCPolicy.load(written(tmp_path / "policy.zip", document))
    assert len(str(caught.value)) < 2_000
    assert str(caught.value).isprintable()


def test_the_honest_one_is_not(honest: Document, tmp_path: Path) -> None:
    policy = MPCPolicy.load(written(tmp_path / "policy.zip", honest))
    assert policy.solver_options == {"max_iterations": 50}
    assert policy.mpc.values.keys() == small().values.keys()


@pytest.fixture(scope="module")
def archives(honest: Document, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Policies whose archives are not what they seem: half a gigabyte of zeros in some of them."""
    folder, text = tmp_path_factory.mktemp("archives"), json.dumps(honest)
    zeros = npy((1 << 26,), bytes(1 << 29))
    kinds = {
        "blanks": (text[:-1] + " " * limits.JSON_BYTES + "}", no_arrays()),
        "empty lists": (text[:-1] + ', "x": [' + "[]," * limits.JSON_CONTAINERS + "[]]}", no_arrays()),
        "a key twice": (text.replace('"discount":', '"discount": 0.5, "discount":'), no_arrays()),
        "deep lists": (text[:-1] + ', "x": ' + "[" * 100_000 + "]" * 100_000 + "}", no_arrays()),
        "zeros": (text, no_arrays(x=zeros)),
        "zeros deflated twice": (text, no_arrays(zipfile.ZIP_DEFLATED, x=zeros)),
        "declared alone": (text, no_arrays(x=npy((1 << 40,), bytes(64)))),
        "more than declared": (text, no_arrays(x=npy((1,), bytes(64)))),
        "negative shape": (text, no_arrays(x=npy((-1, -8), bytes(64)))),
        "texts": (text, no_arrays(x=npy((8,), bytes(64), "<U2"))),
    }
    return [written(folder / f"{kind}.zip", *given) for kind, given in kinds.items()]


def test_archives_are_refused(archives: list[Path]) -> None:
    for path in archives:
        with pytest.raises(FileFormatError, match=re.escape(str(path))):
            MPCPolicy.load(path)


def test_members_are_the_two_and_each_once(honest: Document, tmp_path: Path) -> None:
    path = written(tmp_path / "policy.zip", honest)
    for name in ("mpcoffline.json", "../elsewhere"):
        more = tmp_path / "more.zip"
        more.write_bytes(path.read_bytes())
        with warnings.catch_warnings(), zipfile.ZipFile(more, "a") as archive:
            warnings.simplefilter("ignore")
            archive.writestr(name, "{}")
        with pytest.raises(FileFormatError, match="members"):
            MPCPolicy.load(more)


def test_special_files_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "fifo")
    for path in (tmp_path / "fifo", tmp_path / "link", tmp_path, Path(os.devnull)):
        for load in (MPCPolicy.load, OfflineMPCLearner.load):
            with pytest.raises(FileFormatError, match="expected a regular file"):
                load(path)


BOMB = """
import resource, sys
from mpcoffline import MPCPolicy
from mpcoffline.core.errors import FileFormatError
before = resource.getrusage(resource.RUSAGE_SELF)
for path in sys.argv[1:]:
    try:
        MPCPolicy.load(path)
    except FileFormatError:
        continue
    raise SystemExit(f"{path} was loaded")
after = resource.getrusage(resource.RUSAGE_SELF)
print((after.ru_maxrss - before.ru_maxrss) // 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the unit of ru_maxrss")
def test_refusing_takes_no_memory(archives: list[Path]) -> None:
    done = subprocess.run([sys.executable, "-c", BOMB, *map(str, archives)], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 300  # MB


def test_value_functions_are_as_large_as_their_arrays() -> None:
    arrays = ValueFunction(3, (4, 5), n_members=2).to_arrays()
    assert ValueFunction.from_arrays(arrays).hidden == (4, 5)
    n = 100_000  # a network of these widths takes 40 GB
    wide = {"mean": np.zeros(n), "net.0.weight": np.zeros((n, 1)), "net.2.weight": np.zeros((1, n))}
    with pytest.raises(FileFormatError, match="value function"):
        ValueFunction.from_arrays(arrays | {"net.members.1.2.weight": np.zeros((5, 3))})
    with pytest.raises(FileFormatError, match="value function"):
        ValueFunction.from_arrays(wide)


def test_potentials_are_as_large_as_their_numbers() -> None:
    with pytest.raises(FileFormatError, match="potential"):
        Potential.from_json({"mean": [0.0] * 100_000, "scale": [1.0] * 100_000, "coefficients": [0.0]})
    with pytest.raises(FileFormatError, match="potential"):
        Potential.from_json({"mean": [0.0, 0.0], "scale": [1.0, 1.0], "coefficients": [0.0]})


def test_json_names_a_key_once() -> None:
    assert parsed_json(b'{"a": {"b": 1}, "b": 2}', "x") == {"a": {"b": 1}, "b": 2}
    with pytest.raises(FileFormatError, match="'b' twice"):
        parsed_json(b'{"a": {"b": 1, "c": 2, "b": 1}}', "x")


def test_the_same_limits_hold_where_objects_are_made(tmp_path: Path) -> None:
    """What can be written can be read."""
    with pytest.raises(InvalidArgumentError, match="horizon"):
        small().replace(horizon=limits.HORIZON + 1)
    with pytest.raises(InvalidArgumentError, match="nx"):
        Model(lambda x, u, p: x, limits.STATES + 1, 1, 0.1, discrete=True)
    with pytest.raises(InvalidArgumentError, match="unit"):
        Parameter(1.0, unit="kg\n")
    with pytest.raises(InvalidArgumentError, match="parameter name"):
        small(name="m\n")
    with pytest.raises(InvalidArgumentError, match="name of a constraint"):
        Constraint(lambda x, u, p: x, name="\x1b[2J")
    with pytest.raises(InvalidArgumentError, match="group of m"):
        Block("m", (), np.ones(1), np.zeros(1), np.ones(1), group="other")  # type: ignore[arg-type]
    with pytest.raises(InvalidArgumentError, match="max_iterations: expected an integer from 1 to"):
        MPCPolicy(small(), "ddp", max_iterations=0)


def test_cores_are_not_the_files_matter(tmp_path: Path) -> None:
    MPCPolicy(small(), "ipopt", n_workers=2, max_iterations=np.int64(70)).save(tmp_path / "policy.zip")
    assert MPCPolicy.load(tmp_path / "policy.zip").solver_options == {"max_iterations": 70}
    assert MPCPolicy.load(tmp_path / "policy.zip", n_workers=3).solver_options["n_workers"] == 3
    with pytest.raises(InvalidArgumentError, match="n_threads"):
        MPCPolicy.load(tmp_path / "policy.zip", n_threads=3)  # which ipopt has not
