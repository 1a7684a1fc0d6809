"""Names that may stand in files, and text made safe for where it goes: one function for each place."""

from __future__ import annotations
