"""Damaged logs: what is intact is salvaged, what is not is said, and the log is kept."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from crashing import DATASET, episode, recording
from hypothesis import HealthCheck, given, settings, strategies as st
from typer.testing import CliRunner

from mpcoffline.cli.main import app
from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets import repair
from mpcoffline.datasets.recording.episode_log import EpisodeLog, scan
from mpcoffline.datasets.recording.log_format import LoggedEpisode, LogHeader
from mpcoffline.datasets.store.recording_lock import log_files

HEADER = LogHeader("test/log-v0", "name", "new", "{}", "{}")
FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def piece(number: int, first: int, last: int) -> LoggedEpisode:
    """Steps of the episode of that number, as a recorder writes a long one."""
    whole = LoggedEpisode.of(episode(number, length=10), number, complete=True)
    steps = ("actions", "rewards", "terminations", "truncations")
    arrays = {
        key: values[first:last] if key in steps else values[first + (first > 0) : last + 1]
        for key, values in whole.arrays.items()
    }
    return LoggedEpisode(number, last == 10, arrays)


def wanted(number: int) -> LoggedEpisode:
    return LoggedEpisode.of(episode(number, length=10 if number in (1, 3) else 5), number, complete=True)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[tuple[int, int]]]:
    """A log of five episodes, two of them in pieces, and from where to where each lies."""
    path = tmp_path_factory.mktemp("log") / "a.log"
    written = EpisodeLog(path, HEADER)
    places = []
    for number in range(5):
        begin = written._end
        if number in (1, 3):
            written.append_piece(piece(number, 0, 4))
            written.append_piece(piece(number, 4, 8))
            written.append(piece(number, 8, 10))
        else:
            written.append(wanted(number))
        places.append((begin, written._end))
    written.close()
    return path.read_bytes(), places


def check(found: LoggedEpisode, places: list[tuple[int, int]], damaged: range) -> bool:
    """Whether the episode is whole and right; a part of one that was damaged is the beginning of it, cut off."""
    expected = wanted(found.sequence)
    steps = len(found)
    whole = steps == len(expected)
    if not whole:
        first, last = places[found.sequence]
        assert damaged.start < last
        assert first < damaged.stop
        assert found.arrays["truncations"][-1]
        assert not found.complete
    for key, values in expected.arrays.items():
        got = found.arrays[key]
        if key == "truncations" and not whole:
            got, values = got[:-1], values[: steps - 1]
        np.testing.assert_array_equal(got, values[: len(got)])
        assert len(got) == len(values) or not whole
    return whole


@FUZZ
@given(data=st.data())
def test_a_flipped_bit_or_a_cut_costs_what_it_hits(tmp_path: Path, log: Any, data: st.DataObject) -> None:
    content, places = log
    path = tmp_path / "b.log"
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        changed = bytearray(content)
        changed[at] ^= 1 << data.draw(st.integers(0, 7))
        path.write_bytes(changed)
        damaged = range(at, at + 1)
    else:
        path.write_bytes(content[:at])
        damaged = range(at, len(content))
    undamaged = [n for n, (first, last) in enumerate(places) if last <= damaged.start or damaged.stop <= first]
    if len(content[: damaged.start]) < places[0][0] and damaged.stop == len(content):
        with pytest.raises(FileFormatError, match="a header"):
            scan(path, salvage=True)
        return
    index = scan(path, salvage=True)
    assert index.header == HEADER
    found = list(index.episodes())
    whole = [e.sequence for e in found if check(e, places, damaged)]
    # The first episode and the header behind it lie in one place here.
    assert set(undamaged) <= set(whole)
    assert len(set(whole)) == len(whole)
    if damaged.stop < len(content) and not index.damage:
        assert set(whole) == set(range(5))


@FUZZ
@given(holes=st.lists(st.tuples(st.integers(0, 4000), st.integers(1, 600)), min_size=1, max_size=3))
def test_blocks_that_are_lost_never_make_a_wrong_episode(tmp_path: Path, log: Any, holes: Any) -> None:
    content, places = log
    changed = bytearray(content)
    for begin, length in holes:
        changed[begin : begin + length] = bytes(len(changed[begin : begin + length]))
    path = tmp_path / "c.log"
    path.write_bytes(changed)
    for found in scan(path, salvage=True, fallback=HEADER).episodes():
        check(found, places, range(0, len(content)))


def test_repair_salvages_all_logs_of_a_recording(store: Path) -> None:
    recorded = recording()
    for number in range(8):
        recorded.append(number % 2, episode(number), complete=True)
    recorded.close()
    first, second = log_files(DATASET)
    content = bytearray(first.read_bytes())
    header = scan(first)
    place, _ = header.records[1][0]
    content[place + 10] ^= 1  # in the content of episode 2
    first.write_bytes(content)
    intact = second.read_bytes()
    before = bytes(content)
    with pytest.raises(FileFormatError, match=r"env-0000.log, record 2: .*repair --salvage"):
        repair(DATASET)
    assert first.read_bytes() == before
    result = CliRunner().invoke(app, ["datasets", "repair", DATASET, "--salvage"])
    assert result.exit_code == 0, result.output
    assert "salvaged, 7 episodes, 35 steps" in result.output
    assert "these are missing: [2]" in result.output
    dataset = minari.load_dataset(DATASET)
    for found, number in zip(dataset.iterate_episodes(), [0, 1, 3, 4, 5, 6, 7], strict=True):
        np.testing.assert_array_equal(found.observations, episode(number).observations)
    assert dataset.env_spec.id == "mpcoffline/PendulumSwingUp-v0"
    kept = store / ".broken" / f"{DATASET}-recording-0"
    assert (kept / first.name).read_bytes() == before
    assert (kept / second.name).read_bytes() == intact
    assert not (store / ".recording").exists()


def test_a_log_without_a_header_takes_that_of_the_others(store: Path) -> None:
    recorded = recording()
    for number in range(4):
        recorded.append(number % 2, episode(number), complete=True)
    recorded.close()
    first = log_files(DATASET)[0]
    content = bytearray(first.read_bytes())
    (begin, length), (after, _) = (places[0] for places in scan(first).records)
    content[:begin] = bytes(begin)
    content[begin + length : after] = bytes(after - begin - length)
    first.write_bytes(content)
    report = repair(DATASET, salvage=True)
    # The first record's frame is among what is lost, and so is the second's.
    assert (report.action, report.episodes) == ("salvaged", 2)
    assert any("the first bytes are damaged" in note for note in report.notes)
    assert report.backup is not None


def test_intact_logs_are_sealed_as_ever() -> None:
    recorded = recording()
    recorded.append(0, episode(0), complete=True)
    recorded.close()
    report = repair(DATASET, salvage=True)
    assert (report.action, report.notes, report.backup) == ("sealed", (), None)


def test_nothing_intact_leaves_the_logs(store: Path) -> None:
    recorded = recording()
    recorded.append(0, episode(0), complete=True)
    recorded.close()
    path = log_files(DATASET)[0]
    content = bytearray(path.read_bytes())
    content[scan(path).records[0][0][0] + 5] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="expected an intact episode, got none"):
        repair(DATASET, salvage=True)
    assert path.read_bytes() == content


def test_pieces_without_an_end_are_an_episode_that_is_cut_off(tmp_path: Path) -> None:
    written = EpisodeLog(tmp_path / "d.log", HEADER)
    written.append(wanted(0))
    written.append_piece(piece(1, 0, 4))
    written.append_piece(piece(1, 4, 8))
    written.close(finished=False)
    shutil.copy(tmp_path / "d.log", tmp_path / "e.log")
    again = EpisodeLog(tmp_path / "d.log", HEADER)
    again.append(wanted(2))
    again.close()
    found = list(scan(tmp_path / "d.log").episodes())
    assert [(e.sequence, len(e), e.complete) for e in found] == [(0, 5, True), (1, 8, False), (2, 5, True)]
    assert found[1].arrays["truncations"].tolist() == [False] * 7 + [True]
    np.testing.assert_array_equal(found[1].arrays["observations"], wanted(1).arrays["observations"][:9])
    dropped = EpisodeLog(tmp_path / "e.log", HEADER, keep_cut=False)
    dropped.append(wanted(2))
    dropped.close()
    assert [e.sequence for e in scan(tmp_path / "e.log").episodes()] == [0, 2]
