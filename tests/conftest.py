"""What all tests share."""

from __future__ import annotations

import os

from hypothesis import settings

# Equal runs give equal results, and a busy machine fails no test.
settings.register_profile("suite", deadline=None, derandomize=True, database=None, max_examples=60)
settings.load_profile("suite")

# No test asks a remote that the user has configured.
os.environ.pop("MINARI_REMOTE", None)
