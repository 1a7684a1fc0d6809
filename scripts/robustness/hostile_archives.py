"""Hostile policies and learners."""

from __future__ import annotations

import copy
import io
import json
import os
import subprocess
import threading
import time
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mpcoffline import MPCPolicy, OfflineMPCLearner

from . import mutations
from .cases import EQUAL, LET_IN, LIMITS, MEMORY, Finding
from .honest import Honest
from .targets import Read, act

MIB = 1 << 20
FILES: dict[str, Callable[[Honest, Path], Read]] = {}


def read(path: Path, must_refuse: bool, batch: int = 1) -> str:
    """Loads a policy and acts; some must be refused, the others work or are refused."""
    policy = MPCPolicy.load(path)
    act(policy)
    if batch > 1:
        with few_processes():
            policy.predict(np.zeros((batch, policy.mpc.nx)))
    if must_refuse:
        raise Finding(LET_IN, "loaded, and acted")
    return EQUAL


class few_processes:  # noqa: N801 -- used as a word
    """Ends this process where it has started more than a few dozen."""

    def __enter__(self) -> None:
        self._done = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def __exit__(self, *error: object) -> None:
        self._done.set()

    def _watch(self) -> None:
        while not self._done.is_set():
            mine = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
            if len(mine) > 4 * (os.cpu_count() or 1):
                LIMITS.end_with(MEMORY, f"{len(mine)} processes")
            time.sleep(0.02)


def document_of(honest: Honest, name: str = "policy.zip") -> tuple[mutations.Members, Any]:
    """The members and the JSON of an honest file."""
    found = mutations.members(honest.folder / name)
    return found, json.loads(found[mutations.document_name(found)])


def edited(name: str, *, refuse: bool = True, batch: int = 1) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Registers a file made by changing the JSON of the honest policy; the function may return a text instead."""

    def register(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def make(honest: Honest, folder: Path) -> Read:
            found, document = document_of(honest)
            changed = change(document)
            text = changed if isinstance(changed, str) else document
            mutations.write_zip(folder / "policy.zip", mutations.with_document(found, text))
            return partial(read, folder / "policy.zip", refuse, batch)

        FILES[name] = make
        return change

    return register


def made(name: str) -> Callable[[Callable[[Honest, Path], Read]], Callable[[Honest, Path], Read]]:
    """Registers a file made from scratch."""

    def register(make: Callable[[Honest, Path], Read]) -> Callable[[Honest, Path], Read]:
        FILES[name] = make
        return make

    return register


def function(document: Any) -> Any:
    """The instructions of the model."""
    return document["mpc"]["model"]["function"]


def block(document: Any) -> Any:
    """The one parameter of the model."""
    return document["mpc"]["model"]["blocks"][0]


# --- sizes --------------------------------------------------------------------------------------------------------


def _zeros(write: Callable[[bytes], Any], count: int, byte: bytes = b"\0") -> None:
    for _ in range(count):
        write(byte * MIB)


@made("JSON padded with blanks")
def padded(honest: Honest, folder: Path) -> Read:
    found, document = document_of(honest)
    with zipfile.ZipFile(folder / "policy.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open(mutations.document_name(found), "w", force_zip64=True) as file:
            file.write(json.dumps(document)[:-1].encode())
            _zeros(file.write, 450, b" ")
            file.write(b"}")
        archive.writestr(mutations.arrays_name(found), found[mutations.arrays_name(found)])
    return partial(read, folder / "policy.zip", True)


@made("arrays deflated twice")
def twice_deflated(honest: Honest, folder: Path) -> Read:
    found, _ = document_of(honest)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as inner, inner.open("x.npy", "w") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (450 * MIB // 8,)}
        np.lib.format.write_array_header_1_0(file, header)
        _zeros(file.write, 450)
    mutations.write_zip(folder / "policy.zip", found | {mutations.arrays_name(found): buffer.getvalue()})
    return partial(read, folder / "policy.zip", True)


@made("arrays of a declared size")
def declared(honest: Honest, folder: Path) -> Read:
    found, _ = document_of(honest)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as inner, inner.open("x.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
    mutations.write_zip(folder / "policy.zip", found | {mutations.arrays_name(found): buffer.getvalue()})
    return partial(read, folder / "policy.zip", True)


@made("arrays to unpickle")
def pickled(honest: Honest, folder: Path) -> Read:
    found, _ = document_of(honest)
    mutations.CANARY_PATH = str(folder / "canary")
    buffer = io.BytesIO()
    np.savez(buffer, x=np.array([mutations.Opened()], dtype=object))
    mutations.write_zip(folder / "policy.zip", found | {mutations.arrays_name(found): buffer.getvalue()})
    return partial(read, folder / "policy.zip", True)


@made("100,000 members")
def many_members(honest: Honest, folder: Path) -> Read:
    found, _ = document_of(honest)
    mutations.write_zip(folder / "policy.zip", found | {f"m{k}": b"" for k in range(100_000)}, zipfile.ZIP_STORED)
    return partial(read, folder / "policy.zip", False)


@edited("JSON that amplifies")
def amplifying(document: Any) -> str:
    return json.dumps(document)[:-1] + ', "x": [' + "[]," * 6_000_000 + "0]}"


@edited("JSON nested 100,000 deep")
def deep(document: Any) -> str:
    return json.dumps(document)[:-1] + ', "x": ' + "[" * 100_000 + "]" * 100_000 + "}"


@edited("nx of 100 million")
def nx(document: Any) -> None:
    document["mpc"]["model"]["nx"] = function(document)["output"] = function(document)["inputs"][0] = 10**8


@edited("nu of 100 million")
def nu(document: Any) -> None:
    document["mpc"]["model"]["nu"] = function(document)["inputs"][1] = 10**8


@edited("an output of 100 million")
def output(document: Any) -> None:
    function(document)["output"] = 10**8


for _exponent in (7, 9, 30):

    @edited(f"horizon of 1e{_exponent}")
    def horizon(document: Any, exponent: int = _exponent) -> None:
        document["mpc"]["horizon"] = 10**exponent


def chain(document: Any, length: int, op: str = "sin") -> None:
    """The first output goes through so many operations."""
    program = function(document)["instructions"]
    last = next(line for line in program if line[0] == "output")
    source, start = last[2], 10**7
    rest = [line for line in program if line[0] == "output"]
    steps = [[op, start + k, *[source if k == 0 else start + k - 1] * (1 if op == "sin" else 2)] for k in range(length)]
    last[2] = start + length - 1
    function(document)["instructions"] = [line for line in program if line[0] != "output"] + steps + rest


for _length in (1_000, 10_000):

    @edited(f"a chain of {_length:,} sines", refuse=False)
    def sines(document: Any, length: int = _length) -> None:
        chain(document, length)


@edited("two million nodes")
def nodes(document: Any) -> None:
    chain(document, 2_000_000)


@edited("a sum that doubles 200 times", refuse=False)
def doubling(document: Any) -> None:
    chain(document, 200, "add")


@edited("a parameter of shape (0, 1e9)", refuse=False)
def hollow(document: Any) -> None:
    shape = {"name": "z", "shape": [0, 10**9], "theta": [], "low": [], "high": []}
    document["mpc"]["model"]["blocks"].append(block(document) | shape)


@edited("a parameter of shape (-1, -1)")
def negative(document: Any) -> None:
    document["mpc"]["model"]["blocks"].append(block(document) | {"name": "z", "shape": [-1, -1]})
    function(document)["inputs"][2] = 2


@edited("100,000 worker processes", refuse=False, batch=32)
def workers(document: Any) -> None:
    document["solver"], document["solver_options"] = "ipopt", {"n_workers": 100_000}


@edited("a million threads", refuse=False, batch=4)
def threads(document: Any) -> None:
    document["solver_options"] = {"n_threads": 10**6}


@edited("iterations without end", refuse=False)
def iterations(document: Any) -> None:
    document["solver_options"] = {"max_iterations": 10**15, "tolerance": 0.0}


# --- values -------------------------------------------------------------------------------------------------------


VALUES: dict[str, tuple[str, Any]] = {
    "tolerance NaN": ("solver_options", {"tolerance": float("nan")}),
    "tolerance a text": ("solver_options", {"tolerance": "x"}),
    "an unknown solver option": ("solver_options", {"hsllib": "evil.so"}),
    "solver options a list": ("solver_options", [1]),
    "an unknown solver": ("solver", "os:system"),
    "version true": ("version", True),
    "version 2.0": ("version", 2.0),
    "version a list": ("version", [2]),
    "noise a text": ("exploration_noise", "0.1"),
    "noise NaN": ("exploration_noise", float("nan")),
}
for _name, (_key, _value) in VALUES.items():

    @edited(_name)
    def value(document: Any, key: str = _key, changed: Any = _value) -> None:
        document[key] = changed


@edited("a constant NaN")
def nan(document: Any) -> None:
    next(line for line in function(document)["instructions"] if line[0] == "const")[2] = "nan"


@edited("a bound NaN")
def bound(document: Any) -> None:
    block(document)["low"] = [float("nan")]


@edited("an integer of 4,000 digits")
def digits(document: Any) -> str:
    return json.dumps(document).replace('"horizon": ', '"horizon": ' + "9" * 4000)


@edited("a number above float64")
def above(document: Any) -> str:
    return json.dumps(document).replace('"dt": 0.1', '"dt": 1e400')


@edited("one key twice")
def key_twice(document: Any) -> str:
    return json.dumps(document).replace('"discount":', '"discount": 0.5, "discount":')


@made("one member twice")
def member_twice(honest: Honest, folder: Path) -> Read:
    found, document = document_of(honest)
    mutations.write_zip(folder / "policy.zip", found)
    changed = copy.deepcopy(document)
    block(changed)["theta"] = [50.0]
    with zipfile.ZipFile(folder / "policy.zip", "a") as archive:
        archive.writestr(mutations.document_name(found), json.dumps(changed))
    return partial(read, folder / "policy.zip", True)


# --- names --------------------------------------------------------------------------------------------------------


C = """ */
#ifdef DISCOUNT
}; int creat(const char *, unsigned); __attribute__((constructor)) static void c(void) { creat("CANARY", 0600); }
static const mpc_parameters rest = { 0,
#endif
/* """
NAMES = {
    "a name that ends a comment": ("name", f"m{C}"),
    "a unit that ends a comment": ("unit", f"kg{C}"),
    "a group that ends a comment": ("group", f"model{C}"),
    "a name with a line break": ("name", "m\n#error"),
    "a unit with a line break": ("unit", 'kg\n#include "/etc/passwd"'),
    "a name that continues the line": ("name", "m\\\n"),
    "a unit with a trigraph": ("unit", "??/\n"),
    "a name with quotes": ("name", 'm"; evil("'),
    "a name of terminal escapes": ("name", "\x1b]0;evil\x07\x1b[2J"),
    "a name that turns text around": ("name", "m\u202e"),
    "a name of markup": ("name", "<script>alert(1)</script>"),
    "a name of 100,000 letters": ("name", "m" * 100_000),
    "a name that is a number": ("name", 5),
    "a unit that is a list": ("unit", ["kg"]),
}


def read_name(path: Path, folder: Path) -> str:
    """Loads; what is let in is exported and compiled, and its library opened."""
    import ctypes

    policy = MPCPolicy.load(path)
    LIMITS.begin("export", 60, wall=120, room=1 << 30)
    from mpcoffline.control.export import export_c

    export_c(policy, folder / "c")
    library = folder / "evil.so"
    sources = [str(path) for path in (folder / "c").glob("*.c") if "test" not in path.name]
    subprocess.run(["cc", "-shared", "-fPIC", *sources, "-o", str(library), "-lm"], check=False)
    if library.exists():
        ctypes.CDLL(str(library))
    raise Finding(LET_IN, f"loaded; compiled: {library.exists()}")


for _name, (_key, _value) in NAMES.items():

    @made(_name)
    def named(honest: Honest, folder: Path, key: str = _key, text: Any = _value) -> Read:
        found, document = document_of(honest)
        changed = text.replace("CANARY", str(folder / "canary")) if isinstance(text, str) else text
        block(document)[key] = changed
        mutations.write_zip(folder / "policy.zip", mutations.with_document(found, document))
        return partial(read_name, folder / "policy.zip", folder)


# --- learners -----------------------------------------------------------------------------------------------------


def read_learner_file(path: Path) -> str:
    """A learner that must be refused."""
    OfflineMPCLearner.load(path)
    raise Finding(LET_IN, "loaded")


@made("a learner with a history of 10 million")
def history(honest: Honest, folder: Path) -> Read:
    found, document = document_of(honest, "learner.zip")
    text = json.dumps(document).replace('"history": [', '"history": [' + "[1, {}]," * 5_000_000, 1)
    mutations.write_zip(folder / "learner.zip", mutations.with_document(found, text))
    return partial(read_learner_file, folder / "learner.zip")


@made("a policy with a path as a member")
def upward(honest: Honest, folder: Path) -> Read:
    found, _ = document_of(honest)
    mutations.write_zip(folder / "policy.zip", found | {"../../canary": b"x", str(folder / "canary"): b"x"})
    return partial(read, folder / "policy.zip", False)
