"""What is to be done in the field, one controller of one log each, in which order, and what came of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

NAN = float("nan")


class Algorithm(NamedTuple):
    """A controller of the field.

    Attributes:
        label: What it is called on the page.
        needs_log: Whether it depends on the log; those that do not are done once a seed.
        peer: Whether d3rlpy trains it, in steps.
        cost: How long it takes beside the others, roughly: what is quick is done first.
        largest: The largest log that it is given by default; 0 for any.
    """

    label: str
    needs_log: bool = True
    peer: bool = False
    cost: int = 0
    largest: int = 0


#: All that are compared, in the order of the page's tables.
ALGORITHMS: dict[str, Algorithm] = {
    "truth": Algorithm("MPC, true model", needs_log=False),
    "behaviour": Algorithm("the log's controller", needs_log=False),
    "rough": Algorithm("MPC_1, rough model", needs_log=False),
    "identified": Algorithm("identified, plain MPC"),
    "default": Algorithm("mpcoffline, default"),
    "paper": Algorithm("mpcoffline, paper"),
    "bc": Algorithm("behaviour cloning", peer=True, cost=1),
    "td3+bc": Algorithm("TD3+BC", peer=True, cost=2),
    "iql": Algorithm("IQL", peer=True, cost=2, largest=5_000),
    "cql": Algorithm("CQL", peer=True, cost=3, largest=5_000),
    # Only its time is measured: what a pass over the log takes where each transition solves two MPCs.
    "mpcrl": Algorithm("mpcrl, LSTD-Q", cost=1),
}
#: With ``--search``: the same with the best of ten settings by closed loops on the plant, which no log gives.
SEARCHED = {f"{name}, searched": name for name in ("td3+bc", "iql", "cql")}
ALGORITHMS |= {
    name: ALGORITHMS[of]._replace(label=f"{ALGORITHMS[of].label}, best of 10 on the plant", cost=4)
    for name, of in SEARCHED.items()
}


@dataclass(frozen=True)
class Job:
    """One controller from one log, and its closed loops.

    Attributes:
        arena: Name of a task, or of a plant file.
        path: The plant file; empty for a task.
        algorithm: A key of :data:`ALGORITHMS`.
        size: Transitions that the log has at least; 0 where none is needed.
        seed: Of the log, the rough model, the learning and, on plant files, the starts.
        starts: Number of episodes.
        steps: Gradient steps of a peer's training; 0 for the others.
    """

    arena: str
    path: str
    algorithm: str
    size: int
    seed: int
    starts: int
    steps: int

    @property
    def key(self) -> tuple[str, str, int, int, int, int]:
        """What makes it the same job; where the plant file lies does not."""
        return self.arena, self.algorithm, self.size, self.seed, self.starts, self.steps

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.arena} {self.size} rows, seed {self.seed}: {self.algorithm}"


@dataclass(frozen=True)
class Outcome:
    """What came of a job; a line of the results. Means over the starts; NaN where there is none.

    Attributes:
        arena: As in :class:`Job`.
        algorithm: Likewise.
        size: Likewise.
        seed: Likewise.
        starts: Likewise.
        steps: Likewise.
        rows: Transitions that the log has, in whole episodes.
        cost: J, undiscounted.
        cost_error: Standard error of its mean over the starts.
        discounted: Jd, with the plant's own discount.
        success: Share of the episodes that end well, where the plant knows.
        violated: Share of the steps that violate a limit, where there are limits.
        train_s: Time of the training in s of one core; of ours with its choice.
        regressions_s: Of it, what ours learns in, without the choice.
        verdict_s: What ``diagnose`` takes besides.
        pass_s: What ours takes for one pass over the log: (FIT)'s error of each transition, and its gradient in theta.
        latency_ms: Median time of an action, one observation at a time.
        file_kb: Size of the saved controller.
        verdict: What ``diagnose`` says of ours.
        said: What else is to be known: the candidate that was handed out, the settings that a search took, the share
            of the log that was timed.
        error: What went wrong; such a job is tried again.
    """

    arena: str
    algorithm: str
    size: int
    seed: int
    starts: int
    steps: int
    rows: int = 0
    cost: float = NAN
    cost_error: float = NAN
    discounted: float = NAN
    success: float = NAN
    violated: float = NAN
    train_s: float = NAN
    regressions_s: float = NAN
    verdict_s: float = NAN
    pass_s: float = NAN
    latency_ms: float = NAN
    file_kb: float = NAN
    verdict: str = ""
    said: str = ""
    error: str = ""

    @property
    def has_own_starts(self) -> bool:
        """Whether these are logged episodes, which began elsewhere than the others'."""
        return self.algorithm == "behaviour" and bool(self.said)

    @property
    def key(self) -> tuple[str, str, int, int, int, int]:
        """That of its job."""
        return self.arena, self.algorithm, self.size, self.seed, self.starts, self.steps

    def __str__(self) -> str:
        """In short."""
        return self.error or f"J {self.cost:.5g} +- {self.cost_error:.2g}, trained in {self.train_s:.0f} s"


def jobs_of(
    arenas: dict[str, str],
    algorithms: Iterable[str],
    sizes: Sequence[int],
    seeds: Sequence[int],
    starts: int,
    steps: int,
) -> list[Job]:
    """All jobs, in the order in which they are worth the most: one seed of all before the next, what is slow last.

    Args:
        arenas: Tasks and plants in their order, and the plants' files; an empty path for a task.
        algorithms: Keys of :data:`ALGORITHMS`.
        sizes: Of the logs.
        seeds: The seeds.
        starts: Episodes of each controller.
        steps: Gradient steps of each peer's training.
    """
    wanted: list[tuple[tuple[int, ...], Job]] = []
    chosen = list(dict.fromkeys(algorithms))
    for name in chosen:
        algorithm = ALGORITHMS[name]
        trained = steps if algorithm.peer else 0
        for turn, seed in enumerate(seeds):
            for place, (arena, path) in enumerate(arenas.items()):
                for size in _sizes(name, algorithm, sizes, first=turn == 0):
                    job = Job(arena, path, name, size, seed, starts, trained)
                    # What plant files are to be done waits for the tasks; CQL waits for all.
                    slow = max(0, algorithm.cost - 2)
                    wanted.append(((slow, turn, bool(path), algorithm.cost, size, place, chosen.index(name)), job))
    return [job for _, job in sorted(wanted, key=lambda each: each[0])]


def _sizes(name: str, algorithm: Algorithm, sizes: Sequence[int], *, first: bool) -> list[int]:
    """The logs that an algorithm is given; a search is of one seed and one log."""
    if not algorithm.needs_log:
        return [0]
    if name in SEARCHED:
        return [size for size in sizes if size == algorithm.largest and first]
    return [size for size in sizes if not algorithm.largest or size <= algorithm.largest]
