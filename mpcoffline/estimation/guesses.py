"""Ways to read a log otherwise: other units, exchanged columns, signs, another sampling time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from typing import NamedTuple

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .units import CONVERSIONS, FACTORS, in_words

#: How much longer, or shorter, the sampling time may have been.
LONGER = (2.0, 3.0, 5.0, 10.0, 60.0, 100.0, 1e3, 3600.0)


class Reading(NamedTuple):
    """Rows as they may have been meant.

    Attributes:
        x: States, ``(m, n)``.
        u: Inputs, then the present signals, ``(m, nu + n_signals)``.
        reached: States after them, ``(m, n)``.
        cost: Logged costs, ``(m,)``.
        u_next: Inputs and signals of the rows after; NaN where there is none.
    """

    x: Array
    u: Array
    reached: Array
    cost: Array
    u_next: Array


_Columns = tuple[tuple[int, ...], tuple[int, ...]]  # of states, and of inputs and signals


class Guess(NamedTuple):
    """One way to read the log otherwise: what it is about, in words, and how."""

    name: str
    expected: str
    words: str
    hint: str
    read: Callable[[Reading], Reading]
    columns: int = 1  # how many it changes: of guesses that explain as much, the one of fewest


def every_guess(mpc: MPC) -> list[Guess]:
    """All of them, the simplest first."""
    nx, nu, named = mpc.layout.n_states, mpc.nu, _names(mpc)
    found = [*_signs(nx, nu), *_exchanges(nx, nu, named), *_sampling(mpc.model.dt)]
    single: list[_Columns] = [((i,), ()) for i in range(nx)] + [((), (j,)) for j in range(len(named))]
    pairs: list[_Columns] = [(pair, ()) for pair in combinations(range(nx), 2)] if nx > 2 else []
    mixed: list[_Columns] = [((i,), (j,)) for i in range(nx) for j in range(nu)]
    whole: list[_Columns] = [(tuple(range(nx)), ())] if nx > 1 else []
    whole += [((), tuple(range(nu)))] if nu > 1 else []
    for xs, us in single + whole:
        found += [_scaled(xs, us, factor, 0.0, named) for factor in FACTORS]
    for xs, us in pairs:
        found += [_scaled(xs, us, factor, 0.0, named) for factor in FACTORS[:6]]
    for xs, us in single + whole + mixed + [(tuple(range(nx)), tuple(range(nu)))]:
        found += [_scaled(xs, us, factor, offset, named) for factor, offset in CONVERSIONS]
    return sorted(found, key=lambda guess: guess.columns)


def _names(mpc: MPC) -> list[str]:
    """What inputs and signals are called, in the order of a reading's ``u``."""
    return [f"action {j}" for j in range(mpc.nu)] + [f"observation {at}" for at in mpc.layout.present.tolist()]


def _scaled(xs: tuple[int, ...], us: tuple[int, ...], factor: float, offset: float, named: list[str]) -> Guess:
    def read(r: Reading) -> Reading:
        x, u, reached = r.x.copy(), r.u.copy(), r.reached.copy()
        x[:, xs], reached[:, xs] = factor * x[:, xs] + offset, factor * reached[:, xs] + offset
        u[:, us] = factor * u[:, us] + offset
        return r._replace(x=x, u=u, reached=reached)

    names = [f"observation {i}" for i in xs] + [named[j] for j in us]
    name = " and ".join(names)
    words = f"{name} {'is' if len(names) == 1 else 'are'} {in_words(factor, offset)}"
    return Guess(name, "data in the model's units", words, "Are data and model in the same unit?", read, len(names))


def _signs(nx: int, nu: int) -> Iterator[Guess]:
    hint = "Which direction counts as positive?"
    for j in range(nu):

        def read_u(r: Reading, j: int = j) -> Reading:
            u = r.u.copy()
            u[:, j] *= -1.0
            return r._replace(u=u)

        yield Guess(f"action {j}", "the model's sign", f"the sign of action {j} is flipped", hint, read_u)
    for i in range(nx):

        def read_x(r: Reading, i: int = i) -> Reading:
            x, reached = r.x.copy(), r.reached.copy()
            x[:, i] *= -1.0
            reached[:, i] *= -1.0
            return r._replace(x=x, reached=reached)

        yield Guess(f"observation {i}", "the model's sign", f"the sign of observation {i} is flipped", hint, read_x)


def _exchanges(nx: int, nu: int, named: list[str]) -> Iterator[Guess]:
    expected, hint = "columns in the model's order", "Compare the order of the columns with that of the model."
    for a, b in combinations(range(nx), 2):

        def read_states(r: Reading, a: int = a, b: int = b) -> Reading:
            order = list(range(nx))
            order[a], order[b] = b, a
            return r._replace(x=r.x[:, order], reached=r.reached[:, order])

        names = f"observations {a} and {b}"
        yield Guess(names, expected, f"{names} are exchanged", hint, read_states)
    for a, b in combinations(range(nu), 2):

        def read_inputs(r: Reading, a: int = a, b: int = b) -> Reading:
            order = list(range(r.u.shape[1]))  # signals stay
            order[a], order[b] = b, a
            return r._replace(u=r.u[:, order])

        names = f"actions {a} and {b}"
        yield Guess(names, expected, f"{names} are exchanged", hint, read_inputs)
    for i in range(nx):
        for j, other in enumerate(named):

            def read_both(r: Reading, i: int = i, j: int = j) -> Reading:
                x, u, reached = r.x.copy(), r.u.copy(), r.reached.copy()
                x[:, i], u[:, j], reached[:, i] = r.u[:, j], r.x[:, i], r.u_next[:, j]
                return r._replace(x=x, u=u, reached=reached)

            names = f"observation {i} and {other}"
            yield Guess(names, expected, f"{names} are exchanged", hint, read_both)


def _sampling(dt: float) -> Iterator[Guess]:
    for factor in LONGER:
        yield sampled(dt, factor)
        yield sampled(dt, 1.0 / factor)


def sampled(dt: float, factor: float) -> Guess:
    """Another sampling time, for motion that is slow against it."""

    def read(r: Reading) -> Reading:
        return r._replace(reached=r.x + (r.reached - r.x) / factor)

    words = f"the log's sampling time is about {factor * dt:.3g} s ({factor:.3g} times as long)"
    hint = "Give the model the log's dt, in the unit of time of its equations."
    return Guess("dt", f"a log sampled every {dt:g} s, as the model says", words, hint, read)
