"""Pictures: what is seen stands where the state says, and everything that can go wrong says what."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.envs import ENV_IDS, ControlTask, rendering as style
from mpcoffline.envs.rendering import Canvas, refined, signed, ticks

CAPTION = 44
HANG = float(np.pi)


def make(env_id: str, render_mode: str | None = "rgb_array", **kwargs: Any) -> ControlTask:
    task = gym.make(env_id, render_mode=render_mode, **kwargs).unwrapped
    assert isinstance(task, ControlTask)
    return task


def picture(env_id: str, state: list[float], action: list[float] | None = None, **kwargs: Any) -> NDArray[np.uint8]:
    """The picture of a state, or of where an action leads from there."""
    env = make(env_id, **kwargs)
    env.reset(options={"state": state})
    if action is not None:
        env.step(np.array(action))
    frame = env.render()
    assert frame is not None
    return frame


def where(frame: NDArray[np.uint8], color: style.Color) -> NDArray[np.int64]:
    """(x, y) of the pixels of a colour below the caption."""
    rows, columns = np.nonzero((np.abs(frame.astype(int) - color).max(axis=-1) <= 2)[CAPTION:])
    return np.stack([columns, rows + CAPTION], axis=-1)


def middle(frame: NDArray[np.uint8], color: style.Color) -> NDArray[np.float64]:
    found = where(frame, color)
    assert len(found) > 5
    return found.mean(axis=0)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_picture_is_an_array_of_its_own(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    first = env.render()
    assert first is not None
    width, height = env.picture_size
    assert (first.shape, first.dtype) == ((height, width, 3), np.uint8)
    assert first.flags.c_contiguous
    kept = first.copy()
    env.step(env.action_space.high)
    second = env.render()
    assert second is not None
    assert (first != second).any()
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_same_episode_gives_the_same_pictures(env_id: str) -> None:
    frames = []
    for mode in ("rgb_array", "human"):
        env = make(env_id, mode)
        env.reset(seed=3)
        for _ in range(3):
            env.step(env.action_space.high)
        if mode == "human":
            shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
            assert env.render() is None
        else:
            shown = env.render()
        frames.append(shown)
        env.close()
    np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize("phi", [0.0, 0.7, 1.6, 2.9, -2.0, -0.3])
def test_the_pendulum_points_where_its_angle_says(phi: float) -> None:
    frame = picture(PENDULUM, [phi, 0.0])
    hinge = middle(frame, style.INK)
    along = middle(frame, style.PLANT) - hinge
    assert np.arctan2(along[0], -along[1]) == pytest.approx(phi, abs=0.02)


def test_the_zone_of_success_stands_upright_and_is_as_wide_as_it_is() -> None:
    frame = picture(PENDULUM, [HANG, 0.0])
    hinge = middle(frame, style.INK)
    rays = where(frame, style.TARGET_ZONE) - hinge
    far = rays[np.hypot(*rays.T) > 100]
    angles = np.arctan2(far[:, 0], -far[:, 1])
    assert [angles.min(), angles.max()] == pytest.approx([-0.3, 0.3], abs=0.02)


@pytest.mark.parametrize("torque", [-2.0, -1.0, 1.0, 2.0])
def test_the_torque_turns_its_way_and_grows_with_its_size(torque: float) -> None:
    frame = picture(PENDULUM, [0.0, 0.0], [torque])
    hinge = middle(frame, style.INK)
    arrow = where(frame, style.INPUT) - hinge
    angles = np.arctan2(arrow[:, 0], -arrow[:, 1])
    assert (np.sign(angles) == np.sign(torque)).all()
    assert np.abs(angles).max() == pytest.approx(0.15 + 0.7 * abs(torque), abs=0.12)


@pytest.mark.parametrize(("x", "phi"), [(0.0, 0.0), (1.0, 2.0), (-1.2, -1.0)])
def test_the_cart_stands_and_its_pole_points_where_they_should(x: float, phi: float) -> None:
    frame = picture(CARTPOLE, [x, 0.0, phi, 0.0])
    assert middle(frame, style.INK)[0] == pytest.approx(300 + 125 * x, abs=8)  # the pole hides a part of the cart
    pole = where(frame, style.PLANT)
    tip = pole[np.argmax(np.hypot(*(pole - [300 + 125 * x, 206]).T))]
    assert np.hypot(*(tip - [300 + 125 * x + 125 * np.sin(phi), 206 - 125 * np.cos(phi)])) < 8


@pytest.mark.parametrize("x", [5.0, -30.0, 99.0])
def test_the_view_follows_the_cart(x: float) -> None:
    frame = picture(CARTPOLE, [x, 0.0, 0.0, 0.0])
    assert 100 < middle(frame, style.INK)[0] < 500
    mark = middle(frame, style.TARGET)[0]  # of the reference, at the edge that it lies beyond
    assert (mark < 25) if x > 0 else (mark > 575)


def test_a_longer_pole_still_fits() -> None:
    frame = picture(CARTPOLE, [0.0, 0.0, 0.0, 0.0], l=4.0)
    pole = where(frame, style.PLANT)
    assert pole[:, 1].min() > CAPTION + 10
    assert np.ptp(pole[:, 1]) == pytest.approx(125, abs=12)


@pytest.mark.parametrize("force", [-2.0, 2.0])
def test_the_force_points_its_way(force: float) -> None:
    frame = picture(CARTPOLE, [0.0, 0.0, 0.0, 0.0], [force])
    arrow = where(frame, style.INPUT)
    assert (np.sign(arrow[:, 0] - 300) == np.sign(force)).all()
    assert np.ptp(arrow[:, 0]) == pytest.approx(80, abs=4)


@pytest.mark.parametrize("position", [[0.6, -0.6], [-1.0, 0.2], [40.0, 3.0], [-500.0, 500.0]])
def test_the_mass_stands_in_a_view_that_holds_it(position: list[float]) -> None:
    frame = picture(LINEAR, [*position, 0.0, 0.0])
    x, y = middle(frame, style.PLANT) - 300
    assert np.arctan2(-y, x) == pytest.approx(np.arctan2(position[1], position[0]), abs=0.02)
    assert 120 < max(abs(x), abs(y)) < 275  # neither lost in the middle nor at the edge


def test_the_success_radius_is_drawn_to_scale() -> None:
    frame = picture(LINEAR, [1.0, 1.0, 0.0, 0.0])
    ring = where(frame, style.TARGET)
    assert np.ptp(ring, axis=0) == pytest.approx(2 * 0.05 * 300 / 1.25, abs=3)


def test_the_trail_is_where_the_tip_was_and_ends_with_the_episode() -> None:
    env = make(PENDULUM)
    env.reset(options={"state": [0.5, 0.0]})
    first = env.render()
    for _ in range(12):
        env.step(np.zeros(1))
    assert first is not None
    later = env.render()
    assert later is not None
    start = (300 + 215 * np.sin(0.7), 314 - 215 * np.cos(0.7))  # passed on the way down
    x, y = round(start[0]), round(start[1])
    before, after = first[y, x].astype(int), later[y, x].astype(int)
    assert after[2] > after[0] + 10  # blue
    assert abs(before[2] - before[0]) < 5
    env.reset(options={"state": [0.5, 0.0]})
    np.testing.assert_array_equal(env.render(), first)


def test_the_pictures_of_the_documentation_are_those_of_today(tmp_path: Path) -> None:
    folder = Path(__file__).parents[2] / "docs" / "environments"
    spec = importlib.util.spec_from_file_location("make_pictures", folder / "make_pictures.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    for name in ("pendulum", "cartpole", "linear"):
        today, kept = (
            pygame.surfarray.array3d(pygame.image.load(place / f"{name}.png")).astype(int)
            for place in (tmp_path, folder)
        )
        assert np.abs(today - kept).mean() < 1.0  # another version of pygame may draw letters a little differently
        assert (folder / f"{name}.png").stat().st_size < 60_000


# ---------------------------------------------------------------- what can go wrong


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("wrapped", [True, False])
def test_render_before_reset(env_id: str, wrapped: bool) -> None:
    env: Any = gym.make(env_id, render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match="render"):
        (env if wrapped else env.unwrapped).render()


def test_render_without_a_mode_warns() -> None:
    env = make(PENDULUM, None)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@pytest.mark.parametrize("mode", [None, "rgb_array", "human"])
def test_close_can_be_repeated_and_undone(mode: str | None) -> None:
    env = make(PENDULUM, mode)
    env.close()
    env.reset(seed=0)
    env.close()
    env.close()
    if mode is not None:
        env.reset(seed=0)
        assert (env.render() is None) == (mode == "human")
        env.close()


def test_environments_take_turns_in_the_window() -> None:
    first, second = make(PENDULUM, "human"), make(CARTPOLE, "human")
    first.reset(seed=0)
    second.reset(seed=0)
    assert pygame.display.get_surface().get_size() == (600, 400)
    first.step(np.zeros(1))
    assert pygame.display.get_surface().get_size() == (600, 600)
    second.close()
    assert pygame.display.get_surface() is None
    first.step(np.zeros(1))  # opens it again
    assert pygame.display.get_surface().get_size() == (600, 600)
    first.close()
    assert pygame.display.get_surface() is None


def test_without_pygame_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    array, window = make(PENDULUM, "rgb_array"), make(PENDULUM, "human")
    monkeypatch.setitem(sys.modules, "pygame", None)
    array.reset(seed=0)
    for draw in (array.render, window.reset):
        with pytest.raises(gym.error.DependencyNotInstalled, match=r'pip install "mpcoffline\[render\]"'):
            draw()


# ---------------------------------------------------------------- the parts


def test_what_lies_far_outside_is_not_seen() -> None:
    canvas = Canvas((40, 30))
    canvas.clear()
    canvas.line([20.0, -1e9], [20.0, 1e9], 4.0, style.INK)
    canvas.disc([1e7, 1e7], 3.0, style.INPUT)
    frame = canvas.pixels()
    assert (frame[15, 20] == style.INK).all()
    assert (frame[:, :15] == 255).all()


def test_arrows_without_length_are_not_drawn() -> None:
    canvas = Canvas((40, 40))
    canvas.clear()
    canvas.arrow([20.0, 20.0], [20.0, 20.0], 5.0, style.INPUT)
    canvas.curved_arrow([20.0, 20.0], 10.0, 1.0, 0.0, 5.0, style.INPUT)
    canvas.line([20.0, 20.0], [20.0, 20.0], 5.0, style.INPUT)
    canvas.trail(np.array([[20.0, 20.0]]), 5.0, style.TRAIL)
    assert (canvas.pixels() == 255).all()


def test_refined_trails_pass_through_all_states_the_shorter_way_round() -> None:
    t = np.linspace(0.0, 6.0, 60)
    trail = np.stack([np.sin(t), np.angle(np.exp(1j * t))], axis=-1)
    curve = refined(trail, angle=1, pieces=4)
    assert len(curve) == 4 * 59 + 1
    np.testing.assert_allclose(np.exp(1j * curve[::4, 1]), np.exp(1j * t), atol=1e-12)
    np.testing.assert_allclose(curve[::4, 0], np.sin(t), atol=1e-12)
    fine = np.linspace(0.0, 6.0, len(curve))
    np.testing.assert_allclose(curve[4:-4, 0], np.sin(fine)[4:-4], atol=1e-4)
    np.testing.assert_allclose(np.exp(1j * curve[:, 1]), np.exp(1j * fine), atol=1e-12)
    np.testing.assert_array_equal(refined(trail[:1], angle=1), trail[:1])


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (-2.4, 2.4, np.arange(-4, 5) * 0.5),
        (0.0, 10.0, [2.0, 4.0, 6.0, 8.0]),
        (97.5, 102.5, [98.0, 99.0, 100.0, 101.0, 102.0]),
    ],
)
def test_ticks_are_round(start: float, end: float, expected: list[float]) -> None:
    np.testing.assert_allclose(ticks(start, end), expected, atol=1e-12)


def test_signed_numbers_keep_their_width() -> None:
    assert [signed(x) for x in (1.234, -1.234, -0.001, 0.0)] == ["+1.23", "−1.23", "+0.00", "+0.00"]
