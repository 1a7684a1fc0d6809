"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .check.cleaning import CleaningReport as CleaningReport, Waste as Waste, clean as clean
from .check.repairing import RepairReport as RepairReport, repair as repair
from .check.replaying import ReplayReport as ReplayReport, replay as replay
from .check.summary import Summary as Summary, show as show
from .hub.loading import load_dataset as load_dataset
from .hub.transfer import download_dataset as download_dataset, upload_dataset as upload_dataset
from .interop.convert import (
    to_d3rlpy as to_d3rlpy,
    to_dict as to_dict,
    to_sb3_replay_buffer as to_sb3_replay_buffer,
    to_torchrl as to_torchrl,
)
from .interop.episodes import from_episodes as from_episodes
from .interop.from_buffers import (
    from_d3rlpy as from_d3rlpy,
    from_dict as from_dict,
    from_sb3_replay_buffer as from_sb3_replay_buffer,
    from_torchrl as from_torchrl,
)
from .interop.from_steps import from_do_mpc as from_do_mpc, from_lerobot as from_lerobot, from_rlds as from_rlds
from .recording.from_arrays import (
    dataset_from_arrays as dataset_from_arrays,
    dataset_from_table as dataset_from_table,
)
from .recording.from_csv import from_csv as from_csv
from .recording.recorder import MinariRecorder as MinariRecorder
from .recording.rollouts import record as record
from .store.local import list_datasets as list_datasets
from .store.verification import VerifyReport as VerifyReport, verify as verify
from .table.parquet import parquet_sources as parquet_sources, read_parquet as read_parquet
from .table.sharding import write_shards as write_shards
from .table.shards import ShardedTable as ShardedTable
from .table.transitions import TransitionTable as TransitionTable
