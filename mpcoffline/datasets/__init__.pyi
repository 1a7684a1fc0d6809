"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .check.cleaning import CleaningReport as CleaningReport
from .check.cleaning import Waste as Waste
from .check.cleaning import clean as clean
from .check.repairing import RepairReport as RepairReport
from .check.repairing import repair as repair
from .check.replaying import ReplayReport as ReplayReport
from .check.replaying import replay as replay
from .check.summary import Summary as Summary
from .check.summary import show as show
from .hub.loading import load_dataset as load_dataset
from .hub.transfer import download_dataset as download_dataset
from .hub.transfer import upload_dataset as upload_dataset
from .interop.convert import to_d3rlpy as to_d3rlpy
from .interop.convert import to_dict as to_dict
from .interop.convert import to_sb3_replay_buffer as to_sb3_replay_buffer
from .interop.convert import to_torchrl as to_torchrl
from .recording.from_arrays import dataset_from_arrays as dataset_from_arrays
from .recording.from_csv import from_csv as from_csv
from .recording.recorder import MinariRecorder as MinariRecorder
from .recording.rollouts import record as record
from .store.local import list_datasets as list_datasets
from .store.verification import VerifyReport as VerifyReport
from .store.verification import verify as verify
from .table.transitions import TransitionTable as TransitionTable
