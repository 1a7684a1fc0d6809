"""What all tests share."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rich
from hypothesis import settings

# Equal runs give equal results, and a busy machine fails no test.
settings.register_profile("suite", deadline=None, derandomize=True, database=None, max_examples=60)
settings.load_profile("suite")

# No test asks a remote that the user has configured.
os.environ.pop("MINARI_REMOTE", None)


@pytest.fixture
def shipped(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store that tests share which only read shipped data sets: each is unpacked once, by whoever comes first."""
    base = tmp_path_factory.getbasetemp()
    store = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shipped"
    store.mkdir(exist_ok=True)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(store))
    return store


@pytest.fixture(autouse=True, scope="module")
def compiled_lightly(request: pytest.FixtureRequest) -> Iterator[None]:
    """Solvers are compiled at -O1, in half the time; tests/solvers/ddp and tests/studies have them as shipped."""
    build = sys.modules.get("mpcoffline.solvers.ddp.build")  # imported by whatever compiles, and by nothing else
    if build is None or {"ddp", "studies"} & set(request.path.parts):
        yield
        return
    from compiling import LIGHT_FLAGS, compiled_with

    with compiled_with(LIGHT_FLAGS):
        yield


@pytest.fixture(autouse=True)
def console() -> None:
    """The command line sends progress to stderr, for good in its process: each test begins as a user's program."""
    rich.reconfigure()


# Where a shell starts the tests in the background, Ctrl-C is ignored, and what it does could not be tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
