"""From a data set to a policy: the learner, its presets, and what it writes down meanwhile."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
