"""The losses whose minimum is a value function (arXiv:2301.01667, arXiv:2110.06169)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from numbers import Real
from typing import Any, Protocol

import torch
from torch import Tensor

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.registry import Registry
from mpcoffline.datasets.table.transitions import Columns


class Critic(Protocol):
    """What the losses ask of the function that learns."""

    def __call__(self, observations: Tensor) -> Tensor:
        """V of observations ``(..., ny)``, shape ``(...)``."""

    def q(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Q of observations ``(..., ny)`` and actions ``(..., nu)``, shape ``(...)``; for methods that learn one."""


class ValueMethod(ABC):
    """A loss whose minimum is a value function.

    An own one is a frozen dataclass, whose fields are its options; one called ``tau`` is that of the configuration.
    Registered in ``VALUE_METHODS``, it is known by its name, and files can hold it.
    """

    #: Whether a function Q(s, a) is learned beside V.
    learns_q: bool = False

    @abstractmethod
    def loss(self, V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        """The mean loss over a minibatch, in units of V squared.

        Args:
            V: The function that learns.
            V_target: Its slowly following copy; constant.
            batch: Transitions; see :class:`~mpcoffline.datasets.table.transitions.Columns`.
            discount: gamma.
        """


#: Methods by name; ``"auto"`` chooses among them.
VALUE_METHODS: Registry[type[ValueMethod]] = Registry("value method", ValueMethod)


@VALUE_METHODS.register("residual")
@dataclass(frozen=True)
class Residual(ValueMethod):
    """(VALUE) as published: the squared Bellman residual, differentiated on both sides.

    ::

        E_D[ (L(s,a) + gamma V_phi(s+) - V_phi(s))^2 ]

    Estimates the value of the policy that logged the data; unbiased for deterministic plants only.
    """

    def loss(self, V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`."""
        values, following = V(torch.stack([batch.observations, batch.next_observations]))
        residual: Tensor = batch.costs + discount * (1.0 - batch.terminations) * following - values
        return residual.square().mean()


@VALUE_METHODS.register("td")
@dataclass(frozen=True)
class TemporalDifference(ValueMethod):
    """Semi-gradient TD(0) with a target network: the target is held constant.

    ::

        E_D[ (L(s,a) + gamma V_target(s+) - V_phi(s))^2 ]

    Estimates the value of the policy that logged the data, for noisy plants too (Sutton & Barto, ch. 9).
    """

    def loss(self, V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`."""
        return self.errors(V, V_target, batch, discount).square().mean()

    @staticmethod
    def errors(V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        """Target minus prediction, ``(B,)``."""
        return sampled_target(V_target, batch, discount) - V(batch.observations)


@VALUE_METHODS.register("expectile")
@dataclass(frozen=True)
class Expectile(ValueMethod):
    """A low expectile of the sampled target: towards the best action in the data instead of the average one.

    ::

        E_D[ |tau - 1(delta < 0)| delta^2 ],      delta = L(s,a) + gamma V_target(s+) - V_phi(s),   tau < 1/2

    After implicit Q-learning (Kostrikov et al., arXiv:2110.06169) with the sign of costs. Optimistic where the plant is
    noisy: the best of the noise counts as if an action had made it. :class:`ImplicitQ` is not.

    Args:
        tau: The expectile: the weight of targets above V; those below weigh 1 - tau.
    """

    tau: float = 0.3

    def __post_init__(self) -> None:
        check_tau(self.tau)

    def loss(self, V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`."""
        return expectile_loss(TemporalDifference.errors(V, V_target, batch, discount), self.tau)


@VALUE_METHODS.register("iql")
@dataclass(frozen=True)
class ImplicitQ(ValueMethod):
    """Implicit Q-learning (Kostrikov et al., arXiv:2110.06169, eqs. 5 and 6) with the sign of costs.

    ::

        E_D[ |tau - 1(delta < 0)| delta^2 ],      delta = Q_target(s,a) - V_phi(s),   tau < 1/2
        E_D[ (L(s,a) + gamma V_phi(s+) - Q(s,a))^2 ]

    Q averages over the noise of the plant before V takes the low expectile over the actions in the data, so that noise
    makes V no smaller. One Q where the paper has two.

    Args:
        tau: The expectile: the weight of Q above V; Q below weighs 1 - tau.
    """

    tau: float = 0.3
    learns_q = True

    def __post_init__(self) -> None:
        check_tau(self.tau)

    def loss(self, V: Critic, V_target: Critic, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`; the sum of both."""
        pair = batch.observations, batch.actions
        with torch.no_grad():
            q_target = V_target.q(*pair)
        low: Tensor = expectile_loss(q_target - V(batch.observations), self.tau)
        return low + (sampled_target(V, batch, discount) - V.q(*pair)).square().mean()


def method_to_json(method: ValueMethod) -> dict[str, Any]:
    """A method as a file has it: its name and its fields.

    Raises:
        InvalidArgumentError: For a method whose class is not registered or no dataclass: no file can hold it.
    """
    name = VALUE_METHODS.name_of(type(method))
    if not name or not is_dataclass(type(method)):
        raise InvalidArgumentError(
            "value method",
            expected="a registered dataclass, which a file can hold",
            actual=repr(method)[:200],
            hint="Register its class: VALUE_METHODS.register of mpcoffline.learning.",
        )
    own: Any = method
    return {"kind": name} | asdict(own)


def method_from_json(data: Mapping[str, Any]) -> ValueMethod:
    """The inverse of :func:`method_to_json`.

    Raises:
        FileFormatError: For a method that nobody has registered.
    """
    options = dict(data)
    return VALUE_METHODS.of_file(options.pop("kind", None), "value method")(**options)


def check_tau(tau: object) -> None:
    """Refuses anything but a number in (0, 1).

    Raises:
        InvalidArgumentError: For something else.
    """
    if isinstance(tau, bool) or not isinstance(tau, Real) or not 0.0 < float(tau) < 1.0:
        raise InvalidArgumentError("tau", expected="a number in (0, 1)", actual=repr(tau)[:80])


def sampled_target(V: Critic, batch: Columns, discount: float) -> Tensor:
    """L(s, a) + gamma V(s+) as a constant, without V where the episode terminated, ``(B,)``."""
    with torch.no_grad():
        target: Tensor = batch.costs + discount * (1.0 - batch.terminations) * V(batch.next_observations)
    return target


def expectile_loss(delta: Tensor, tau: float) -> Tensor:
    """The mean of |tau - 1(delta < 0)| delta^2."""
    return (torch.where(delta > 0.0, tau, 1.0 - tau) * delta.square()).mean()
