"""Where the package keeps what it can make again, and whom it trusts there."""

from __future__ import annotations

from pathlib import Path

import platformdirs


def cache_folder(kind: str) -> Path:
    """The folder of one kind of what can be made again, whether it exists or not.

    Args:
        kind: Its name below the package's cache, e.g. ``"tables"``.
    """
    return platformdirs.user_cache_path("mpcoffline") / kind
