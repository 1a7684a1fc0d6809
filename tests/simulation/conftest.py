"""One thread, so that equal runs give equal bits on any number of cores."""

from on_one_thread import one_thread

__all__ = ["one_thread"]
