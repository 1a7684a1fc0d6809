"""Adam against torch's own optimiser, bit for bit."""

from __future__ import annotations

import pytest
import torch

from mpcoffline.learning.adam import STATE, Adam


@pytest.mark.parametrize("fused", [False, True])
def test_it_is_torchs(fused: bool) -> None:
    """Also where the length of the steps changes, and where a tensor has no gradient at first."""
    start = [torch.linspace(-1.0, 1.0, 7), torch.ones(2, 3)]
    ours, theirs = ([part.clone().requires_grad_() for part in start] for _ in range(2))
    mine, torchs = Adam(ours, fused=fused), torch.optim.Adam(theirs, fused=fused)
    for k in range(20):
        rate = 0.1 / (1 + k)
        mine.learning_rate = torchs.param_groups[0]["lr"] = rate
        for optimiser, (first, second) in ((mine, ours), (torchs, theirs)):
            optimiser.zero_grad()
            loss = (first - 0.3).pow(4).sum() + (second.square().sum() if k > 2 else 0.0)
            loss.backward()
            optimiser.step()
        assert (ours[1] in mine.state) == (k > 2)
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)
        for name in STATE:
            assert torch.equal(mine.state[one][name], torchs.state[other][name])
