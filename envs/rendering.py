"""Pictures of the tasks: one style, colour-blind safe (Okabe-Ito), anti-aliased.

Needs pygame, which is loaded when the first picture is drawn.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import ArrayLike, NDArray

from .arguments import Array

if TYPE_CHECKING:
    import pygame

Frame = NDArray[np.uint8]
Color = tuple[int, int, int]

WHITE: Color = (255, 255, 255)
INK: Color = (51, 51, 51)
GREY: Color = (136, 136, 136)
PALE: Color = (230, 230, 230)
PLANT: Color = (0, 114, 178)
TRAIL: Color = (86, 180, 233)
INPUT: Color = (213, 94, 0)
TARGET: Color = (0, 158, 115)
TARGET_ZONE: Color = (217, 240, 233)

# Pictures are drawn larger and shrunk: this smooths what gfxdraw does not, such as text and joints.
_OVERSAMPLING = 4
# gfxdraw takes 16-bit coordinates.
_FARTHEST = 32_000


class Moment(NamedTuple):
    """What a picture shows.

    Attributes:
        state: The state, ``(nx,)``.
        action: The action that led here, ``(nu,)``; None at the start of an episode.
        cost: Its cost.
        time: Time since the start of the episode in s.
        trail: The last states, the present one at the end, ``(k, nx)``.
    """

    state: Array
    action: Array | None
    cost: float
    time: float
    trail: Array


class Viewer:
    """Remembers what an episode's pictures need, and makes them: as arrays, or in a window.

    Args:
        draw: Draws a moment on a canvas.
        size: Width and height in pixels.
        trail_steps: Steps that the trail goes back.
        dt: Sampling time in s; the window shows the episode in real time.
        render_mode: ``"human"`` or ``"rgb_array"``.
    """

    def __init__(
        self,
        draw: Callable[[Canvas, Moment], None],
        size: tuple[int, int],
        trail_steps: int,
        dt: float,
        render_mode: str,
    ) -> None:
        self._draw, self._size, self._dt, self._render_mode = draw, size, dt, render_mode
        self._trail: deque[Array] = deque(maxlen=trail_steps + 1)
        self._step, self._cost = 0, 0.0
        self._action: Array | None = None
        self._canvas: Canvas | None = None
        self._shown = False
        self._clock: pygame.time.Clock | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but pygame's objects, which are not pickled or copied but made again."""
        return self.__dict__ | {"_canvas": None, "_clock": None, "_shown": False}

    def begin(self, state: Array) -> None:
        """An episode starts in a state ``(nx,)``."""
        self._trail.clear()
        self._trail.append(state.copy())
        self._step, self._action, self._cost = 0, None, 0.0

    def add(self, state: Array, action: Array, cost: float) -> None:
        """An action ``(nu,)`` led to a state ``(nx,)``."""
        self._trail.append(state.copy())
        self._step, self._action, self._cost = self._step + 1, action.copy(), cost

    def render(self) -> Frame | None:
        """The picture, ``(height, width, 3)`` uint8; None if it is shown in the window.

        Raises:
            gymnasium.error.DependencyNotInstalled: Without pygame.
        """
        if self._canvas is None:
            self._canvas = Canvas(self._size)
        self._canvas.clear()
        trail = np.array(self._trail)
        self._draw(self._canvas, Moment(trail[-1], self._action, self._cost, self._step * self._dt, trail))
        if self._render_mode == "human":
            self._show(self._canvas)
            return None
        return self._canvas.pixels()

    def close(self) -> None:
        """Closes the window, if there is one; can be repeated."""
        if self._shown:
            pygame, _ = load_pygame()
            pygame.display.quit()
        self._canvas, self._clock, self._shown = None, None, False

    def _show(self, canvas: Canvas) -> None:
        pygame, _ = load_pygame()
        # pygame has one window, that another environment may have taken or closed since.
        window = pygame.display.get_surface()
        if window is None or window.get_size() != self._size:
            pygame.display.init()
            pygame.display.set_caption("mpcoffline")
            window = pygame.display.set_mode(self._size)
        self._shown = True
        window.blit(canvas.picture(), (0, 0))
        pygame.event.pump()
        self._clock = self._clock or pygame.time.Clock()
        self._clock.tick(round(1.0 / self._dt))
        pygame.display.flip()


class Canvas:
    """A drawing area in pixels, x to the right, y down; what lies outside is not seen.

    Args:
        size: Width and height in pixels.

    Raises:
        gymnasium.error.DependencyNotInstalled: Without pygame.
    """

    width: int
    height: int

    def __init__(self, size: tuple[int, int]) -> None:
        self._pygame, self._gfx = load_pygame()
        self._pygame.font.init()
        self.width, self.height = self._size = size
        self._surface = self._pygame.Surface((size[0] * _OVERSAMPLING, size[1] * _OVERSAMPLING))
        self._fonts: dict[int, pygame.font.Font] = {}

    def clear(self) -> None:
        """An empty page."""
        self._surface.fill(WHITE)

    def picture(self) -> pygame.Surface:
        """What was drawn, in the size that it is shown in."""
        picture: pygame.Surface = self._pygame.transform.smoothscale(self._surface, self._size)
        return picture

    def pixels(self) -> Frame:
        """What was drawn, ``(height, width, 3)`` uint8."""
        return np.array(self._pygame.surfarray.pixels3d(self.picture()).transpose(1, 0, 2), order="C")

    def polygon(self, points: ArrayLike, color: Color) -> None:
        """A filled polygon with corners ``(n, 2)``."""
        corners = _pixels(points)
        self._gfx.aapolygon(self._surface, corners, color)
        self._gfx.filled_polygon(self._surface, corners, color)

    def disc(self, center: ArrayLike, radius: float, color: Color) -> None:
        """A filled circle."""
        (x, y), r = _pixels(center), round(radius * _OVERSAMPLING)
        self._gfx.aacircle(self._surface, x, y, r, color)
        self._gfx.filled_circle(self._surface, x, y, r, color)

    def wedge(self, center: ArrayLike, radius: float, start: float, end: float, color: Color) -> None:
        """A filled sector between two angles, clockwise from the top, in rad."""
        middle = np.asarray(center, dtype=np.float64)
        rim = middle + radius * clockwise(np.linspace(start, end, _corners(radius, start, end)))
        self.polygon(np.vstack([middle, rim]), color)

    def arc(self, center: ArrayLike, radius: float, start: float, end: float, width: float, color: Color) -> None:
        """A band along a circle between two angles, clockwise from the top, in rad."""
        ray = clockwise(np.linspace(start, end, _corners(radius, start, end)))
        outside, inside = (np.asarray(center) + r * ray for r in (radius + width / 2, radius - width / 2))
        self.polygon(np.vstack([outside, inside[::-1]]), color)

    def line(self, start: ArrayLike, end: ArrayLike, width: float, color: Color, *, rounded: bool = False) -> None:
        """A straight line; ``rounded`` gives it half discs as ends."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        along = b - a
        length = float(np.hypot(*along))
        if length > 0.0:
            across = np.array([-along[1], along[0]]) / length * width / 2
            self.polygon([a + across, b + across, b - across, a - across], color)
        if rounded:
            self.disc(a, width / 2, color)
            self.disc(b, width / 2, color)

    def dashed(self, start: ArrayLike, end: ArrayLike, width: float, color: Color, dash: float = 7.0) -> None:
        """A dashed straight line."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        count = max(1, round(float(np.hypot(*(b - a))) / dash))
        for k in range(0, count, 2):
            self.line(a + (b - a) * k / count, a + (b - a) * min(k + 1, count) / count, width, color)

    def arrow(self, start: ArrayLike, end: ArrayLike, width: float, color: Color) -> None:
        """A straight arrow; shorter than its head it is drawn smaller, without length not at all."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        length = float(np.hypot(*(b - a)))
        if length < 1.0:
            return
        along = (b - a) / length
        across = np.array([-along[1], along[0]])
        head = min(3.6 * width, length)
        neck = b - head * along
        self.line(a, neck + 0.2 * head * along, width, color)
        self.polygon([b, neck + 0.5 * head * across, neck - 0.5 * head * across], color)

    def curved_arrow(
        self, center: ArrayLike, radius: float, start: float, turn: float, width: float, color: Color
    ) -> None:
        """An arrow along a circle: from an angle (clockwise from the top, rad) on by ``turn`` rad."""
        if abs(turn) * radius < 1.0:
            return
        middle = np.asarray(center, dtype=np.float64)
        head = min(3.6 * width / radius, abs(turn)) * math.copysign(1.0, turn)
        neck = start + turn - head
        self.arc(middle, radius, start, neck + 0.2 * head, width, color)
        half = 0.5 * abs(head) * radius
        # The tip lies on the tangent at the neck, bent halfway towards the circle.
        tip = middle + radius * (1.0 + head**2 / 8.0) * clockwise(start + turn)
        base = clockwise(neck)
        self.polygon([tip, middle + (radius + half) * base, middle + (radius - half) * base], color)

    def trail(self, points: Array, width: float, color: Color) -> None:
        """A line through ``(n, 2)`` points, the oldest first, that fades into the page with age."""
        if len(points) < 2:
            return
        along = np.gradient(points, axis=0)
        along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        across = np.stack([-along[:, 1], along[:, 0]], axis=-1) * width / 2
        left, right = points + across, points - across
        for k in range(len(points) - 1):
            piece = np.stack([left[k], left[k + 1], right[k + 1], right[k]])
            self.polygon(piece, faded(color, (k + 1) / len(points)))
        self.disc(points[-1], width / 2, color)

    def text(self, position: ArrayLike, text: str, size: int, color: Color, anchor: str = "midleft") -> None:
        """A line of text; ``anchor`` is pygame's name of the point of the text that lies at ``position``."""
        if size not in self._fonts:
            self._fonts[size] = self._pygame.font.Font(None, size * _OVERSAMPLING)
        drawn = self._fonts[size].render(text, True, color, WHITE)
        self._surface.blit(drawn, drawn.get_rect(**{anchor: _pixels(position)}))

    def box(self, center: ArrayLike, width: float, height: float, color: Color, radius: float = 7.0) -> None:
        """A filled rectangle with rounded corners."""
        inner = np.array([width / 2 - radius, height / 2 - radius])
        quarter = np.linspace(0.0, np.pi / 2, 8)
        corners = [
            np.asarray(center) + inner * signs + radius * clockwise(quarter + turn)
            for turn, signs in zip(np.arange(4) * np.pi / 2, ([1, -1], [1, 1], [-1, 1], [-1, -1]), strict=True)
        ]
        self.polygon(np.concatenate(corners), color)

    def marker(self, position: ArrayLike, target: float, color: Color) -> None:
        """A small triangle that points down, or to the side if ``target`` (its x) lies elsewhere than it stands."""
        x, y = np.asarray(position, dtype=np.float64)
        turn = np.pi if abs(target - x) < 1.0 else math.copysign(np.pi / 2, target - x)
        self.polygon(np.array([x, y]) + 8.0 * clockwise(turn + np.array([0.0, 2.2, -2.2])), color)

    def ruler(self, y: float, start: float, end: float) -> None:
        """A scale in m along the width of the picture, that reads ``start`` at the left and ``end`` at the right."""
        self.line([0.0, y], [self.width, y], 1.5, GREY)
        scale = self.width / (end - start)
        for value in ticks(start, end):
            x = (value - start) * scale
            self.line([x, y], [x, y + 6.0], 1.5, GREY)
            self.text([x, y + 17.0], label(value), 18, GREY, "center")

    def grid(self, origin: Array, scale: float) -> None:
        """Lines of equal coordinates in m, those through the origin darker, with labels at two edges."""
        for value in ticks(-self.width / 2 / scale, self.width / 2 / scale):
            color = GREY if value == 0.0 else PALE
            x, y = origin[0] + value * scale, origin[1] - value * scale
            self.line([x, 0.0], [x, self.height], 1.5, color)
            self.line([0.0, y], [self.width, y], 1.5, color)
            if value != 0.0:
                self.text([x, self.height - 14.0], label(value), 18, GREY, "center")
                self.text([10.0, y], label(value), 18, GREY)

    def caption(self, entries: Iterable[tuple[str, Color]]) -> None:
        """Figures along the top, in columns that do not move; a colour says what in the picture a figure is of."""
        self.polygon([[0.0, 0.0], [self.width, 0.0], [self.width, 44.0], [0.0, 44.0]], WHITE)
        for k, (text, color) in enumerate(entries):
            self.text([18.0 + 150.0 * k, 22.0], text, 22, color)


def load_pygame() -> tuple[Any, Any]:
    """Loads pygame and its gfxdraw.

    Raises:
        gymnasium.error.DependencyNotInstalled: Without pygame.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would print a greeting on stdout
    try:
        import pygame
        from pygame import gfxdraw
    except ImportError as error:
        raise DependencyNotInstalled(
            'render: expected pygame, which is not installed. Run: pip install "mpcoffline[render]"'
        ) from error
    return pygame, gfxdraw


def clockwise(angle: ArrayLike) -> Array:
    """Unit vectors ``(..., 2)`` at angles in rad, clockwise from the top of the picture."""
    return np.stack([np.sin(angle), -np.cos(angle)], axis=-1)


def faded(color: Color, strength: float) -> Color:
    """A colour mixed with the page: 1 is the colour, 0 is white."""
    red, green, blue = (round(255 + (channel - 255) * strength) for channel in color)
    return red, green, blue


def refined(trail: Array, angle: int | None, pieces: int = 5) -> Array:
    """A trail of states ``(k, nx)`` with more between them, on a smooth curve (Catmull-Rom) through all.

    Args:
        trail: The states.
        angle: The coordinate that wraps, which goes the shorter way round.
        pieces: Pieces between two states.
    """
    if len(trail) < 2:
        return trail
    steps = np.diff(trail, axis=0)
    if angle is not None:
        steps[:, angle] = np.remainder(steps[:, angle] + np.pi, 2.0 * np.pi) - np.pi
    slopes = np.vstack([steps[:1], (steps[1:] + steps[:-1]) / 2.0, steps[-1:]])
    t = (np.arange(1, pieces + 1) / pieces)[:, None]
    start, first, last, step = trail[:-1, None], slopes[:-1, None], slopes[1:, None], steps[:, None]
    curve = start + t * first + t**2 * (3.0 * step - 2.0 * first - last) + t**3 * (first + last - 2.0 * step)
    return np.vstack([trail[:1], curve.reshape(-1, trail.shape[1])])


def ticks(start: float, end: float) -> Array:
    """Five to ten round numbers (1, 2 or 5 times a power of ten) that divide a range, none too near its ends."""
    power = 10.0 ** math.floor(math.log10((end - start) / 5.0))
    spacing = max(power * digit for digit in (1.0, 2.0, 5.0) if power * digit <= (end - start) / 5.0)
    margin = 0.04 * (end - start)
    first, last = math.ceil((start + margin) / spacing), math.floor((end - margin) / spacing)
    return np.asarray(spacing * np.arange(first, last + 1), dtype=np.float64)


def label(number: float) -> str:
    """A tick's number, with a true minus."""
    return f"{round(number, 9) + 0.0:g} m".replace("-", "\u2212")


def signed(number: float, digits: int = 2) -> str:
    """A number with its sign, of constant width: a true minus, and no negative zero."""
    rounded = round(number, digits) + 0.0
    return f"{'−' if rounded < 0 else '+'}{abs(rounded):.{digits}f}"


def _corners(radius: float, start: float, end: float) -> int:
    """Corners of a polygon that looks like an arc."""
    return max(3, math.ceil(abs(end - start) * math.sqrt(max(radius, 1.0) * _OVERSAMPLING)) + 1)


def _pixels(points: ArrayLike) -> Any:
    """Points as gfxdraw takes them: lists of integers on the larger canvas."""
    scaled = np.asarray(points, dtype=np.float64) * _OVERSAMPLING
    return np.clip(scaled, -_FARTHEST, _FARTHEST).round().astype(int).tolist()
