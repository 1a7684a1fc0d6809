"""OfflineMPCLearner: the two regressions of arXiv:2301.01667 as one ``fit``, and the policy that they give."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from gymnasium import spaces

from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.core.notebook import html_of
from mpcoffline.core.progress import Bars
from mpcoffline.core.text import check_name
from mpcoffline.core.threads import one_blas_thread
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import OutputIdentification, Sensors
from mpcoffline.estimation.consistency import check
from mpcoffline.learning import FitResult, Known, Method, ValueFunction, ValueMethod
from mpcoffline.mpc import MPC
from mpcoffline.mpc.shown import parameter_table
from mpcoffline.simulation.polishing import check_search

from .callbacks import Callback, Evaluator, asks_to_end, check_callbacks
from .candidates import Candidates, candidates_of, check_also, compiling_ahead
from .checkpoint import Checkpoint, History
from .effort import core_seconds
from .files import read_learner, write_learner
from .findings import findings
from .presets import method_of
from .run import Run
from .softening import Soften, Softening, check_soften, softening_found
from .together import Together, opened

if TYPE_CHECKING:
    from minari import MinariDataset

Learn = Literal["cost", "cost+model", "cost+model+constraints"]

logger = logging.getLogger(__name__)

_GROUPS: dict[str, tuple[str, ...]] = {name: tuple(name.split("+")) for name in get_args(Learn)}


class OfflineMPCLearner:
    r"""Learns the parameters of an MPC from logged transitions, without solving one MPC; then tries what it learned.

    Two regressions on the data set D, with the stage cost L (= -reward), discount gamma and successor s+::

        (VALUE)  phi* = argmin E_D[ (L(s,a) + gamma V_phi(s+) - V_phi(s))^2 ]
        (FIT)    th*  = argmin E_D[ (L(s,a) + gamma V_phi(s+) - gamma V_phi(f_th(s,a)) - Lhat_th(s,a))^2 ]
                               + l2 |th - th_0|^2

    By Theorem 1 of Gros & Zanon (doi:10.1109/TAC.2019.2913768) an MPC whose stage cost is Q*(s,a) - gamma V*(f(s,a))
    and whose terminal cost is V* gives the optimal policy even when its model f is wrong; (FIT) looks for that stage
    cost, and all presets but ``"paper"`` take the terminal cost from V too.

    Example:
        >>> mpc = nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.0, seed=0)
        >>> learner = OfflineMPCLearner(mpc, learn="cost+model", preset="paper", seed=0)
        >>> history = learner.fit("mpcoffline/pendulum/ddpg-v0")
        >>> action, state = learner.policy.predict(observation)

    Args:
        mpc: MPC_1: the nominal MPC. It is never changed.
        learn: ``"cost"`` fits the stage cost with the model fixed (MPC_2), ``"cost+model"`` both (MPC_3),
            ``"cost+model+constraints"`` besides parameters that soft limits alone depend on, as back-offs. A dead time
            that the model does not state (``delay=None``) is taken from the log in either case.
        preset: Name of a learning method with options in ``mpcoffline.learner.PRESETS``: ``"paper"`` is the published
            recipe, ``"default"`` what most users should get, ``"fast"`` has the shortest horizon, ``"best"`` the
            longest.
        seed: Seeds weights and minibatches. Same seed, data and machine: same theta, bit for bit.
        candidate: Which of the ``candidates`` is handed out. ``"auto"`` tries them on models of the log and takes
            the best, MPC_1 where none is better; that solves MPCs, learning does not. ``"full"``, or another name,
            takes that one and tries nothing; under ``integrator="auto"`` it is then as fine as the log asks for, not as
            its plans do. The paper's preset has no others than the whole fit.
        polish: Whether weights of the best candidate are moved, too, by what closed loops on models of the log cost
            (``mpcoffline.simulation.polishing``); needs ``candidate="auto"`` and ``pip install "mpcoffline[polish]"``.
            ``learner.candidates.effort`` says what that gained in its time, and the regressions in theirs.
        soften: ``"auto"`` puts exact penalties in place of the hard limits of all candidates and of what is handed out,
            at prices from MPC_1's multipliers in states of the log (:func:`mpcoffline.solvers.softened`): where a
            limit cannot be kept, it is violated as little as it must be. ``findings`` and report say which, and how
            dear. None, the default, leaves hard limits hard.
        keep_limits: In which share of the steps of closed loops on models of the log the given limits are to be kept,
            e.g. 0.95: those of the best candidate are made tighter until they are (chance constraints by back-off);
            ``findings`` and report say by how much. It needs ``candidate="auto"``. None makes soft limits tighter as
            far as that is cheaper in these loops, and leaves hard ones as they are.
        method: In place of a preset: a learning method, or the name of one in ``mpcoffline.learning.METHODS``, with its
            own options.
        value: Name of a value method, ``"residual"``, ``"td"``, ``"expectile"``, ``"iql"``, ``"auto"`` or another in
            ``mpcoffline.learning.VALUE_METHODS``, or a method itself; overrides the preset.
        value_function: A V_phi learned before, of the same data and discount, and of the MPC's state; (VALUE) is
            skipped. A dead time that is found changes nothing of it; none is looked for where its class is your own.
        device: Torch device for (VALUE). A GPU pays with large minibatches (``value_batch_size`` of some thousands).
        **options: Any option of the method, e.g. ``discount=0.97``, ``prior=1e-2`` or ``tau=0.1``; what two stages
            have takes the name of the stage in front (``value_n_steps``, ``fit_n_steps``). ``learner.method.options``
            has all of them.

    Raises:
        UnknownIdError: For an unknown preset, learning method, value method or option.
        InvalidArgumentError: For another ``learn``, a preset beside a method, or a value out of range.

    Attributes:
        method: The learning method with its options.
        preset: The name of the preset; None where a method was given.
        candidate, polish, soften, keep_limits: As given.
        candidates: What could be handed out, and how it did on models of the log; None before ``fit``, without choice.
        sensors: What ``output_policy`` sees in place of states; None where states were learned from.
    """

    def __init__(
        self,
        mpc: MPC,
        learn: Learn = "cost+model",
        preset: str = "default",
        seed: int = 0,
        *,
        candidate: str = "auto",
        polish: bool = False,
        soften: Soften | None = None,
        keep_limits: float | None = None,
        method: str | Method | None = None,
        value: str | ValueMethod | None = None,
        value_function: ValueFunction | None = None,
        device: str = "cpu",
        **options: Any,
    ) -> None:
        if not isinstance(learn, str) or learn not in _GROUPS:
            raise InvalidArgumentError("learn", expected=" or ".join(map(repr, _GROUPS)), actual=repr(learn))
        check_integers(0, seed=seed)
        if value_function is not None and value_function.ny != mpc.nx:
            size, hint = f"a function of {mpc.nx} coordinates", "Was it learned with dead time? mpc.with_delay(delay)."
            raise InvalidArgumentError("value_function", expected=size, actual=str(value_function.ny), hint=hint)
        self.preset: str | None = preset if method is None else None
        self.method: Method = method_of(preset, method, options if value is None else options | {"value": value})
        self.nominal_mpc: MPC = mpc
        self.learn: Learn = learn
        self.seed: int = int(seed)
        self.device: str = device
        self.candidate: str = check_name("candidate", candidate)
        self.polish: bool = bool(polish)
        if keep_limits is not None:
            check_number("keep_limits", keep_limits, 0.0, 1.0)
        for name, asked in (("keep_limits", keep_limits is not None), ("polish", self.polish)):
            if asked and candidate != "auto":
                raise InvalidArgumentError("candidate", expected=f"'auto' with {name}", actual=repr(candidate))
        self.soften: Soften | None = check_soften(soften)
        self.keep_limits: float | None = keep_limits
        self.softening: Softening | None = None
        self.start: MPC | None = None  # of the last fit
        self.candidates: Candidates | None = None
        self._given_value_function = self.value_function = value_function
        self.result: FitResult | None = None
        self.history: History = []
        self._mpc: MPC | Callable[[], MPC] | None = None  # while fitting, how to find it
        self._observation_space: spaces.Box | None = None
        self._policy: MPCPolicy | None = None
        self.sensors: Sensors | None = None

    def __repr__(self) -> str:
        """What it learns, how, and whether it has."""
        state = "fitted" if self.result is not None else "not fitted"
        if isinstance(self._mpc, MPC) and any(self._mpc.layout.delay):
            state += f", dead time {list(self._mpc.layout.delay)}"
        how = f"method={type(self.method).__name__}" if self.preset is None else f"preset={self.preset!r}"
        return f"{type(self).__name__}(learn={self.learn!r}, {how}, seed={self.seed}; {state})"

    def _repr_html_(self) -> str:
        shown = (self._mpc, self.nominal_mpc) if isinstance(self._mpc, MPC) else (self.nominal_mpc,)
        return html_of(repr(self), tables=[parameter_table(*shown)], sentences=self.findings)

    def __str__(self) -> str:
        """The same, and what was found beside the parameters."""
        return "\n".join([repr(self), *(f"  {each}" for each in self.findings)])

    @property
    def findings(self) -> tuple[str, ...]:
        """What the fit found of plant and costs beside the parameters, in sentences; none before ``fit``.

        Whether the logged cost is the MPC's, dead time, integrator, learned residual; which candidate is handed out.
        """
        if not isinstance(self._mpc, MPC):
            return ()
        chosen = () if self.candidates is None else (self.candidates.finding,)
        soft = softening_found(self.nominal_mpc, self._mpc)
        seen = () if self.sensors is None else (str(self.sensors),)
        return (*findings(self.nominal_mpc, self._mpc, self.result), *seen, *soft, *chosen)

    def fit(
        self,
        dataset: MinariDataset | TransitionTable | ShardedTable | OutputIdentification | str,
        *,
        n_steps: int | None = None,
        n_steps_per_epoch: int | None = None,
        evaluators: Mapping[str, Evaluator] | None = None,
        callbacks: Sequence[Callback] = (),
        checkpoint: str | PathLike[str] | None = None,
        show_progress: bool = True,
        also: Mapping[str, MPC] | None = None,
        start: MPC | None = None,
    ) -> History:
        """Learns, stage by stage: by all presets V_phi, then theta.

        First :func:`mpcoffline.check` compares the MPC with the data, and what it finds likely is logged as a warning.

        Args:
            dataset: A Minari data set, the id of one, a table of transitions, shards of what is larger than a machine
                (:class:`~mpcoffline.datasets.ShardedTable`, by one process or several), or what
                :func:`~mpcoffline.estimation.identify_from_outputs` found in a log that holds outputs in place of
                states: then candidates are tried behind an observer, and ``output_policy`` takes outputs.
            n_steps: Gradient steps of (VALUE), by far the longest part; the method's by default.
            n_steps_per_epoch: Steps between entries of the history; by default 500 in (VALUE) and 100 in (FIT).
            evaluators: Functions ``(learner, table) -> number`` by name, called at the end of each epoch from the first
                one of (FIT) on, when there is a policy: the one that would be handed out if the fit ended there.
            callbacks: Functions ``(learner, epoch, total_step)``, called at the end of each epoch; one that returns
                False, also numpy's or torch's, ends the fit. Where one has a method ``on_fit_end()``, it is called when
                the fit ends, for whatever reason. :mod:`mpcoffline.learner.loggers` has those that write CSV files and
                TensorBoard events, :mod:`mpcoffline.sb3` one that runs SB3's.
            checkpoint: A file that is written at the end of each epoch. Where it exists, the fit goes on from it and
                ends with the theta that it would have had without interruption, bit for bit.
            show_progress: Whether to draw a progress bar.
            also: Further MPCs of this plant by name, as one that runs already: candidates beside what is learned.
            start: An MPC that was learned before, as from a part of the data: identification begins there, too, and
                ends at the better minimum. What the data leave open stays near the given values.

        Returns:
            ``[(epoch, metrics), ...]``, first the epochs of (VALUE) with ``value_loss``, then those of (FIT) with
            ``fit_loss``.

        Raises:
            InvalidDataError: If the data do not fit the MPC, or hold NaN or actions out of bounds, or
                :func:`mpcoffline.check` is certain of a contradiction.
            InvalidArgumentError: If the checkpoint is of another fit, the given V_phi of another discount,
                ``dataset`` something else, or what ``polish`` needs is not installed.
            UnknownIdError: For an unknown data set id.
        """
        for _ in self.fitter(
            dataset,
            n_steps=n_steps,
            n_steps_per_epoch=n_steps_per_epoch,
            evaluators=evaluators,
            callbacks=callbacks,
            checkpoint=checkpoint,
            show_progress=show_progress,
            also=also,
            start=start,
        ):
            pass
        return self.history

    def fitter(
        self,
        dataset: MinariDataset | TransitionTable | ShardedTable | OutputIdentification | str,
        *,
        n_steps: int | None = None,
        n_steps_per_epoch: int | None = None,
        evaluators: Mapping[str, Evaluator] | None = None,
        callbacks: Sequence[Callback] = (),
        checkpoint: str | PathLike[str] | None = None,
        show_progress: bool = True,
        also: Mapping[str, MPC] | None = None,
        start: MPC | None = None,
    ) -> Iterator[tuple[int, dict[str, float]]]:
        """As :meth:`fit`, but yields ``(epoch, metrics)`` at the end of each epoch; the caller may stop between."""
        begun = core_seconds()
        if self.polish:
            check_search()
        for name in evaluators or {}:
            check_name("evaluator", name)
        check_callbacks(callbacks)
        check_also(self.nominal_mpc, also or {})
        if n_steps_per_epoch is not None:
            check_integers(1, n_steps_per_epoch=n_steps_per_epoch)
        method = self.method if n_steps is None else self.method.replaced({"value_n_steps": n_steps})
        self.sensors = None
        if isinstance(dataset, OutputIdentification):
            self.sensors, start, dataset = dataset.sensors, start or dataset.mpc, dataset.table
        table, observation_space, shards = opened(dataset, self.seed)
        together = Together(shards)
        if not together.is_first:
            callbacks, evaluators, show_progress = (), {}, False
        report = check(self.nominal_mpc, table)
        report.raise_for_errors()
        for finding in report.warnings:
            logger.warning("%s", finding)
        known = Known(self.nominal_mpc, table, _GROUPS[self.learn], self.seed, self.device, self._given_value_function)
        self.start, known = start, replace(known, start=start, shards=shards)
        self.softening = Softening.of(self.nominal_mpc, table, self.seed) if self.soften else None
        run = Run(method, known)
        saved = None if checkpoint is None else Checkpoint(checkpoint, run.identity)
        history: History = [] if saved is None else saved.resume(run)
        with ExitStack() as ending, Bars(show_progress) as bars, one_blas_thread():
            for callback in callbacks:
                if (end := getattr(callback, "on_fit_end", None)) is not None:
                    ending.callback(end)
            foresee = ending.enter_context(compiling_ahead(self))
            for epoch in run.epochs(n_steps_per_epoch, bars.busy, foresee):
                self.value_function, self.result = run.value_function, run.result
                self._mpc, self._policy, self._observation_space = self._ready(run), None, observation_space
                metrics = dict(epoch.metrics)
                if run.learned is not None:
                    metrics |= {name: float(evaluator(self, table)) for name, evaluator in (evaluators or {}).items()}
                history.append((len(history) + 1, metrics))
                self.history = history
                if saved is not None and run.result is None and together.is_first:
                    saved.write(run, history)  # what comes last takes seconds and can be repeated
                answers = [callback(self, len(history), epoch.total_step) for callback in callbacks]
                shown = ", ".join(f"{name} {value:.4g}" for name, value in epoch.metrics.items())
                bars.show(epoch.phase, epoch.step, epoch.n_steps, shown)
                yield history[-1]
                if together.any_asks(any(asks_to_end(answer) for answer in answers)):
                    break
            if run.learned is not None and together.is_first:
                bars.busy("models of the log")
                kept = None if saved is None else saved.kept
                self.candidates = candidates_of(self, run, table, bars, also or {}, kept, core_seconds() - begun)
                self._policy = None
            found = self._found() if self.candidates is None else self.candidates.mpc  # which lets go of the data
            self._mpc = together.handed_out(found)
            if self.sensors is not None and self._mpc is not None:
                self.sensors = self.sensors.suited(self._mpc, table)

    @property
    def mpc(self) -> MPC:
        """The learned MPC; a new object. While fitting, the one that would be handed out if the fit ended now.

        Raises:
            MPCOfflineError: Before ``fit``, and in it before the first epoch of (FIT).
        """
        found = self._found()
        if found is None:
            raise MPCOfflineError(
                "learner", expected="a fitted learner", actual="no fit yet", hint="Call fit(dataset)."
            )
        return found

    def _ready(self, run: Run) -> Callable[[], MPC] | None:
        """How to find the MPC that a run would hand out now; None before the last stage that takes steps."""
        learned, soft = run.learned, self.softening
        return learned if learned is None or soft is None else lambda: soft(learned())

    def _found(self) -> MPC | None:
        """The MPC; while fitting, its cost and its terminal cost take some seconds, once an epoch."""
        return self._mpc if isinstance(self._mpc, MPC) or self._mpc is None else self._mpc()

    @property
    def theta(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The learned parameters, ``(mpc.space.size,)``."""
        return self.mpc.theta

    @property
    def policy(self) -> MPCPolicy:
        """The learned MPC as an SB3-compatible policy.

        Raises:
            MPCOfflineError: Before ``fit``.
        """
        if self._policy is None:
            self._policy = MPCPolicy(self.mpc, observation_space=self._observation_space)
        return self._policy

    @property
    def output_policy(self) -> OutputFeedbackPolicy:
        """The same behind an observer: a policy that takes outputs in place of states.

        Raises:
            MPCOfflineError: Before ``fit``, and where it learned from states.
        """
        if self.sensors is None:
            hint = "Call fit(identify_from_outputs(mpc, log, outputs, ...))."
            raise MPCOfflineError("learner", expected="a fit of outputs", actual="states, or no fit", hint=hint)
        return OutputFeedbackPolicy(self.policy, self.sensors.observer(self.policy.mpc))

    def save(self, path: str | PathLike[str]) -> None:
        """Writes nominal and learned MPC, value function, method and history to a zip of JSON and npz.

        Raises:
            InvalidArgumentError: For an MPC that has no JSON form, or a learning or value method that is not
                registered; nothing is written then.
            StorageError: If it cannot be written.
        """
        write_learner(self, path)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> OfflineMPCLearner:
        """Reads what :meth:`save` wrote.

        Raises:
            FileFormatError: If the file is damaged, foreign, of another version, or of a learning method that is not
                known here.
        """
        return read_learner(cls, path)
