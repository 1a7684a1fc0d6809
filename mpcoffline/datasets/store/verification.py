"""Is a data set what it claims to be? Structure, hashes, NaN, bounds, alignment, ends of episodes, reward = -cost."""

from __future__ import annotations

from collections.abc import Iterator, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, StorageError
from mpcoffline.core.tables import Table, verdict
from mpcoffline.core.text import visible

from .hdf5_guard import episode_number
from .ids import check_dataset_id, dataset_path, is_local
from .local import open_local
from .manifest import MANIFEST, differences, write_manifest
from .opening import DATA_FILE, faults_of, open_to_examine

if TYPE_CHECKING:
    from minari import MinariDataset
    from rich.console import RenderableType

CHECKS = ("structure", "hash", "alignment", "finite", "bounds", "ends", "cost")
SHOWN = 20
# Rounding of float32: a value that was stored in single precision still counts as the same.
ROUNDING = 1e-6


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it should be.

    Attributes:
        check: One of :data:`CHECKS`.
        message: What was expected and what was found.
        episode: Where; None for the data set as a whole.
        step: The first such step within the episode (a row of its observations or actions); None for all of it.
        serious: False for what is worth knowing but harms no learning.
    """

    check: str
    message: str
    episode: int | None = None
    step: int | None = None
    serious: bool = True

    @property
    def place(self) -> str:
        """Episode and step in words."""
        where = "data set" if self.episode is None else f"episode {self.episode}"
        return where if self.step is None else f"{where}, step {self.step}"

    def __str__(self) -> str:
        return visible(f"{'error' if self.serious else 'note'}: {self.check}: {self.place}: {self.message}")


@dataclass(frozen=True)
class VerifyReport:
    """What :func:`verify` found.

    Attributes:
        dataset_id: Minari id.
        episodes: Number of episodes looked at.
        steps: Number of transitions in those that could be read.
        hashed: Whether there is a manifest, so that the files could be compared with it.
        findings: At most one for each check and episode, in the order of the data.
    """

    dataset_id: str
    episodes: int
    steps: int
    hashed: bool
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing serious was found."""
        return not any(finding.serious for finding in self.findings)

    @property
    def headline(self) -> str:
        """One line: id, size, verdict."""
        hashed = f"files compared with {MANIFEST}" if self.hashed else f"no {MANIFEST}, files not compared"
        serious = sum(finding.serious for finding in self.findings)
        notes = len(self.findings) - serious
        verdict = "ok" if self.ok else f"{serious} errors"
        extra = f", {notes} notes" if notes else ""
        return f"{self.dataset_id}: {verdict}{extra} ({self.episodes} episodes, {self.steps} steps, {hashed})"

    def __str__(self) -> str:
        lines = [self.headline, *(str(finding) for finding in self.findings[:SHOWN]), *self._more()]
        return visible("\n".join(lines))

    def __rich__(self) -> RenderableType:
        shown = self.findings[:SHOWN]
        rows = [(finding.check, finding.place, finding.message) for finding in shown]
        styles = ["red" if finding.serious else "yellow" for finding in shown]
        table = Table(("check", "where", "what"), rows, styles=styles) if rows else None
        return verdict(self.headline, self.ok, table, self._more())

    def _more(self) -> list[str]:
        hidden = len(self.findings) - SHOWN
        return [f"... and {hidden} more"] if hidden > 0 else []


def verify(dataset: MinariDataset | str, *, accept: bool = False) -> VerifyReport:
    """Checks a data set without changing its data, and without importing anything that its files name.

    * structure: Minari can read it, its counts are true, episode ids are 0, 1, ..., and nothing points to other files;
    * hash: the files are those of the manifest, where there is one;
    * alignment: T actions, rewards, terminations and truncations go with T+1 observations and infos;
    * finite: no NaN and no inf;
    * bounds: actions lie in the action space (observations outside of theirs are a note);
    * ends: an episode terminates or is truncated at its last step, and only there;
    * cost: reward = -infos/cost, where the cost is recorded.

    Args:
        dataset: The data set, or the id of one in the local store or shipped with this package.
        accept: Whether its files, as they are now, get a new manifest where nothing but the old one speaks against
            them: after Minari's own tools, or you, have changed a data set on purpose. The report says that it was so.

    Returns:
        The report. Damage is a finding, not an exception.

    Raises:
        InvalidArgumentError: For an id against Minari's grammar.
        UnknownIdError: For the id of no data set here.
        StorageError: Where the new manifest cannot be written.
    """
    if not isinstance(dataset, str) and hasattr(dataset, "iterate_episodes"):
        dataset_id, folder = str(dataset.spec.dataset_id), Path(dataset.spec.data_path).parent
    else:
        check_dataset_id(dataset)
        dataset_id, folder = str(dataset), dataset_path(str(dataset))
    try:
        if isinstance(dataset, str) and is_local(dataset_id):
            dataset, faults = open_to_examine(folder)
        else:
            dataset = open_local(dataset_id) if isinstance(dataset, str) else dataset
            faults = faults_of(folder)
        report = _report(dataset, dataset_id, folder, faults)
    except (FileFormatError, OSError) as error:
        hashed, findings = _hash_findings(folder)
        report = VerifyReport(dataset_id, 0, 0, hashed, (Finding("structure", str(error)), *findings))
    serious = {finding.check for finding in report.findings if finding.serious}
    if not accept or serious != {"hash"}:
        return report
    try:
        write_manifest(folder)
    except FileFormatError as error:
        return replace(report, findings=(*report.findings, Finding("hash", f"not accepted: {error}")))
    except OSError as error:
        raise StorageError.of(folder / MANIFEST, error) from error
    kept = tuple(replace(f, serious=False) if f.check == "hash" else f for f in report.findings)
    return replace(report, findings=(*kept, Finding("hash", f"accepted: {MANIFEST} is written anew", serious=False)))


def _report(dataset: MinariDataset, dataset_id: str, folder: Path, faults: dict[str, str]) -> VerifyReport:
    findings = [Finding("structure", fault, episode_number(name)) for name, fault in faults.items()]
    faulty = {number for number in map(episode_number, faults) if number is not None}
    findings += _looked_at("structure", None, _structure_findings(dataset, dataset_id, faulty))
    hashed, changed = _hash_findings(folder)
    findings += changed
    steps = 0
    for number, episode in _episodes(dataset, faulty):
        if isinstance(episode, Exception):
            findings.append(Finding("structure", f"unreadable: {type(episode).__name__}: {episode}", number))
            continue
        with suppress(TypeError):  # the alignment says so
            steps += len(episode.rewards)
        findings += _looked_at("alignment", number, _episode_findings(dataset, episode))
    findings += _looked_at("structure", None, _count_findings(dataset, steps))
    return VerifyReport(dataset_id, dataset.total_episodes, steps, hashed, tuple(findings))


def _looked_at(check: str, episode: int | None, findings: Iterator[Finding]) -> list[Finding]:
    """What a check finds; what it stumbles over is a finding too: no file's content is an exception here."""
    found: list[Finding] = []
    try:
        found.extend(findings)
    except Exception as error:  # references, texts, compounds, other ranks: what a check was not made for
        found.append(Finding(check, f"not what can be checked: {type(error).__name__}: {error}", episode))
    return found


def _count_findings(dataset: MinariDataset, steps: int) -> Iterator[Finding]:
    storage = dataset.storage
    if dataset.total_episodes == storage.total_episodes and steps != storage.total_steps:
        yield Finding("structure", f"expected the metadata's {storage.total_steps} steps, got {steps}")


def _episodes(dataset: MinariDataset, faulty: Set[int]) -> Iterator[tuple[int, Any]]:
    """The id of each episode that may be read with its data, or with what was raised in reading it."""
    left = [int(index) for index in dataset.episode_indices if int(index) not in faulty]
    while left:
        reader = iter(dataset.iterate_episodes(list(left)))  # one for all: each opens the file anew
        while left:
            try:
                episode: Any = next(reader)
            except Exception as error:  # HDF5 and Arrow raise whatever the damage makes them
                yield left.pop(0), error
                break
            yield left.pop(0), episode


def _hash_findings(folder: Path) -> tuple[bool, list[Finding]]:
    try:
        return True, [Finding("hash", str(d), serious=d.concerns_data) for d in differences(folder)]
    except FileNotFoundError:
        return False, []
    except (FileFormatError, OSError) as error:
        return True, [Finding("hash", str(error))]


def _structure_findings(dataset: MinariDataset, dataset_id: str, faulty: Set[int]) -> Iterator[Finding]:
    if dataset.spec.dataset_id != dataset_id:
        yield Finding("structure", f"expected the id of its folder, got {dataset.spec.dataset_id!r}")
    if dataset.total_episodes == 0:
        yield Finding("structure", "expected at least one episode, got none")
    path = Path(dataset.spec.data_path) / DATA_FILE
    if not path.exists():
        return
    try:
        with h5py.File(path, "r") as file:
            yield from _hdf5_findings(file, dataset.storage.total_episodes, faulty)
    except (OSError, RuntimeError, KeyError) as error:
        yield Finding("structure", f"{path.name} is damaged: {error}")


def _hdf5_findings(file: h5py.File, episodes: int, faulty: Set[int]) -> Iterator[Finding]:
    names = set(file)
    wanted = {f"episode_{i}" for i in range(min(episodes, len(names) + SHOWN))}
    if names != wanted or episodes != len(wanted):
        odd = sorted(names ^ wanted)
        yield Finding(
            "structure",
            f"expected the groups episode_0 to episode_{episodes - 1} of the metadata, got {len(names)} groups;"
            f" missing or odd: {', '.join(odd[:3])}{', ...' if len(odd) > 3 else ''}",
        )
    seen: dict[int, str] = {}
    for name in sorted(names & wanted, key=lambda name: int(name[8:])):
        number = int(name[8:])
        if number in faulty:
            continue
        stored = file[name].attrs.get("id", number)
        found = int(stored)
        if found != stored:
            yield Finding("structure", f"expected an integer as its id, got {stored}", number)
        elif found in seen:
            yield Finding("structure", f"expected an episode id of its own, got {found} as in {seen[found]}", number)
        elif found != number:
            yield Finding("structure", f"expected the episode id {number}, got {found}", number)
        seen.setdefault(found, name)


def _episode_findings(dataset: MinariDataset, episode: Any) -> Iterator[Finding]:
    number, steps, infos = int(episode.id), len(episode.rewards), episode.infos or {}
    columns = {
        "observations": (episode.observations, steps + 1, dataset.observation_space),
        "actions": (episode.actions, steps, dataset.action_space),
        "rewards": (episode.rewards, steps, None),
        "terminations": (episode.terminations, steps, None),
        "truncations": (episode.truncations, steps, None),
        **{f"infos/{key}": (infos[key], steps + 1, None) for key in ("cost", "state") if key in infos},
    }
    arrays: dict[str, NDArray[Any]] = {}
    for name, (values, length, space) in columns.items():
        if space is not None and not isinstance(space, spaces.Box):
            continue  # Dict, Tuple, Text: nothing that an MPC could learn from
        array = arrays[name] = np.asarray(values)
        if array.dtype.kind not in "fiub":
            yield Finding("alignment", f"{name}: expected numbers, got {array.dtype}", number)
            return
        wanted = (length, *space.shape) if space is not None else (length, *array.shape[1:])
        if array.shape != wanted or steps == 0:
            yield Finding("alignment", f"{name}: expected shape {wanted} of T >= 1 steps, got {array.shape}", number)
            return
    for name, array in arrays.items():
        yield from _finite(name, array, number)
    for name, serious in (("actions", True), ("observations", False)):
        if name in arrays:
            yield from _bounds(name, arrays[name], columns[name][2], number, serious=serious)
    yield from _ends(arrays["terminations"], arrays["truncations"], number)
    if "infos/cost" in arrays:
        yield from _cost(arrays["rewards"], arrays["infos/cost"], number)


def _finite(name: str, array: NDArray[Any], episode: int) -> Iterator[Finding]:
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    if not bad.any():
        return
    step, count = int(np.flatnonzero(bad)[0]), int(bad.sum())
    if name.startswith("infos/") and count == 1 and step == 0:
        yield Finding("finite", f"{name}: unknown at the start (recording began halfway)", episode, 0, serious=False)
    else:
        yield Finding("finite", f"{name}: expected finite numbers, got NaN or inf in {count} rows", episode, step)


def _bounds(name: str, array: NDArray[Any], space: spaces.Box, episode: int, *, serious: bool) -> Iterator[Finding]:
    low, high, values = (np.asarray(a, dtype=np.float64) for a in (space.low, space.high, array))
    slack = [ROUNDING * np.maximum(1.0, np.where(np.isfinite(b), np.abs(b), 1.0)) for b in (low, high)]
    outside = (values < low - slack[0]) | (values > high + slack[1])
    if outside.any():
        place = tuple(int(i) for i in np.argwhere(outside)[0])
        coordinate, rows = place[1:], int(outside.reshape(len(values), -1).any(axis=1).sum())
        label = f"{name}[{', '.join(map(str, coordinate))}]" if coordinate else name
        expected = f"{low[coordinate]:g} to {high[coordinate]:g}"
        message = f"{label}: expected {expected}, got {values[place]:g} ({rows} such rows)"
        yield Finding("bounds", message, episode, place[0], serious=serious)


def _ends(terminations: NDArray[Any], truncations: NDArray[Any], episode: int) -> Iterator[Finding]:
    for name, array in (("terminations", terminations), ("truncations", truncations)):
        if not np.isin(array, (0, 1)).all():
            yield Finding("ends", f"{name}: expected booleans, got values such as {array.max()}", episode)
            return
    ended = (terminations.astype(bool) | truncations.astype(bool)).reshape(len(terminations))
    if ended[:-1].any():
        step = int(np.flatnonzero(ended)[0])
        yield Finding("ends", f"expected an end at the last step {len(ended) - 1} only, got one before", episode, step)
    elif not ended[-1]:
        message = "expected a termination or a truncation at the last step, got neither"
        yield Finding("ends", message, episode, len(ended) - 1)


def _cost(rewards: NDArray[Any], costs: NDArray[Any], episode: int) -> Iterator[Finding]:
    if costs.size != len(costs):
        yield Finding("cost", f"infos/cost: expected shape ({len(costs)}, 1), got {costs.shape}", episode)
        return
    rewards, wanted = rewards.reshape(-1), -costs.reshape(-1)[1:].astype(np.float64)
    error = np.abs(rewards - wanted)
    bad = np.isfinite(error) & (error > ROUNDING * np.maximum(1.0, np.abs(wanted)))
    if bad.any():
        step = int(np.flatnonzero(bad)[0])
        found = f"expected -infos/cost = {wanted[step]:g}, got {rewards[step]:g} ({int(bad.sum())} such rows)"
        yield Finding("cost", f"rewards: {found}", episode, step)
