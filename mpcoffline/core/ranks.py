"""The processes of one job, as ``torchrun`` starts them, and what they say to each other.

Sums are exact: each summand is rounded to a grid that all of them share, so coarse that float64 holds every sum of
them. Such sums do not depend on the order in which they are taken, nor on who takes them: what is learned with two
processes is what is learned with four, to the bit, by whatever algorithm the network library sums.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import MPCOfflineError

if TYPE_CHECKING:
    from torch import Tensor

#: Seconds after which a process that says nothing counts as lost.
TIMEOUT = 3_600.0
_DIGITS = 52  # of the integers that float64 sums exactly
_TYPES = "float32", "float64", "int64", "uint8", "bool"
_MOST_AXES = 4


class Ranks:
    """The processes of a job; alone, all it does is nothing.

    Args:
        rank: Which of them this is, from 0.
        size: How many there are.
    """

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.rank} of {self.size})"

    @classmethod
    def current(cls, timeout: float = TIMEOUT) -> Ranks:
        """Those that ``torchrun`` has started; this process alone where it was not started so.

        They exchange by gloo; tensors on a GPU by NCCL, each process with the GPU of its ``LOCAL_RANK``.

        Args:
            timeout: Seconds that are waited for another process, here and later.

        Raises:
            MPCOfflineError: If not all of them come.
        """
        import torch
        from torch import distributed

        if not distributed.is_available() or "WORLD_SIZE" not in os.environ:
            return cls()
        on_gpu = torch.cuda.is_available() and distributed.is_nccl_available()
        if not distributed.is_initialized():
            if on_gpu:
                torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
            with _together():
                backend = "cpu:gloo,cuda:nccl" if on_gpu else "gloo"
                distributed.init_process_group(backend, timeout=timedelta(seconds=timeout))
        return cls(distributed.get_rank(), distributed.get_world_size())

    @property
    def is_first(self) -> bool:
        """Whether this is the one that writes files and speaks."""
        return self.rank == 0

    def largest(self, numbers: Sequence[float]) -> list[float]:
        """The largest of each number over all processes; infinite where one of them is not finite."""
        import torch
        from torch import distributed

        finite = [number if math.isfinite(number) else math.inf for number in numbers]
        if self.size == 1:
            return finite
        found = torch.tensor(finite, dtype=torch.float64)
        with _together():
            distributed.all_reduce(found, distributed.ReduceOp.MAX)
        return [float(number) for number in found]

    def exact_sums(self, parts: Sequence[Sequence[Tensor]], count: int) -> list[Tensor] | None:
        """Sums over the parts of all processes, the same to the bit whoever has which part.

        ::

            sum_k step round(x_k / step),        step = 2^(e - 51) m,    2^e > max |x|,   m = 2^j >= count

        of which each summand is a whole number up to 2^51 / m, so that float64 holds all sums. What is lost of a
        summand is below 2^-51 m of the largest number of its tensor.

        Args:
            parts: Of each part of this process its tensors, as many and of the same shapes in all.
            count: How many parts there are, in all processes.

        Returns:
            A tensor in float64 for each tensor of a part, on its device; None where a number is not finite.
        """
        import torch
        from torch import distributed

        columns = list(zip(*parts, strict=True))
        sizes = self.largest([float(torch.stack([part.abs().max() for part in column]).max()) for column in columns])
        if not all(map(math.isfinite, sizes)):
            return None
        bits = _DIGITS - 1 - math.ceil(math.log2(max(count, 1)))
        steps = [math.ldexp(1.0, max(math.frexp(size)[1] - bits, -1000)) for size in sizes]
        own = [
            sum((torch.round(part.double() / step) for part in column[1:]), torch.round(column[0].double() / step))
            for column, step in zip(columns, steps, strict=True)
        ]
        if self.size > 1:
            flat = torch.cat([part.reshape(-1) for part in own])
            with _together():
                distributed.all_reduce(flat)
            own = [
                each.reshape(part.shape)
                for each, part in zip(torch.split(flat, [part.numel() for part in own]), own, strict=True)
            ]
        return [part * step for part, step in zip(own, steps, strict=True)]

    def shared(self, array: NDArray[Any] | None, owner: int) -> NDArray[Any]:
        """An array of one process, in all of them.

        Args:
            array: It, where it is; ignored elsewhere.
            owner: Who has it.
        """
        if self.size == 1:
            return np.asarray(array)
        import torch
        from torch import distributed

        mine = np.array(array, order="C") if owner == self.rank else np.empty(0)  # torch wants to be able to write
        header = torch.zeros(2 + _MOST_AXES, dtype=torch.int64)
        if owner == self.rank:
            header[: 2 + mine.ndim] = torch.tensor([_TYPES.index(str(mine.dtype)), mine.ndim, *mine.shape])
        with _together():
            distributed.broadcast(header, owner)
            kind, n_axes, *shape = header.tolist()
            found = mine if owner == self.rank else np.empty(shape[:n_axes], dtype=_TYPES[kind])
            distributed.broadcast(torch.from_numpy(found.reshape(-1).view(np.uint8)), owner)
        return found

    def check_alike(self, what: str, content: bytes) -> None:
        """Refuses to go on where processes have come apart.

        Args:
            what: What should be the same in all of them, in words.
            content: It.

        Raises:
            MPCOfflineError: If one of them has another.
        """
        digest = hashlib.sha256(content).digest()[:6]
        number = float(int.from_bytes(digest, "big"))  # 48 bits: float64 holds them
        high, low = self.largest([number, -number])
        if high != -low:
            raise MPCOfflineError(
                "processes",
                expected=f"the same {what} in all of them",
                actual=f"another in some of {self.size}",
                hint="Start all with the same program, data and versions, on machines of one kind.",
            )


@contextmanager
def _together() -> Iterator[None]:
    """What torch says where a process is missing or lost becomes an error of the project."""
    try:
        yield
    except (RuntimeError, ValueError) as error:  # torch.distributed raises its own kinds, all of them RuntimeErrors
        raise MPCOfflineError(
            "processes",
            expected=f"{os.environ.get('WORLD_SIZE', 'all')} that answer",
            actual=f"{type(error).__name__}: {error}".splitlines()[0][:300],
            hint="torchrun --max-restarts=3 starts them again, and a fit with a checkpoint goes on from it.",
        ) from error
