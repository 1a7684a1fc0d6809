"""A tiny MPC to compile, quickly where its speed does not matter, and programs to be $CC."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers.ddp import build

STATE = [[1.5]]
SHIPPED_FLAGS = build.FLAGS
LIGHT_FLAGS = tuple("-O1" if flag == "-O3" else flag for flag in SHIPPED_FLAGS)
QUICK_FLAGS = tuple("-O0" if flag == "-O3" else flag for flag in SHIPPED_FLAGS)


_REMEMBERED = (build._target, build.trial)


@contextmanager
def compiled_with(flags: tuple[str, ...]) -> Iterator[None]:
    """Solvers are compiled with these flags."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "FLAGS", flags)
        for answers in _REMEMBERED:
            answers.cache_clear()
        yield
    for answers in _REMEMBERED:
        answers.cache_clear()


def tiny(weight: float = 1.0, factor: float = 1.0) -> MPC:
    """x+ = factor x + u, N = 2: compiled in a second."""
    model = Model(lambda x, u, p: factor * x + u, 1, 1, 1.0, discrete=True)
    return MPC(model, QuadraticCost([[weight]], [[1.0]]), QuadraticCost([[2.0]]), 2, 0.9, [-1.0], [1.0])


def libraries(folder: Path) -> list[Path]:
    """The compiled solvers in a folder."""
    return sorted(folder.glob("*.so"))


def compiler_script(folder: Path, text: str) -> str:
    """A program to be $CC."""
    path = folder / "fake-cc"
    path.write_text(text)
    path.chmod(0o755)
    return str(path)
