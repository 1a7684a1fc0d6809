"""Things with names: what a name in a call or in a file stands for, and the door through which others add theirs."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, ItemsView, Iterator
from typing import Any, Generic, TypeVar, cast

from .checks import check_known
from .errors import FileFormatError, InvalidArgumentError

T = TypeVar("T")
K = TypeVar("K")  # what a decorator stands before stays what it is
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.+-]{0,63}")


class Registry(Generic[T]):
    """The things of one kind by name, in the order in which they were added.

    Example:
        >>> SOLVERS = Registry[type[Solver]]("solver", Solver)
        >>> @SOLVERS.register("mine")
        ... class MySolver(Solver): ...

    Args:
        kind: What messages call one of them.
        base: The class that each must be a subclass of (where it is a class) or an instance of; by default any thing.
        methods: Methods that each must have, beside the abstract ones of ``base``; ``"a|b"`` asks for one of them.
    """

    kind: str

    def __init__(self, kind: str, base: type[Any] = object, methods: tuple[str, ...] = ()) -> None:
        self.kind, self._base, self._methods = kind, base, methods
        self._things: dict[str, T] = {}

    def register(self, name: str) -> Callable[[K], K]:
        """A decorator that adds what it stands before.

        Raises:
            InvalidArgumentError: As :meth:`add`.
        """

        def added(thing: K) -> K:
            self.add(name, cast("T", thing))
            return thing

        return added

    def add(self, name: str, thing: T) -> T:
        """Adds a thing; the same one again changes nothing.

        Raises:
            InvalidArgumentError: For a name that is taken or malformed, or a thing of another kind or without a method.
        """
        what = f"{self.kind} {name!r:.80}"
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise InvalidArgumentError(what, expected="a name of letters, digits and _.+-", actual=repr(name)[:80])
        if self._things.get(name, thing) is not thing:
            raise InvalidArgumentError(what, expected="a name that is free", actual=f"taken by {self._things[name]!r}")
        right = issubclass(thing, self._base) if isinstance(thing, type) else isinstance(thing, self._base)
        if not right:
            raise InvalidArgumentError(what, expected=f"a {self._base.__name__}", actual=repr(thing)[:200])
        abstract = getattr(thing, "__abstractmethods__", ()) if inspect.isabstract(thing) else ()
        absent = (each for each in self._methods if not any(hasattr(thing, name) for name in each.split("|")))
        if missing := sorted({*abstract, *absent}):
            raise InvalidArgumentError(what, expected=f"the methods {', '.join(missing)}", actual="none of them")
        self._things[name] = thing
        return thing

    def __getitem__(self, name: str) -> T:
        """The thing of that name.

        Raises:
            UnknownIdError: For a name of no thing, whatever its type; it names the nearest ones.
        """
        check_known(self.kind, name, self._things)
        return self._things[name]

    def of_file(self, name: object, where: str) -> T:
        """The thing that a file names; nothing is imported for it.

        Raises:
            FileFormatError: For a name of no thing.
        """
        if isinstance(name, str) and name in self._things:
            return self._things[name]
        raise FileFormatError(
            where,
            expected=f"a {self.kind} that is known here ({', '.join(self._things) or 'none'})",
            actual=f"{name!r:.80}",
            hint=f"If it is one of your own or of another package, import what registers that {self.kind} first.",
        )

    def name_of(self, thing: Any, *, shared: bool = False) -> str:
        """What a thing is called here; empty where it is not: a subclass is another thing.

        Args:
            thing: The thing.
            shared: Whether classes of this package alone count, which every process knows.
        """
        if shared and thing.__module__.split(".")[0] != __name__.split(".")[0]:
            return ""
        return next((name for name, known in self._things.items() if known is thing), "")

    def items(self) -> ItemsView[str, T]:
        """Names and things."""
        return self._things.items()

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._things

    def __iter__(self) -> Iterator[str]:
        return iter(self._things)

    def __len__(self) -> int:
        return len(self._things)
