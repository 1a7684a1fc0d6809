"""OfflineMPCLearner: the two regressions of arXiv:2301.01667 as one ``fit``, and the policy that they give."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium import spaces

from mpcoffline.archive import box_from_json, box_to_json, file_errors, read_archive, write_archive
from mpcoffline.datasets.transitions import TransitionTable
from mpcoffline.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, UnknownIdError
from mpcoffline.learning import FitConfig, FitResult, ValueConfig, ValueFunction, fit_parameters, fit_value
from mpcoffline.learning.checks import check_integers, check_number
from mpcoffline.learning.progress import Metrics, Report
from mpcoffline.mpc import MPC
from mpcoffline.policy import MPCPolicy

if TYPE_CHECKING:
    from minari import MinariDataset

Learn = Literal["cost", "cost+model"]
History = list[tuple[int, dict[str, float]]]

_GROUPS: dict[str, tuple[str, ...]] = {"cost": ("cost",), "cost+model": ("cost", "model")}


@dataclass(frozen=True)
class LearnerConfig:
    """Everything that a fit depends on besides data and seed.

    Attributes:
        trim: Share of the transitions that is learned from; the farthest out are left out.
        value: How V_phi is learned.
        fit: How theta is learned.
    """

    trim: float = 0.9
    value: ValueConfig = field(default_factory=ValueConfig)
    fit: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        check_number("trim", self.trim, 0.0, 1.0)


#: The published recipe: (VALUE) by Bellman residual, then (FIT); discount, horizon and terminal cost are the MPC's.
PRESETS: dict[str, LearnerConfig] = {"paper": LearnerConfig()}


class OfflineMPCLearner:
    r"""Learns the parameters of an MPC from logged transitions, without solving one MPC.

    Two regressions on the data set D, with the stage cost L (= -reward), discount gamma and successor s+::

        (VALUE)  phi* = argmin E_D[ (L(s,a) + gamma V_phi(s+) - V_phi(s))^2 ]
        (FIT)    th*  = argmin E_D[ (L(s,a) + gamma V_phi(s+) - gamma V_phi(f_th(s,a)) - Lhat_th(s,a))^2 ]
                               + l2 |th - th_0|^2

    By Theorem 1 of Gros & Zanon (doi:10.1109/TAC.2019.2913768) an MPC whose stage cost is Q*(s,a) - gamma V*(f(s,a))
    and whose terminal cost is V* gives the optimal policy even when its model f is wrong; (FIT) looks for that stage
    cost.

    Example:
        >>> mpc = nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.0, seed=0)
        >>> learner = OfflineMPCLearner(mpc, learn="cost+model", preset="paper", seed=0)
        >>> history = learner.fit("mpcoffline/pendulum/ddpg-v0")
        >>> action, state = learner.policy.predict(observation)

    Args:
        mpc: MPC_1: the nominal MPC. It is never changed.
        learn: ``"cost"`` fits the stage cost with the model fixed (MPC_2), ``"cost+model"`` both (MPC_3).
        preset: Name of a :class:`LearnerConfig`; ``"paper"`` is the published recipe.
        seed: Seeds weights and minibatches. Same seed, data and machine: same theta, bit for bit.
        value: ``"residual"``, ``"td"`` or ``"expectile"``; overrides the preset.
        value_function: A V_phi learned before (of the same data and discount); (VALUE) is skipped.
        device: Torch device for (VALUE).
        **overrides: Any field of :class:`LearnerConfig`, :class:`ValueConfig` or :class:`FitConfig`, e.g.
            ``prior=1e-2`` or ``tau=0.1``; names that both have take a prefix (``value_n_steps``, ``fit_n_steps``).

    Raises:
        UnknownIdError: For an unknown preset, value method or override.
        InvalidArgumentError: For another ``learn``, or a value out of range.
    """

    def __init__(
        self,
        mpc: MPC,
        learn: Learn = "cost+model",
        preset: str = "paper",
        seed: int = 0,
        *,
        value: str | None = None,
        value_function: ValueFunction | None = None,
        device: str = "cpu",
        **overrides: Any,
    ) -> None:
        if learn not in _GROUPS:
            raise InvalidArgumentError("learn", expected="'cost' or 'cost+model'", actual=repr(learn))
        if preset not in PRESETS:
            raise UnknownIdError.of("preset", preset, PRESETS)
        if value is not None:
            overrides["method"] = value
        check_integers(0, seed=seed)
        if value_function is not None and value_function.ny != mpc.nx:
            raise InvalidArgumentError(
                "value_function", expected=f"a function of {mpc.nx} coordinates", actual=str(value_function.ny)
            )
        self.config = _overridden(PRESETS[preset], overrides)
        self.nominal_mpc, self.learn, self.preset, self.seed, self.device = mpc, learn, preset, int(seed), device
        self._given_value_function = self.value_function = value_function
        self.result: FitResult | None = None
        self.history: History = []
        self._observation_space: spaces.Box | None = None
        self._policy: MPCPolicy | None = None

    def fit(self, dataset: MinariDataset | TransitionTable | str, *, show_progress: bool = True) -> History:
        """Learns V_phi, then theta.

        Args:
            dataset: A Minari data set, the id of one, or a table of transitions.
            show_progress: Whether to draw a progress bar.

        Returns:
            ``[(epoch, metrics), ...]``, first the epochs of (VALUE) with ``value_loss``, then those of (FIT) with
            ``fit_loss``.

        Raises:
            InvalidDataError: If the data do not fit the MPC, or hold NaN or actions out of bounds.
            UnknownIdError: For an unknown data set id.
        """
        table, observation_space = self._table(dataset)
        mpc = self.nominal_mpc
        table.check_fits(mpc.nx, mpc.nu, np.asarray(mpc.action_low), np.asarray(mpc.action_high))
        table = table.trim(self.config.trim)
        history: History = []
        with _Progress(show_progress) as progress:
            value_function = self._given_value_function
            if value_function is None:
                value_function = fit_value(
                    table,
                    mpc.discount,
                    self.config.value,
                    seed=self.seed,
                    device=self.device,
                    report=progress.phase("(VALUE) learning V", history),
                ).cpu()
            result = fit_parameters(
                mpc,
                value_function,
                table,
                _GROUPS[self.learn],
                self.config.fit,
                seed=self.seed,
                report=progress.phase(f"(FIT) learning {self.learn}", history),
            )
        self.value_function, self.result = value_function, result
        self.history, self._observation_space, self._policy = history, observation_space, None
        return history

    @property
    def mpc(self) -> MPC:
        """The learned MPC; a new object.

        Raises:
            MPCOfflineError: Before ``fit``.
        """
        return self.nominal_mpc.with_theta(self._fitted().theta)

    @property
    def theta(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The learned parameters, ``(mpc.space.size,)``."""
        return self._fitted().theta.copy()

    @property
    def policy(self) -> MPCPolicy:
        """The learned MPC as an SB3-compatible policy.

        Raises:
            MPCOfflineError: Before ``fit``.
        """
        if self._policy is None:
            self._policy = MPCPolicy(self.mpc, observation_space=self._observation_space)
        return self._policy

    def _fitted(self) -> FitResult:
        if self.result is None:
            raise MPCOfflineError(
                "learner", expected="a fitted learner", actual="no fit yet", hint="Call fit(dataset)."
            )
        return self.result

    def _table(self, dataset: MinariDataset | TransitionTable | str) -> tuple[TransitionTable, spaces.Box | None]:
        if isinstance(dataset, TransitionTable):
            return dataset, None
        if isinstance(dataset, str):
            from mpcoffline.datasets import load_dataset

            dataset = load_dataset(dataset)
        space = dataset.observation_space
        return TransitionTable.from_minari(dataset), space if isinstance(space, spaces.Box) else None

    def save(self, path: str | PathLike[str]) -> None:
        """Writes nominal and learned MPC, value function, configuration and history to a zip of JSON and npz."""
        document = {
            "mpc": self.nominal_mpc.to_json(),
            "learn": self.learn,
            "preset": self.preset,
            "seed": self.seed,
            "config": asdict(self.config),
            "history": self.history,
            "result": None
            if self.result is None
            else {"theta": self.result.theta.tolist()}
            | {name: getattr(self.result, name) for name in ("loss_before", "loss_after")},
            "observation_space": None if self._observation_space is None else box_to_json(self._observation_space),
        }
        arrays = {} if self.value_function is None else self.value_function.to_arrays()
        write_archive(path, "learner", document, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> OfflineMPCLearner:
        """Reads what :meth:`save` wrote.

        Raises:
            FileFormatError: If the file is damaged, foreign or of another version.
        """
        document, arrays = read_archive(path, "learner")
        with file_errors(path):
            config = document["config"]
            value = config["value"] | {"hidden": tuple(config["value"]["hidden"])}
            learner = cls(MPC.from_json(document["mpc"]), document["learn"], document["preset"], document["seed"])
            learner.config = LearnerConfig(config["trim"], ValueConfig(**value), FitConfig(**config["fit"]))
            learner.history = [(int(epoch), dict(metrics)) for epoch, metrics in document["history"]]
            if document["result"] is not None:
                theta = learner.nominal_mpc.space.checked(document["result"].pop("theta"))
                losses = {name: float(loss) for name, loss in document["result"].items()}
                learner.result = FitResult(theta, **losses)
            if document["observation_space"] is not None:
                learner._observation_space = box_from_json(document["observation_space"])
            if arrays:
                learner.value_function = ValueFunction.from_arrays(arrays).eval().requires_grad_(False)
                if learner.value_function.ny != learner.nominal_mpc.nx:
                    raise FileFormatError("value function", expected="the MPC's coordinates", actual="others")
        return learner


def _overridden(config: LearnerConfig, overrides: dict[str, Any]) -> LearnerConfig:
    """The configuration with fields replaced by name; a name that both parts have needs its prefix."""
    parts: dict[str, ValueConfig | FitConfig] = {"value": config.value, "fit": config.fit}
    own = {f.name for part in parts.values() for f in fields(part)}
    shared = {f.name for f in fields(config.value)} & {f.name for f in fields(config.fit)}
    accepted: dict[str, tuple[str, str]] = {}
    for prefix, part in parts.items():
        for f in fields(part):
            accepted[f"{prefix}_{f.name}"] = (prefix, f.name)
            if f.name in own - shared:
                accepted[f.name] = (prefix, f.name)
    changes: dict[str, dict[str, Any]] = {"value": {}, "fit": {}}
    trim = overrides.pop("trim", config.trim)
    for name, value in overrides.items():
        if name not in accepted:
            raise UnknownIdError.of("option of OfflineMPCLearner", name, ["trim", *accepted])
        prefix, field_name = accepted[name]
        changes[prefix][field_name] = value
    return LearnerConfig(trim, replace(config.value, **changes["value"]), replace(config.fit, **changes["fit"]))


class _Progress:
    """A progress bar over the phases of a fit, and their history."""

    def __init__(self, show: bool) -> None:
        from rich.progress import Progress

        self._bar = Progress(disable=not show, transient=False)

    def __enter__(self) -> _Progress:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def phase(self, title: str, history: History) -> Report:
        """A report that moves the bar and appends to the history."""
        task = self._bar.add_task(title, total=None)

        def report(steps_done: int, steps_total: int, metrics: Metrics) -> None:
            history.append((len(history) + 1, metrics))
            shown = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())
            self._bar.update(task, completed=steps_done, total=steps_total, description=f"{title}: {shown}")

        return report
