"""What a fit depends on besides data and seed, and the combinations of it that have a name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np

from mpcoffline.core.checks import check_integers, check_known, check_number
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.learning import FitConfig, ValueConfig

Init = Literal["nominal", "identified"]
Terminal = Literal["given", "norm", "quadratic", "network"]


@dataclass(frozen=True)
class LearnerConfig:
    """Everything that a fit depends on besides data and seed.

    Attributes:
        trim: Share of the transitions that is learned from; the farthest out are left out.
        discount: gamma of V and of the learned MPC; None keeps the given MPC's.
        least_discount: Where ``discount`` is None and the given MPC's is smaller, this is taken.
        horizon: N of the learned MPC; None keeps the given one's.
        terminal: Its terminal cost: ``"given"`` keeps the given one's, ``"norm"`` is (TERM), ``"quadratic"`` and
            ``"network"`` are fitted to V, as Theorem 1 asks for (doi:10.1109/TAC.2019.2913768).
        terminal_blend: Share of the convex quadratic in ``terminal="network"``: steadier at short horizons.
        cross_term: Whether the quadratic stage cost gets a cross term S.
        init: Where the model starts: ``"nominal"`` at theta_0, ``"identified"`` at the smallest one-step prediction
            error, which also removes measurement noise from the data where there is any.
        adapt_above: With ``init="identified"``, steps on cost and model together (``fit.n_steps``) are made only where
            the identified model misses more than this share of an increment (root mean square of the one-step
            errors): where its structure is not the plant's. Else the model stays and the cost alone is fitted.
        value: How V_phi is learned.
        fit: How theta is learned.
    """

    trim: float = 0.9
    discount: float | None = None
    least_discount: float = 0.0
    horizon: int | None = None
    terminal: Terminal = "given"
    terminal_blend: float = 0.0
    cross_term: bool = False
    init: Init = "nominal"
    adapt_above: float = 0.0
    value: ValueConfig = field(default_factory=ValueConfig)
    fit: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        check_number("trim", self.trim, 0.0, 1.0)
        if self.discount is not None:
            check_number("discount", self.discount, 0.0, 1.0)
        check_number("least_discount", self.least_discount, 0.0, 1.0, open_low=False)
        if self.horizon is not None:
            check_integers(1, horizon=self.horizon)
        check_number("terminal_blend", self.terminal_blend, 0.0, 1.0, open_low=False)
        check_number("adapt_above", self.adapt_above, 0.0, open_low=False)
        if self.fit.potential and self.terminal in ("given", "norm"):
            raise InvalidArgumentError(
                "potential",
                expected="a terminal cost from V, as T = V - Phi",
                actual=f"terminal={self.terminal!r}",
                hint="Set terminal='network' or 'quadratic'.",
            )
        for name, kinds in (("terminal", Terminal), ("init", Init)):
            check_known(name, getattr(self, name), get_args(kinds))

    def replaced(self, overrides: Mapping[str, Any]) -> LearnerConfig:
        """The configuration with fields replaced by name; a name that two parts have needs a prefix.

        Args:
            overrides: Fields of this class, of ``value`` and of ``fit``, e.g. ``{"trim": 1.0, "tau": 0.1}``, with
                ``value_`` or ``fit_`` in front where both have them (``fit_n_steps``).

        Raises:
            UnknownIdError: For a name that is none of these.
            InvalidArgumentError: For a value out of range.
        """
        parts: dict[str, Any] = {"value": self.value, "fit": self.fit}
        own = {f.name for f in fields(self)} - set(parts)
        names = {prefix: {f.name for f in fields(part)} for prefix, part in parts.items()}
        shared = own | (names["value"] & names["fit"])
        homes = {name: ("", name) for name in own}
        for prefix in parts:
            homes |= {f"{prefix}_{name}": (prefix, name) for name in names[prefix]}
            homes |= {name: (prefix, name) for name in names[prefix] - shared}
        changes: dict[str, dict[str, Any]] = {"": {}, "value": {}, "fit": {}}
        for given, value in overrides.items():
            if given not in homes:
                raise UnknownIdError.of("option of OfflineMPCLearner", given, sorted(homes))
            prefix, name = homes[given]
            changes[prefix][name] = value.item() if isinstance(value, np.generic) else value  # JSON has no numpy
        changed = {prefix: replace(part, **changes[prefix]) for prefix, part in parts.items()}
        return replace(self, **changes[""], **changed)

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; raises as ``ValueConfig.to_json``."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        return own | {"value": self.value.to_json(), "fit": asdict(self.fit)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> LearnerConfig:
        """The inverse of ``to_json``."""
        return cls(**(dict(data) | {"value": ValueConfig.from_json(data["value"]), "fit": FitConfig(**data["fit"])}))


# Half of the terminal cost is a convex quadratic: a network alone has local minima, to which short plans fall.
_DEFAULT = LearnerConfig(
    least_discount=0.95,
    horizon=30,
    terminal="network",
    terminal_blend=0.5,
    init="identified",
    value=ValueConfig(method="auto", tau=0.1, n_steps=3_000, learning_rate=2e-3, polyak=0.02),
    # A model that cannot become the plant is adapted to what (FIT) needs of it; one that predicts well is left alone:
    # models of the wrong structure missed 13 % of an increment in the study, right ones less than 1 %, noise or not.
    adapt_above=0.03,
    fit=FitConfig(n_steps=200, prediction_weight=0.1),
)

PRESETS: dict[str, LearnerConfig] = {
    # The published recipe: (VALUE) by Bellman residual, then (FIT); discount, horizon and terminal cost are the MPC's.
    "paper": LearnerConfig(),
    # What most users should get: the model by identification, the stage cost by (FIT), the terminal cost from V.
    "default": _DEFAULT,
    # The same at a third of the horizon, which leaves more to the terminal cost: it has to be closer to V.
    "fast": replace(_DEFAULT, horizon=10, terminal_blend=0.25),
    # Looking farther ahead, by V and by the plan: better wherever the model can become the plant, and more at the
    # mercy of its errors where it cannot. The larger discount gives V more to bridge, so it learns for longer.
    "best": replace(_DEFAULT, horizon=50, least_discount=0.97, value=replace(_DEFAULT.value, n_steps=6_000)),
}
