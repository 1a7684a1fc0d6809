"""What makes data sets: recipes, the agents that they train, and the cards that describe what came of it."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
