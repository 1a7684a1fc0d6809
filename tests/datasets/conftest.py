"""A Minari store of its own for every test."""

from own_store import store

__all__ = ["store"]
