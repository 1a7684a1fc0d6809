"""Past inputs in a table: from the same episode, without gaps, exactly, and refused where there are none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mpcoffline import TransitionTable
from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets.table.memory import gathered, plant_table, rows_before, with_memory, with_plant_states
from mpcoffline.mpc.layout import Layout


def make_table(
    lengths: list[int], *, nu: int = 2, offset: float = 0.0, gaps: tuple[int, ...] = (), twice: float = 0.0
) -> TransitionTable:
    """Episodes of two states that move at random; ``twice``: noise that makes s+ and the next s two measurements."""
    rng, parts = np.random.default_rng(0), []
    for e, n in enumerate(lengths):
        y = offset + rng.normal(size=(n + 1, 2)).cumsum(axis=0)
        s, reached = y[:-1], y[1:] + twice * rng.normal(size=(n, 2))
        a, last = offset + rng.normal(size=(n, nu)), np.arange(n) == n - 1
        parts.append((s, a, rng.normal(size=n), reached, last & (e % 2 == 0), np.full(n, e)))
    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
    kept = np.setdiff1d(np.arange(len(columns[0])), gaps)
    return TransitionTable.from_arrays(*(column[kept] for column in columns))


def by_hand(table: TransitionTable, layout: Layout, usual: np.ndarray | None = None) -> list[np.ndarray]:
    """Row by row: [s, past inputs], [s+, past inputs after a]; rows with a break among their past are left out.

    With a usual input before each episode, only those after a gap.
    """
    found, y, a = [], table.values(), table.values().actions
    inputs, ages = layout.ages
    for row in range(len(table)):
        first = int(np.flatnonzero(table.episode_ids == table.episode_ids[row])[0])
        past = np.vstack([*[usual if usual is not None else np.zeros(2)] * layout.steps, a[first : row + 1]])
        before = range(max(row - layout.steps, -1 if usual is None else first) + 1, row + 1)
        unbroken = all(
            k > 0
            and table.episode_ids[k] == table.episode_ids[k - 1]
            and np.array_equal(y.observations[k], y.next_observations[k - 1])
            for k in before
        )
        if unbroken:
            now, later = ([past[-1 - g + j, i] for i, g in zip(inputs, ages, strict=True)] for j in (0, 1))
            s, reached = y.observations[row], y.next_observations[row]
            found.append(np.concatenate([s, now, a[row], reached, later, [row]]))
    return found


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=6),
    st.lists(st.integers(0, 3), min_size=2, max_size=2),
    st.lists(st.integers(0, 40), max_size=4),
    st.booleans(),
)
def test_past_inputs_are_those_of_the_rows_before(
    lengths: list[int], delay: list[int], gaps: list[int], begins: bool
) -> None:
    layout, usual = Layout.of(2, 2, delay), np.array([0.25, -0.5]) if begins else None
    table = make_table([6, *lengths], gaps=tuple(g + 5 for g in gaps))
    expected = by_hand(table, layout, usual)
    if layout.n_memory and not expected:
        with pytest.raises(InvalidDataError, match="consecutive rows"):
            with_memory(table, layout)
        return
    found = with_memory(table, layout, usual)
    v = found.values()
    np.testing.assert_array_equal(
        np.hstack([v.observations, v.actions, v.next_observations]), np.array(expected)[:, :-1]
    )
    rows = np.array(expected)[:, -1].astype(int)
    for name in ("costs", "terminations", "episode_ids"):
        np.testing.assert_array_equal(getattr(found, name), getattr(table, name)[rows])


def test_offsets_keep_their_digits() -> None:
    """Columns at 1e7 are packed without it; the past inputs are the same numbers as the inputs were."""
    table, layout = make_table([30], offset=1e7), Layout.of(2, 2, [2, 1])
    assert not table.centring.is_none
    found = with_memory(table, layout)
    np.testing.assert_array_equal(found.observations[:, 2], table.actions[1:-1, 0])
    np.testing.assert_array_equal(found.next_observations[:, 3], table.actions[1:-1, 0])
    np.testing.assert_array_equal(found.next_observations[:, :2], table.next_observations[2:])


def test_what_counts_as_applied_before_keeps_its_digits_to_the_offset() -> None:
    table, layout = make_table([9, 9], offset=1e7), Layout.of(2, 2, [2, 1])
    found = with_memory(table, layout, np.array([1e7 + 1.0, 1e7]))
    assert len(found) == len(table)
    np.testing.assert_allclose(found.observations[[0, 9], 2:] - 1e7, [[1.0, 1.0, 0.0]] * 2, atol=1e-6)
    np.testing.assert_array_equal(found.next_observations[:, 2], table.actions[:, 0])


def test_states_measured_twice_are_no_gaps() -> None:
    before = rows_before(make_table([200], twice=0.05))
    assert np.mean(np.diff(before) == 1) > 0.95
    jump = rows_before(make_table([200], twice=0.05, gaps=tuple(range(100, 120))))
    assert jump[100] == 0


def test_what_the_plant_is_given_and_back() -> None:
    layout = Layout.of(2, 2, [2, 0])
    table = make_table([20, 20])
    z = with_memory(table, layout)
    plant = plant_table(z, layout)
    np.testing.assert_array_equal(plant.observations, z.observations[:, :2])
    np.testing.assert_array_equal(plant.actions[:, 0], z.observations[:, 3])  # what was applied two steps ago
    np.testing.assert_array_equal(plant.actions[:, 1], z.actions[:, 1])
    moved = plant.with_states(plant.observations + 1.0, plant.next_observations + 1.0)
    back = with_plant_states(z, moved)
    np.testing.assert_array_equal(
        back.observations - z.observations > 0.5, np.tile([True, True, False, False], (36, 1))
    )
    np.testing.assert_array_equal(back.actions, z.actions)
    np.testing.assert_array_equal(back.costs, z.costs)
    assert plant_table(table, Layout.of(2, 2)) is table


def test_a_mapped_table_gives_a_mapped_one(tmp_path: Any) -> None:
    table, layout = make_table([60, 50]), Layout.of(2, 2, [3, 1])
    from mpcoffline.datasets.table.cache import scratch_table

    file = scratch_table(2, 2, [(table.rows, table.episode_ids)], tmp_path)
    mapped = with_memory(TransitionTable._of(file, "mapped"), layout)
    assert mapped.is_mapped
    np.testing.assert_array_equal(mapped.rows, with_memory(table, layout).rows)
    assert gathered(mapped, [0, 1]).is_mapped


def test_trimming_by_the_first_coordinates() -> None:
    table = make_table([50, 50])
    z = with_memory(table, Layout.of(2, 2, 1))
    expected = gathered(z, [0, 1]).trim(0.7)
    np.testing.assert_array_equal(z.trim(0.7, 2).observations[:, :2], expected.observations)


def test_a_table_of_another_plant_is_refused() -> None:
    with pytest.raises(InvalidDataError, match="observations: expected 3 coordinates"):
        with_memory(make_table([9]), Layout.of(3, 2, 1))
