"""An MPC on a plant of which only some outputs are measured."""

from __future__ import annotations

from os import PathLike
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.policies import BasePolicy

from mpcoffline.core.archive import file_errors, read_archive, with_ending, write_archive
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.estimation.observer import Estimate, KalmanObserver
from mpcoffline.estimation.sensors import Sensors
from mpcoffline.mpc import MPC
from mpcoffline.mpc.labels import Label
from mpcoffline.solvers import Solver
from mpcoffline.solvers.fallback import SolverStats

from .course import Course, course_from
from .observations import checked_observation
from .policy import MPCPolicy

OWN = 3  # arrays of the state that are the observer's: estimates, covariances, what acts


class OutputFeedbackPolicy(BasePolicy):
    """An MPC that sees outputs instead of states: an observer estimates these, step by step.

    Observations are the outputs, ``(n_outputs,)``, followed by the plant's signals, if it has some. Estimates and their
    covariances travel in SB3's ``state``, in front of what the MPC itself carries, so that batches, ``evaluate``,
    recorders and ``episode_start`` are used as with :class:`~mpcoffline.MPCPolicy`. Outputs that are NaN are left out
    of the estimate, as those of a sensor that is slower than the controller; so are those that depend on inputs, before
    any has acted.

    With disturbances of the inputs (``KalmanObserver(disturbance=)``) the MPC plans what is to act, v, and
    ``u = v - d`` is applied, within the bounds; past inputs that it holds are to act with the disturbance of now, too.

    Example:
        >>> observer = KalmanObserver(mpc, [0], noise=0.01, process=1e-3, start_spread=[1.0, 0.5])
        >>> policy = OutputFeedbackPolicy(MPCPolicy(mpc), observer)
        >>> action, state = policy.predict(y, state, episode_start)

    Args:
        policy: The MPC.
        observer: Of the same MPC.
        observation_space: The environment's; unbounded by default.

    Attributes:
        policy: The MPC.
        observer: What estimates its states.

    Raises:
        InvalidArgumentError: For an observer of another MPC, or a space of another size.
    """

    policy: MPCPolicy
    observer: KalmanObserver

    def __init__(
        self, policy: MPCPolicy, observer: KalmanObserver, *, observation_space: spaces.Box | None = None
    ) -> None:
        layout = policy.mpc.layout
        if observer.mpc is not policy.mpc:
            raise InvalidArgumentError("observer", expected="one of the policy's MPC", actual="one of another")
        size = observer.n_outputs + layout.ny - layout.n_states
        space = spaces.Box(-np.inf, np.inf, (size,), np.float32) if observation_space is None else observation_space
        if not isinstance(space, spaces.Box) or space.shape != (size,):
            raise InvalidArgumentError(
                "observation_space", expected=f"a Box of {size} outputs and signals", actual=str(space)
            )
        super().__init__(space, policy.action_space)
        self.policy, self.observer, self._size = policy, observer, size

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...]]:
        """The inputs for outputs, and what is carried to the next call.

        Args:
            observation: Outputs and signals, ``(n,)``, or ``(B, n)``; outputs that are NaN are not there.
            state: What the previous call returned; None at the beginning.
            episode_start: ``(B,)`` booleans: which episodes have just begun.
            deterministic: Whether to act without exploration noise.

        Returns:
            Actions ``(nu,)`` or ``(B, nu)`` as :meth:`mpcoffline.MPCPolicy.predict` does; and estimates ``(B, n)``,
            covariances ``(B, n, n)``, what acts ``(B, nu + n_signals)``, and the MPC's own state. A row of NaN in the
            third, of a state that is given, is a loop that has not begun: its estimate is the one before any output.

        Raises:
            InvalidArgumentError: For an observation of the wrong shape, or a state of another policy or batch size.
        """
        given = checked_observation(observation, self._size, may_lack=self.observer.n_outputs)
        seen, mpc = np.atleast_2d(given), self.policy.mpc
        y, signals = np.split(seen, [self.observer.n_outputs], axis=1)
        known, acted, inner = self._before(state, episode_start, len(seen))
        known = self.observer.corrected(known, y, acted)
        full, disturbance = np.hstack([self.observer.states(known), signals]), self.observer.disturbances(known)
        plan, memory = course_from(mpc, inner, episode_start, len(seen))
        if memory is not None:
            inner = Course(plan.x, plan.u, memory + disturbance[:, mpc.layout.ages[0]], plan.multipliers)
        wanted, carried = self.policy.predict(full, inner, episode_start, deterministic)
        actions = wanted
        if self.observer.n_disturbances:
            space = self.policy.action_space
            assert isinstance(space, spaces.Box)  # noqa: S101 -- refused by the policy; narrows the type
            actions = np.clip((wanted - disturbance).astype(space.dtype), space.low, space.high)
        applied = actions.astype(np.float64)
        if memory is not None:
            carried = Course(carried[0], carried[1], mpc.layout.remembered(memory, applied), *carried[3:])
        acting = mpc.layout.split(full if memory is None else np.hstack([full, memory]), applied)[1]
        return actions[0] if given.ndim == 1 else actions, (*known, acting, *carried)

    def _before(
        self, state: tuple[NDArray[Any], ...] | None, episode_start: ArrayLike | None, n: int
    ) -> tuple[Estimate, Array | None, tuple[NDArray[Any], ...] | None]:
        """What is known before the outputs of this step, what acted in the one before, and the MPC's own state."""
        if state is None:
            return self.observer.begin(n), None, None
        m = self.policy.mpc.layout.n_states + self.observer.n_disturbances
        sizes = [(n, m), (n, m, m), (n, len(self.policy.mpc.layout.acting))]
        shapes = [np.shape(each) for each in state[:OWN]]
        if shapes != sizes:
            raise InvalidArgumentError(
                "state", expected=f"what predict returned for {n} loops, {sizes}", actual=f"arrays of {shapes}"
            )
        *parts, acted = (np.array(each, dtype=np.float64) for each in state[:OWN])
        known, begun = Estimate(*parts), np.asarray(np.isfinite(acted).all(axis=1))
        if begun.any():
            moved = self.observer.ahead(known, np.where(begun[:, None], acted, 0.0))
            known.x[begun], known.P[begun] = moved.x[begun], moved.P[begun]
        if episode_start is not None and np.any(episode_start):
            started, fresh = np.broadcast_to(episode_start, (n,)).astype(bool), self.observer.begin(n)
            known.x[started], known.P[started], acted[started] = fresh.x[started], fresh.P[started], np.nan
        return known, acted, state[OWN:]

    def estimates(self, state: tuple[NDArray[Any], ...]) -> tuple[Array, Array]:
        """The plant's states ``(B, n_states)`` and the disturbances ``(B, nu)`` in what :meth:`predict` returned."""
        known = Estimate(*state[:2])
        return self.observer.states(known), self.observer.disturbances(known)

    @property
    def mpc(self) -> MPC:
        """The MPC that acts."""
        return self.policy.mpc

    @property
    def y_labels(self) -> tuple[Label, ...]:
        """What the coordinates of an observation are called: outputs, then signals."""
        layout = self.mpc.layout
        return (*self.observer.labels, *layout.y_labels[layout.n_states :])

    @property
    def solver(self) -> Solver:
        """Its solver."""
        return self.policy.solver

    @property
    def solver_stats(self) -> SolverStats:
        """How its solves went."""
        return self.policy.solver_stats

    def _predict(self, observation: torch.Tensor | dict[str, torch.Tensor], deterministic: bool = True) -> torch.Tensor:
        if isinstance(observation, dict):
            raise InvalidArgumentError("observation", expected="a tensor", actual="a dictionary")
        actions, _ = self.predict(observation.detach().cpu().numpy(), deterministic=deterministic)
        return torch.as_tensor(actions, device=observation.device)

    def save(self, path: str | PathLike[str]) -> None:
        """Writes policy and observer to a zip of JSON (no pickle).

        Raises:
            InvalidArgumentError: As :meth:`mpcoffline.MPCPolicy.save`; or for outputs that are no plain arithmetic.
        """
        known = Sensors.of(self.observer).to_json()
        write_archive(path, "output_feedback", {"policy": self.policy.to_document(), "observer": known})

    @classmethod
    def load(cls, path: str | PathLike[str], device: torch.device | str = "auto", **solver_options: Any) -> Self:
        """Reads what :meth:`save` wrote; see :meth:`mpcoffline.MPCPolicy.load`.

        Raises:
            FileFormatError: If the file is damaged, foreign or of another version.
        """
        path = with_ending(path)
        document, _ = read_archive(path, "output_feedback")
        with file_errors(path):
            policy = MPCPolicy.of_document(document["policy"])
            found = cls(policy, Sensors.from_json(document["observer"], policy.mpc).observer(policy.mpc))
        policy.use_options(solver_options)
        return found
