"""The rule of the verdict, case by case, on trials with invented numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from invented_trials import trials

from mpcoffline.diagnostics.differences import Difference, Today, bounds, candidates, paired
from mpcoffline.diagnostics.verdict import Judgement, costs_of, decide
from mpcoffline.simulation.trials import Trials

BETTER = (20.0, 22.0, 19.0, 21.0, 20.0)
ORDER = ["keep MPC_1", "try with care", "recommend"]


def judge(tried: Trials, name: str = "learned", **known: Any) -> tuple[str, str]:
    found = decide(tried, name, **known)
    assert found.reasons
    assert not any("nan" in reason or "inf " in reason for reason in found.reasons)
    return found.verdict, " ".join(found.reasons)


# ---------------------------------------------------------------- against MPC_1


def test_better_on_all_models_is_recommended_with_its_size_and_what_would_contradict_it() -> None:
    tried = trials({"learned": BETTER})
    found, why = judge(tried)
    saved = np.sort((tried.cost[0] - tried.cost[1]).mean(axis=1))[2]
    assert found == "recommend"
    assert f"learned costs {saved:.3g} +- 0.35 less than MPC_1 an episode of 50 steps" in why  # 2 sqrt(2 / 64)
    assert "on 5 of 5 models" in why
    assert "Expected is a mean of" in why
    assert "safe" not in why


def test_one_wild_model_is_named_and_not_obeyed() -> None:
    found, why = judge(trials({"learned": (20.0, 22.0, -300.0, 21.0, 20.0)}))
    assert found == "recommend"
    assert "One of 5 models says otherwise, residual 2 (+300)" in why
    assert "outlier" in why
    assert judge(trials({"learned": (20.0, 22.0, -300.0, -5.0, 20.0)}))[0] == "try with care"
    assert judge(trials({"learned": (20.0, 22.0, -300.0)}))[0] == "try with care"  # of three, one is many


def test_models_without_a_vote_are_not_asked() -> None:
    gains = (-50.0, -60.0, *BETTER)
    assert judge(trials({"learned": gains}))[0] == "try with care"
    assert judge(trials({"learned": gains}, votes=[False] * 2 + [True] * 5))[0] == "recommend"


def test_without_a_vote_mpc_1_is_kept() -> None:
    found, why = judge(trials({"learned": BETTER}, votes=[False] * 5))
    assert found == "keep MPC_1"
    assert "No model of the log predicts it" in why
    assert "mpcoffline.check" in why


def test_both_regressions_of_the_cost_are_asked() -> None:
    found, why = judge(trials({"learned": BETTER}, second={"learned": [-5.0] * 5}))
    assert found == "try with care"
    assert "the other regression of the logged cost" in why
    assert "stage cost" in why


def test_no_clear_gain_keeps_mpc_1_and_says_what_would_decide() -> None:
    found, why = judge(trials({"learned": [0.4] * 5}, noise=3.0))
    assert found == "keep MPC_1"
    assert "no clear gain" in why
    assert "starts would decide" in why
    found, why = judge(trials({"learned": [-8.0] * 5}))
    assert found == "keep MPC_1"
    assert "more than MPC_1" in why
    assert "on 5 of 5" in why


def test_a_trifle_is_no_gain() -> None:
    found, why = judge(trials({"learned": [0.03] * 5}, noise=0.001))
    assert found == "keep MPC_1"
    assert "both are as good" in why


def test_sizes_are_said_where_models_agree_about_them() -> None:
    assert "do not agree about the size (-60 to -10)" in judge(trials({"learned": (60.0, 10.0, 30.0)}, noise=0.1))[1]
    assert "do not agree" not in judge(trials({"learned": BETTER}))[1]


def test_a_learner_that_hands_out_mpc_1_says_what_the_best_other_was() -> None:
    found, why = judge(trials({"V": [-9.0] * 5, "identified": [0.1] * 5}), "MPC_1")
    assert found == "keep MPC_1"
    assert "the best of 2 candidates, identified" in why
    assert judge(trials({"V": BETTER}, clone=50.0, today=50.0), "MPC_1")[0] == "keep MPC_1"
    unasked = trials({"V": BETTER}, votes=[False] * 5)
    found, why = judge(trials({"V": BETTER}), "MPC_1", choice=unasked)
    assert found == "keep MPC_1"
    assert "No model of the log predicts it" in why


def test_only_starts_without_a_part_in_the_choice_judge() -> None:
    tried = trials({"learned": BETTER})
    first = np.arange(64) < 32
    cost = tried.cost.copy()
    cost[1, :, ~first] += 100.0
    found = decide(replace(tried, cost=cost, second=cost, judged=first), "learned")
    assert found.verdict == "recommend"
    assert decide(replace(tried, cost=cost, second=cost, judged=~first), "learned").verdict == "keep MPC_1"


# ---------------------------------------------------------------- against today


def test_what_is_worse_than_today_is_not_recommended_and_told() -> None:
    found, why = judge(trials({"learned": BETTER}, today=30.0, clone=31.0))
    assert found == "keep MPC_1"
    assert "learned is worse than what runs today (30 in the log): " in why
    assert "MPC_1 is, too." in why


def test_what_is_better_than_today_is_told() -> None:
    found, why = judge(trials({"learned": BETTER}, today=130.0, clone=128.0))
    assert found == "recommend"
    assert "learned is better than what runs today (130 in the log): -50" in why
    found, _ = judge(trials({"learned": BETTER}, today=130.0))  # by the log alone
    assert found == "recommend"


def test_within_the_disagreement_of_models_and_log_nothing_is_recommended() -> None:
    found, why = judge(trials({"learned": BETTER}, today=75.0, clone=120.0, noise=0.01))
    assert found == "try with care"
    assert "which is not clear; on the models a clone of that controller costs 45 more than what was logged" in why
    found, why = judge(trials({"learned": BETTER}, today=95.0, clone=60.0))
    assert found == "try with care"
    assert "costs 35.1 less than what was logged" in why
    found, why = judge(trials({"learned": BETTER}, today=81.0, clone=81.0, noise=20.0))
    assert found == "try with care"
    assert "the episodes differ too much from each other: more of them in the log" in why


def test_one_runaway_in_the_log_does_not_make_today_unclear() -> None:
    """As an exploring agent leaves it: one of 64 episodes costs more than all others together."""
    tried = trials({"learned": BETTER}, today=130.0, clone=130.0)
    returns, cost = tried.returns.copy(), tried.cost.copy()
    returns[5] = 1e6
    cost[tried.names.index("today"), :, 5] = 1e6
    found = decide(replace(tried, returns=returns, cost=cost, second=cost), "learned")
    assert found.verdict == "recommend"
    assert found.today.better
    low, middle, high = found.expected
    assert middle == pytest.approx(80.0, abs=1.0)
    assert 70.0 < low < middle < high < 90.0


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, -50.0), (1e4, 1e6)])
def test_no_band_reaches_below_what_an_episode_costs_at_least(scale: float, offset: float) -> None:
    """A clone costs 20 more than the log did, and so the proposal, of 15, may cost 20 less: as if that were possible.

    With steps of 0.1 at least an episode of 50 costs 5 or more, in any unit, and whatever zero the cost has.
    """
    tried = trials({"learned": [85.0] * 8}, today=20.0, clone=40.0)
    per_step = offset / tried.n_steps
    cost = {name: scale * getattr(tried, name) + offset for name in ("cost", "second", "returns")}
    known = replace(tried, **cost, least=np.array([scale * 0.1 + per_step]))
    low, middle, high = decide(known, "learned").expected
    assert low == pytest.approx(scale * 5.0 + offset)
    assert middle == pytest.approx(scale * 15.0 + offset, abs=scale)
    unknown = decide(replace(known, least=np.full(1, -np.inf)), "learned").expected
    assert unknown[0] < offset
    assert unknown[1:] == (middle, high)
    for _, band in costs_of(decide(known, "learned"), known):
        assert (band[np.isfinite(band)] >= scale * 5.0 + offset - 1e-9 * scale).all()


def test_today_is_unknown_where_the_log_is_shorter() -> None:
    found, why = judge(trials({"learned": BETTER}))
    assert found == "recommend"
    assert "no logged episode is 50 steps long" in why


# ---------------------------------------------------------------- lost and failed


def with_lost(tried: Trials, which: list[int], models: int = 5) -> Trials:
    lost = tried.lost.copy()
    lost[1, :models, which] = True
    return replace(tried, lost=lost)


def test_a_controller_that_is_lost_where_mpc_1_is_not_is_no_recommendation() -> None:
    tried = with_lost(trials({"learned": BETTER}), [3])
    found, why = judge(tried)
    assert found == "try with care"
    assert "lost more often than MPC_1 on 5 of 5 models, from 1 of 64 starts" in why
    assert judge(with_lost(trials({"learned": BETTER}), [3], models=1))[0] == "recommend"  # one wild model
    both = replace(tried, lost=np.broadcast_to(tried.lost.any(axis=0), tried.lost.shape))
    assert judge(both)[0] == "recommend"  # the start is hopeless


def test_rare_failures_are_told() -> None:
    tried = trials({"learned": BETTER})
    cost = tried.cost.copy()
    cost[1, :, 7] += 200.0
    found, why = judge(replace(tried, cost=cost, second=cost))
    assert "From 1 of 64 starts it does worse than MPC_1 (1 cost far more), the worst is row 700 of the log" in why
    assert found == "recommend"
    assert "From" not in judge(tried)[1]


def test_failed_solves_are_told() -> None:
    assert "28.0% of its problems" in judge(trials({"learned": BETTER}), failed=0.28)[1]


# ---------------------------------------------------------------- what was not tried, what is not finite


def test_a_single_start_decides_nothing() -> None:
    found, why = judge(trials({"learned": BETTER}, n_starts=1))
    assert found != "recommend"
    assert "no clear gain" in why


def test_costs_that_are_not_finite_are_no_gain() -> None:
    tried = trials({"learned": BETTER}, today=100.0, clone=100.0)
    for value in (np.inf, np.nan):
        for controllers in ([1], [0, 1, 2]):
            cost = tried.cost.copy()
            cost[controllers] = value
            found = decide(replace(tried, cost=cost, second=cost), "learned")
            assert found.verdict != "recommend"
            assert found.reasons


def test_starts_that_were_not_tried_are_left_out() -> None:
    tried = trials({"learned": BETTER})
    cost = tried.cost.copy()
    cost[1, :, 32:] = np.nan
    found = decide(replace(tried, cost=cost, second=cost), "learned")
    assert found.verdict == "recommend"
    assert found.first is not None
    expected = (tried.cost[1] - tried.cost[0])[:, :32]
    np.testing.assert_allclose(found.first.mean, expected.mean(axis=1))
    np.testing.assert_allclose(found.first.error, expected.std(axis=1, ddof=1) / np.sqrt(32))


# ---------------------------------------------------------------- invariance, order


def affine(tried: Trials, scale: float, offset: float) -> Trials:
    """The trials of the cost scale L + offset."""
    moved = {name: scale * getattr(tried, name) + offset for name in ("cost", "second", "returns")}
    return replace(tried, **moved)


whole = st.integers(-40, 40)


@st.composite
def any_trials(draw: Any) -> Trials:
    m = draw(st.integers(1, 6))
    tried = trials(
        {"learned": draw(st.lists(whole, min_size=m, max_size=m))},
        second={"learned": draw(st.lists(whole, min_size=m, max_size=m))},
        votes=draw(st.lists(st.booleans(), min_size=m, max_size=m)),
        today=draw(st.one_of(st.none(), st.integers(50, 150))),
        clone=draw(st.one_of(st.none(), st.integers(50, 150))),
        noise=draw(st.sampled_from([1.0, 10.0, 50.0])),
        n_starts=draw(st.integers(1, 20)),
    )
    return replace(tried, **{k: np.round(getattr(tried, k) * 64.0) / 64.0 for k in ("cost", "second", "returns")})


@given(any_trials(), st.sampled_from([2.0**-20, 0.25, 8.0, 2.0**30]), st.integers(-1000, 1000))
def test_an_affine_change_of_the_cost_changes_no_verdict(tried: Trials, scale: float, offset: int) -> None:
    first, second = decide(tried, "learned"), decide(affine(tried, scale, scale * offset), "learned")
    assert first.verdict == second.verdict
    assert len(first.reasons) == len(second.reasons)
    assert candidates(tried)[:1] == () or candidates(tried)[0].agree == candidates(affine(tried, scale, 0.0))[0].agree
    for one, other in zip(first.expected, second.expected, strict=True):
        assert other == pytest.approx(scale * (one + offset), rel=1e-9, abs=1e-9 * scale, nan_ok=True)


@given(any_trials(), st.integers(0, 60))
def test_a_better_controller_is_never_judged_worse(tried: Trials, gain: int) -> None:
    saved = np.zeros((len(tried.names), 1, 1))
    saved[1] = gain
    better = replace(tried, cost=tried.cost - saved, second=tried.second - saved)
    assert ORDER.index(decide(better, "learned").verdict) >= ORDER.index(decide(tried, "learned").verdict)


@given(any_trials())
def test_recommended_is_only_what_is_cheaper_on_all_voting_models_but_one(tried: Trials) -> None:
    found = decide(tried, "learned")
    n, gains = int(tried.votes.sum()), (tried.cost[0] - tried.cost[1])[tried.votes].mean(axis=1)
    if found.verdict == "recommend":
        assert np.sum(gains > 0.0) >= n - (n >= 4)
        assert n > 0
    if n and np.median(gains) <= 0.0 and n % 2:
        assert found.verdict == "keep MPC_1"


# ---------------------------------------------------------------- parts


def test_paired_differences() -> None:
    costs, others = np.array([[1.0, 4.0, 9.0, np.nan]]), np.array([[0.0, 2.0, 6.0, 1.0]])
    mean, error = paired(costs, others)
    assert mean == pytest.approx([2.0])
    assert error == pytest.approx([1.0 / np.sqrt(3.0)])
    assert paired(costs[:, :1], others[:, :1])[1] == np.inf


def test_bounds_are_two_standard_errors_where_nothing_sticks_out() -> None:
    difference = np.random.default_rng(0).normal(1.0, 2.0, (3, 40))
    low, high = bounds(difference, np.zeros_like(difference))
    error = 2.0 * difference.std(axis=1, ddof=1) / np.sqrt(40.0)
    np.testing.assert_allclose(low, difference.mean(axis=1) - error)
    np.testing.assert_allclose(high, difference.mean(axis=1) + error)


def test_an_enormous_gain_does_not_hide_that_there_is_one() -> None:
    gains = np.concatenate([np.random.default_rng(0).normal(-1.0, 1.0, 63), [-1e6]])[None]
    assert paired(gains, 0.0 * gains)[0] + 2.0 * paired(gains, 0.0 * gains)[1] > 0.0
    (low,), (high,) = bounds(gains, 0.0 * gains)
    assert low == pytest.approx(gains.mean() - 2.0 * gains.std(ddof=1) / 8.0)
    cut = np.maximum(gains[0], -20.0)  # a fence is nearer
    assert gains.mean() < high < cut.mean() + 2.0 * cut.std(ddof=1) / 8.0 < 0.0


@given(st.lists(st.one_of(whole, st.just(-1000), st.just(1000)), min_size=2, max_size=30), st.integers(-50, 50))
def test_bounds_hold_the_mean_and_turn_with_the_sign(values: list[int], offset: int) -> None:
    difference = np.array([values], dtype=np.float64)
    (low,), (high,) = bounds(difference + offset, np.full_like(difference, offset))
    assert low <= difference.mean() + 1e-9
    assert high >= difference.mean() - 1e-9
    mean, error = paired(difference, 0.0 * difference)
    assert high <= mean[0] + 2.0 * error[0] + 1e-9
    assert bounds(4.0 * difference, 0.0 * difference)[1] == pytest.approx([4.0 * high])


def test_infinite_costs_of_the_other_are_large_gains() -> None:
    others = np.full((1, 20), 10.0)
    others[0, 3] = np.inf
    costs = np.linspace(1.0, 2.0, 20)[None]
    assert bounds(costs, others)[1] < -7.0
    assert bounds(others, costs)[0] > 7.0


def test_of_two_models_the_dearer_is_the_middle() -> None:
    d = Difference.of(trials({"learned": (20.0, 10.0)}), "learned", "MPC_1")
    assert d.models[d.middle] == "residual 1"


def test_today_by_log_and_by_clone() -> None:
    tried = trials({"learned": BETTER}, today=90.0, clone=96.0, noise=0.0)
    found = Today.of(tried, "learned")
    np.testing.assert_allclose(found.disagreement, 6.0)
    np.testing.assert_allclose(found.low, 4.0 - np.array(BETTER))
    np.testing.assert_allclose(found.high, 10.0 - np.array(BETTER))
    assert found.logged == pytest.approx(90.0)
    assert found.better
    assert not found.worse


def test_candidates_are_ordered_by_what_they_cost() -> None:
    found = candidates(trials({"a": [5.0] * 5, "b": [20.0] * 5, "c": [-3.0, 1.0, -3.0, -3.0, -3.0]}))
    assert [each.name for each in found] == ["b", "a", "c"]
    assert [each.agree for each in found] == [5, 5, 1]
    assert found[0].cost == pytest.approx(80.0, abs=0.5)
    assert found[0].error == pytest.approx(np.sqrt(2.0 / 64.0), rel=0.3)


def test_the_table_holds_today_mpc_1_and_the_proposal() -> None:
    tried = trials({"learned": BETTER}, today=130.0, clone=128.0)
    found: Judgement = decide(tried, "learned")
    rows = dict(costs_of(found, tried))
    assert list(rows) == ["today", "MPC_1", "learned"]
    assert rows["today"][1] == pytest.approx(130.0)
    assert rows["learned"][0] < 80.0 < rows["learned"][2]
    assert all(low <= middle <= high for low, middle, high in rows.values())


def test_a_candidate_that_left_the_choice_early_is_judged_by_the_starts_that_it_had() -> None:
    tried = trials({"best": BETTER, "left": [-9.0] * 5})
    cost, judged = tried.cost.copy(), np.arange(64) >= 40
    cost[2, :, 6:] = np.nan
    tried = replace(tried, cost=cost, second=cost, judged=judged)
    best, left = (Difference.of(tried, name, "MPC_1") for name in ("best", "left"))
    np.testing.assert_allclose(best.mean, (cost[1] - cost[0])[:, 40:].mean(axis=1))
    np.testing.assert_allclose(left.mean, (cost[2] - cost[0])[:, :6].mean(axis=1))
    assert [each.name for each in candidates(tried)] == ["best", "left"]
    assert "24 starts" in judge(tried, "best")[1]
    assert judge(tried, "left")[0] == "keep MPC_1"
