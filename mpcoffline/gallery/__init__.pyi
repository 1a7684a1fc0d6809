"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .collection import collect as collect
