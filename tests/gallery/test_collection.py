"""Recipes and collection: what is recorded is raw, whatever the agent is trained on."""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
import rich
import torch
from rich.console import Console
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.check.coverage import coverage_figure, panels_of
from mpcoffline.datasets.recipes import Recipe, recorded_tasks
from mpcoffline.datasets.store.packed import packed_size
from mpcoffline.envs import PLANTS, ControlTask
from mpcoffline.gallery import collect
from mpcoffline.gallery.cards import return_figure, write_card
from mpcoffline.gallery.collection import collect_with, make_agent, return_curve, score_agent
from mpcoffline.gallery.shipping import make_shipped

ROOT = Path(__file__).resolve().parents[2]


def quick(task: str, steps: int = 300) -> Recipe:
    """A recipe whose agent begins to learn at once, in small networks."""
    recipe = Recipe.load(task).vary(steps=steps, dataset_id=f"test/{task}-v0")
    return replace(recipe, hidden=(8,), hyperparameters={**recipe.hyperparameters, "learning_starts": 50})


@cache
def collected(task: str) -> tuple[minari.MinariDataset, OffPolicyAlgorithm]:
    """By a quick recipe, once, in the store of the test that asks first."""
    return collect_with(quick(task), progress=False)


@pytest.mark.parametrize("task", recorded_tasks())
def test_what_is_collected_is_raw(task: str) -> None:
    recipe = quick(task)
    dataset, _ = collected(task)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 300)
    plain = recipe.make_env().unwrapped
    assert isinstance(plain, ControlTask)
    for episode in dataset.iterate_episodes():
        state, action = episode.infos["state"], episode.actions.astype(np.float64)
        np.testing.assert_array_equal(episode.observations, plain.observe(state))
        np.testing.assert_allclose(-episode.rewards, plain.cost(state[:-1], action), rtol=1e-12)
        np.testing.assert_allclose(plain.next_state(state[:-1], action), state[1:], rtol=1e-12, atol=1e-12)
    # Uniform exploration at first: in the environment's units it comes close to the bounds.
    assert np.abs(dataset[0].actions).max() > 0.9 * plain.action_space.high[0]
    np.testing.assert_allclose(return_curve(dataset), [e.rewards.sum() for e in dataset.iterate_episodes()])
    env = dataset.recover_environment()
    assert env.spec is not None
    assert (env.spec.id, env.spec.max_episode_steps, env.spec.kwargs) == (recipe.env_id, 100, recipe.env_kwargs)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_data() -> None:
    recipes = [
        replace(quick("pendulum", steps=120), seed=seed, dataset_id=f"test/s{i}-v0") for i, seed in enumerate((3, 3, 4))
    ]
    sets = [collect_with(recipe, progress=False)[0] for recipe in recipes]
    first, again, other = (TransitionTable.from_minari(dataset).rows for dataset in sets)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("task", recorded_tasks())
def test_the_agent_sees_scaled_observations_and_rewards(task: str) -> None:
    recipe = Recipe.load(task)
    agent = make_agent(recipe)
    env = agent.get_env()
    assert env is not None
    observation = env.reset()
    extracted = agent.policy.actor.features_extractor(torch.as_tensor(observation))
    np.testing.assert_allclose(extracted.numpy(), observation / np.array(recipe.observation_scale, np.float32))
    action = np.full((1, *env.action_space.shape), 0.5, np.float32)
    _, reward, _, infos = env.step(action)
    cost = 0.1 * infos[0]["cost"]
    np.testing.assert_allclose(reward[0], -np.sqrt(cost) if recipe.reward_form == "sqrt" else -cost, rtol=1e-6)
    assert agent.gamma == 0.9


def test_threads_are_as_before() -> None:
    before = torch.get_num_threads()
    collect("linear", steps=5, dataset_id="test/threads-v0", progress=False)
    assert torch.get_num_threads() == before


def test_ids_say_what_deviates_from_the_recipe() -> None:
    linear, pendulum = Recipe.load("linear"), Recipe.load("pendulum")
    assert linear.dataset_id == linear.vary(alpha=1.0, steps=50_000).dataset_id == "mpcoffline/linear/ddpg-v0"
    assert linear.vary(alpha=0.5).dataset_id == "mpcoffline/linear/ddpg-alpha050-v0"
    assert linear.vary(alpha=0.5).env_kwargs == {"alpha": 0.5}
    assert linear.vary(alpha=1.25, seed=7).dataset_id == "mpcoffline/linear/ddpg-alpha125-seed7-v0"
    assert pendulum.vary(steps=200).dataset_id == "mpcoffline/pendulum/ddpg-steps200-v0"
    assert linear.vary(alpha=0.123, dataset_id="test/a-v0").dataset_id == "test/a-v0"
    with pytest.raises(InvalidArgumentError, match="two decimals"):
        linear.vary(alpha=0.123)
    with pytest.raises(InvalidArgumentError, match=r"no alpha for task 'pendulum'.*MPC's model"):
        pendulum.vary(alpha=1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps: expected a positive integer, got 0"),
        ({"seed": -1}, "seed: expected an integer >= 0, got -1"),
        ({"dataset_id": "no.dots-v0"}, r"namespace/"),
        ({"alpha": 1.0}, "alpha: expected no alpha"),
    ],
)
def test_bad_arguments_are_refused_before_training(arguments: Any, message: str, store: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        collect("pendulum", progress=False, **arguments)
    assert not [path for path in store.rglob("*") if path.is_file()]


def test_an_unknown_task_names_the_nearest() -> None:
    with pytest.raises(UnknownIdError, match="Did you mean 'cartpole'"):
        collect("cart-pole")


def test_an_existing_id_is_refused_unless_overwritten() -> None:
    for steps in (20, 30):
        collect("linear", steps=steps, dataset_id="test/once-v0", overwrite=steps == 30, progress=False)
        with pytest.raises(InvalidArgumentError, match="exists"):
            collect("linear", steps=40, dataset_id="test/once-v0", progress=False)
        assert minari.load_dataset("test/once-v0").total_steps == steps


def test_the_progress_bar_shows_the_running_return(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(rich, "_console", Console(file=stream, force_terminal=True, width=100, color_system=None))
    dataset = collect("pendulum", steps=220, dataset_id="test/bar-v0")
    mean = return_curve(dataset)[:2].mean()
    shown = stream.getvalue()
    assert "DDPG learns pendulum" in shown
    assert f"return {mean:.1f}" in shown


def test_scores_are_those_of_the_environment() -> None:
    """The batched closed loop against one episode after the other with `step`."""

    class Constant:
        def predict(self, observation: Any, deterministic: bool) -> Any:
            return 0.3 * np.sign(observation[..., :1]), None

    env = gym.make("mpcoffline/CartPoleSwingUp-v0")
    scores = score_agent(Constant(), env, episodes=3, seed=5)
    assert [score.start for score in scores] == ["broad", "hanging"]
    for score in scores:
        costs, success = [], []
        for i in range(3):
            observation, _ = env.reset(seed=5 + i, options={"start": score.start})
            episode = []
            while True:
                observation, _, _, truncated, info = env.step(Constant().predict(observation, True)[0])
                episode.append(info["cost"])
                if truncated:
                    break
            costs.append(episode)
            success.append(info["is_success"])
        total = np.sum(costs, axis=1)
        np.testing.assert_allclose([score.cost, score.worst_cost], [total.mean(), total.max()], rtol=1e-9)
        np.testing.assert_allclose(score.discounted_cost, np.mean(costs @ 0.9 ** np.arange(100)), rtol=1e-9)
        assert score.success == np.mean(success)


@pytest.mark.slow
@pytest.mark.parametrize("task", recorded_tasks())
def test_a_card_says_what_the_data_are(task: str, tmp_path: Path) -> None:
    recipe = quick(task)
    dataset, agent = collected(task)
    scores = score_agent(agent, recipe.make_env(), episodes=2)
    text = write_card(dataset, recipe, scores, tmp_path).read_text(encoding="utf-8")
    for part in (recipe.dataset_id, recipe.env_id, "3 x 100", "MIT", "arXiv:2301.01667", f"{scores[0].cost:.1f}"):
        assert part in text
    assert ("Riccati" in text) == (task == "linear")
    for figure in ("returns", "coverage"):
        assert f"({task}_{figure}.png)" in text
        assert (tmp_path / f"{task}_{figure}.png").read_bytes().startswith(b"\x89PNG")


def test_figures_hold_the_numbers() -> None:
    costs = np.linspace(400.0, 100.0, 50)
    axes = return_figure(costs, []).axes[0]
    points, mean = axes.get_lines()
    np.testing.assert_array_equal(points.get_ydata(), costs)
    np.testing.assert_allclose(mean.get_ydata()[0], costs[:20].mean())
    assert axes.get_yscale() == "linear"
    assert return_figure(np.r_[1e5, costs], []).axes[0].get_yscale() == "log"
    rng = np.random.default_rng(0)
    figure = coverage_figure(
        panels_of(PLANTS["pendulum"]), rng.uniform(-1, 1, (1000, 2)), rng.uniform(-2, 2, (1000, 1))
    )
    counts = [axes.collections[0].get_array() for axes in figure.axes[:2]]
    assert [int(count.sum()) for count in counts] == [1000, 1000]


@pytest.mark.slow
def test_one_call_makes_all_that_is_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = quick("pendulum")
    monkeypatch.setattr(Recipe, "load", lambda task: recipe)
    files = make_shipped("pendulum", tmp_path, progress=False)
    assert [file.name for file in files] == ["pendulum.h5", "pendulum.md", "SHA256SUMS"]
    assert packed_size(tmp_path / "pendulum.h5") == (3, 300)
    assert (tmp_path / "SHA256SUMS").read_text().endswith("  pendulum.h5\n")


def test_the_command_explains_itself_and_refuses_an_unknown_task() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "make_datasets")]
    shown = subprocess.run([*command, "--help"], capture_output=True, text=True, check=True).stdout
    assert all(task in shown for task in recorded_tasks())
    result = subprocess.run([*command, "pendulm"], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "Did you mean 'pendulum'" in result.stderr
