"""Recording, storing and reading transitions."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .collection import collect
    from .logs import dataset_from_arrays, from_csv, record
    from .minari_store import list_datasets, load_dataset
    from .recorder import MinariRecorder
    from .repairing import RepairReport, repair
    from .transitions import TransitionTable

__all__ = [
    "MinariRecorder",
    "RepairReport",
    "TransitionTable",
    "collect",
    "dataset_from_arrays",
    "from_csv",
    "list_datasets",
    "load_dataset",
    "record",
    "repair",
]

# Loaded when first used: the recorder needs Stable-Baselines3 and with it torch, seconds of importing.
_HOMES = {
    "MinariRecorder": "recorder",
    "RepairReport": "repairing",
    "TransitionTable": "transitions",
    "collect": "collection",
    "dataset_from_arrays": "logs",
    "from_csv": "logs",
    "list_datasets": "minari_store",
    "load_dataset": "minari_store",
    "record": "logs",
    "repair": "repairing",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
