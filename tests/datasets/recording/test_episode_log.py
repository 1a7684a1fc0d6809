"""The log: there and back, torn tails, damage in the middle, and any bytes at all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from crashing import episode
from hypothesis import HealthCheck, given, settings, strategies as st

from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets.recording import episode_log, log_format
from mpcoffline.datasets.recording.episode_log import EpisodeLog, scan
from mpcoffline.datasets.recording.log_format import LoggedEpisode, LogHeader

HEADER = LogHeader("test/log-v0", "name", "new", "{}", "{}")


def written(path: Path, episodes: int = 4, *, finished: bool = False) -> tuple[Path, list[int]]:
    """A log, and its size after the header and each episode."""
    log = EpisodeLog(path, HEADER)
    sizes = [path.stat().st_size]
    for number in range(episodes):
        log.append(LoggedEpisode.of(episode(number), number, complete=number != 2))
        sizes.append(path.stat().st_size)
    log.close(finished=finished)
    return path, sizes


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("log") / "a.log")[0].read_bytes()


def test_there_and_back(tmp_path: Path) -> None:
    path, _ = written(tmp_path / "a.log", finished=True)
    index = scan(path)
    assert (index.header, index.torn, index.closed) == (HEADER, 0, True)
    for number, found in enumerate(index.episodes()):
        assert (found.sequence, found.complete, len(found)) == (number, number != 2, 5)
        wanted = LoggedEpisode.of(episode(number), number, complete=True)
        assert found.arrays.keys() == wanted.arrays.keys()
        for key, values in wanted.arrays.items():
            np.testing.assert_array_equal(found.arrays[key], values)
            assert found.arrays[key].dtype == values.dtype
        assert set(found.buffer().infos) == {"cost"}


def first_end(begin: int) -> int:
    """Where the first episode ends, behind which the header comes again."""
    content = log_format.encode(LoggedEpisode.of(episode(0), 0, complete=True))
    return begin + len(log_format.framed(log_format.EPISODE, content, begin))


def test_every_torn_tail_ends_before_the_torn_episode(tmp_path: Path) -> None:
    path, sizes = written(tmp_path / "a.log")
    content = path.read_bytes()
    for size in range(sizes[0], len(content)):
        path.write_bytes(content[:size])
        index = scan(path)
        whole = sum(size >= end for end in [first_end(sizes[0]), *sizes[2:]])
        assert len(index.records) == whole
        assert index.end + index.torn == size
        assert index.end == sizes[whole] or (whole == 1 and index.end == first_end(sizes[0]))
    # Appending removes the torn end first.
    log = EpisodeLog(path, HEADER)
    log.append(LoggedEpisode.of(episode(7), 7, complete=True))
    log.close()
    assert [found.sequence for found in scan(path).episodes()] == [0, 1, 2, 7]


def test_a_file_cut_within_its_header_is_refused(tmp_path: Path) -> None:
    path, sizes = written(tmp_path / "a.log")
    content = path.read_bytes()
    for size in range(sizes[0]):
        path.write_bytes(content[:size])
        with pytest.raises(FileFormatError, match=r"another kind of file|expected a header"):
            scan(path)


def test_damage_before_an_intact_record_names_the_record(tmp_path: Path) -> None:
    path, sizes = written(tmp_path / "a.log", finished=True)
    content = path.read_bytes()
    for record in range(1, 5):
        for offset in (0, 7, 13, 18, 25, 100):
            damaged = bytearray(content)
            damaged[sizes[record - 1] + offset] ^= 4
            path.write_bytes(damaged)
            with pytest.raises(FileFormatError, match=rf"a.log, record {record}: .*before intact records.*--salvage"):
                scan(path)
            with pytest.raises(FileFormatError):
                EpisodeLog(path, HEADER)
            assert path.read_bytes() == damaged


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode_log, "VERSION", 1)
    with pytest.raises(FileFormatError, match="expected version 2, got 1"):
        written(tmp_path / "a.log")
    monkeypatch.undo()
    with pytest.raises(FileFormatError, match="expected version 2, got 1"):
        scan(tmp_path / "a.log")


FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def read_all(path: Path) -> list[LoggedEpisode]:
    try:
        return list(scan(path).episodes())
    except FileFormatError:
        return []


@FUZZ
@given(content=st.binary(max_size=200), magic=st.booleans())
def test_any_bytes_at_all(tmp_path: Path, content: bytes, magic: bool) -> None:
    path = tmp_path / "x.log"
    path.write_bytes(log_format.MAGIC * magic + content)
    assert read_all(path) == []


@FUZZ
@given(data=st.data())
def test_changed_bytes_give_right_episodes_or_an_error(tmp_path: Path, intact: bytes, data: st.DataObject) -> None:
    damaged = bytearray(intact)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "y.log"
    path.write_bytes(damaged)
    for found in read_all(path):
        wanted = LoggedEpisode.of(episode(found.sequence), found.sequence, complete=True)
        for key, values in wanted.arrays.items():
            np.testing.assert_array_equal(found.arrays[key], values)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
)
ARRAYS = st.lists(
    st.tuples(
        st.sampled_from(["observations", "actions", "rewards", "terminations", "truncations", "x"]),
        st.sampled_from(["<f4", "<f8", "|b1", "|O", "<U3", "f4,f4", "no"]) | JSON,
        st.lists(st.integers(-2, 2**40), max_size=3) | JSON,
    ),
    max_size=6,
)


@FUZZ
@given(
    description=st.fixed_dictionaries({"sequence": JSON, "complete": JSON, "part": JSON, "arrays": ARRAYS | JSON})
    | JSON
)
def test_a_record_with_the_right_crc_and_the_wrong_content(tmp_path: Path, description: object) -> None:
    path, _ = written(tmp_path / "z.log", episodes=0)
    text = json.dumps(description).encode()
    content = len(text).to_bytes(4, "little") + text + bytes(40)
    with path.open("ab") as file:
        file.write(log_format.framed(log_format.EPISODE, content, file.tell()))
    with pytest.raises(FileFormatError, match=r"record at byte \d+: expected an episode"):
        list(scan(path).episodes())
    path.unlink()


@FUZZ
@given(values=JSON | st.dictionaries(st.sampled_from(["version", "dataset_id", "mode"]), JSON))
def test_a_header_with_the_right_crc_and_the_wrong_content(tmp_path: Path, values: object) -> None:
    path = tmp_path / "h.log"
    path.write_bytes(log_format.MAGIC + log_format.framed(log_format.HEADER, json.dumps(values).encode(), 8))
    with pytest.raises(FileFormatError):
        scan(path)
