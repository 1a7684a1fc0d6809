"""A learned MPC where d3rlpy expects one of its algorithms."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .policy import MPCPolicy


class D3rlpyPredictor:
    """A policy with the face of a d3rlpy algorithm: batches in, arrays out, nothing carried over.

    It is what d3rlpy's evaluators ask for (``EnvironmentEvaluator``, ``TDErrorEvaluator``, ...).

    Example:
        >>> evaluator = d3rlpy.metrics.EnvironmentEvaluator(env, n_trials=5)
        >>> mean_return = evaluator(D3rlpyPredictor(policy), dataset)

    Args:
        policy: The learned MPC.

    Attributes:
        policy: The learned MPC.
        gamma: Its discount.
        action_size: Its number of inputs.
        observation_scaler: None: an MPC works in units.
        action_scaler: None.
        reward_scaler: None.
    """

    gamma: float
    action_size: int

    observation_scaler = action_scaler = reward_scaler = None

    def __init__(self, policy: MPCPolicy) -> None:
        self.policy = policy
        self.gamma, self.action_size = policy.mpc.discount, policy.mpc.nu

    def predict(self, x: ArrayLike) -> NDArray[Any]:
        """Actions ``(B, nu)`` of observations ``(B, ny)``, by cold solves.

        Raises:
            InvalidArgumentError: For observations of the wrong shape or with NaN.
        """
        return self.policy.predict(x)[0]

    def sample_action(self, x: ArrayLike) -> NDArray[Any]:
        """As :meth:`predict`, with the policy's exploration noise.

        Raises:
            InvalidArgumentError: For observations of the wrong shape or with NaN, or unbounded actions.
        """
        return self.policy.predict(x, deterministic=False)[0]

    def predict_value(self, x: ArrayLike, action: ArrayLike) -> NDArray[np.float64]:
        """The return that the MPC expects, -Q_theta(s, a), ``(B,)``: d3rlpy maximises reward, an MPC minimises cost.

        Args:
            x: Observations, ``(B, ny)``.
            action: Actions, ``(B, nu)``.

        Raises:
            InvalidArgumentError: For a wrong shape, NaN, or actions out of bounds.
        """
        return -self.policy.solver.q_value(self.policy.mpc.state(x), action)
