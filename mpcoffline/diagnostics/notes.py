"""What explains a verdict or may spoil the next fit, with what to do: a rule each, silent where it is not sure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from mpcoffline.core.text import listed

from .report import Report

_WORSE_MODEL = 2.0
_GROWN = 1.5
_UNSTABLE = 1.0 + 1e-3
_LOST_WEIGHT = 1e-6
_FAILED = 0.01  # share of the solves
_OFTEN = 0.05  # of the steps, that a limit is violated in

Rule = Callable[[Report, "Fit"], Iterator[str]]


@dataclass(frozen=True)
class Fit:
    """What a note has to know of the fit.

    Attributes:
        smoothed: Whether it took the noise out of the states.
        model: Whether the model was learned.
        value: Whether V entered the controller; where the given costs stay, it does not.
        learned: Whether a learned MPC is handed out; where MPC_1 is, nothing is said of a learned one.
    """

    smoothed: bool
    model: bool
    value: bool
    learned: bool = True


def notes_on(report: Report, fit: Fit) -> tuple[str, ...]:
    """The notes on a report."""
    return tuple(text for rule in RULES if fit.learned or rule not in _OF_LEARNED for text in rule(report, fit))


def _goal(report: Report, fit: Fit) -> Iterator[str]:
    if report.goal is not None and report.goal.missed and fit.value:
        yield "The log never reaches the goal: V is a guess there. Record episodes that end at the reference."


def _noise(report: Report, fit: Fit) -> Iterator[str]:
    if not report.noise.negligible:
        advice = "as in the fit" if fit.smoothed else "fit with init='identified', which does the same"
        yield f"Measurement noise of {report.noise.level:.1%}: states were smoothed here; {advice}."


def _failures(report: Report, fit: Fit) -> Iterator[str]:
    for name, share in zip(("MPC_1", "the learned MPC"), report.failed_solves, strict=True):
        if share > _FAILED and (fit.learned or name == "MPC_1"):
            yield (
                f"{share:.1%} of the problems of {name} were not solved at first: has its model a corner (fmax, fabs, a"
                " root) where it works? Smooth it, or let ipopt try these: MPCPolicy(mpc, rescue='ipopt')."
            )


def _at_limits(report: Report, _: Fit) -> Iterator[str]:
    often = [check for check in report.limits if check.shares[2] > _OFTEN]
    if often:
        named = listed([f"{check.name!r} in {check.shares[2]:.0%}" for check in often])
        yield (
            f"The learned MPC violates {named} of its steps: what is cheapest lies at the limit, and what no model"
            " knows pushes it over, on the plant more than here. Where that matters, learn with a margin:"
            " keep_limits=0.95 (mpcoffline tune --keep-limits 0.95)."
        )


def _travel(report: Report, _: Fit) -> Iterator[str]:
    busy = [each for each in report.travel if each.much]
    if busy:
        moved = listed(
            [f"{e.name} by {e.shares[2]:.1%} of its range a step ({e.shares[0]:.1%} in the log)" for e in busy]
        )
        yield (
            f"The learned MPC moves {moved}: neither a price nor a rate limit holds it. Where that wears an actuator,"
            " give changes of inputs a price (changes={name: weight} in a plant file, D= of QuadraticCost), or a limit"
            " (rate= of an input), and fit again."
        )


def _value(report: Report, fit: Fit) -> Iterator[str]:
    if fit.value and report.value.blind:
        yield (
            f"V hardly follows the measured returns (correlation {report.value.correlation:.2f}, a regression has"
            f" {report.value.attainable:.2f}): learn it longer, or by another method."
        )


def _model(report: Report, fit: Fit) -> Iterator[str]:
    if report.prediction.learned > _WORSE_MODEL * report.prediction.identified + 0.01:
        advice = (
            "a larger prediction_weight keeps it closer" if fit.smoothed else "init='identified' is the safer start"
        )
        yield (
            f"The learned model misses {report.prediction.learned:.1%} of an increment, the identified one"
            f" {report.prediction.identified:.1%}: Theorem 1 allows that, but"
            f" {advice if fit.model else 'learn=' + repr('cost+model') + ' would adapt it'}."
        )


def _undetermined(report: Report, _: Fit) -> Iterator[str]:
    if report.prediction.undetermined:
        yield (
            f"The data do not determine {listed(report.prediction.undetermined, joint=', nor ')}: vary the"
            " inputs more; or, if they enter the model as ratios alone, fix one of them as a plain number."
        )


def _bounds(report: Report, _: Fit) -> Iterator[str]:
    if report.at_bounds:
        yield f"On a bound: {listed(report.at_bounds)}. Widen it if the physics allow, or raise the prior."


def _growth(report: Report, fit: Fit) -> Iterator[str]:
    if fit.value and report.theorem.value_growth > _GROWN:
        yield "V grows along the model's rollouts beyond anything in the data: Theorem 1's condition is doubtful."


def _stability(report: Report, _: Fit) -> Iterator[str]:
    if report.theorem.leaves and report.theorem.eigenvalues[:1] > (_UNSTABLE,):
        yield (
            "The learned closed loop is unstable at the reference, on its own model: simulated from near it, it leaves."
            " Do not use it there."
        )


def _weights(report: Report, _: Fit) -> Iterator[str]:
    for weight in report.weights:
        lost, had = (w[0] < _LOST_WEIGHT * max(w[-1], 1e-300) for w in (weight.after, weight.before))
        if lost and not had:
            yield f"{weight.name} has lost a direction (smallest eigenvalue 0): raise the prior if that one matters."


#: In the order in which they are said.
RULES: tuple[Rule, ...] = (
    _goal,
    _noise,
    _failures,
    _at_limits,
    _travel,
    _value,
    _model,
    _undetermined,
    _bounds,
    _growth,
    _stability,
    _weights,
)
_OF_LEARNED = (_at_limits, _travel, _model, _growth, _stability, _weights)
