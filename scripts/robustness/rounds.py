"""One interruption at a time: processes that are killed, and what must hold of what they leave."""

from __future__ import annotations

import os
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpcoffline.core.errors import MPCOfflineError

from .recordings import (
    ID,
    PROMISES,
    Found,
    check_set,
    leftovers,
)  # fmt: skip

Job = Callable[[], object]


@dataclass
class Ended:
    """How a process ended.

    Attributes:
        code: Its status, as ``waitpid`` gives it.
        error: What it raised.
        text: What it wrote.
    """

    code: int
    error: str = ""
    text: str = ""

    @property
    def crashed(self) -> str:
        """The signal of a crash; empty where it ended in order or was killed from here."""
        if os.WIFSIGNALED(self.code):
            name = signal.Signals(os.WTERMSIG(self.code)).name
            return "" if name in ("SIGKILL", "SIGINT", "SIGTERM") else name
        return ""


@dataclass
class Round:
    """One case: a seed of its own, a folder of its own, and what was found.

    Attributes:
        rng: Draws its moments.
        folder: Where its store and caches lie.
        found: What it came to.
    """

    rng: random.Random
    folder: Path
    found: Found = field(default_factory=Found)

    def problem(self, text: str) -> None:
        """Notes what is wrong."""
        self.found.problems.append(text)

    # --- processes ------------------------------------------------------------------------------------------------

    def start(self, job: Job, before: Job | None = None) -> int:
        """A process that does a job; ``before`` sets it up."""
        said = self.folder / "said"
        child = os.fork()
        if child:
            return child
        code = 3
        try:
            os.setsid()
            output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            os.chdir(self.folder)
            warnings.simplefilter("ignore")
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if before is not None:
                before()
            job()
            code = 0
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except KeyboardInterrupt:
            code = 130
        except MPCOfflineError as error:
            code = 1
            os.write(2, f"NAMED {type(error).__name__}: {error}\n".encode(errors="replace"))
        except BaseException:
            os.write(2, f"RAW {traceback.format_exc()}\n".encode(errors="replace"))
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)
        return 0

    def wait(self, child: int) -> Ended:
        """Waits for its end."""
        code = os.waitpid(child, 0)[1]
        text = (self.folder / "said").read_text(errors="replace") if (self.folder / "said").exists() else ""
        lines = [line for line in text.splitlines() if line.strip()]
        named = next((line[6:] for line in lines if line.startswith("NAMED ")), "")
        raw = "RAW " + lines[-1] if any(line.startswith("RAW ") for line in lines) else ""
        ended = Ended(code, named or raw, text)
        if ended.crashed:
            self.problem(f"crash: {ended.crashed}")
        elif raw:
            self.problem(f"raw error: {lines[-1][:200]}")
        return ended

    def run(self, job: Job, before: Job | None = None) -> Ended:
        """Does a job to its end in a process of its own."""
        return self.wait(self.start(job, before))

    def killed(
        self,
        job: Job,
        until: bytes | Callable[[], bool] = b"",
        within: float = 0.3,
        number: int = signal.SIGKILL,
    ) -> Ended:
        """Does a job and kills it, some time after it has said something, or at one of its calls of a C function.

        Args:
            job: The job.
            until: What begins the time: a letter that is said, or something that is true.
            within: The time is drawn from 0 to so many seconds.
            number: The signal.
        """
        if number == signal.SIGKILL and isinstance(until, bytes) and self.rng.random() < 0.4:
            last = int(10 ** self.rng.uniform(*((2.5, 5.3) if until == b"b" else (1.0, 4.8))))
            return self.run(job, lambda: _kill_at_call(last, until))
        child, delay = self.start(job), self.rng.uniform(0, within)
        gone = 0
        while until and not gone and not (until() if callable(until) else PROMISES.said == until):
            gone = os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
            time.sleep(0.0005)
        end = time.monotonic() + delay
        while time.monotonic() < end and not gone:
            gone = os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
            time.sleep(0.0005)
        os.killpg(os.getpgid(child), number) if os.getpgid(child) == child else os.kill(child, number)
        return self.wait(child)

    # --- what must hold afterwards --------------------------------------------------------------------------------

    def repaired(self) -> Ended:
        """Repairs, where there is anything."""
        from mpcoffline.core.errors import UnknownIdError
        from mpcoffline.datasets import repair

        def job() -> None:
            with suppress(UnknownIdError):
                repair(ID)

        ended = self.run(job)
        if ended.error and "at least one transition" not in ended.error:  # killed before the first episode
            self.problem(f"repair: {ended.error[:200]}")
        return ended

    def check(self, promised: set[int], allowed: set[int] | None = None, *, after: bool = True) -> None:
        """Compares the data set with what was promised, and looks for what is left over."""
        try:
            found = check_set(promised, allowed=allowed)
        except Exception as error:
            found = Found(len(promised), 0, [f"wrong: the data set cannot be read: {error!r:.200}"])
        self.found.promised += found.promised
        self.found.stored += found.stored
        self.found.problems += found.problems
        if after:
            self.swept()

    def swept(self) -> None:
        """Nothing hidden stays behind, once it is asked to clean up."""
        if leftovers():
            self.run(clean)
        if left := leftovers():
            self.problem(f"left: {', '.join(left)[:200]}")


def clean() -> None:
    """``mpcoffline clean --yes``."""
    command("clean", "--yes")


def command(*words: str) -> None:
    """A command of the package, in this process."""
    from mpcoffline.cli.main import app

    app(list(words))


def _kill_at_call(number: int, until: bytes) -> None:
    """Kills this process at one of its calls of a C function, counted from a letter on."""
    count = 0

    def profile(frame: Any, event: str, argument: Any) -> None:
        nonlocal count
        if event == "c_call" and (not until or count or PROMISES.said == until):
            count += 1
            if count >= number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(profile)
