"""A tiny MPC to compile, and programs to be $CC."""

from __future__ import annotations

from pathlib import Path

from mpcoffline.mpc import MPC, Model, QuadraticCost

STATE = [[1.5]]


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
