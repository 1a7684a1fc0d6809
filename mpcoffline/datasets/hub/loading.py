"""Giving a data set, wherever it is: on this machine, or on a remote."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpcoffline.datasets.store.ids import is_valid_id
from mpcoffline.datasets.store.local import is_here, open_local

from .transfer import download_dataset, find_source

if TYPE_CHECKING:
    from minari import MinariDataset


def load_dataset(dataset_id: str, *, download: bool = True) -> MinariDataset:
    """Gives a data set: out of the local Minari store, shipped with this package, or from the remote.

    A shipped data set is put into the store when it is first asked for (about two seconds); after that
    ``minari.load_dataset`` finds it without this package. A download that was finished but not yet put into the
    store needs no connection; a remote is asked only where one is configured (``MINARI_REMOTE``, or the catalogue).

    Args:
        dataset_id: Minari id, e.g. ``"mpcoffline/pendulum/ddpg-v0"``.
        download: Whether a remote may be asked.

    Raises:
        UnknownIdError: For an id that is nowhere; it names the nearest ones.
        FileFormatError: For a damaged data set, or a shipped file that does not have its sha256.
        RemoteError: Where the remote does not answer.
    """
    if download and is_valid_id(dataset_id) and not is_here(dataset_id) and find_source(dataset_id) is not None:
        return download_dataset(dataset_id)
    return open_local(dataset_id)
