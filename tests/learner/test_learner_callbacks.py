"""What callbacks may answer, and what they and evaluators see during a fit."""

from __future__ import annotations

from typing import Any

import lq_plant
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from mpcoffline import OfflineMPCLearner
from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.mpc import MPC
from mpcoffline.sb3.model import SB3Callback

QUICK: dict[str, Any] = {
    "value_n_steps": 60,
    "fit_n_steps": 40,
    "n_restarts": 0,
    "hidden": (16,),
    "value_batch_size": 64,
    "fit_batch_size": 64,
    "refit_iterations": 20,
    "trim": 1.0,
    "adapt_above": 0.0,
    "terminal": "quadratic",
    "stage_cost": "fitted",  # else it is known here
    "candidate": "full",
}
EPOCHS = 6  # three of (VALUE), two of (FIT), and the last one


def learner(**options: Any) -> OfflineMPCLearner:
    return OfflineMPCLearner(lq_plant.make_mpc(), seed=0, **(QUICK | options))


def fit(callback: Any, **options: Any) -> tuple[OfflineMPCLearner, int]:
    found = learner(**options)
    log = lq_plant.random_log(300)
    return found, len(found.fit(log, callbacks=[callback], n_steps_per_epoch=20, show_progress=False))


@pytest.mark.parametrize("answer", [False, np.False_, 0, np.int64(0), torch.tensor(False), np.array([False])])
def test_what_is_false_ends_the_fit(answer: Any) -> None:
    assert fit(lambda *_: answer)[1] == 1


@pytest.mark.parametrize("answer", [None, True, np.True_, 1, torch.tensor(True), np.zeros(3), torch.zeros(3)])
def test_what_is_not_false_does_not(answer: Any) -> None:
    assert fit(lambda *_: answer)[1] == EPOCHS


class Counting(BaseCallback):
    """Counts its calls and stops with numpy's False."""

    def __init__(self, stop_at: int) -> None:
        super().__init__()
        self.stop_at, self.starts, self.steps, self.ends = stop_at, 0, 0, 0

    def _on_training_start(self) -> None:
        self.starts += 1

    def _on_step(self) -> bool:
        self.steps += 1
        return np.bool_(self.steps % self.stop_at != 0)  # type: ignore[return-value]

    def _on_training_end(self) -> None:
        self.ends += 1


@pytest.mark.parametrize(("stop_at", "epochs"), [(1, 4), (2, 5), (3, EPOCHS), (100, EPOCHS)])
def test_an_sb3_callback_ends_once(stop_at: int, epochs: int) -> None:
    counting = Counting(stop_at)
    callback = SB3Callback(counting)
    assert fit(callback)[1] == epochs
    assert (counting.starts, counting.ends) == (1, 1)
    fit(callback)
    assert (counting.starts, counting.ends) == (2, 2)


def test_an_sb3_callback_ends_also_where_another_ends_the_fit() -> None:
    """Or where an error does, or the caller of `fitter`; never where it had not begun."""
    counting = Counting(stop_at=100)
    callback, log = SB3Callback(counting), lq_plant.random_log(300)
    options: dict[str, Any] = {"n_steps_per_epoch": 20, "show_progress": False}

    def stop(_: OfflineMPCLearner, epoch: int, __: int) -> bool:
        return epoch < 4

    def fail(_: OfflineMPCLearner, epoch: int, __: int) -> None:
        if epoch == 4:
            raise ZeroDivisionError

    learner().fit(log, callbacks=[callback, stop], **options)
    assert (counting.starts, counting.ends) == (1, 1)
    with pytest.raises(ZeroDivisionError):
        learner().fit(log, callbacks=[callback, fail], **options)
    assert (counting.starts, counting.ends) == (2, 2)
    epochs = learner().fitter(log, callbacks=[callback], **options)
    assert [next(epochs)[0] for _ in range(4)] == [1, 2, 3, 4]
    epochs.close()  # type: ignore[attr-defined]
    assert (counting.starts, counting.ends) == (3, 3)
    learner().fit(log, callbacks=[callback, lambda *_: False], **options)  # while (VALUE) goes on
    assert (counting.starts, counting.ends) == (3, 3)


def test_evaluators_see_what_would_be_handed_out() -> None:
    """A fit that ends after an epoch hands out the MPC that was seen then, terminal cost and all."""
    seen: list[MPC] = []

    def look(found: OfflineMPCLearner, *_: Any) -> None:
        try:
            seen.append(found.mpc)
            assert found.policy.mpc is seen[-1]
        except MPCOfflineError:
            return

    whole, _ = fit(look)
    assert len(seen) == 3
    assert seen[-1] is whole.mpc
    for epoch, mpc in zip((4, 5, 6), seen, strict=True):
        stopped, _ = fit(lambda _, now, __, last=epoch: now < last)
        np.testing.assert_array_equal(stopped.theta, mpc.theta)
        assert stopped.mpc.to_json() == mpc.to_json()
        assert stopped.mpc.horizon == 30  # the preset's
        # T is fitted to V, not the nominal one.
        nominal = stopped.nominal_mpc.terminal_cost.space.theta
        assert np.abs(stopped.mpc.terminal_cost.space.theta - nominal[: stopped.mpc.terminal_cost.space.size]).max() > 0


def test_looking_changes_nothing() -> None:
    looked, _ = fit(lambda found, epoch, _: epoch < 4 or found.theta is not None)
    unseen, _ = fit(lambda *_: None)
    np.testing.assert_array_equal(looked.theta, unseen.theta)
