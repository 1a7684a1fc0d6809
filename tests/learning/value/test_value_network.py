"""The networks written out by hand against torch's layers, and the units in which they learn."""

from __future__ import annotations

import lq_plant
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ValueFunction
from mpcoffline.learning.value.function import tanh_network
from mpcoffline.learning.value.network import FlatCritic, FlatNetwork
from mpcoffline.learning.value.units import Units


@given(
    n_in=st.integers(1, 5),
    hidden=st.lists(st.integers(1, 9), max_size=3),
    rows=st.integers(1, 6),
    seed=st.integers(0, 99),
)
def test_outputs_and_slopes_are_those_of_torchs_layers(n_in: int, hidden: list[int], rows: int, seed: int) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        net, x = tanh_network(n_in, hidden).double(), 2.0 * torch.randn(2, rows, n_in, dtype=torch.float64)
    network = FlatNetwork.like(net)
    weights = network.weights_of(net).requires_grad_()
    found, wanted = network(weights, x), net(x).squeeze(-1)
    torch.testing.assert_close(found, wanted)
    (found * torch.arange(found.numel()).view_as(found)).sum().backward()
    (wanted * torch.arange(found.numel()).view_as(found)).sum().backward()
    linear = [layer for layer in net if isinstance(layer, torch.nn.Linear)]
    for (dW, db), layer in zip(network.layers(weights.grad), linear, strict=True):
        torch.testing.assert_close(dW.t(), layer.weight.grad)
        torch.testing.assert_close(db, layer.bias.grad)


def test_weights_come_back_from_the_vector() -> None:
    source, empty = tanh_network(3, (4, 5)), tanh_network(3, (4, 5))
    network = FlatNetwork.like(source)
    network.store(network.weights_of(source), empty)
    for name, tensor in source.state_dict().items():
        assert torch.equal(empty.state_dict()[name], tensor)


@pytest.mark.parametrize("discount", [0.9, 1.0])
def test_the_bellman_equation_keeps_its_form_in_the_units_of_the_network(discount: float) -> None:
    rng = np.random.default_rng(0)
    s, following = rng.normal(5.0, 3.0, (40, 2)), rng.normal(size=(40, 2))
    ends = np.arange(40) % 3 == 0
    table = TransitionTable.from_arrays(s, s[:, :1], rng.normal(1e4, 2.0, 40), following, ends)
    V = ValueFunction(2, (8, 8))
    V.normalise(table, discount)
    [net] = V.members
    network = FlatNetwork.like(net)
    critic = FlatCritic([network], [network.weights_of(net)])
    batch = Units(table, V, discount).columns(torch.from_numpy(table.rows))
    ahead = discount * (1.0 - batch.terminations) * critic(batch.next_observations)
    scaled = batch.costs + ahead - critic(batch.observations)
    raw = table.costs + discount * ~ends * V.predict(table.next_observations) - V.predict(table.observations)
    np.testing.assert_allclose(scaled.numpy(), raw / float(V.scale), atol=1e-5)


def test_the_bounds_hold_every_discounted_sum_of_costs() -> None:
    rng = np.random.default_rng(1)
    for low, high in ((-2.0, 3.0), (1.0, 4.0), (-5.0, -1.0)):
        for ends in (False, True):
            s = np.zeros((50, 1))
            table = TransitionTable.from_arrays(s, s, rng.uniform(low, high, 50), s, np.full(50, ends))
            V = ValueFunction(1, (2,))
            V.normalise(table, 0.9)
            bounds = [float(V.offset + V.scale * bound) for bound in Units(table, V, 0.9).bounds]
            least, most = float(table.costs.min()), float(table.costs.max())
            sums = [c * (1.0 - 0.9**k) / 0.1 for c in (least, most) for k in ((1, 2, 9, 400) if ends else (400,))]
            np.testing.assert_allclose(bounds, [min(sums), max(sums)], rtol=1e-6)


def test_rows_are_standardised() -> None:
    table = lq_plant.random_log(500)
    V = ValueFunction(2, (2,))
    V.normalise(table, 0.9)
    batch = Units(table, V, 0.9).columns(torch.from_numpy(table.rows))
    for column in (batch.observations, batch.actions):
        np.testing.assert_allclose(column.mean(dim=0), 0.0, atol=1e-5)
        np.testing.assert_allclose(column.std(dim=0, correction=0), 1.0, rtol=1e-5)
    np.testing.assert_allclose(batch.costs.std(correction=0), 0.1, rtol=1e-4)  # of 1 - gamma
