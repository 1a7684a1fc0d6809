"""Compiling a generated solver, and finding it again: a cache of shared objects keyed by everything that matters."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from mpcoffline.errors import MPCOfflineError

logger = logging.getLogger(__name__)

# -ffast-math would set flush-to-zero for the whole process and drop the NaN checks; these do neither. A model's
# derivatives divide by the same few numbers again and again: -freciprocal-math divides once and multiplies; and they
# are long straight lines of code, which scheduling by register pressure makes 15 % faster.
FLAGS = (
    "-std=gnu11",
    "-O3",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-freciprocal-math",
    "-fschedule-insns",
    "-fsched-pressure",
    "-march=native",
)
_TIMEOUT = 300.0


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
    built in a temporary file and renamed, so that processes may build the same one at once.

    Raises:
        CompilerError: If there is no compiler, or it fails.
    """
    compiler = find_compiler()
    key = hashlib.sha256("\0".join([source, *FLAGS, _target(compiler)]).encode()).hexdigest()[:24]
    folder = cache_folder()
    library = folder / f"ddp-{key}.so"
    if library.exists():
        try:
            return ctypes.CDLL(str(library))
        except OSError:  # damaged, e.g. by a full disk: build it again
            logger.warning("Rebuilding the damaged solver %s.", library)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as scratch:
            return _built(compiler, source, Path(scratch), library)
    except PermissionError:
        logger.warning("The cache folder %s is read-only: this solver is compiled again in each process.", folder)
    except OSError as error:
        logger.warning("The cache folder %s cannot be used (%s): compiling without it.", folder, error)
    with tempfile.TemporaryDirectory(prefix="mpcoffline-") as scratch:
        return _built(compiler, source, Path(scratch), None)


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
def _target(compiler: str) -> str:
    """The compiler's predefined macros: they name its version and every processor feature it will use."""
    command = [compiler, "-march=native", "-dM", "-E", "-x", "c", os.devnull]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    if done.returncode:
        raise _failure(compiler, done.stderr)
    return compiler + "\n" + "\n".join(sorted(done.stdout.splitlines()))


def _built(compiler: str, source: str, scratch: Path, library: Path | None) -> ctypes.CDLL:
    """Compiles in a scratch folder and moves the result into the cache."""
    code, built = scratch / "solver.c", scratch / "solver.so"
    code.write_text(source, encoding="utf-8")
    command = [compiler, *FLAGS, str(code), "-o", str(built), "-lm"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    except subprocess.TimeoutExpired as error:
        raise _failure(compiler, f"no result after {_TIMEOUT:.0f} s") from error
    if done.returncode:
        raise _failure(compiler, done.stderr)
    if library is not None:
        os.replace(built, library)
        built = library
    return ctypes.CDLL(str(built))


def _failure(compiler: str, message: str) -> CompilerError:
    return CompilerError(
        f"C compiler {compiler}",
        expected="a compiled solver",
        actual=message.strip()[:500],
        hint="Set CC to another one.",
    )
