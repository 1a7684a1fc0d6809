"""What the main job found: numbers, and the table in the forms in which people want it."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mpcoffline.core.archive import file_errors
from mpcoffline.core.documents import read_json
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.outputs import write_file
from mpcoffline.core.tables import Table
from mpcoffline.core.text import markdown, markdown_code
from mpcoffline.solvers.fallback import failures_in_words

_FORMAT = "mpcoffline main job"
_VERSION = 1
REFERENCE = "reference"
RESULTS = "results.json"  # what is written last: where it is, a run is complete


@dataclass(frozen=True)
class ControllerResult:
    """The closed-loop figures of one controller.

    Attributes:
        name: ``"MPC_1"``, ``"MPC_2"``, ``"MPC_3"``, ``"reference"`` or ``"behaviour"``.
        description: What it is.
        costs: Undiscounted cost J of each episode.
        discounted_costs: Discounted cost Jd of each episode.
        successes: Whether each episode ended in success; None where the data do not tell.
        fit_time: Time of the regressions in s; None where nothing was learned.
        solve_time: Mean time of one MPC in s; None for what is no MPC.
        n_solves: MPCs solved.
        n_failures: MPCs whose solution was not accepted.
        states: The state s along the example episode, ``(T + 1, nx)``.
        actions: The actions along it, ``(T, nu)``.
    """

    name: str
    description: str
    costs: list[float]
    discounted_costs: list[float]
    successes: list[bool] | None
    fit_time: float | None = None
    solve_time: float | None = None
    n_solves: int = 0
    n_failures: int = 0
    states: list[list[float]] | None = None
    actions: list[list[float]] | None = None

    @property
    def cost(self) -> float:
        """Mean J."""
        return sum(self.costs) / len(self.costs)

    @property
    def discounted_cost(self) -> float:
        """Mean Jd."""
        return sum(self.discounted_costs) / len(self.discounted_costs)

    @property
    def success(self) -> float | None:
        """Share of episodes that ended in success."""
        return None if self.successes is None else sum(self.successes) / len(self.successes)


@dataclass(frozen=True)
class TaskResult:
    """The outcome of the main job for one task.

    Attributes:
        task: Short name of the plant.
        alpha: Size of the model error.
        seed: Seed of model error, learning and starts.
        env_id: Gymnasium id.
        dataset_id: What was learned from.
        value: The form of (VALUE).
        discount: gamma of Jd, of the MPCs and of the learning.
        dt: Sampling time in s.
        starts: Kind of start of each episode.
        example: Number of the episode whose trajectories are kept: the one that costs the reference most.
        theta: Parameters of each MPC by name.
        controllers: MPC_1, MPC_2, MPC_3 and the reference, from the same starts.
        behaviour: The agent that made the data, in its last episodes there: exploration included, other starts.
    """

    task: str
    alpha: float
    seed: int
    env_id: str
    dataset_id: str
    value: str
    discount: float
    dt: float
    starts: list[str]
    example: int
    theta: dict[str, dict[str, Any]]
    controllers: list[ControllerResult]
    behaviour: ControllerResult

    def controller(self, name: str) -> ControllerResult:
        """The controller of this name."""
        return next(c for c in self.controllers if c.name == name)

    def relative_performance(self, name: str) -> tuple[float, float]:
        """J of the reference over that of the controller, and the same for Jd: 1 is as good, more is better."""
        reference, controller = self.controller(REFERENCE), self.controller(name)
        return reference.cost / controller.cost, reference.discounted_cost / controller.discounted_cost

    @property
    def title(self) -> str:
        """One line that says what the table is about."""
        kinds = [f"{self.starts.count(kind)} {kind}" for kind in dict.fromkeys(self.starts)]
        return f"{self.task}, alpha = {self.alpha:g}, seed {self.seed}: {len(self.starts)} starts ({', '.join(kinds)})"

    def rows(self) -> list[dict[str, str]]:
        """The table: one row a controller, cells as text."""
        shown = []
        for result in [*self.controllers, self.behaviour]:
            compared = result is not self.behaviour
            ratios = [f"{r:.3f}" for r in self.relative_performance(result.name)] if compared else ["", ""]
            shown.append(
                {
                    "controller": result.name,
                    "J": f"{result.cost:.1f}",
                    "Jd": f"{result.discounted_cost:.2f}",
                    "success": "" if result.success is None else f"{result.success:.0%}",
                    "rel. J": ratios[0],
                    "rel. Jd": ratios[1],
                    "fit (s)": "" if result.fit_time is None else f"{result.fit_time:.1f}",
                    "solve (ms)": "" if result.solve_time is None else f"{1e3 * result.solve_time:.2f}",
                }
            )
        return shown

    def notes(self) -> list[str]:
        """What one must know to read the table."""
        return [
            *(f"{c.name}: {c.description}." for c in [*self.controllers, self.behaviour]),
            f"J: cost of an episode, mean; Jd: discounted with {self.discount:g}. rel.: the reference's cost over the"
            " controller's; more is better.",
            f"fit: time of the regressions; that of MPC_2 includes (VALUE, {self.value}), which MPC_3 shares.",
            "solve: mean time of one MPC in closed loop.",
            *self._costs_by_start(),
            f"Failed solves: {self._failures() or 'none'}.",
        ]

    def _failures(self) -> str:
        told = [f"{c.name} {failures_in_words(c.n_failures, c.n_solves)}" for c in self.controllers if c.n_failures]
        return ", ".join(told) + "; the best plan at hand was applied" if told else ""

    def _costs_by_start(self) -> list[str]:
        """J from each kind of start, where there are several: the agent's own episodes start broad, for example."""
        kinds = list(dict.fromkeys(self.starts))
        lines = []
        for kind in kinds if len(kinds) > 1 else []:
            shown = []
            for c in self.controllers:
                costs = [cost for cost, start in zip(c.costs, self.starts, strict=True) if start == kind]
                shown.append(f"{c.name} {sum(costs) / len(costs):.1f}")
            lines.append(f"J from {kind} starts: {', '.join(shown)}.")
        return lines

    def table(self) -> Table:
        """The table, for the terminal and for Markdown."""
        rows = self.rows()
        styles = ["bold" if row["controller"] == "MPC_3" else "" for row in rows]
        return Table([*rows[0]], [[*row.values()] for row in rows], self.title, "lr", styles=styles)

    def markdown(self) -> str:
        """The table and its notes in Markdown."""
        notes = "\n".join(f"* {markdown(note)}" for note in self.notes())
        ids = f"Data: {markdown_code(self.dataset_id)}, environment {markdown_code(self.env_id)}."
        return f"# {markdown(self.title)}\n\n{self.table().markdown()}\n\n{notes}\n\n{ids}\n"

    def save(self, folder: Path) -> list[Path]:
        """Writes results.md (table and notes), results.csv (table) and, last, results.json (everything).

        Args:
            folder: An existing folder.

        Returns:
            The files.
        """
        sheet = io.StringIO()
        writer = csv.DictWriter(sheet, list(self.rows()[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows())
        document = {"format": _FORMAT, "version": _VERSION} | asdict(self)
        contents = {
            RESULTS: json.dumps(document, indent=1) + "\n",
            "results.md": self.markdown(),
            "results.csv": sheet.getvalue(),
        }
        for name in reversed(contents):
            write_file(folder / name, contents[name])
        return [folder / name for name in contents]

    @classmethod
    def load(cls, path: Path) -> TaskResult:
        """Reads a results.json.

        Args:
            path: The file.

        Raises:
            FileFormatError: If it is damaged or another file.
        """
        with file_errors(path):
            document = read_json(path)
            found = document.pop("format"), document.pop("version")
            if found != (_FORMAT, _VERSION) or type(found[1]) is not int:  # True is equal to 1
                raise FileFormatError(str(path), expected=f"{_FORMAT}, version {_VERSION}", actual=str(found))
            controllers = [ControllerResult(**c) for c in document.pop("controllers")]
            behaviour = ControllerResult(**document.pop("behaviour"))
            result = cls(controllers=controllers, behaviour=behaviour, **document)
            result.markdown()  # what it is made of fits together
            return result
