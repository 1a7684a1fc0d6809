"""Recording, storing and reading transitions."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .cleaning import CleaningReport, Waste, clean
    from .collection import collect
    from .hub import download_dataset, upload_dataset
    from .interop import to_d3rlpy, to_dict, to_sb3_replay_buffer, to_torchrl
    from .logs import dataset_from_arrays, from_csv, record
    from .minari_store import list_datasets, load_dataset
    from .recorder import MinariRecorder
    from .repairing import RepairReport, repair
    from .replaying import ReplayReport, replay
    from .summary import Summary, show
    from .transitions import TransitionTable
    from .verification import VerifyReport, verify

__all__ = [
    "CleaningReport",
    "MinariRecorder",
    "RepairReport",
    "ReplayReport",
    "Summary",
    "TransitionTable",
    "VerifyReport",
    "Waste",
    "clean",
    "collect",
    "dataset_from_arrays",
    "download_dataset",
    "from_csv",
    "list_datasets",
    "load_dataset",
    "record",
    "repair",
    "replay",
    "show",
    "to_d3rlpy",
    "to_dict",
    "to_sb3_replay_buffer",
    "to_torchrl",
    "upload_dataset",
    "verify",
]

# Loaded when first used: the recorder needs Stable-Baselines3 and with it torch, seconds of importing.
_HOMES = {
    "CleaningReport": "cleaning",
    "MinariRecorder": "recorder",
    "RepairReport": "repairing",
    "ReplayReport": "replaying",
    "Summary": "summary",
    "TransitionTable": "transitions",
    "VerifyReport": "verification",
    "Waste": "cleaning",
    "clean": "cleaning",
    "collect": "collection",
    "dataset_from_arrays": "logs",
    "download_dataset": "hub",
    "from_csv": "logs",
    "list_datasets": "minari_store",
    "load_dataset": "minari_store",
    "record": "logs",
    "repair": "repairing",
    "replay": "replaying",
    "show": "summary",
    "to_d3rlpy": "interop",
    "to_dict": "interop",
    "to_sb3_replay_buffer": "interop",
    "to_torchrl": "interop",
    "upload_dataset": "hub",
    "verify": "verification",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
