"""Compiling a generated solver, and finding it again: a cache of shared objects keyed by everything that matters."""

from __future__ import annotations

import ctypes
import errno
import functools
import hashlib
import itertools
import logging
import os
import shlex
import shutil
import subprocess
import tempfile
from concurrent.futures import Future
from pathlib import Path

from mpcoffline.core.caches import mark_used, trim
from mpcoffline.core.errors import MPCOfflineError, StorageError
from mpcoffline.core.places import cache_folders, open_own, warn_once
from mpcoffline.core.scratch import scratch_folder

from .bounded import MEMORY, ran_out, run_bounded

logger = logging.getLogger(__name__)

# -ffast-math would set flush-to-zero for the whole process and drop the NaN checks; these do neither. A model's
# derivatives are long straight lines of code, which scheduling by register pressure makes 15 % faster. Loops over
# states and inputs are so short that unrolling all of them pays, nested ones too. Vectors are written out: looking for
# loops that could be some takes a quarter of the time that compiling takes, for one or two percent of a solve's; a fit
# compiles dozens. A compiler that does not know one of these flags, as clang, goes without it.
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
    "-fno-tree-loop-vectorize",
    "-march=native",
)
# Some processors had rather have two halves of such a vector. Up to version 14, clang then lets one function hand over
# halves where another expects the whole: wrong numbers.
_CLANG_AVX512 = ("-mprefer-vector-width=512",)
_TIMEOUT = 300.0
_KIND = "solvers"
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_ENOUGH = 1 << 24  # bytes, for what a compiler writes
# What the generated code needs of a compiler beyond C: vectors whose operators and elements work.
_TRIAL = """
typedef double vd __attribute__((vector_size(16)));
typedef long long vl __attribute__((vector_size(16)));
int trial(double a) { vd v = a - (vd){0}; vl m = v < 2.0 * v; return m[0] && v[1] > 0.0; }
"""
_loads = itertools.count()


class CompilerError(MPCOfflineError, RuntimeError):
    """There is no working C compiler."""


#: Sources that are compiled in the background; see :mod:`.ahead`.
underway: dict[str, Future[ctypes.CDLL]] = {}


def compiled(source: str) -> ctypes.CDLL:
    """The shared library of a C source, compiled unless the cache has it, or it is being compiled.

    Raises:
        CompilerError: If there is no compiler, or none that works, or a working one fails.
    """
    begun = underway.get(source)
    # One that waits for its turn is not waited for.
    return compiled_here(source) if begun is None or begun.cancel() else begun.result()


def compiled_here(source: str) -> ctypes.CDLL:
    """The shared library of a C source, compiled unless the cache has it.

    The key holds the source, the flags, and the compiler with the processor features that it targets. A library is
    built in a temporary folder, sealed with a digest and renamed, so that processes may build the same one at once and
    an interrupted or damaged one is never loaded; nor is one that another user could have written. A compiler that
    cannot compile anything of this kind is passed over for the next, with a warning.

    Raises:
        CompilerError: If there is no compiler, or none that works, or a working one fails.
    """
    refusals: list[str] = []
    for compiler in compilers():
        try:
            library = _compiled_by(compiler, source)
        except CompilerError as error:
            full = error.actual in {os.strerror(code) for code in _NO_ROOM}  # for the next one, too
            reason = "" if full else trial(compiler)
            if not reason:
                raise
            refusals.append(f"{compiler} cannot compile vectors of doubles ({reason.splitlines()[0]})")
            continue
        if refusals:
            warn_once(f"Compiling with {compiler}, as {'; '.join(refusals)}.")
        return library
    raise CompilerError(
        "C compiler",
        expected="one that works: in CC, or cc, gcc or clang on the PATH",
        actual="; ".join(refusals) or "none",
        hint="Install gcc or clang, or set CC to one.",
    )


def compilers() -> list[str]:
    """The C compilers that are there, as command lines: ``$CC``, which may have arguments, then cc, gcc and clang."""
    found = [path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))]
    given = os.environ.get("CC", "").strip()
    if not given:
        return [shlex.quote(path) for path in found]
    try:
        words = [given] if shutil.which(given) else shlex.split(given)
    except ValueError:  # a quotation mark without its other
        words = []
    program = shutil.which(words[0]) if words else None
    if program:
        return [shlex.join([program, *words[1:]]), *(shlex.quote(path) for path in found)]
    if found:
        warn_once(f"CC={given!r} names no program on the PATH: {found[0]} is taken.")
    return [shlex.quote(path) for path in found]


def find_compiler() -> str:
    """The first of :func:`compilers`.

    Raises:
        CompilerError: If there is none.
    """
    for compiler in compilers():
        return compiler
    raise CompilerError(
        "C compiler",
        expected="CC, or one of cc, gcc, clang on the PATH",
        actual="none",
        hint="Install gcc or clang, or set CC to one.",
    )


def flags_of(compiler: str) -> tuple[str, ...]:
    """Those of :data:`FLAGS` that a compiler takes.

    Raises:
        CompilerError: If it does not answer.
    """
    return _target(compiler)[0]


@functools.cache
def trial(compiler: str) -> str:
    """Why a compiler cannot compile solvers at all, in words; empty if it can."""
    try:
        flags, _ = _target(compiler)
        with tempfile.TemporaryDirectory(prefix="mpcoffline-") as folder:
            ctypes.CDLL(str(_output(compiler, flags, _TRIAL, Path(folder))))
    except CompilerError as error:
        return error.actual
    except OSError as error:
        return str(error)
    return ""


def _compiled_by(compiler: str, source: str) -> ctypes.CDLL:
    """The library, by one compiler: from the cache, else built there, else, where there is no room, elsewhere."""
    flags, target = _target(compiler)
    key = hashlib.sha256("\0".join([source, *flags, target]).encode()).hexdigest()[:24]
    name, failure = f"ddp-{key}.so", "no folder"
    try:
        for folder in cache_folders(_KIND):
            try:
                return _loaded(folder / name, name) or _built(compiler, flags, source, folder / name)
            except OSError as error:
                failure = error.strerror or str(error)
                warn_once(f"The cache folder {folder} cannot be used ({failure}).")
    except StorageError as error:
        failure = str(error)
    hint = "Free some space, or set MPCOFFLINE_CACHE to a folder of yours where there is room for it."
    raise _failure(compiler, failure, hint)


@functools.cache
def _target(compiler: str) -> tuple[tuple[str, ...], str]:
    """The flags that a compiler takes, and what it targets.

    The target are its predefined macros: they name its version and every processor feature that it will use.
    """

    def macros(*flags: str) -> subprocess.CompletedProcess[str]:
        return _run(compiler, *flags, "-dM", "-E", "-x", "c", os.devnull)

    flags: tuple[str, ...] = FLAGS
    done = macros(*flags)
    if done.returncode:
        flags = tuple(flag for flag in FLAGS if not macros(flag).returncode)
        done = macros(*flags)
    if done.returncode:
        raise _failure(compiler, done.stderr)
    if "__clang__" in done.stdout and "__AVX512F__" in done.stdout:
        flags += _CLANG_AVX512
    return flags, compiler + "\n" + "\n".join(sorted(done.stdout.splitlines()))


def _built(compiler: str, flags: tuple[str, ...], source: str, library: Path) -> ctypes.CDLL:
    """Compiles in a scratch folder, seals the result, loads it and puts it into the cache."""
    with scratch_folder(library.parent) as scratch:
        built = _output(compiler, flags, source, scratch)
        built.chmod(0o700)
        with built.open("r+b") as file:
            file.write(_seal(file.read(), library.name))  # after the end of the object, where no loader looks
        loaded = _loaded(built, library.name)
        if loaded is None:
            raise OSError(f"{built} is not what was written")
        os.replace(built, library)
    trim(keep=library)
    return loaded


def _output(compiler: str, flags: tuple[str, ...], source: str, scratch: Path) -> Path:
    """What a compiler makes of a source that it reads from a pipe, in a folder that is its alone."""
    built = scratch / "solver.so"
    done = _run(compiler, *flags, "-x", "c", "-", "-o", str(built), "-lm", source=source, scratch=scratch)
    if not done.returncode and built.exists():
        return built
    if not _has_room(scratch, done.stderr):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(scratch))
    if ran_out(done):
        raise _too_large(compiler, done.stderr)
    raise _failure(compiler, done.stderr or "no output")


def _has_room(folder: Path, stderr: str) -> bool:
    """Whether a compiler failed for another reason than a full disk, a quota or a limit of files' sizes."""
    if any(os.strerror(code) in stderr for code in _NO_ROOM):
        return False
    try:
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            return file.write(bytes(_ENOUGH)) == _ENOUGH
    except OSError:
        return False


def _seal(content: bytes, name: str) -> bytes:
    """The digest of a library and the name that it has in the cache."""
    return hashlib.sha256(content + name.encode()).digest()


def _loaded(library: Path, name: str) -> ctypes.CDLL | None:
    """The library, if it is there and as :func:`_built` left it; loading a truncated one would crash the process.

    Raises:
        OSError: If the system does not load it.
    """
    try:
        descriptor = open_own(library)
    except FileNotFoundError:
        return None
    except OSError as error:
        logger.warning("A solver in the cache is not used, but built again: %s.", error)
        return None
    with os.fdopen(descriptor, "rb") as file:
        content = file.read()
        if content[-32:] != _seal(content[:-32], name):
            logger.warning("Rebuilding the damaged solver %s.", library)
            return None
        mark_used(library)
        return ctypes.CDLL(_name_of(descriptor) or str(library))


def _name_of(descriptor: int) -> str:
    """A path of the open file itself, which nobody can exchange; empty where the system has none.

    The loader takes equal paths for the same library, and descriptors are used again. So each has its own turns in it,
    the digits of a number: ``/`` and ``/.`` lead nowhere.
    """
    turns = "".join("/." if digit == "1" else "/" for digit in f"{next(_loads):b}")
    path = f"/proc/self/fd{turns}/{descriptor}"
    return path if os.path.exists(path) else ""


def _run(
    compiler: str, *arguments: str, source: str = "", scratch: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a compiler; its messages are English, its temporary files in the scratch folder."""
    environment = os.environ | {"LC_ALL": "C"} | ({} if scratch is None else {"TMPDIR": str(scratch)})
    try:
        bounded = [*shlex.split(compiler), *arguments]
        return run_bounded(bounded, timeout=_TIMEOUT, source=source, env=environment)
    except subprocess.TimeoutExpired as error:
        raise _too_large(compiler, "") from error
    except BrokenPipeError as error:  # a program that reads nothing
        raise _failure(compiler, "no output") from error
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


def _failure(compiler: str, message: str, hint: str = "Set CC to another one.") -> CompilerError:
    return CompilerError(
        f"C compiler {compiler}",
        expected="a compiled solver",
        actual=message.strip()[:500] or "no message",
        hint=hint,
    )
