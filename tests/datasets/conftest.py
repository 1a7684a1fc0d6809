"""A Minari store of its own for every test."""

from own_store import machine, store

__all__ = ["machine", "store"]
