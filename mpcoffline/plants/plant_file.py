"""Plant files: Python programs of the user's own that describe a plant. They are the one thing here that runs code."""

from __future__ import annotations

import ast
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from mpcoffline.core.errors import InvalidDataError, MPCOfflineError, StorageError

from .black_box import BlackBoxPlant
from .description import Plant


def load_plant(path: str | Path) -> Plant:
    """Runs a plant file and takes the :class:`~mpcoffline.Plant` that it defines.

    It runs with all that your user may do: load your own files only.

    Args:
        path: The file, Python. Of several plants in it the one that is called ``plant`` counts.

    Raises:
        StorageError: If it cannot be read.
        InvalidDataError: If it is no Python, raises an error (named with its line), or defines no plant with equations.
    """
    plant = load_description(path)
    if isinstance(plant, BlackBoxPlant):
        hint = "`mpcoffline check` and `tune` find a model in a log; in Python: plant.modelled(plant.read(log))."
        raise InvalidDataError(str(path), expected="a Plant, with equations", actual="a BlackBoxPlant", hint=hint)
    return plant


def load_description(path: str | Path) -> Plant | BlackBoxPlant:
    """Runs a plant file as :func:`~mpcoffline.load_plant` does, and takes a plant without equations, too.

    Args:
        path: The file.

    Raises:
        StorageError: As :func:`~mpcoffline.load_plant`.
        InvalidDataError: Likewise, but for a plant without equations.
    """
    file = Path(path)
    module = run_plant_file(file)
    found = {name: value for name, value in vars(module).items() if isinstance(value, Plant | BlackBoxPlant)}
    plant = found.get("plant") or (next(iter(found.values())) if len(set(map(id, found.values()))) == 1 else None)
    if plant is None:
        hint = "Write `plant = Plant(...)` into it; `mpcoffline new FILE.py` makes a file to begin with."
        actual = f"{len(found)}: {', '.join(found)}" if found else "none"
        raise InvalidDataError(str(path), expected="one mpcoffline.Plant, called plant", actual=actual, hint=hint)
    return plant


def run_plant_file(path: Path) -> ModuleType:
    """Runs a Python file of the user's.

    Args:
        path: The file; modules beside it can be imported.

    Raises:
        StorageError: If it cannot be read.
        InvalidDataError: If it is no Python, or raises an error; names the line.
    """
    parsed(path)
    spec = importlib.util.spec_from_file_location(f"plant_file_{path.stem}", path.resolve())
    if spec is None or spec.loader is None:
        raise InvalidDataError(str(path), expected="a Python file, its name ending in .py", actual=path.name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    folder = str(path.resolve().parent)
    sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except MPCOfflineError as error:
        name = error.name if f"{path.name}, line" in error.name else f"{_place(path, error)}: {error.name}"
        raise InvalidDataError(name, expected=error.expected, actual=error.actual, hint=error.hint) from error
    except Exception as error:
        actual = f"{type(error).__name__}: {error}"
        raise InvalidDataError(_place(path, error), expected="a program that runs", actual=actual) from error
    finally:
        sys.path.remove(folder)
    return module


def parsed(path: Path) -> ast.AST:
    """The file's syntax tree.

    Raises:
        StorageError: If it cannot be read.
        InvalidDataError: If it is no Python.
    """
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StorageError(str(path), expected="a plant file", actual=error.strerror or str(error)) from error
    except SyntaxError as error:
        where = f"{path.name}, line {error.lineno}"
        raise InvalidDataError(where, expected="Python", actual=error.msg) from error
    except ValueError as error:
        raise InvalidDataError(str(path), expected="a Python file", actual=str(error)) from error


def _place(path: Path, error: BaseException) -> str:
    """File and line that an error comes from."""
    own = str(path.resolve())
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
    return f"{path.name}, line {lines[-1]}" if lines else path.name
