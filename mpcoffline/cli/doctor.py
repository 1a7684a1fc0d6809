"""Is this installation in order? What ``mpcoffline doctor`` says, as data."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from packaging.requirements import Requirement

Status = Literal["ok", "warn", "fail"]

#: Optional packages, and what they are for.
_OPTIONAL = {
    "pygame": ("pictures and films of the environments", "render"),
    "cma": ("learn --polish", "polish"),
    "tensorboard": ("learn --tensorboard", "tensorboard"),
    "huggingface_hub": ("data sets on hf://", "hub"),
    "google-cloud-storage": ("data sets on gcp://", "gcs"),
    "torchrl": ("to_torchrl", "interop"),
    "onnx": ("export --to onnx", "onnx"),
    "imageio-ffmpeg": ("films as MP4", "video"),
}
_ALTERNATIVES = {"pygame": ("pygame-ce",)}
_REINSTALL = "Run: pip install --upgrade mpcoffline"


class Check(NamedTuple):
    """One thing that was looked at.

    Attributes:
        name: What.
        status: ``"ok"``; ``"warn"``: something optional is missing or slow; ``"fail"``: something needed is broken.
        found: What was found.
        advice: What to do about it; empty where nothing is to be done.
    """

    name: str
    status: Status
    found: str
    advice: str = ""


def checkup() -> dict[str, Any]:
    """Examines versions, compiler, solvers, data sets, GPU and threads.

    Nothing is raised: what breaks is a check that says so.

    Returns:
        ``{"ok": bool, "checks": [{"name", "status", "found", "advice"}, ...]}``; ``ok`` unless a check failed.
    """
    checks = [check for examine in _EXAMINATIONS for check in _caught(examine)]
    return {
        "ok": all(check.status != "fail" for check in checks),
        "checks": [check._asdict() for check in checks],
    }


def _caught(examine: Callable[[], Iterator[Check]]) -> list[Check]:
    """The checks of one examination; an error that it did not foresee is a failed check."""
    checks: list[Check] = []
    try:
        checks.extend(examine())
    except Exception as error:  # whatever breaks, the doctor goes on
        name = examine.__name__.strip("_").replace("_", " ")
        checks.append(Check(name, "fail", f"{type(error).__name__}: {error}", _REINSTALL))
    return checks


def _versions() -> Iterator[Check]:
    from mpcoffline import __version__

    yield Check("mpcoffline", "ok", f"{__version__} in {Path(__file__).parent}")
    yield Check("Python", "ok", f"{platform.python_version()} ({sys.executable})")
    yield Check("platform", "ok", platform.platform())
    for requirement in _needed():
        name, wanted, version = requirement.name, requirement.specifier, _version(requirement.name)
        if version is None:
            yield Check(name, "fail", "not installed", _REINSTALL)
        elif not wanted.contains(version, prereleases=True):
            yield Check(name, "fail", f"{version}, where {wanted} is needed", _REINSTALL)
        else:
            yield Check(name, "ok", version)


def _optional_packages() -> Iterator[Check]:
    for name, (purpose, extra) in _OPTIONAL.items():
        for candidate in (name, *_ALTERNATIVES.get(name, ())):
            if (version := _version(candidate)) is not None:
                yield Check(candidate, "ok", version)
                break
        else:
            advice = f'For {purpose}: pip install "mpcoffline[{extra}]"'
            yield Check(name, "warn", "not installed (optional)", advice)


def _compiler() -> Iterator[Check]:
    from mpcoffline.solvers.ddp import build

    advice = "Install gcc or clang, or name one in CC: without one ipopt solves, hundreds of times slower."
    found = build.compilers()
    for compiler in found:
        if reason := build.trial(compiler):
            yield Check("C compiler", "warn", f"{compiler} fails: {reason.splitlines()[0]}", advice)
        else:
            yield Check("C compiler", "ok", f"{compiler} {' '.join(build.flags_of(compiler))}")
            break
    if not found:
        yield Check("C compiler", "warn", "none", advice)


def _cache() -> Iterator[Check]:
    from mpcoffline.core.caches import disk_size, size_limit
    from mpcoffline.core.places import cache_root, distrusted

    folder = cache_root()
    advice = "Set MPCOFFLINE_CACHE to a folder of yours: temporary files take its place."
    if folder is None:
        yield Check("cache", "warn", "no home directory", advice)
        return
    problem = distrusted(folder) if folder.exists() else ""
    if not problem and not _writable(folder):
        problem = "cannot be written"
    found = f"{folder}, {disk_size(folder) / 1e6:.0f} MB of at most {size_limit() / 1e6:.0f}"
    if problem:
        yield Check("cache", "warn", f"{found}; it {problem}", advice)
    else:
        yield Check("cache", "ok", found)


def _solvers() -> Iterator[Check]:
    """Each solver solves a tiny problem; one that needs a compiler may be missing."""
    import numpy as np

    from mpcoffline import MPC, Model, QuadraticCost
    from mpcoffline.solvers import SOLVERS

    model = Model(lambda x, u, p: x + p["b"] * u, nx=1, nu=1, dt=1.0, parameters={"b": 1.0}, discrete=True)
    # min x^2 + u^2 + (x + u)^2 from x = 1: u = -1/2.
    tiny = MPC(model, QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 1, 1.0, [-1.0], [1.0])
    for name, kind in SOLVERS.items():
        if kind.refuses(tiny):
            continue
        begin = time.perf_counter()
        try:
            action = float(np.asarray(kind(tiny).solve(np.array([1.0])).u0)[0])
        except Exception as error:
            status: Status = "warn" if kind.needs_compiler else "fail"
            advice = "See C compiler above." if kind.needs_compiler else _REINSTALL
            yield Check(f"solver {name}", status, str(error), advice)
            continue
        right = abs(action + 0.5) < 1e-4
        found = f"a tiny MPC in {time.perf_counter() - begin:.2f} s" if right else f"u = {action:g} instead of -0.5"
        advice = "" if right else "Please report it, with this list."
        yield Check(f"solver {name}", "ok" if right else "fail", found, advice)


def _data_sets() -> Iterator[Check]:
    from minari.storage import get_dataset_path

    from mpcoffline.datasets import list_datasets

    store = Path(get_dataset_path(""))
    writable = _writable(store)
    advice = "" if writable else "Set MINARI_DATASETS_PATH to a folder that can be written."
    yield Check("data set store", "ok" if writable else "warn", str(store), advice)
    rows = list_datasets()
    shipped = sum(row.where == "shipped" for row in rows)
    yield Check("data sets", "ok" if rows else "fail", f"{shipped} shipped, {len(rows) - shipped} local")


def _hardware() -> Iterator[Check]:
    import torch

    from mpcoffline.core.parallel import n_cpus

    if torch.cuda.is_available():
        yield Check("GPU", "ok", f"{torch.cuda.get_device_name()} (CUDA {torch.version.cuda})")
    else:
        yield Check("GPU", "ok", "none; nothing needs one")
    variables = [f"{name}={os.environ[name]}" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS") if name in os.environ]
    cores = n_cpus()
    found = f"torch uses {torch.get_num_threads()} of {cores} cores {' '.join(variables)}".rstrip()
    many = torch.get_num_threads() > cores
    advice = f"Set OMP_NUM_THREADS={cores}: more threads than cores only get in each other's way." if many else ""
    yield Check("threads", "warn" if many else "ok", found, advice)


_EXAMINATIONS = (_versions, _optional_packages, _compiler, _cache, _solvers, _data_sets, _hardware)


def _needed() -> list[Requirement]:
    """What the package's own metadata ask for, extras apart."""
    from packaging.requirements import Requirement  # comes with Matplotlib

    given = [Requirement(text) for text in importlib.metadata.requires("mpcoffline") or ()]
    return [each for each in given if each.marker is None or each.marker.evaluate({"extra": ""})]


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _writable(folder: Path) -> bool:
    """Whether a file can be made in a folder, or in the nearest one above it that exists."""
    place = next((parent for parent in (folder, *folder.parents) if parent.exists()), folder)
    try:
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False
