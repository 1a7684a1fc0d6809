"""A program run with bounds on its time and memory: what is compiled may come from a file."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress

MEMORY = 4 << 30  # bytes of address space; a compiler that wants more would take it from everybody
# Where a system has no such limit, as macOS for memory, the program runs without it.
_BOUNDED = 'ulimit -t "$1" 2>/dev/null; ulimit -v "$2" 2>/dev/null; shift 2; exec "$@"'


def run_bounded(
    command: Sequence[str], *, timeout: float, source: str | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a program to its end; where it is cut short, what it started ends with it.

    Args:
        command: The program and its arguments.
        timeout: Bound on its time in s, on the clock and of each of its processes.
        source: What it reads; nothing by default.
        env: Its environment; this process's by default.

    Raises:
        TimeoutExpired: If it takes longer.
    """
    bounded = ["/bin/sh", "-c", _BOUNDED, "sh", f"{timeout:.0f}", str(MEMORY >> 10), *command]
    with subprocess.Popen(
        bounded,
        stdin=subprocess.PIPE if source is not None else subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        env=env,
        start_new_session=True,
    ) as process:
        try:
            out, err = process.communicate(source, timeout)
        except BaseException:  # also Ctrl-C, which a session of its own does not get
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            raise
        return subprocess.CompletedProcess(command, process.returncode, out, err)


def ran_out(done: subprocess.CompletedProcess[str]) -> bool:
    """Whether a program ended for want of time or memory, as far as it or the system says so."""
    text = done.stderr.lower()
    signs = ("out of memory", "memory exhausted", "cannot allocate", "bad_alloc", "time limit exceeded", "killed")
    return bool(done.returncode) and (done.returncode < 0 or any(sign in text for sign in signs))
