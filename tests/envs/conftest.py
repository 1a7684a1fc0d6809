"""Windows that are opened here are not shown, and nobody waits for what nobody sees."""

from __future__ import annotations

from importlib.util import find_spec

import pytest


class Hurried:
    """A clock at which every frame is late."""

    def tick(self, frames_a_second: int) -> int:
        return 0


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    if find_spec("pygame"):
        monkeypatch.setattr("pygame.time.Clock", Hurried)
