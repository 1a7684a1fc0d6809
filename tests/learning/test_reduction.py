"""Gradients of minibatches in parts are those of the whole, and what is learned is the same whoever has the parts."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path

import lq_episodes
import lq_plant
import numpy as np
import pytest
import torch

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.ranks import Ranks
from mpcoffline.datasets import ShardedTable, write_shards
from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.learning import ParameterConfig, ValueConfig, ValueTraining
from mpcoffline.learning.bellman.equation import BellmanProblem
from mpcoffline.learning.bellman.regression import ParameterTraining
from mpcoffline.learning.reduction import ByLanes, Parts, Reduction


def parts_of(cuts: list[int]) -> Parts:
    """Some rows, cut into parts of different sizes."""
    table = lq_episodes.episodes(n=4)
    rows = torch.from_numpy(table.rows)
    ends = [0, *cuts, len(rows)]
    pieces = [rows[a:b] for a, b in itertools.pairwise(ends)]
    return [(len(piece) / len(rows), table.columns(piece)) for piece in pieces]


@pytest.mark.parametrize("cuts", [[40], [3, 10, 77]])
def test_the_gradient_of_fit_in_parts_is_that_of_the_whole(cuts: list[int]) -> None:
    mpc, value = lq_plant.make_mpc(), lq_plant.QuadraticValue(lq_plant.BEST.P)
    problem = BellmanProblem(mpc, value, unit=1.7)

    def residuals(theta: torch.Tensor, batch: Columns) -> torch.Tensor:
        return problem.residuals(batch, theta)

    def loss(theta: torch.Tensor, constant: torch.Tensor | None, batch: Columns) -> tuple[torch.Tensor, torch.Tensor]:
        error = problem.error(batch, theta, constant)
        return error, error

    found = []
    for parts, reduction in ((parts_of([]), Reduction()), (parts_of(cuts), ByLanes(Ranks(), len(cuts) + 1))):
        theta = torch.from_numpy(mpc.theta).requires_grad_()
        constant = reduction.mean(partial(residuals, theta.detach()), parts)
        shown = reduction.gradient(partial(loss, theta, constant), parts, [theta])
        assert theta.grad is not None
        found.append((shown, theta.grad.numpy()))
    (error, gradient), (own_error, own_gradient) = found
    assert own_error == pytest.approx(error, rel=1e-12)
    np.testing.assert_allclose(own_gradient, gradient, rtol=1e-9, atol=1e-12 * np.abs(gradient).max())


def test_a_part_that_is_not_finite_moves_nothing() -> None:
    z = torch.ones(2, dtype=torch.float64, requires_grad=True)

    def loss(batch: Columns) -> tuple[torch.Tensor, torch.Tensor]:
        found = (z * batch.costs.mean()).sum()
        return found, found

    parts = parts_of([50])
    parts[1][1].costs[0] = torch.nan
    assert np.isnan(ByLanes(Ranks(), 2).gradient(loss, parts, [z]))
    assert z.grad is not None
    assert z.grad.isnan().all()


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> ShardedTable:
    folder: Path = tmp_path_factory.mktemp("shards")
    write_shards(folder, [lq_episodes.episodes(n=300)])
    return ShardedTable.open(folder, lanes=4)


def test_v_from_shards_is_the_value_of_the_logging_policy(shards: ShardedTable) -> None:
    config = ValueConfig(hidden=(32,), n_steps=250, learning_rate=1e-2, polyak=None, method="td")
    training = ValueTraining(shards.excerpt(), lq_plant.DISCOUNT, config, seed=0, shards=shards)
    training.advance(config.n_steps)
    s = lq_episodes.episodes(n=50, seed=9).observations
    truth = lq_plant.quadratic(lq_plant.policy_value(lq_plant.GAIN), s)
    assert np.corrcoef(training.result.predict(s), truth)[0, 1] > 0.95


def test_trainings_from_shards_go_on_bit_for_bit(shards: ShardedTable) -> None:
    config, value = ParameterConfig(n_steps=12, batch_size=64), lq_plant.QuadraticValue(lq_plant.BEST.P)
    mpc, table, groups = lq_plant.make_mpc(), shards.excerpt(), ("cost", "model")
    once, begun, resumed = (
        ParameterTraining(mpc, value, table, groups, config, seed=0, shards=shards) for _ in range(3)
    )
    once.advance(9)
    begun.advance(4)
    resumed.restore(begun.to_arrays())
    resumed.advance(5)
    assert np.array_equal(resumed.theta, once.theta)


def test_no_episodes_are_held_out_of_shards(shards: ShardedTable) -> None:
    with pytest.raises(InvalidArgumentError, match="validation: expected 0 where rows come from shards"):
        ValueTraining(shards.excerpt(), 0.9, ValueConfig(validation=0.1), seed=0, shards=shards)


def test_the_convex_fit_in_parts_is_that_of_the_whole(shards: ShardedTable) -> None:
    """With all rows in the sample and in the parts, both are the same convex problem."""
    mpc, value, groups = lq_plant.make_mpc(), lq_plant.QuadraticValue(lq_plant.BEST.P), ("cost",)
    config, table = ParameterConfig(refit_rows=len(shards), prior=1e-6), lq_episodes.episodes(n=300)
    of_table, of_shards = (
        ParameterTraining(mpc, value, table, groups, config, seed=0, shards=each) for each in (None, shards)
    )
    for training in (of_table, of_shards):
        training.advance(1)
    assert of_shards.result.loss_after == pytest.approx(of_table.result.loss_after, rel=1e-4, abs=1e-9)
    np.testing.assert_allclose(of_shards.result.theta, of_table.result.theta, rtol=1e-3, atol=1e-4)
