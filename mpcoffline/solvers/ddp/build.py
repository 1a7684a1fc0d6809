"""Compiling a generated solver, and finding it again: a cache of shared objects keyed by everything that matters."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from mpcoffline.errors import MPCOfflineError

from .bounded import MEMORY, ran_out, run_bounded

logger = logging.getLogger(__name__)

# -ffast-math would set flush-to-zero for the whole process and drop the NaN checks; these do neither. A model's
# derivatives are long straight lines of code, which scheduling by register pressure makes 15 % faster. Loops over
# states and inputs are so short that unrolling all of them pays, nested ones too.
FLAGS = (
    "-std=gnu11",
    "-O3",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fschedule-insns",
    "-fsched-pressure",
    "--param=max-completely-peeled-insns=1000",
    "-march=native",
)
_TIMEOUT = 300.0
_SCRATCH = ".build-"


class CompilerError(MPCOfflineError, RuntimeError):
    """There is no working C compiler."""


def cache_folder() -> Path:
    """Where compiled solvers are kept: ``$MPCOFFLINE_CACHE``, else ``mpcoffline`` in the user's cache folder."""
    if "MPCOFFLINE_CACHE" in os.environ:
        return Path(os.environ["MPCOFFLINE_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mpcoffline"


def compiled(source: str) -> ctypes.CDLL:
    """The shared library of a C source, compiled unless the cache has it.

    The key holds the source, the flags, and the compiler with the processor features that it targets. A library is
    built in a temporary folder, sealed with a digest and renamed, so that processes may build the same one at once and
    an interrupted or damaged one is never loaded.

    Raises:
        CompilerError: If there is no compiler, or it fails.
    """
    compiler = find_compiler()
    flags, target = _target(compiler)
    key = hashlib.sha256("\0".join([source, *flags, target]).encode()).hexdigest()[:24]
    folder = cache_folder()
    library = folder / f"ddp-{key}.so"
    try:
        if library.exists():
            if _is_sealed(library):
                return ctypes.CDLL(str(library))
            logger.warning("Rebuilding the damaged solver %s.", library)
        folder.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(folder)
        with tempfile.TemporaryDirectory(dir=folder, prefix=_SCRATCH) as scratch:
            built = _build(compiler, flags, source, Path(scratch))
            loaded = ctypes.CDLL(str(built))
            os.replace(built, library)
            return loaded
    except OSError as error:
        logger.warning("The cache folder %s cannot be used (%s): compiling in each process.", folder, error)
    try:
        with tempfile.TemporaryDirectory(prefix="mpcoffline-") as scratch:
            return ctypes.CDLL(str(_build(compiler, flags, source, Path(scratch))))
    except OSError as error:
        raise _failure(compiler, str(error)) from error


def find_compiler() -> str:
    """The C compiler: ``$CC``, else ``cc``, ``gcc`` or ``clang``.

    Raises:
        CompilerError: If there is none.
    """
    candidates = [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]
    for candidate in candidates:
        path = shutil.which(candidate)
        if path:
            return path
    raise CompilerError(
        "C compiler",
        expected=f"one of {', '.join(candidates)} on the PATH",
        actual="none",
        hint="Install gcc or clang.",
    )


@functools.cache
def _target(compiler: str) -> tuple[tuple[str, ...], str]:
    """The flags that a compiler takes, and what it targets.

    The target are its predefined macros: they name its version and every processor feature that it will use.
    """
    macros = ("-dM", "-E", "-x", "c", os.devnull)
    for flags in (FLAGS, tuple(flag for flag in FLAGS if flag != "-march=native")):
        done = _run(compiler, *(flag for flag in flags if flag.startswith("-march")), *macros)
        if not done.returncode:
            return flags, compiler + "\n" + "\n".join(sorted(done.stdout.splitlines()))
    raise _failure(compiler, done.stderr)


def _build(compiler: str, flags: tuple[str, ...], source: str, scratch: Path) -> Path:
    """Compiles in a scratch folder and seals the result."""
    code, built = scratch / "solver.c", scratch / "solver.so"
    code.write_text(source, encoding="utf-8")
    done = _run(compiler, *flags, str(code), "-o", str(built), "-lm")
    if ran_out(done):
        raise _too_large(compiler, done.stderr)
    if done.returncode or not built.exists():
        raise _failure(compiler, done.stderr or "no output")
    with built.open("r+b") as file:
        digest = hashlib.sha256(file.read()).digest()
        file.write(digest)  # after the end of the object, where no loader looks
    return built


def _is_sealed(library: Path) -> bool:
    """Whether a library is as :func:`_build` left it; loading a truncated one would crash the process."""
    content = library.read_bytes()
    return hashlib.sha256(content[:-32]).digest() == content[-32:]


def _remove_abandoned(folder: Path) -> None:
    """Removes what interrupted builds left behind more than an hour ago."""
    for scratch in folder.glob(_SCRATCH + "*"):
        with contextlib.suppress(OSError):
            if time.time() - scratch.stat().st_mtime > 3600.0:
                shutil.rmtree(scratch)


def _run(compiler: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return run_bounded([compiler, *arguments], timeout=_TIMEOUT)
    except subprocess.TimeoutExpired as error:
        raise _too_large(compiler, "") from error
    except OSError as error:  # e.g. a file that is no program
        raise _failure(compiler, str(error)) from error


def _too_large(compiler: str, message: str) -> CompilerError:
    bounds = f"no result within {_TIMEOUT:.0f} s and {MEMORY >> 30} GiB"
    return CompilerError(
        f"C compiler {compiler}",
        expected="a compiled solver",
        actual=f"{bounds} {message.strip()[-300:]}".strip(),
        hint="The model is too large for this compiler: use the solver ipopt, which needs none.",
    )


def _failure(compiler: str, message: str) -> CompilerError:
    return CompilerError(
        f"C compiler {compiler}",
        expected="a compiled solver",
        actual=message.strip()[:500],
        hint="Set CC to another one.",
    )
