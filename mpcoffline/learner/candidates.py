"""What a fit could hand out: MPC_1, the whole fit and what lies between, tried on models of the log."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.core.text import check_name, figure
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Sensors
from mpcoffline.learning import Known
from mpcoffline.mpc import MPC
from mpcoffline.simulation.back_offs import BackOffs, backed_off
from mpcoffline.simulation.choice import FIRST, choose, various_first
from mpcoffline.simulation.polishing import Kept, polished
from mpcoffline.simulation.quick import are_slow, quick_policy
from mpcoffline.simulation.surroundings import surroundings_of
from mpcoffline.simulation.trials import Trials
from mpcoffline.solvers.ddp import Ahead

from .effort import Effort, core_seconds
from .fineness import fine_enough

if TYPE_CHECKING:
    from mpcoffline.core.progress import Bars

    from .learner import OfflineMPCLearner
    from .run import Run

FULL = "full"
TIGHTER = ", backed off"  # after the name of one whose limits were made tighter
TRIALS = "trials/"  # in front of the names of their arrays in a file

logger = logging.getLogger(__name__)
#: Tells what was handed out. Who shows a learner's findings himself can do without.
outcome = logger.getChild("outcome")


def _as_it_is(mpc: MPC) -> MPC:
    return mpc


@dataclass(frozen=True)
class Candidates(Mapping[str, MPC]):
    """The MPCs that were tried, by name, and how they did.

    Example:
        >>> print(learner.candidates)
        >>> policy = MPCPolicy(learner.candidates["identified"])

    Attributes:
        mpcs: By name: ``"MPC_1"``, ``"full"`` and those between.
        chosen: The one that the learner hands out.
        trials: Their closed loops on models of the log; None where one was taken by name.
        back_offs: How the limits of the chosen one were made tighter, where that was asked for, or pays.
        effort: What regressions, choice and search each gain, and how long they took; None where one was taken by name,
            and in what was read from a file.
    """

    mpcs: Mapping[str, MPC]
    chosen: str
    trials: Trials | None = None
    back_offs: BackOffs | None = None
    effort: Effort | None = field(default=None, compare=False)

    def __getitem__(self, name: str) -> MPC:
        """The MPC of a name.

        Raises:
            UnknownIdError: For another name, with those that there are.
        """
        if name not in self.mpcs:
            raise UnknownIdError.of("candidate", name, self.mpcs)
        return self.mpcs[name]

    def __contains__(self, name: object) -> bool:
        """Whether there is one of this name."""
        return name in self.mpcs

    def __iter__(self) -> Iterator[str]:
        """The names."""
        return iter(self.mpcs)

    def __len__(self) -> int:
        """How many there are."""
        return len(self.mpcs)

    @property
    def finding(self) -> str:
        """Which one was chosen and why, and which limits are tighter than they were given, in sentences."""
        return self._choice if self.back_offs is None else f"{self._choice} {self.back_offs}"

    @property
    def _choice(self) -> str:
        chosen = self.chosen.removesuffix(TIGHTER)
        if self.trials is None:
            return f"Handed out: {self.chosen!r}, as was asked."
        votes = int(self.trials.votes.sum())
        if not votes:
            return "Handed out: MPC_1. No model predicts the log, so nothing could be tried."
        where = f"of {len(self)} candidates in closed loop with {votes} model{'s' * (votes > 1)} of the log"
        if chosen == FIRST:
            return f"Handed out: MPC_1. None {where} is better for sure."
        gain = np.nanmean(self.trials.differences(chosen)[self.trials.votes], axis=1)
        level = np.nanmean(self.trials.of(FIRST)[self.trials.votes], axis=1)
        less, other = -float(np.median(gain)), f"MPC_1's {figure(float(np.median(level)), 4)}"
        cost = f"{figure(less)} less than {other}" if less > 0.0 else f"as much as {other}"
        return f"Handed out: {chosen!r}, the best {where} that was confirmed: an episode costs {cost}."

    def __str__(self) -> str:
        """A line each: cost of an episode less that of MPC_1, over the models that have a vote."""
        width = max(map(len, self.mpcs))
        return "\n".join(
            f"{'*' if name == self.chosen else ' '} {name:<{width}}  {self._figures(name)}".rstrip() for name in self
        )

    def _figures(self, name: str) -> str:
        if self.trials is None:
            return ""
        if not self.trials.votes.any():
            return "not tried: no model predicts the log"
        costs = self.trials.of(name)[self.trials.votes]
        tried = ~np.isnan(costs[0])
        if not tried.any():
            return "not tried"
        if name == FIRST:
            middle = figure(float(np.median(costs[:, tried].mean(axis=1))), 5)
            return f"{middle} an episode (median of {len(costs)} models)"
        means = self.trials.differences(name)[self.trials.votes][:, tried].mean(axis=1)
        middle, low, high = (figure(float(f(means)), sign=True) for f in (np.median, np.min, np.max))
        return f"{middle} (models: {low} to {high}), {tried.sum()} starts"

    @property
    def mpc(self) -> MPC:
        """The chosen one."""
        return self[self.chosen]

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description, of the trials the names."""
        models = None if self.trials is None else list(self.trials.models)
        mpcs = {name: mpc.to_json() for name, mpc in self.mpcs.items()}
        tighter = None if self.back_offs is None else self.back_offs.to_json()
        return {"mpcs": mpcs, "chosen": self.chosen, "models": models, "back_offs": tighter}

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The numbers of the trials."""
        return {} if self.trials is None else {TRIALS + name: v for name, v in self.trials.to_arrays().items()}

    @classmethod
    def from_files(cls, data: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Candidates:
        """The inverse of :meth:`to_json` and :meth:`to_arrays`.

        Raises:
            FileFormatError: If the chosen one is none of them, or the trials are of others.
        """
        mpcs = {
            check_name("candidate", name, error=FileFormatError): MPC.from_json(m) for name, m in data["mpcs"].items()
        }
        chosen, models, trials = data["chosen"], data["models"], None
        if chosen not in mpcs or FULL not in mpcs:
            raise FileFormatError("candidates", expected="the chosen one and the whole fit", actual=str(chosen))
        if models is not None:
            own = {name.removeprefix(TRIALS): v for name, v in arrays.items() if name.startswith(TRIALS)}
            named = tuple(check_name("model", name, error=FileFormatError) for name in models)
            trials = Trials.from_arrays(tuple(mpcs), named, own)
        tighter = None if data["back_offs"] is None else BackOffs.from_json(mpcs[chosen], data["back_offs"])
        return cls(mpcs, chosen, trials, tighter)


def whole_fit(learner: OfflineMPCLearner) -> MPC:
    """The MPC of the whole fit, whatever the learner hands out.

    Raises:
        MPCOfflineError: Before a fit.
    """
    return learner.mpc if learner.candidates is None else learner.candidates[FULL]


def check_also(nominal: MPC, also: Mapping[str, MPC]) -> None:
    """Refuses further candidates that no other could be compared with.

    Raises:
        InvalidArgumentError: For the name of one that there is anyhow, or an MPC of another plant.
    """
    for name, mpc in also.items():
        check_name("candidate", name)
        if name in (FIRST, FULL):
            raise InvalidArgumentError("also", expected=f"other names than {FIRST} and {FULL}", actual=repr(name))
        if (mpc.ny, mpc.nu) != (nominal.ny, nominal.nu):
            sizes = "{} observations and {} inputs"
            expected, actual = (sizes.format(each.ny, each.nu) for each in (nominal, mpc))
            raise InvalidArgumentError(f"also: {name}", expected=expected, actual=actual)


@contextmanager
def compiling_ahead(learner: OfflineMPCLearner) -> Iterator[Callable[[list[MPC]], None]]:
    """Gives what has solvers compiled beside the regressions, where a choice will ask for them.

    Args:
        learner: The learner.
    """
    with Ahead(None if learner.candidate == "auto" else 0) as ahead:
        yield lambda mpcs: ahead.start(mpcs if learner.softening is None else map(learner.softening, mpcs))


def candidates_of(
    learner: OfflineMPCLearner,
    run: Run,
    table: TransitionTable,
    bars: Bars,
    also: Mapping[str, MPC],
    kept: Kept | None = None,
    learned_in: float = 0.0,
) -> Candidates | None:
    """What a learner could hand out at the end of a run, and what it does; None where that is the whole fit alone.

    Args:
        learner: The learner.
        run: Its run, at the end.
        table: The transitions as they were logged.
        bars: Progress bars.
        also: Further candidates.
        kept: What an interrupted search has found, and where more of it is kept.
        learned_in: How long the run took, in s of one core.

    Raises:
        UnknownIdError: If it was asked for a candidate that there is none of.
    """
    known, nominal, soft = run.known, learner.nominal_mpc, learner.softening
    ready = _as_it_is if soft is None else soft
    if learner.candidate == "auto":
        show, begun = partial(bars.show, "choosing on models of the log"), core_seconds()
        between = run.method.candidates(known)
        if not between:
            if learner.polish:
                logger.warning("Not polished: %s knows of no candidates.", type(run.method).__name__)
            return None
        how: dict[str, Any] = {"polish": learner.polish, "keep_limits": learner.keep_limits}
        how |= {"kept": kept, "learned_in": learned_in, "sensors": learner.sensors, "ready": ready}
        known, between = fine_enough(known, between, table, ready)
        variants = partial(run.method.variants, known)
        return tried(nominal, known, {**between, **also}, table, variants, show, begun=begun, **how)
    between = {} if learner.candidate == FULL else run.method.candidates(known)
    mpcs = {FIRST: nominal, **between, **also, FULL: known.mpc}
    for turn in (1, 0, 1):  # a variant, and one of a variant
        if learner.candidate not in mpcs:
            alike = {name: mpc for name, mpc in mpcs.items() if learner.candidate.startswith(f"{name}, ")}
            mpcs |= run.method.variants(known, alike, turn) if alike else {}
    found = Candidates(mpcs if soft is None else {name: soft(mpc) for name, mpc in mpcs.items()}, learner.candidate)
    _ = found.mpc  # refuses a name that is none of them
    return None if learner.candidate == FULL else found


def tried(
    nominal: MPC,
    known: Known,
    between: Mapping[str, MPC],
    table: TransitionTable,
    variants: Callable[[Mapping[str, MPC], int], Mapping[str, MPC]],
    tell: Callable[[int, int, str], None],
    *,
    polish: bool = False,
    keep_limits: float | None = None,
    ready: Callable[[MPC], MPC] = _as_it_is,
    kept: Kept | None = None,
    learned_in: float = 0.0,
    sensors: Sensors | None = None,
    begun: float | None = None,
) -> Candidates:
    """Tries MPC_1, the whole fit and what lies between on models of the log, and chooses.

    Args:
        nominal: MPC_1.
        known: What is known at the end of the fit.
        between: The MPCs between.
        table: The transitions as they were logged.
        variants: Of good ones.
        tell: Is told how many starts of how many are done, and what is tried.
        polish: Whether the best one's weights are moved by what closed loops cost.
        keep_limits: In which share of its simulated steps the best one is to keep the given limits; None for as far as
            that pays.
        ready: What becomes of each before it is tried.
        kept: What an interrupted search over the weights has found, and where more of it is kept.
        learned_in: How long the regressions took, in s of one core.
        sensors: What the MPCs will see in place of states.
        begun: When the choice began, in s of one core; now by default.
    """
    begun = core_seconds() if begun is None else begun
    mpcs = _different({name: ready(mpc) for name, mpc in {FIRST: nominal, **between, FULL: known.mpc}.items()})
    if known.found is None:
        raise InvalidArgumentError("candidates", expected="an identified model to try them on", actual="none")
    with Ahead() as ahead:
        ahead.start(mpcs.values())
        if ahead.works:  # which variants will be asked for is not known yet; but most of them are the same code
            ahead.start(variants({name: mpc for name, mpc in mpcs.items() if name != FIRST}, 0).values())

        def variants_ahead(good: Mapping[str, MPC], turn: int) -> Mapping[str, MPC]:
            found = variants(good, turn)
            ahead.start(found.values())
            return found

        around = surroundings_of(
            known.mpc,
            nominal,
            table,
            known.found,
            are_slow=lambda: are_slow(quick_policy(mpc) for mpc in (mpcs[FIRST], mpcs[FULL])),
            choosing=True,
            seed=known.seed,
            sensors=sensors,
        )
        around = various_first(around, mpcs[FIRST])
        trials, chosen = choose(mpcs, around, variants_ahead, tell, FULL)
    seconds, steps = {"the regressions": learned_in, "the choice": core_seconds() - begun}, [FIRST, FULL, chosen]
    if polish:
        begun = core_seconds()
        better, name = polished(mpcs[chosen], around, known.seed, tell, kept), f"{chosen}, polished"
        logger.log(logging.INFO if better.taken else logging.WARNING, "%s: %s", chosen, better.reason)
        if better.taken:
            mpcs, trials = {**mpcs, name: better.mpc}, trials.with_names([name])
            trials.fill({name: around.seeing(quick_policy(better.mpc))}, around, slice(0, len(trials.rows)))
            chosen = name if trials.improves(name) else chosen
        seconds["polishing"] = core_seconds() - begun
        steps.append(chosen)
    effort = Effort.of(trials, seconds, steps)
    tighter, taken = backed_off(mpcs[chosen], around, keep_limits, tell), keep_limits is not None
    if tighter.mpc is not mpcs[chosen]:
        name = chosen + TIGHTER
        mpcs, trials = {**mpcs, name: tighter.mpc}, trials.with_names([name])
        trials.fill({name: around.seeing(quick_policy(tighter.mpc))}, around, slice(0, len(trials.rows)))
        taken = taken or (trials.improves(name) and trials.improves(name, chosen))
        chosen = name if taken else chosen
    found = Candidates(mpcs, chosen, trials, tighter if taken else None, effort)
    if polish:
        logger.info("%s", effort)
    outcome.log(logging.WARNING if chosen == FIRST else logging.INFO, "%s\n%s", found.finding, found)
    return found


def _different(mpcs: dict[str, MPC]) -> dict[str, MPC]:
    """Without those that are the same as one before; the whole fit stays by its name."""
    texts = {name: str(mpc.to_json()) for name, mpc in mpcs.items()}
    kept: dict[str, MPC] = {}
    for name, mpc in mpcs.items():
        others = [texts[FULL], *(texts[other] for other in kept)] if name not in (FIRST, FULL) else []
        if texts[name] not in others:
            kept[name] = mpc
    return kept
