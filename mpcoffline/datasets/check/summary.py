"""What is in a data set: its card, a table of statistics, a figure of what it covers."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.outputs import check_output, write_file
from mpcoffline.core.tables import Table
from mpcoffline.core.text import markdown
from mpcoffline.datasets.hub.loading import load_dataset
from mpcoffline.datasets.recipes import catalog_file
from mpcoffline.datasets.store.local import shipped_datasets
from mpcoffline.datasets.store.names import names_of
from mpcoffline.datasets.table.numbers import check_numbers
from mpcoffline.envs import find_plant

from .coverage import Axis, coverage_figure, panels_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from minari import MinariDataset
    from rich.console import RenderableType

QUANTILES = (0.0, 5.0, 50.0, 95.0, 100.0)
_HEADER = ("", "smallest", "5 %", "median", "95 %", "largest", "mean")


@dataclass(frozen=True)
class Statistics:
    """Of one quantity, over all steps or episodes.

    Attributes:
        name: What it is.
        quantiles: At :data:`QUANTILES`.
        mean: Its mean.
    """

    name: str
    quantiles: tuple[float, ...]
    mean: float


@dataclass(frozen=True)
class Summary:
    """What :func:`show` gives; prints as Markdown, and in colour with rich.

    Attributes:
        dataset_id: Minari id.
        card: The card of a shipped data set, Markdown; empty for any other.
        facts: What the metadata say: environment, algorithm, counts, ends.
        statistics: Of observations, actions, cost and the J of an episode.
        figure: Where the coverage plot is; None where none was asked for.
    """

    dataset_id: str
    card: str
    facts: dict[str, str]
    statistics: tuple[Statistics, ...]
    figure: Path | None

    def __str__(self) -> str:
        facts = [f"* {key}: {markdown(value)}" for key, value in self.facts.items()]
        lines = [self.card or f"# {markdown(self.dataset_id)}\n", *facts, "", self._table().markdown()]
        return "\n".join([*lines, "", f"coverage: {self.figure}"] if self.figure is not None else lines)

    def __rich__(self) -> RenderableType:
        from rich.console import Group
        from rich.markdown import Markdown
        from rich.text import Text

        head: RenderableType = Markdown(self.card) if self.card else Text(self.dataset_id, style="bold")
        tail = [Text(f"coverage: {self.figure}")] if self.figure is not None else []
        return Group(head, Text(), Table((), [*self.facts.items()]), Text(), self._table(), Text(), *tail)

    def _table(self) -> Table:
        rows = [(s.name, *(f"{value:.4g}" for value in (*s.quantiles, s.mean))) for s in self.statistics]
        return Table(_HEADER, rows, align="lr")


def show(dataset: MinariDataset | str, figure: str | Path | None = None) -> Summary:
    """Summarises a data set, and plots what it covers.

    Args:
        dataset: The data set or its id.
        figure: File for the coverage plot, of any format that matplotlib writes; None for no plot.

    Raises:
        UnknownIdError: For an unknown id.
        InvalidDataError: For observations or actions that are no vectors, or no step at all.
        StorageError: If the plot could not be written there.
    """
    if figure is not None:
        check_output(figure, make=True)
    if isinstance(dataset, str):
        dataset = load_dataset(dataset)
    columns = _columns(dataset)
    path = None
    if figure is not None:
        path = Path(figure)
        picture = io.BytesIO()
        coverage(dataset, columns).savefig(picture, format=path.suffix.lstrip(".").lower() or "png", dpi=130)
        write_file(path, picture.getvalue())
    values = [*columns["observation"].T, *columns["action"].T]
    named = list(zip(column_names(dataset), values, strict=True))
    named += [("cost L of a step", columns["cost"]), ("cost J of an episode", columns["J"])]
    named.append(("steps of an episode", columns["length"]))
    return Summary(
        dataset_id=dataset.spec.dataset_id,
        card=_card(dataset.spec.dataset_id),
        facts=_facts(dataset, columns),
        statistics=tuple(_statistics(name, values) for name, values in named),
        figure=path,
    )


def coverage(dataset: MinariDataset, columns: dict[str, NDArray[np.float64]] | None = None) -> Figure:
    """Two-dimensional histograms of where the data lie.

    For our tasks the panels of their cards; for any other environment neighbouring coordinates of the observation, and
    the first of them against the first action.

    Args:
        dataset: The data set.
        columns: As read by :func:`show`; read here if None.
    """
    data = columns if columns is not None else _columns(dataset)
    plant = find_plant(dataset.env_spec.id) if dataset.env_spec is not None else None
    if plant is not None and "state" in data:
        return coverage_figure(panels_of(plant), data["state"], data["action"])
    size, names = data["observation"].shape[1], column_names(dataset)
    axes = [Axis(names[i], "state", i) for i in range(size)]
    pairs = [(axes[i], axes[i + 1]) for i in range(0, min(size, 6) - 1, 2)]
    return coverage_figure([*pairs, (axes[0], Axis(names[size], "action", 0))], data["observation"], data["action"])


def column_names(dataset: MinariDataset) -> tuple[str, ...]:
    """What the columns of a data set are called, observations first: by name and unit, else ``observation[0]`` ...

    Raises:
        FileFormatError: For stored names that are none.
    """
    spaces = {"observation": dataset.observation_space, "action": dataset.action_space}
    sizes = {kind: math.prod(space.shape or ()) for kind, space in spaces.items()}
    return names_of(dataset) or tuple(f"{kind}[{i}]" for kind, size in sizes.items() for i in range(size))


def _columns(dataset: MinariDataset) -> dict[str, NDArray[np.float64]]:
    """Observations, actions, states and costs of all steps ``(n, ...)``; J and length of all episodes ``(E,)``."""
    name = f"data set {dataset.spec.dataset_id!r}"
    for kind, space in (("observation", dataset.observation_space), ("action", dataset.action_space)):
        if len(space.shape or ()) != 1:
            raise InvalidDataError(f"{name}: {kind} space", expected="a Box of shape (n,)", actual=str(space))
    parts: dict[str, list[Any]] = {key: [] for key in ("observation", "action", "cost", "state", "J", "length", "ends")}
    try:
        for episode in dataset.iterate_episodes():
            rewards = check_numbers("rewards", episode.rewards).astype(np.float64)
            parts["observation"].append(check_numbers("observations", episode.observations)[:-1])
            parts["action"].append(check_numbers("actions", episode.actions))
            parts["cost"].append(-rewards)
            if "state" in (episode.infos or {}):
                parts["state"].append(check_numbers("infos/state", episode.infos["state"])[:-1])
            parts["J"].append([-rewards.sum()])
            parts["length"].append([len(rewards)])
            parts["ends"].append([float(check_numbers("terminations", episode.terminations)[-1:].any())])
        columns = {key: np.concatenate(arrays).astype(np.float64) for key, arrays in parts.items() if arrays}
    except (OSError, RuntimeError, TypeError, ValueError, LookupError, AttributeError) as error:
        hint = "`mpcoffline datasets verify` says what is wrong."
        raise InvalidDataError(name, expected="episodes of numbers", actual=str(error)[:300], hint=hint) from error
    if not parts["cost"]:
        raise InvalidDataError(name, expected="at least one episode", actual="none")
    if len(columns.get("state", ())) != len(columns["cost"]):
        columns.pop("state", None)
    return columns


def _facts(dataset: MinariDataset, columns: dict[str, NDArray[np.float64]]) -> dict[str, str]:
    metadata, spec = dataset.storage.metadata, dataset.env_spec
    names, size = names_of(dataset), columns["observation"].shape[1]
    arguments = ", ".join(f"{key} = {value}" for key, value in spec.kwargs.items()) if spec is not None else ""
    terminated = int(columns["ends"].sum())
    high = np.abs(columns["action"]).max(axis=0)
    at_bound = np.mean(np.abs(columns["action"]) >= 0.999 * np.where(high > 0.0, high, np.inf))
    facts = {
        "environment": f"{spec.id}{f' ({arguments})' if arguments else ''}" if spec is not None else "",
        "algorithm": str(metadata.get("algorithm_name") or ""),
        "description": str(metadata.get("description") or ""),
        "observation": ", ".join(names[:size]),
        "action": ", ".join(names[size:]),
        "episodes": f"{len(columns['J'])} ({terminated} terminated, {len(columns['J']) - terminated} truncated)",
        "steps": str(len(columns["cost"])),
        "actions at their extremes": f"{at_bound:.0%}",
        "stored in": str(Path(dataset.spec.data_path).parent),
    }
    return {key: value for key, value in facts.items() if value}


def _statistics(name: str, values: NDArray[np.float64]) -> Statistics:
    return Statistics(name, tuple(float(q) for q in np.percentile(values, QUANTILES)), float(values.mean()))


def _card(dataset_id: str) -> str:
    task = shipped_datasets().get(dataset_id)
    card = catalog_file(f"{task}.md", task) if task is not None else None
    return card.read_text(encoding="utf-8") if card is not None and card.is_file() else ""
