"""What all tests share."""

from __future__ import annotations

import os
import signal

import pytest
import rich
from hypothesis import settings

# Equal runs give equal results, and a busy machine fails no test.
settings.register_profile("suite", deadline=None, derandomize=True, database=None, max_examples=60)
settings.load_profile("suite")

# No test asks a remote that the user has configured.
os.environ.pop("MINARI_REMOTE", None)


@pytest.fixture(autouse=True)
def console() -> None:
    """The command line sends progress to stderr, for good in its process: each test begins as a user's program."""
    rich.reconfigure()


# Where a shell starts the tests in the background, Ctrl-C is ignored, and what it does could not be tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
