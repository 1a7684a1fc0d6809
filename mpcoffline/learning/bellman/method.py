"""The method "bellman": the published regressions, begun at an identified model and ended by a terminal cost from V."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.estimation import with_profiles
from mpcoffline.learning.known_cost import CostConfig, with_known_cost
from mpcoffline.learning.known_limits import with_limit_costs
from mpcoffline.learning.method import METHODS, Method
from mpcoffline.learning.stages import Change, Known, Stage
from mpcoffline.learning.value.config import ValueConfig
from mpcoffline.mpc import MPC

from .candidates import candidates, undiscounted, with_learned_residual
from .limits import check_limit_parameters
from .regression import ParameterConfig
from .stages import (
    LearnParameters,
    LearnValue,
    StartConfig,
    TerminalConfig,
    identified,
    with_dead_time,
    with_terminal_cost,
    with_terminal_form,
)


@METHODS.register("bellman")
@dataclass(frozen=True)
class Bellman(Method):
    """The regressions of arXiv:2301.01667 one after the other; no MPC is solved.

    In this order: what soft limits cost, which V sees and (FIT) need not explain; whether the stage cost is known, dead
    time of the inputs, identification of the model and removal of measurement noise (the last three with
    ``init="identified"``), V_phi by (VALUE), theta by (FIT), the terminal cost from V. By default all are as in
    :class:`~mpcoffline.learning.Paper`.

    Attributes:
        cost: Whether the stage cost is learned.
        identify: Where the model starts.
        value: How V_phi is learned.
        fit: How theta is learned.
        terminal: What the terminal cost becomes.
    """

    cost: CostConfig = field(default_factory=CostConfig)
    identify: StartConfig = field(default_factory=StartConfig)
    value: ValueConfig = field(default_factory=ValueConfig)
    fit: ParameterConfig = field(default_factory=ParameterConfig)
    terminal: TerminalConfig = field(default_factory=TerminalConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fit.potential and self.terminal.method in ("given", "norm"):
            raise InvalidArgumentError(
                "potential",
                expected="a terminal cost from V, as T = V - Phi",
                actual=f"terminal={self.terminal.method!r}",
                hint="Set terminal='network' or 'quadratic'.",
            )

    def prepared(self, known: Known) -> Known:
        """Profiles of signals; and dead time of the inputs, found in the data or checked (``init="identified"``).

        Raises:
            InvalidArgumentError: If limits are to be learned, and none of them can.
        """
        if "constraints" in known.groups:
            check_limit_parameters(known.mpc)
        return with_dead_time(replace(known, mpc=with_profiles(known.mpc, known.table)), self.identify)

    def foreseen(self, known: Known) -> list[MPC]:
        """The whole fit, of which all but the numbers is known, and MPC_1; nothing where there will be no choice."""
        if known.given is None or known.found is None:
            return []
        return [with_terminal_form(known, self.terminal), known.given]

    def candidates(self, known: Known) -> dict[str, MPC]:
        """The identified model with the costs that were given, and with V; see :func:`candidates`."""
        fixed = self.horizon is not None or self.discount is not None
        return candidates(known, self.terminal, fixed=fixed, only_fitted=self.cost.stage_cost == "fitted")

    def variants(self, known: Known, mpcs: Mapping[str, MPC], turn: int) -> dict[str, MPC]:
        """Candidates with a learned residual, where held-out episodes ask for one; then the best one undiscounted."""
        if turn == 0:
            return with_learned_residual(known, mpcs)
        return undiscounted(mpcs) if self.discount is None else {}

    def stages(self) -> dict[str, Stage | Change]:
        """Identification, (VALUE), (FIT), the terminal cost."""
        return {
            "limits": with_limit_costs,
            "cost": partial(with_known_cost, config=self.cost),
            "identify": partial(identified, config=self.identify),
            "value": LearnValue(self.value),
            "fit": LearnParameters(self.fit, self.identify.adapt_above),
            "terminal": partial(with_terminal_cost, config=self.terminal, horizon=self.horizon),
        }
