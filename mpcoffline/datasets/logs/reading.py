"""A log of a plant, to transitions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.recording.from_arrays import dataset_from_table
from mpcoffline.datasets.table.arrays import packed_blocks
from mpcoffline.datasets.table.math import CHUNK
from mpcoffline.datasets.table.transitions import TransitionTable

from . import faults
from .collecting import Options, Rows, collected
from .columns import Quantity
from .report import LogReport
from .sampling import Series, averaged, between, bridge, free_of, grid, held, phase_of, single_gaps
from .wanted import Wanted

if TYPE_CHECKING:
    from minari import MinariDataset

_SLOW = 1.2  # control intervals, beyond which rows are too far apart
_HARMLESS = 0.05  # of what a step moves, by which a bridged value may be off
_OVER_ONE = 2.05  # times the usual time between rows, over one that is missing
_CLIPPED = 0.01  # of an input's range, by which it may lie beyond its bounds
_ROUNDED = 1e-3  # of a signal's range
_MOST_BEYOND = 0.2  # share of rows
_TOO_FAST = (
    "All rows lie within {span:.3g} s, less than one control interval of the plant, {dt:g} s: is time in another unit,"
    " or was a simulation run faster than its own time? A loop with a VirtualClock writes the plant's. "
)
_UNIT = "Is it in the unit of the plant file? units={...} says what the log's numbers are in."


class LoggedTable(TransitionTable):
    """A table of transitions that remembers how it was read.

    Attributes:
        report: What became of the log.
        action_bounds: Bounds of the inputs, ``(nu,)`` each.
        options: As what it was read.
        header: Names of the first log's columns.
    """

    report: LogReport
    options: Options
    header: list[str]
    action_bounds: tuple[Array, Array]

    def to_minari(self, dataset_id: str, *, overwrite: bool = False) -> MinariDataset:
        """Stores the log as a Minari data set.

        Args:
            dataset_id: Its id.
            overwrite: Whether an existing one may be replaced.

        Raises:
            InvalidArgumentError: For a bad id, or one that exists.
        """
        low, high = self.action_bounds
        return dataset_from_table(
            dataset_id,
            self,
            action_low=low,
            action_high=high,
            description=f"Log {self.name}.",
            overwrite=overwrite,
        )


def read_log(sources: Any, wanted: Wanted, options: Options) -> LoggedTable:
    """Reads one log, or several as one.

    Args:
        sources: A file or a frame, or a list of them.
        wanted: What it should hold.
        options: How it is read.

    Raises:
        InvalidArgumentError: For options that do not fit together.
        InvalidDataError: For a log that cannot be understood; names row and column.
        StorageError: For a file that cannot be read.
    """
    every = list(sources) if isinstance(sources, list | tuple) else [sources]
    if not every:
        raise InvalidArgumentError("log", expected="a file or a frame, or some", actual="none")
    if options.max_gap is not None and not options.max_gap >= wanted.dt:
        expected = f"at least the control interval, {wanted.dt:g} s"
        raise InvalidArgumentError("max_gap", expected=expected, actual=str(options.max_gap))
    report = LogReport()
    rows = collected(every, wanted.logged, wanted.dt, options, report)
    name = ", ".join(Path(each).name if isinstance(each, str | Path) else "frame" for each in every[:3])
    max_gap = _gap(name, rows, wanted.dt, options.max_gap, report)
    _mend(rows, wanted, report)
    table = _sampled(name, rows, wanted, max_gap, report)
    table.options, table.header = options, list(rows.files[0][1].header)
    return table


def _gap(name: str, rows: Rows, dt: float, given: float | None, report: LogReport) -> float:
    """The time between rows beyond which something is missing."""
    steps = np.diff(rows.t)
    usual = float(np.median(steps)) if len(steps) else dt
    report.seconds = float(f"{usual:.4g}")
    if given is None and usual > _SLOW * dt:
        hint = "Give the plant that dt, log faster, or pass max_gap= for a log that holds changes only."
        expected = f"rows at most as far apart as the control interval, {dt:g} s"
        raise InvalidDataError(f"{name}: time", expected=expected, actual=f"{usual:g} s", hint=hint)
    limit = 1.5 * max(dt, usual) if given is None else float(given)
    gaps = int((steps > limit).sum())
    if gaps:
        first = rows.place(int(np.flatnonzero(steps > limit)[0]) + 1)
        gap = "gap" if gaps == 1 else "gaps"
        report.note(f"{gaps} {gap} of more than {limit:g} s, where new episodes begin, the first before {first}")
    return limit


def _mend(rows: Rows, wanted: Wanted, report: LogReport) -> None:
    """Takes out what cannot be: values beyond ranges, spikes, sensors that stand still, inputs beyond their bounds."""
    for each in wanted.inputs:
        _bounded(rows, each, report)
    for each in wanted.states:
        v = rows.values[each.name]
        beyond = (v < each.low) | (v > each.high)
        if beyond.any():
            i = int(np.flatnonzero(beyond)[0])
            if beyond.mean() > _MOST_BEYOND:
                _refuse_beyond(rows, each, beyond, _UNIT)
            report.leave_out(
                each.name, f"outside {each.low:g} to {each.high:g} {each.unit}".rstrip(), beyond.sum(), rows.place(i)
            )
            v[beyond] = np.nan
        good = np.flatnonzero(np.isfinite(v)) if np.isnan(v).any() else slice(None)
        own = v[good]
        far = faults.spikes(own)
        if len(far):
            where = far if isinstance(good, slice) else good[far]
            report.leave_out(each.name, "a spike", len(far), rows.place(int(where[0])))
            v[where] = np.nan
        others = [rows.values[q.name] for q in (*wanted.states, *wanted.inputs) if q.name != each.name]
        full = np.where(np.isfinite(v), v, np.inf) if np.isnan(v).any() else v
        _free_of_stuck(rows, each, full, others, report)
        ends = [end for end in (each.low, each.high) if np.isfinite(end)]
        for end in ends:
            if (share := float(np.mean(v == end))) > _CLIPPED:
                report.note(f"{each.name} is at the end of its range, {end:g}, in {share:.0%} of the rows")
    for each, period in zip(wanted.signals, wanted.periods, strict=True):
        if period is None:
            _plausible(rows, each, report)


def _plausible(rows: Rows, each: Quantity, report: LogReport) -> None:
    """A signal about its range: what comes from outside may leave it, but not lie farther off than it is wide."""
    v, width = rows.values[each.name], each.high - each.low
    if not np.isfinite(width):
        return
    if np.mean((v < each.low - width) | (v > each.high + width)) > _MOST_BEYOND:
        _refuse_beyond(rows, each, (v < each.low) | (v > each.high), _UNIT)
    margin = _ROUNDED * width  # an end that was converted, or written with few digits
    share = float(np.mean((v < each.low - margin) | (v > each.high + margin)))
    if share > _CLIPPED:
        text = f"{each.name} is outside its range, {each.low:g} to {each.high:g} {each.unit}".rstrip()
        report.note(f"{text}, in {share:.0%} of the rows")


def _free_of_stuck(rows: Rows, each: Quantity, v: Array, others: list[Array], report: LogReport) -> None:
    finite = [np.nan_to_num(other) for other in others]
    for a, e in faults.stuck(v, finite):
        if np.isfinite(v[a]):
            why, lasting = f"stuck at {v[a]:g} while others move", e == len(v)
            report.leave_out(each.name, why, e - a, rows.place(a), lasting=lasting)
            rows.blocked[a:e] = True


def _bounded(rows: Rows, each: Quantity, report: LogReport) -> None:
    """An input within its bounds: a little beyond is rounding, more is left out."""
    v = rows.values[each.name]
    margin = _CLIPPED * (each.high - each.low) if np.isfinite(each.high - each.low) else 0.0
    beyond = (v < each.low - margin) | (v > each.high + margin)
    if beyond.any():
        i = int(np.flatnonzero(beyond)[0])
        if beyond.mean() > _MOST_BEYOND:
            _refuse_beyond(rows, each, beyond, "Are its bounds and its unit right? units={...} says the log's.")
        why = f"outside its bounds, {each.low:g} to {each.high:g} {each.unit}".rstrip()
        report.leave_out(each.name, why, beyond.sum(), rows.place(i))
        rows.blocked |= beyond
    np.clip(v, each.low, each.high, out=v)


def _refuse_beyond(rows: Rows, each: Quantity, beyond: NDArray[np.bool_], hint: str) -> None:
    i = int(np.flatnonzero(beyond)[0])
    actual = f"{rows.values[each.name][i]:g}, and the like in {beyond.mean():.0%} of the rows"
    expected = f"values from {each.low:g} to {each.high:g} {each.unit}".rstrip()
    raise InvalidDataError(f"{rows.place(i)}: {each.name}", expected=expected, actual=actual, hint=hint)


def _sampled(name: str, rows: Rows, wanted: Wanted, max_gap: float, report: LogReport) -> LoggedTable:
    """The transitions between control instants."""
    t, dt = rows.t, wanted.dt
    series = {key: Series.of(t, v) for key, v in rows.values.items()}
    rows.values.clear()
    phase, aligned = phase_of(t, [series[each.name] for each in wanted.inputs], dt)
    k, at = grid(t, dt, phase, max_gap)
    if report.seconds < 0.999 * dt or np.abs((t - phase) / dt - np.rint((t - phase) / dt)).max() > 1e-3:
        where = "where inputs change" if aligned else "at the first row"
        report.note(
            f"resampled to {dt:g} s, intervals beginning {where}: states linearly between rows, signals as last known,"
            " inputs their mean over the interval (nothing is filtered)"
        )
    reaches = [_reach(series[each.name], each, t, max_gap, report) for each in wanted.states]
    columns = [between(series.pop(q.name), at, dt, reach) for q, reach in zip(wanted.states, reaches, strict=True)]
    states = np.stack(columns, axis=1)
    inputs, moved = np.empty((len(at), len(wanted.inputs))), 0
    for i, each in enumerate(wanted.inputs):
        inputs[:, i], changed = averaged(series.pop(each.name), at, dt, max_gap)
        moved = max(moved, changed)
    if moved:
        report.note(f"an input changed within {moved / max(len(at), 1):.1%} of the intervals: its mean was taken")
    outside = _signals(series, wanted, at, max_gap, rows.epoch)
    good: NDArray[np.bool_] = np.asarray(np.isfinite(states).all(axis=1))
    good &= np.isfinite(outside).all(axis=1)
    kept: NDArray[np.bool_] = np.asarray(np.isfinite(inputs).all(axis=1)) & free_of(t, rows.blocked, at, dt)
    kept &= good
    kept[:-1] &= (np.diff(k) == 1) & good[1:]
    kept[-1:] = False
    index = np.flatnonzero(kept)
    if not len(index):
        hint = f"What was left out: {report}" if report.left_out else ""
        if np.ptp(t) < dt:
            hint = _TOO_FAST.format(span=np.ptp(t), dt=dt) + hint
        expected = f"two instants {dt:g} s apart of which everything is known"
        raise InvalidDataError(name, expected=expected, actual=f"none in {report.rows} rows", hint=hint)
    starts = np.ones(len(index), dtype=bool)
    starts[1:] = np.diff(index) != 1
    ids = np.cumsum(starts) - 1
    report.steps, report.episodes = len(index), int(ids[-1]) + 1
    lost = int((np.diff(k) == 1).sum()) - len(index)
    if lost:
        report.note(f"{lost} control intervals are missing because of what was left out, or of empty cells")
    present = np.cumsum([0, *(1 + p if q is None else 2 for p, q in zip(wanted.previews, wanted.periods, strict=True))])

    def blocks() -> Any:
        for a in range(0, len(index), CHUNK):
            i = index[a : a + CHUNK]
            before = np.where(starts[a : a + CHUNK, None], inputs[i], inputs[i - 1])
            cost = wanted.cost(states[i], inputs[i], outside[i][:, present[:-1]], before)
            if not np.isfinite(cost).all():
                bad = int(np.flatnonzero(~np.isfinite(cost))[0])
                where = rows.place(int(np.searchsorted(t, at[i[bad]])))
                raise InvalidDataError(f"{where}: cost", expected="a finite number", actual=str(cost[bad]))
            s, s_next = (np.hstack([states[j], outside[j]]) for j in (i, i + 1))
            yield np.hstack([s, inputs[i], cost[:, None], s_next, np.zeros((len(i), 1))]), ids[a : a + CHUNK]

    ny, nu = states.shape[1] + outside.shape[1], len(wanted.inputs)
    built = packed_blocks(name, blocks, ny, nu)
    table = LoggedTable(built.rows, ny, nu, built.episode_ids, name, centring=built.centring)
    table.report = report
    table.names = _names(wanted)
    table.action_bounds = tuple(np.array([getattr(q, end) for q in wanted.inputs]) for end in ("low", "high"))  # type: ignore[assignment]
    return table


def _reach(own: Series, each: Quantity, t: Array, max_gap: float, report: LogReport) -> float:
    """How far apart values of a state may be for what lies between: over single empty cells where that is harmless.

    Harmless is what is off by less than a twentieth of what a step moves: a model that is fitted to steps does not
    notice. Where the state moves less smoothly than that, the step in front of the cell and the one behind it are lost.
    """
    reach = max(max_gap, _OVER_ONE * float(np.median(np.diff(t)))) if len(t) > 1 else max_gap
    n = int(single_gaps(own, t, max_gap, reach).sum())
    if not n:
        return max_gap
    off, step = bridge(own, reach)
    harmless = off <= _HARMLESS * step
    cells = "single empty cell" if n == 1 else "single empty cells"
    measured = f"a value between its neighbours is off by {off:.2g} {each.unit}".rstrip() + f", a step moves {step:.2g}"
    what = "bridged" if harmless else "not bridged, a new episode begins behind each"
    report.note(f"{each.name}: {n} {cells} {what} ({measured})")
    return reach if harmless else max_gap


def _names(wanted: Wanted) -> tuple[str, ...]:
    """Of the columns of observations and actions, with units."""
    names = [_labelled(each) for each in wanted.states]
    for each, preview, period in zip(wanted.signals, wanted.previews, wanted.periods, strict=True):
        if period is not None:
            names += [f"{each.name}, cosine", f"{each.name}, sine"]
        else:
            names += [_labelled(each), *(f"{_labelled(each)}, {k} ahead" for k in range(1, preview + 1))]
    return (*names, *(_labelled(each) for each in wanted.inputs))


def _labelled(each: Quantity) -> str:
    return f"{each.name} [{each.unit}]" if each.unit else each.name


def _signals(series: dict[str, Series], wanted: Wanted, at: Array, max_gap: float, epoch: float) -> Array:
    """The columns of the signals at control instants, those to come too; of clocks cosine and sine."""
    columns: list[Array] = []
    for each, preview, period in zip(wanted.signals, wanted.previews, wanted.periods, strict=True):
        if period is not None:
            phase = 2.0 * np.pi * (((at + epoch) / wanted.dt / period) % 1.0)
            columns += [np.cos(phase), np.sin(phase)]
            continue
        own = series[each.name]
        for ahead in range(1 + preview):
            later = held(own, at + ahead * wanted.dt, wanted.dt, max_gap)
            if ahead and len(own.t):  # what the log does not know any more stays as it was
                later = np.where(np.isnan(later), columns[-1], later)
            columns.append(later)
    return np.stack(columns, axis=1) if columns else np.zeros((len(at), 0))
