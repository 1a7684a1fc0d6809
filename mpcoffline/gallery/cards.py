"""The card of a shipped data set: what it is, how it was made, how well its agent learned, what it covers."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.outputs import write_file
from mpcoffline.core.tables import Table
from mpcoffline.core.text import markdown
from mpcoffline.datasets.check.coverage import coverage_figure, panels_of
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.envs import PLANTS, ControlTask
from mpcoffline.envs.episode import DISCOUNT, EPISODE_STEPS

from .collection import AgentScore, return_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from minari import MinariDataset

WINDOW = 20


def write_card(dataset: MinariDataset, recipe: Recipe, scores: Sequence[AgentScore], folder: Path) -> Path:
    """Writes a data set's card and its two figures.

    Args:
        dataset: The data set as recorded.
        recipe: How it was made.
        scores: The final agent's closed-loop figures.
        folder: Where ``<task>.md``, ``<task>_returns.png`` and ``<task>_coverage.png`` go.

    Returns:
        The card's path.
    """
    states, actions = _visited(dataset)
    costs = -return_curve(dataset)
    _save(return_figure(costs, scores), folder / f"{recipe.task}_returns.png")
    _save(coverage_figure(panels_of(PLANTS[recipe.task]), states, actions), folder / f"{recipe.task}_coverage.png")
    card = folder / f"{recipe.task}.md"
    return write_file(card, _card_text(recipe, costs, states, actions, scores))


def return_figure(costs: NDArray[np.float64], scores: Sequence[AgentScore]) -> Figure:
    """The cost of every training episode, its running mean, and the final agent without exploration.

    Args:
        costs: J, the summed cost of each episode (minus its return), ``(E,)``.
        scores: The final agent's figures.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.add_subplot()
    episodes = np.arange(1, len(costs) + 1)
    window = min(WINDOW, len(costs))
    # Costs over several decades (an unstable plant before anything is learned) need a logarithmic axis, on which
    # the geometric mean is the mean of what one sees.
    logarithmic = bool(costs.min() > 0.0 and costs.max() > 100.0 * np.median(costs))
    values = np.log(costs) if logarithmic else costs
    running = np.convolve(values, np.full(window, 1.0 / window), mode="valid")
    mean, label = (np.exp(running), "geometric mean") if logarithmic else (running, "mean")
    axes.plot(episodes, costs, ".", color="0.7", markersize=3.5, label="episode, with exploration")
    axes.plot(episodes[window - 1 :], mean, color="C0", linewidth=1.8, label=f"{label} of {window} episodes")
    for score, color in zip(scores, ("C3", "C1"), strict=False):
        label = f"final agent alone, {score.start} starts"
        axes.axhline(score.cost, color=color, linestyle="--", linewidth=1.3, label=label)
    if logarithmic:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlim(0, len(costs))
    axes.set_xlabel(f"training episode ({EPISODE_STEPS} steps)")
    axes.set_ylabel("cost $J$ of the episode (= $-$return)")
    axes.grid(which="major", color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return figure


def _visited(dataset: MinariDataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    states, actions = [], []
    for episode in dataset.iterate_episodes():
        states.append(episode.infos["state"][:-1])
        actions.append(episode.actions)
    return np.concatenate(states), np.concatenate(actions).astype(np.float64)


def _save(figure: Figure, path: Path) -> None:
    # No metadata: the same data give the same file.
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=130, metadata={"Software": None})
    write_file(path, picture.getvalue())


def _card_text(
    recipe: Recipe,
    costs: NDArray[np.float64],
    states: NDArray[np.float64],
    actions: NDArray[np.float64],
    scores: Sequence[AgentScore],
) -> str:
    settings = {
        "environment": f"`{recipe.env_id}`" + (f", alpha = {recipe.alpha:g}" if recipe.alpha is not None else ""),
        "algorithm": f"Stable-Baselines3 {recipe.algorithm}, seed {recipe.seed}, {recipe.steps} steps",
        "networks": "actor and critic " + " x ".join(map(str, recipe.hidden)),
        "agent's observation": "y / [" + ", ".join(f"{s:g}" for s in recipe.observation_scale) + "]",
        "agent's reward": f"-{recipe.reward_scale:g} L"
        if recipe.reward_form == "linear"
        else f"-sqrt({recipe.reward_scale:g} L)",
        "exploration": f"{recipe.noise_kind} noise, sigma {recipe.noise_sigma:g} of the action in [-1, 1]",
        **{key.replace("_", " "): f"{value:g}" for key, value in recipe.hyperparameters.items()},
    }
    last = costs[-50:]
    extent = np.percentile(np.abs(states), [50, 90, 99, 100], axis=0)
    saturated = float(np.mean(np.abs(actions) >= 0.999 * np.abs(actions).max()))
    covered = [
        ("episodes x steps", f"{len(costs)} x {len(states) // len(costs)}"),
        ("J of an episode: median, worst", f"{np.median(costs):.1f}, {costs.max():.1f}"),
        ("J of the last 50 episodes: mean", f"{last.mean():.1f}"),
        ("actions at a bound", f"{saturated:.0%}"),
    ]
    sizes = [(f"s[{i}]", *(f"{value:.3g}" for value in column)) for i, column in enumerate(extent.T)]
    parts = [
        f"# {recipe.dataset_id}",
        markdown(recipe.description)
        + " Recorded raw: observations y and actions in their units, reward -L, the stage cost L and the state s in"
        " float64. No episode terminates; each is truncated after 100 steps.",
        "```python\nimport mpcoffline\n\n"
        f'dataset = mpcoffline.load_dataset("{recipe.dataset_id}")  # a minari.MinariDataset\n```',
        "## How it was made",
        f"`scripts/make_datasets {recipe.task}` repeats it from `{recipe.task}.toml`: the agent starts untrained, and"
        " every transition of its training is kept, exploration included.",
        Table(("setting", "value"), list(settings.items())).markdown(str),
        "## How well the agent learned",
        f"The final agent, without exploration noise, from fresh starts; J is the summed cost of 100 steps, Jd the"
        f" cost discounted with {DISCOUNT:g}.",
        Table(
            ("starts", "episodes", "J", "worst J", "Jd", "success"), [_figures(score) for score in scores]
        ).markdown(),
        *_optimum(recipe, scores),
        f"![Cost of each training episode]({recipe.task}_returns.png)",
        "## What it covers",
        Table(("", "value"), covered).markdown(str),
        Table(("size of", "median", "90 %", "99 %", "largest"), sizes).markdown(str),
        f"![State-action coverage]({recipe.task}_coverage.png)",
        "## Licence and source",
        "MIT, like the package. The task and the idea of learning an MPC from such data are those of Sawant, Anand,"
        ' Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement Learning", arXiv:2301.01667.',
    ]
    return "\n\n".join(parts) + "\n"


def _figures(score: AgentScore) -> tuple[str, ...]:
    costs = f"{score.cost:.1f}", f"{score.worst_cost:.1f}", f"{score.discounted_cost:.2f}"
    return score.start, str(score.episodes), *costs, f"{score.success:.0%}"


def _optimum(recipe: Recipe, scores: Sequence[AgentScore]) -> list[str]:
    """For a linear plant: the discounted optimum on the starts of the scores, E[s'Ps]."""
    env, plant = recipe.make_env(), PLANTS[recipe.task]
    if plant.reference != "riccati":
        return []
    from mpcoffline.plants.optimal import riccati

    from .collection import FIRST_START, starting_states

    P = riccati(plant, **cast("ControlTask", env.unwrapped).parameters)
    s = starting_states(env, [scores[0].start] * scores[0].episodes, FIRST_START)
    best = float(np.einsum("bi,ij,bj->b", s, P, s).mean())
    return [
        f"The optimum without input bounds (discounted Riccati equation) is Jd = {best:.2f} on these starts: the agent"
        f" reaches {best / scores[0].discounted_cost:.3f} of it."
    ]
