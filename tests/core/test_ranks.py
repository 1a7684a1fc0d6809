"""What the processes of a job say to each other: sums that know no order, and errors where one of them is missing."""

from __future__ import annotations

import itertools
import math
import socket

import numpy as np
import pytest
import torch

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.ranks import Ranks


def numbers(count: int, size: int = 50) -> list[list[torch.Tensor]]:
    """Parts of numbers over twelve decades, of both signs."""
    rng = np.random.default_rng(count)
    parts = rng.normal(size=(count, size)) * 10.0 ** rng.uniform(-12.0, 0.0, (count, size))
    return [[torch.from_numpy(part), torch.from_numpy(part[:3]).float()] for part in parts]


def test_sums_are_those_of_exact_arithmetic_up_to_the_grid() -> None:
    parts = numbers(6)
    sums = Ranks().exact_sums(parts, 6)
    assert sums is not None
    for j, total in enumerate(sums):
        truth = [math.fsum(float(part[j][i]) for part in parts) for i in range(len(total))]
        largest = max(float(part[j].abs().max()) for part in parts)
        assert total.dtype == torch.float64
        np.testing.assert_allclose(total, truth, rtol=0.0, atol=6 * 8 * 2.0**-51 * largest)


def test_sums_are_the_same_bits_in_any_order() -> None:
    parts = numbers(5)
    first, *others = (Ranks().exact_sums([parts[i] for i in order], 5) for order in itertools.permutations(range(5)))
    assert first is not None
    for other in others:
        assert other is not None
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_number_that_is_not_finite_leaves_no_sum(bad: float) -> None:
    parts = numbers(2)
    parts[1][0][7] = bad
    assert Ranks().exact_sums(parts, 2) is None


def test_zeros_sum_to_zeros() -> None:
    sums = Ranks().exact_sums([[torch.zeros(3)], [torch.zeros(3)]], 2)
    assert sums is not None
    assert torch.equal(sums[0], torch.zeros(3, dtype=torch.float64))


def test_a_process_by_itself_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    ranks = Ranks.current()
    assert (ranks.rank, ranks.size, ranks.is_first) == (0, 1, True)
    array = np.arange(6.0).reshape(2, 3)
    assert np.array_equal(ranks.shared(array, 0), array)
    assert ranks.largest([1.0, math.nan]) == [1.0, math.inf]
    ranks.check_alike("state", b"anything")


def test_a_process_that_does_not_come_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    for name, value in own.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(MPCOfflineError, match=r"processes: expected 2 that answer, got .*max-restarts"):
        Ranks.current(timeout=0.5)
