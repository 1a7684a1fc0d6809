"""scripts/attack_files: cases come from seed and name alone, every outcome is told apart, parts of the page stay."""

from __future__ import annotations

import faulthandler
import io
import json
import os
import random
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mpcoffline.core.errors import FileFormatError

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "attack_files"


@pytest.fixture
def robustness(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    """Modules of the package that the scripts share."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return lambda name: import_module(f"robustness.{name}")


def refused() -> str:
    raise FileFormatError("file", expected="this", actual="that")


def raw() -> str:
    raise ValueError("raw")


def aborted() -> None:
    faulthandler.disable()  # which would write the child's stack between the tests' lines
    os.abort()


def hidden_memory() -> str:
    try:
        bytearray(1 << 40)
    except MemoryError as error:
        raise FileFormatError("file", expected="this", actual="that") from error
    return "as the original"


@pytest.mark.parametrize(
    ("read", "kind", "detail"),
    [
        (lambda: "as the original", "as the original", ""),
        (refused, "refused", "FileFormatError: file: expected this, got that."),
        (raw, "RAW ERROR", "ValueError: raw"),
        (aborted, "CRASH", "SIGABRT"),
        (lambda: str(len(bytearray(1 << 30))), "OVER MEMORY", "MemoryError"),
        (hidden_memory, "OVER MEMORY", "FileFormatError"),
        (lambda: str(os.system("true")), "EXECUTION", "code of the file ran"),
        (lambda: str(Path("canary").touch()), "EXECUTION", "code of the file ran"),
        (lambda: os._exit(3), "RAW ERROR", "exit status"),
    ],
)
def test_outcomes_are_told_apart(
    robustness: Any, tmp_path: Path, read: Callable[[], str], kind: str, detail: str
) -> None:
    cases = robustness("cases")
    outcome = cases.run(cases.Case("file/bytes/0", lambda folder, rng: ("changed", read)), 0, tmp_path)
    assert (outcome.kind, outcome.mutation) == (kind, "changed")
    assert detail in outcome.detail
    assert not list(tmp_path.glob("case-*/"))


def test_what_takes_too_long_is_ended(robustness: Any, tmp_path: Path) -> None:
    cases = robustness("cases")

    def busy() -> str:
        cases.LIMITS.begin("reading", 0.05)
        while True:
            pass

    def idle() -> str:
        cases.LIMITS.begin("reading", wall=1)
        os.mkfifo("pipe")
        return Path("pipe").read_text()

    for read, name in ((busy, "SIGPROF"), (idle, "SIGALRM")):
        outcome = cases.run(cases.Case("file/bytes/0", lambda folder, rng, read=read: ("", read)), 0, tmp_path)
        assert (outcome.kind, outcome.detail) == ("OVER TIME", name)


def test_a_file_that_could_not_be_made_is_no_finding(robustness: Any, tmp_path: Path) -> None:
    cases = robustness("cases")
    outcome = cases.run(cases.Case("file/bytes/0", lambda folder, rng: raw()), 0, tmp_path)
    assert (outcome.kind, outcome.detail) == ("not made", "ValueError: raw")


def test_a_case_depends_on_seed_and_name_alone(robustness: Any, tmp_path: Path) -> None:
    cases = robustness("cases")

    def case(name: str) -> Any:
        return cases.Case(name, lambda folder, rng: (str(rng.random()), lambda: "refused"))

    names = [f"file/bytes/{k}" for k in range(5)]
    several = {o.name: o.mutation for o in cases.run_all([case(name) for name in names], 0, tmp_path, 2)}
    assert sorted(several) == names
    assert len(set(several.values())) == 5
    (alone,) = cases.run_all([case(names[3])], 0, tmp_path, 1)
    (other,) = cases.run_all([case(names[3])], 1, tmp_path, 1)
    assert alone.mutation == several[names[3]] != other.mutation


def test_the_table_counts_and_findings_name_a_case(robustness: Any) -> None:
    cases = robustness("cases")
    outcomes = [
        cases.Outcome("policy/bytes/0", "refused"),
        cases.Outcome("policy/bytes/1", "CRASH", "SIGSEGV", "cut at 3"),
        cases.Outcome("policy/bytes/2", "CRASH", "SIGSEGV", "cut at 4"),
        cases.Outcome("hostile places/x", "LET IN", "loaded", "by hand"),
    ]
    rows = {line.split(" | ")[0]: line for line in cases.table(outcomes)}
    assert rows["| policy/bytes"] == "| policy/bytes | 3 | 0 | 0 | 1 | 0 | **2** | 0 | 0 | 0 | 0 | 0 |"
    assert rows["| **all**"].startswith("| **all** | 4 |")
    assert cases.findings(outcomes) == [
        "hostile places: LET IN: 1 x loaded; `--only 'hostile places/x'`",
        "policy/bytes: CRASH: 2 x SIGSEGV; `--only 'policy/bytes/1'` (cut at 3)",
    ]


def test_each_script_replaces_its_own_part_of_the_page(robustness: Any, tmp_path: Path) -> None:
    page = robustness("page")
    path = tmp_path / "results" / "robustness.md"
    for text in ("first", "second"):
        for part in reversed(page.PARTS):
            page.write_part(path, part, [f"{part}: {text}", "", "### Below", "", "* a line"])
    content = path.read_text()
    assert content.startswith(f"{page.TITLE}\n\n## {page.PARTS[0]}\n\n{page.PARTS[0]}: second\n")
    assert content.count("\n## ") == content.count("second") == 2
    assert "first" not in content


def test_mutations_change_what_they_say(robustness: Any, tmp_path: Path) -> None:
    mutations = robustness("mutations")
    content, other = bytes(range(256)) * 4, bytes(1024)
    document = {"a": {"b": [1.0, 2.5], "c": "text"}, "d": None, "e": True, "f": '{"type": "Box"}'}
    sums = "".join(f"{k:064x}  data/file{k}\n" for k in range(3))
    log = b"magic" + b"".join(b"\xb7\x1eR\n" + bytes([k]) * 30 for k in range(6))
    buffer = io.BytesIO()
    np.savez(buffer, x=np.arange(6.0).reshape(2, 3), y=np.zeros(2))
    makers: dict[str, Callable[[random.Random], tuple[str, Any]]] = {
        "bytes": lambda rng: mutations.mutated_bytes(rng, content, other),
        "json": lambda rng: mutations.mutated_json(rng, document),
        "lines": lambda rng: mutations.mutated_lines(rng, sums),
        "log": lambda rng: mutations.mutated_log(rng, log, log.replace(b"\3", b"\xff")),
        "arrays": lambda rng: mutations.mutated_arrays(rng, buffer.getvalue()),
    }
    for name, make in makers.items():
        made = [make(random.Random(seed)) for seed in range(200)]
        again = [make(random.Random(seed)) for seed in range(200)]
        assert [what for what, _ in made] == [what for what, _ in again]
        if name != "arrays":  # whose zip bears the time
            assert made == again
        assert len({str(changed) for _, changed in made}) > 60, name
    assert document["a"] == {"b": [1.0, 2.5], "c": "text"}


def test_changed_zips_and_hdf5_files(robustness: Any, tmp_path: Path) -> None:
    mutations, objects = robustness("mutations"), robustness("mutations_hdf5")
    found = {"x.json": json.dumps({"a": 1}).encode(), "x.npz": b"arrays"}
    intact = 0
    for seed in range(60):
        mutations.mutated_zip(random.Random(seed), tmp_path / "x.zip", found)
        try:
            with zipfile.ZipFile(tmp_path / "x.zip") as archive:
                intact += archive.testzip() is None
        except Exception:
            continue
    assert 20 < intact < 60
    opened = 0
    for seed in range(60):
        path = tmp_path / f"{seed}.h5"
        with h5py.File(path, "w") as file:
            for k in range(3):
                file[f"episode_{k}/observations"] = np.zeros((4, 2), np.float32)
                file[f"episode_{k}/rewards"] = np.zeros(3)
                file[f"episode_{k}"].attrs["id"] = k
        try:
            objects.mutated_hdf5(random.Random(seed), path)
        except Exception:  # HDF5 refuses some, as to move an object into itself
            continue
        opened += h5py.is_hdf5(path)
    assert opened > 50


def test_help(tmp_path: Path) -> None:
    done = subprocess.run([SCRIPT, "--help"], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "scripts/attack_files [--full] [--only NAME ...]" in done.stdout


@pytest.mark.slow
def test_some_files_of_each_kind(tmp_path: Path) -> None:
    names = ["policy/bytes/0", "learner/json/0", "checkpoint/bytes/1", "sums/bytes/0", "table cache/json/0"]
    made = ["hostile archives/arrays to unpickle", "hostile places/policy.zip that is a nothing"]
    done = subprocess.run(
        [SCRIPT, "--workers", "1", "--out", str(tmp_path / "page.md"), "--only", *names, *made],
        capture_output=True, text=True, timeout=600, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| **all** | 7 |" in done.stdout
    assert "Nothing went wrong." in done.stdout
    assert not (tmp_path / "page.md").exists()
