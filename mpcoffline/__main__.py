"""``python -m mpcoffline``: the command line."""

from __future__ import annotations

from mpcoffline.cli.main import app

if __name__ == "__main__":
    app()
