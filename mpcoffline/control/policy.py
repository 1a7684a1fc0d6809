"""MPCPolicy: an MPC wherever Stable-Baselines3 expects a policy."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from os import PathLike
from typing import Any, Self, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from mpcoffline.core.archive import (
    box_from_json,
    box_to_json,
    file_errors,
    holds,
    plain,
    read_archive,
    with_ending,
    write_archive,
)
from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError
from mpcoffline.mpc import MPC
from mpcoffline.mpc.labels import Label
from mpcoffline.mpc.shown import html_of_mpc
from mpcoffline.solvers import SOLVERS, Plan, Solver, changed_options, check_solver, make_solver
from mpcoffline.solvers.fallback import Fallback, SolverStats
from mpcoffline.solvers.options import OF_THE_MACHINE

from .course import Course, course_from
from .explicit.distilling import distill
from .explicit.policy import DistilledPolicy
from .observations import checked_observation, spaces_of

logger = logging.getLogger(__name__)


class MPCPolicy(BasePolicy):
    """The policy pi_theta(s) = u_0* of (MPC) with the interface of an SB3 policy.

    ``predict`` solves one MPC an observation. The warm start travels in SB3's recurrent ``state``, so that nothing is
    hidden in the policy: ``state=None`` is a cold, deterministic solve.

    A solve that fails does not raise in the control loop. A problem that was only tried from its plan is solved again
    from all starts; with ``rescue="ipopt"`` ipopt tries too; else the best plan found is applied, which is a rollout of
    the model within the input bounds, or, if the previous plan violates hard constraints less or no plan is finite, the
    next input of the previous one (zero, within bounds, if there is none either). ``solver_stats`` counts each of these
    answers, and the first of each kind is logged.

    Where the MPC's state holds past inputs (dead time, prices on changes), observations stay what they are: the inputs
    that were applied, clipped and with noise, travel in ``state`` beside the plan. Of those before an episode nothing
    is known; ``mpc.usual_input`` stands for them: as the log's episodes began, else the stage cost's ``u_ref``, or 0.

    The policy is also a plain function, ``policy(observations)``: actions alone, by cold solves.

    With ``deterministic=False`` it explores, so that an MPC can collect data::

        a = clip(u_0* + sigma (high - low) w, low, high),   w ~ N(0, I)

    where ``low`` and ``high`` are the bounds of the action space and sigma is ``exploration_noise``. The plan that
    travels in ``state`` is that of u_0*, without noise.

    Args:
        mpc: The MPC; its observation is the environment's.
        solver: Name of the solver, see :func:`mpcoffline.make_solver`; or a solver of this very MPC.
            A policy's file names solver and options, so that to save one, an own class must be registered.
        observation_space: The environment's; unbounded by default.
        action_space: The environment's; float32 with the MPC's input bounds by default.
        exploration_noise: sigma, a fraction of the action range; SB3's customary ``NormalActionNoise`` of 0.1 in
            actions scaled to [-1, 1] is 0.05 here.
        seed: Seeds the noise; :meth:`set_random_seed` starts it anew.
        rescue: ``"ipopt"`` has ipopt try what the solver failed to solve, hundreds of times slower; its program is
            built at the first failure. None, the default, for no rescue. Exported C has none.
        rescue_time: Time that ipopt may take for a problem, in s, the building aside.
        **solver_options: Passed to the solver.

    Attributes:
        mpc: The MPC.
        solver_stats: Counts since construction, of solves and of how failures were answered.

    Raises:
        InvalidArgumentError: For spaces of other sizes than the MPC's observations and inputs, a negative noise or
            seed, a ``rescue_time`` that is not positive, an option that the solver has not, or a solver of another MPC.
        UnknownIdError: For an unknown solver or rescue.
    """

    def __init__(
        self,
        mpc: MPC,
        solver: str | Solver = "auto",
        *,
        observation_space: spaces.Box | None = None,
        action_space: spaces.Box | None = None,
        exploration_noise: float = 0.1,
        seed: int = 0,
        rescue: str | None = None,
        rescue_time: float = 1.0,
        **solver_options: Any,
    ) -> None:
        observation_space, action_space = spaces_of(mpc, observation_space, action_space)
        made = solver if isinstance(solver, Solver) else None
        if made is None:
            check_solver(cast("str", solver), solver_options)
        elif made.mpc is not mpc or solver_options:
            raise InvalidArgumentError(
                "solver",
                expected="a name with options, or a solver of this very MPC without",
                actual=f"{made!r}{' of another MPC' * (made.mpc is not mpc)}, options {list(solver_options)}",
            )
        super().__init__(observation_space, action_space)
        self.mpc: MPC = mpc
        self.solver_name: str = solver if isinstance(solver, str) else solver.name
        self.solver_options: dict[str, Any] = solver_options if made is None else changed_options(made)
        self._fallback = Fallback(mpc, rescue, rescue_time)
        self.exploration_noise = exploration_noise
        self.set_random_seed(seed)
        self._solver = self._made = made
        self._vec_normalize: VecNormalize | None = None
        self._clipping_reported = False

    def extra_repr(self) -> str:
        """What it sees and sets, and how it is solved."""
        sees, sets = (", ".join(map(str, each)) for each in (self.mpc.layout.y_labels, self.mpc.layout.u_labels))
        return f"{sees} -> {sets}; horizon {self.mpc.horizon} of {self.mpc.model.dt:g} s, solver {self.solver_name!r}"

    def _repr_html_(self) -> str:
        return html_of_mpc(self.mpc)

    @property
    def solver_stats(self) -> SolverStats:
        """Counts since construction."""
        return self._fallback.stats

    def retry_at_most(self, share: float, level: int = logging.WARNING) -> None:
        """Limits which share of its problems is tried again from all starts, beyond the first thousand.

        A retry takes as long as some hundred warm solves, too long for one of many MPCs whose solves fail again and
        again; at ``level`` the log tells of those. Raises :class:`InvalidArgumentError` for a share outside 0 to 1.
        """
        check_number("share", share, 0.0, 1.0, open_low=False)
        self._fallback.most_retried, self._fallback.level = share, level

    @property
    def exploration_noise(self) -> float:
        """Standard deviation of the noise under ``deterministic=False``, a fraction of the action range.

        Raises:
            InvalidArgumentError: On setting a number that is negative or not finite.
        """
        return self._exploration_noise

    @exploration_noise.setter
    def exploration_noise(self, value: float) -> None:
        check_number("exploration_noise", value, 0.0, open_low=False)
        self._exploration_noise = float(value)

    def set_random_seed(self, seed: int) -> None:
        """Starts the exploration noise anew.

        Args:
            seed: The same seed gives the same noise.

        Raises:
            InvalidArgumentError: For a negative seed.
        """
        check_integers(0, seed=seed)
        self._seed, self._noise_generator = int(seed), np.random.default_rng(seed)

    def with_normalization(self, vec_env: VecEnv | None) -> Self:
        """The policy for the observations that an environment under ``VecNormalize`` gives.

        An MPC needs observations in their units, so each is un-normalised with the statistics that ``vec_env`` has at
        that moment; normalised rewards do not matter. What ``VecNormalize`` clipped is lost: the MPC then sees the
        clipped observation, and a warning is logged the first time. The statistics are not saved with the policy
        (``VecNormalize.save`` does that).

        Args:
            vec_env: The environment that will be acted in; wrappers are looked through.

        Returns:
            A policy that shares everything else with this one; for an environment without ``VecNormalize``, or None,
            one that takes observations as they are.
        """
        policy = copy.copy(self)
        policy._solver = self._solver  # a copy alone would build its own
        policy._noise_generator = copy.deepcopy(self._noise_generator)  # whose draws would otherwise be shared out
        policy._vec_normalize = None if vec_env is None else unwrap_vec_normalize(vec_env)
        return policy

    def __getstate__(self) -> dict[str, Any]:
        """Everything but a solver that was named, which is compiled code: a copy builds its own when first used."""
        return self.__dict__ | {"_solver": self._made}

    @property
    def y_labels(self) -> tuple[Label, ...]:
        """What the coordinates of an observation are called."""
        return self.mpc.layout.y_labels

    @property
    def solver(self) -> Solver:
        """The solver, built when first used."""
        if self._solver is None:
            self._solver = make_solver(self.mpc, self.solver_name, **self.solver_options)
        return self._solver

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Plan | Course]:
        """The optimal first inputs, and the warm start for the next call.

        Args:
            observation: ``(ny,)``, or ``(B, ny)`` for B environments; dictionaries are refused.
            state: What the previous call returned; None starts cold.
            episode_start: ``(B,)`` booleans; environments that have just been reset start cold, without past inputs.
            deterministic: Whether to act without exploration noise.

        Returns:
            Actions ``(nu,)`` or ``(B, nu)`` within the bounds and in the dtype of the action space, and the state: the
            plan shifted by one step, with the past inputs where the MPC asks for them.

        Raises:
            InvalidArgumentError: For an observation of the wrong shape or with NaN, a state of another batch size, or
                noise where actions are unbounded.
        """
        given = checked_observation(observation, self.mpc.ny)
        observations = np.atleast_2d(given)
        if self._vec_normalize is not None:
            observations = self._unnormalized(observations, self._vec_normalize)
        warm_start, memory = course_from(self.mpc, state, episode_start, len(observations))
        if memory is not None:
            observations = self.mpc.state(observations, memory)
        solution = self.solver.solve(observations, warm_start=warm_start)
        inputs, plan = self._fallback.answer(self.solver, observations, warm_start, solution)
        if not deterministic:
            inputs = self._explored(inputs)
        space = self._action_box
        actions = np.clip(inputs.astype(space.dtype), space.low, space.high)
        answer = actions[0] if given.ndim == 1 else actions
        if memory is None:
            return answer, plan
        remembered = self.mpc.layout.remembered(memory, actions.astype(np.float64))
        return answer, Course(plan.x, plan.u, remembered, plan.multipliers)

    def forward(self, observation: ArrayLike | torch.Tensor, deterministic: bool = True) -> NDArray[Any] | torch.Tensor:
        """Actions ``(B, nu)`` of observations ``(B, ny)``, or of one, by cold solves: what ``policy(y)`` returns.

        A tensor gives a tensor, without gradients; anything else an array.
        """
        if isinstance(observation, torch.Tensor):
            return self._predict(observation, deterministic)
        return self.predict(observation, deterministic=deterministic)[0]

    def _predict(self, observation: torch.Tensor | dict[str, torch.Tensor], deterministic: bool = True) -> torch.Tensor:
        if isinstance(observation, dict):
            raise InvalidArgumentError("observation", expected="a tensor", actual="a dictionary")
        actions, _ = self.predict(observation.detach().cpu().numpy(), deterministic=deterministic)
        return torch.as_tensor(actions, device=observation.device)

    @property
    def _action_box(self) -> spaces.Box:
        assert isinstance(self.action_space, spaces.Box)  # noqa: S101 -- refused in __init__; narrows the type
        return self.action_space

    def _unnormalized(self, observations: NDArray[np.float64], vec_env: VecNormalize) -> NDArray[np.float64]:
        """Observations in their units."""
        if not vec_env.norm_obs:
            return observations
        if not self._clipping_reported and (np.abs(observations) >= np.float32(vec_env.clip_obs)).any():
            logger.warning("VecNormalize clipped an observation at %g: the MPC sees another state.", vec_env.clip_obs)
            self._clipping_reported = True
        return np.asarray(vec_env.unnormalize_obs(observations), dtype=np.float64)

    def _explored(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inputs with exploration noise, not yet clipped."""
        width = self._action_box.high.astype(np.float64) - self._action_box.low
        if not np.isfinite(width).all():
            raise InvalidArgumentError(
                "deterministic",
                expected="True where an action is unbounded, since the noise is a fraction of its range",
                actual=f"False in {self.action_space}",
            )
        return inputs + self.exploration_noise * width * self._noise_generator.standard_normal(inputs.shape)

    def distill(self, starts: Any = None, **options: Any) -> DistilledPolicy:
        """An explicit policy, a small network that acts as this one: see :func:`mpcoffline.control.distill`."""
        return distill(self, starts, **options)

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the policy to a zip of JSON (no pickle). One that is loaded starts its noise from the same seed.

        Of the solver's options, those that say how many cores are used (``n_threads``, ``n_workers``) are left out:
        they are the machine's, not the controller's.

        Raises:
            InvalidArgumentError: For a solver of a class that is not registered, which no file can name, or an MPC that
                has no JSON form; nothing is written then.
        """
        write_archive(path, "policy", self.to_document())

    def to_document(self) -> dict[str, Any]:
        """What :meth:`save` writes, JSON-able; raises as that."""
        if self.solver_name != "auto" and self.solver_name not in SOLVERS:
            raise InvalidArgumentError(
                "solver",
                expected="one that is registered, which a file can name",
                actual=self.solver_name,
                hint="Register its class: SOLVERS.register of mpcoffline.solvers.",
            )
        observation_space = self.observation_space
        assert isinstance(observation_space, spaces.Box)  # noqa: S101 -- refused in __init__; narrows the type
        return {
            "mpc": self.mpc.to_json(),
            "solver": self.solver_name,
            "solver_options": plain({k: v for k, v in self.solver_options.items() if k not in OF_THE_MACHINE}),
            "exploration_noise": self.exploration_noise,
            "seed": self._seed,
            "rescue": self._fallback.rescue,
            "rescue_time": self._fallback.rescue_time,
            "observation_space": box_to_json(observation_space),
            "action_space": box_to_json(self._action_box),
        }

    @classmethod
    def load(cls, path: str | PathLike[str], device: torch.device | str = "auto", **solver_options: Any) -> Self:
        """Reads what :meth:`save` wrote; of a learner's file, the policy that it has learned.

        Args:
            path: The file of a policy or a learner, with or without ``.zip``.
            device: Accepted for SB3; MPCs are solved on the CPU.
            **solver_options: Options of the solver that go before the file's, e.g. ``n_threads=4``.

        Raises:
            FileFormatError: If the file is damaged, foreign or of another version.
            InvalidArgumentError: For an option that the solver has not.
            MPCOfflineError: For a learner that has not learned.
        """
        path = with_ending(path)
        if holds(path, "learner"):
            return cls._of_learner(path, solver_options)
        document, _ = read_archive(path, "policy")
        with file_errors(path):
            policy = cls.of_document(document)
        policy.use_options(solver_options)
        return policy

    def use_options(self, solver_options: Mapping[str, Any]) -> None:
        """Has options of the solver go before its own; raises :class:`InvalidArgumentError` for one that it has not."""
        check_solver(self.solver_name, self.solver_options | dict(solver_options))
        self.solver_options |= solver_options

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_document`.

        Raises:
            FileFormatError: For options that no file has.
            InvalidArgumentError: For an option that the solver has not.
        """
        options, solver = dict(document["solver_options"]), document["solver"]
        if foreign := OF_THE_MACHINE & options.keys():
            raise FileFormatError("solver_options", expected="none of the machine", actual=", ".join(foreign))
        check_solver(solver, options)
        return cls(
            MPC.from_json(document["mpc"]),
            solver,
            observation_space=box_from_json(document["observation_space"]),
            action_space=box_from_json(document["action_space"]),
            exploration_noise=document.get("exploration_noise", 0.1),
            seed=document.get("seed", 0),
            rescue=document.get("rescue"),
            rescue_time=document.get("rescue_time", 1.0),
            **options,
        )

    @classmethod
    def _of_learner(cls, path: str | PathLike[str], solver_options: dict[str, Any]) -> Self:
        document, _ = read_archive(path, "learner")
        with file_errors(path):
            learned, space = document["learned"], document["observation_space"]
            mpc = None if learned is None else MPC.from_json(learned)
            observation_space = None if space is None else box_from_json(space)
        if mpc is None:
            raise MPCOfflineError(str(path), expected="a learner that has learned", actual="one before its fit")
        return cls(mpc, observation_space=observation_space, **solver_options)
