"""What a log of episodes is made of: records, and their content.

A record is a frame and its content. The frame is a marker, the record's kind, the length and the CRC-32 of its content,
and a CRC-32 of these and of the record's place in the file: what lies elsewhere, such as a log within the content of
another one, is no record. Episodes are the length of a JSON description, the description, and the arrays' bytes.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets.table.numbers import NUMBERS, check_numbers

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

MAGIC = b"mpco-log"
VERSION = 2
HEADER, EPISODE, CLOSED, PART, END = 1, 2, 3, 4, 5
MARKER = b"\xb7\x1eR\x0a"
FRAME = struct.Struct("<4sIII")  # marker, kind, length, CRC-32 of the content
CRC = struct.Struct("<I")
OVERHEAD = FRAME.size + CRC.size
_STEPS = ("actions", "rewards", "terminations", "truncations")


@dataclass(frozen=True)
class LogHeader:
    """What a log knows beside its episodes: enough to make a data set of them.

    Attributes:
        dataset_id: Minari id that the data set will have.
        recording: Random name of this recording, which the data set bears too: so that a second
            sealing of the same logs knows that it has been done.
        mode: What becomes of a data set that has this id: ``"new"`` (there must be none), ``"replace"``, or
            ``"extend"`` (the episodes are added to it).
        observation_space: The space in Minari's serialisation.
        action_space: The space in Minari's serialisation.
        env_spec: The environment's spec as JSON; None where it has none.
        algorithm_name: Metadata.
        description: Metadata.
        origin: What else makes it this recording and no other, a JSON object; None where nothing is known.
    """

    dataset_id: str
    recording: str
    mode: str
    observation_space: str
    action_space: str
    env_spec: str | None = None
    algorithm_name: str | None = None
    description: str | None = None
    origin: str | None = None


@dataclass(frozen=True)
class LoggedEpisode:
    """An episode as the log holds it.

    Attributes:
        sequence: Its place in the order in which episodes ended, over all environments.
        complete: False for the one under way when recording ended, whose last step is marked as truncated.
        arrays: ``observations (T+1, ...)``, ``actions (T, ...)``, ``rewards``, ``terminations``, ``truncations``
            ``(T,)``, and ``infos/...`` ``(T+1, ...)``; ``T`` observations and infos in pieces but the first.
        part: None for a whole episode. Of a long one that is written in pieces, where the first piece lies in the file,
            and which one this is.
    """

    sequence: int
    complete: bool
    arrays: dict[str, NDArray[Any]]
    part: tuple[int, int] | None = None

    @classmethod
    def of(cls, buffer: EpisodeBuffer, sequence: int, *, complete: bool) -> LoggedEpisode:
        """Takes over the arrays of Minari's buffer; ``InvalidDataError`` where one is not of numbers."""
        infos = {f"infos/{key}": value for key, value in (buffer.infos or {}).items()}
        columns = {key: getattr(buffer, key) for key in ("observations", *_STEPS)}
        arrays = {key: np.asarray(value) for key, value in (columns | infos).items()}
        for key, values in arrays.items():
            if values.dtype.kind not in NUMBERS:
                check_numbers(f"episode {sequence}: {key}", values)
        return cls(sequence, complete, arrays)

    def __len__(self) -> int:
        """Number of transitions."""
        return len(self.arrays["rewards"])

    def buffer(self) -> EpisodeBuffer:
        """The episode as Minari stores it."""
        from minari.data_collector import EpisodeBuffer

        columns: dict[str, Any] = {key: self.arrays[key] for key in ("observations", *_STEPS)}
        infos = {key.removeprefix("infos/"): value for key, value in self.arrays.items() if key.startswith("infos/")}
        return EpisodeBuffer(**columns, infos=infos)


def joined(pieces: Sequence[LoggedEpisode]) -> LoggedEpisode:
    """The episode that its pieces make; infos that one of them lacks are left out."""
    first, last = pieces[0], pieces[-1]
    if len(pieces) == 1:
        return replace(first, part=None)
    keys = [key for key in first.arrays if all(key in piece.arrays for piece in pieces)]
    arrays = {key: np.concatenate([piece.arrays[key] for piece in pieces]) for key in keys}
    return LoggedEpisode(last.sequence, last.complete, arrays)


def cut_off(episode: LoggedEpisode) -> LoggedEpisode:
    """The episode as one that did not end: its last step is marked as truncated."""
    truncations = episode.arrays["truncations"].copy()
    truncations[-1] |= not episode.arrays["terminations"][-1]
    return replace(episode, complete=False, arrays=episode.arrays | {"truncations": truncations})


def framed(kind: int, content: bytes, offset: int) -> bytes:
    """The bytes of a record that begins at ``offset``."""
    frame = FRAME.pack(MARKER, kind, len(content), zlib.crc32(content))
    return frame + CRC.pack(_frame_crc(frame, offset)) + content


def unframed(head: bytes, offset: int) -> tuple[int, int, int] | None:
    """Kind, length and CRC-32 of the content of a record that begins at ``offset``; None where none does."""
    if len(head) < OVERHEAD or CRC.unpack_from(head, FRAME.size)[0] != _frame_crc(head[: FRAME.size], offset):
        return None
    marker, kind, length, crc = FRAME.unpack_from(head)
    return (kind, length, crc) if marker == MARKER else None


def _frame_crc(frame: bytes, offset: int) -> int:
    return zlib.crc32(frame, offset & 0xFFFFFFFF)


def decode_header(content: bytes, path: Path) -> LogHeader:
    """Reads a header, or ``FileFormatError``."""
    try:
        values = json.loads(content)
        version = values.pop("version")
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise FileFormatError(f"log {path}, header", expected="JSON with a version", actual=str(error)) from error
    if version != VERSION:
        raise FileFormatError(
            f"log {path}", expected=f"version {VERSION}", actual=str(version), hint="Seal it with what recorded it."
        )
    try:
        header = LogHeader(**values)
    except TypeError as error:
        raise FileFormatError(f"log {path}, header", expected="its fields", actual=str(error)) from error
    required = (header.dataset_id, header.recording, header.mode, header.observation_space, header.action_space)
    optional = (header.env_spec, header.algorithm_name, header.description, header.origin)
    if not all(isinstance(text, str) for text in (*required, *(text for text in optional if text is not None))):
        raise FileFormatError(f"log {path}, header", expected="texts", actual="something else")
    try:
        known = isinstance(json.loads(header.origin or "{}"), dict)
    except (ValueError, RecursionError):
        known = False
    if not known:
        raise FileFormatError(f"log {path}, header: origin", expected="a JSON object", actual="something else")
    return header


def encode(episode: LoggedEpisode) -> bytes:
    """The content of an episode's record."""
    arrays = {key: np.ascontiguousarray(value) for key, value in episode.arrays.items()}
    description = {
        "sequence": episode.sequence,
        "complete": episode.complete,
        "part": episode.part,
        "arrays": [[key, value.dtype.str, value.shape] for key, value in arrays.items()],
    }
    text = json.dumps(description).encode()
    return b"".join([CRC.pack(len(text)), text, *(value.tobytes() for value in arrays.values())])


def decode(content: bytes, where: str) -> LoggedEpisode:
    """Reads an episode or a piece of one, or ``FileFormatError``."""
    try:
        (length,) = CRC.unpack_from(content)
        description = json.loads(content[CRC.size : CRC.size + length])
        arrays, offset = {}, CRC.size + length
        for key, code, shape in description["arrays"]:
            dtype = np.dtype(str(code))
            if dtype.kind not in NUMBERS or min(shape, default=0) < 0:
                raise ValueError(f"{key} of type {dtype} and shape {shape}")
            values: NDArray[Any] = np.frombuffer(content, dtype, int(np.prod(shape, dtype=np.int64)), offset)
            arrays[str(key)] = values.reshape(shape).copy()
            offset += values.nbytes
        part = description["part"]
        episode = LoggedEpisode(
            int(description["sequence"]),
            bool(description["complete"]),
            arrays,
            None if part is None else (int(part[0]), int(part[1])),
        )
        _check_lengths(episode, left=len(content) - offset)
    except (
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        struct.error,
        RecursionError,
        OverflowError,
        MemoryError,
    ) as error:
        raise FileFormatError(where, expected="an episode", actual=f"{type(error).__name__}: {error}") from error
    return episode


def _check_lengths(episode: LoggedEpisode, left: int) -> None:
    steps = len(episode.arrays["rewards"])
    more = episode.part is None or episode.part[1] == 0
    lengths = {key: len(value) - (more and key not in _STEPS) for key, value in episode.arrays.items()}
    if left or not {"observations", *_STEPS} <= lengths.keys() or set(lengths.values()) != {steps} or steps == 0:
        raise ValueError(f"columns of {lengths} transitions, {left} bytes left over")
