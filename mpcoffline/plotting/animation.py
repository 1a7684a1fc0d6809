"""Films of controllers side by side, from the pictures that the environment draws: GIF, or MP4 by ffmpeg."""

from __future__ import annotations

import importlib
import io
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.core.outputs import check_output, write_file

from .panels import task_of
from .style import OTHER, STYLES, stem_and_index

if TYPE_CHECKING:
    from PIL.Image import Image

    from mpcoffline.control.evaluation import Predictor

Frames = list[NDArray[np.uint8]]

_TITLE_SHARE = 0.11  # of a picture's height
_COLORS = 160
_LOWERED = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUFFIXES = (".gif", ".mp4")


def animate(
    policies: Mapping[str, Predictor],
    env: gym.Env[Any, Any] | str,
    start: ArrayLike,
    path: str | PathLike[str],
    *,
    seconds: float | None = None,
    fps: int = 10,
    width: int = 360,
) -> Path:
    """Writes a film of several controllers, each in its own picture, from the same start; in real time.

    Args:
        policies: The controllers by name, e.g. ``{"MPC_1": ..., "MPC_3": ...}``.
        env: The environment or its id.
        start: Initial state, ``(nx,)``.
        path: A ``.gif`` file, or an ``.mp4`` one, for which ffmpeg must be there.
        seconds: Length; the whole episode by default.
        fps: Pictures a second; rounded so that each is a whole number of sampling times.
        width: Of each controller's picture, in pixels.

    Returns:
        The file.

    Raises:
        InvalidArgumentError: For another suffix, no controllers, a number that is not positive, or an environment that
            is none of this package's.
        MPCOfflineError: If pygame, or for MP4 ffmpeg, is missing.
        StorageError: If nothing can be written there.
    """
    target = Path(path)
    check_film(target)
    if not policies:
        raise InvalidArgumentError("policies", expected="at least one", actual="none")
    for name, number in (("seconds", 1.0 if seconds is None else seconds), ("fps", fps), ("width", width)):
        if not number > 0:
            raise InvalidArgumentError(name, expected="a positive number", actual=str(number))
    task, _ = task_of(env)
    every = max(1, round(1.0 / (fps * task.dt)))
    columns = [_frames(policy, env, start, seconds, every) for policy in policies.values()]
    pictures = [_beside(list(policies), moment, width) for moment in zip(*columns, strict=True)]
    duration = every * task.dt
    content = _gif(pictures, duration) if target.suffix == ".gif" else _mp4(pictures, duration)
    return write_file(target, content)


def check_film(path: Path) -> None:
    """Refuses what :func:`animate` would refuse, before the work that comes before it.

    Raises:
        InvalidArgumentError: For another suffix than ``.gif`` and ``.mp4``.
        MPCOfflineError: If pygame, or for MP4 ffmpeg, is missing.
        StorageError: If nothing could be written there.
    """
    if path.suffix not in _SUFFIXES:
        raise InvalidArgumentError("film", expected=f"a file ending in {' or '.join(_SUFFIXES)}", actual=str(path))
    try:
        importlib.import_module("pygame")
    except ImportError as error:
        raise MPCOfflineError(
            "film", expected="the package pygame", actual="none", hint='pip install "mpcoffline[render]"'
        ) from error
    if path.suffix == ".mp4":
        _ffmpeg()
    check_output(path, make=True)


def _frames(
    policy: Predictor, env: gym.Env[Any, Any] | str, start: ArrayLike, seconds: float | None, every: int
) -> Frames:
    """The pictures of one episode, one every so many steps."""
    spec = gym.spec(env) if isinstance(env, str) else env.spec
    if spec is None:
        raise InvalidArgumentError("env", expected="an environment made by gym.make", actual=f"{env} without a spec")
    made: gym.Env[Any, Any] = gym.make(spec, render_mode="rgb_array")
    dt = task_of(made)[0].dt
    n_steps = None if seconds is None else round(seconds / dt)
    try:
        observation, _ = made.reset(seed=0, options={"state": np.asarray(start, dtype=np.float64)})
        frames, state, done, step = [np.asarray(made.render(), dtype=np.uint8)], None, False, 0
        while not done and (n_steps is None or step < n_steps):
            first = np.array([step == 0])
            action, state = policy.predict(observation, state=state, episode_start=first, deterministic=True)
            observation, _, terminated, truncated, _ = made.step(action)
            step, done = step + 1, bool(terminated or truncated)
            if step % every == 0:
                frames.append(np.asarray(made.render(), dtype=np.uint8))
    finally:
        made.close()
    return frames


def _beside(names: list[str], moment: tuple[NDArray[np.uint8], ...], width: int) -> Image:
    """One picture of all controllers, their names above; even sizes, which video needs."""
    from PIL import Image, ImageDraw

    height = round(width * moment[0].shape[0] / moment[0].shape[1])
    head = round(_TITLE_SHARE * height)
    whole = Image.new("RGB", (2 * (width * len(names) // 2), 2 * ((head + height) // 2)), "white")
    draw, font = ImageDraw.Draw(whole), _font(round(0.62 * head))
    for i, (name, frame) in enumerate(zip(names, moment, strict=True)):
        whole.paste(Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS), (i * width, head))
        color = STYLES.get(name, OTHER).color
        draw.text((round((i + 0.5) * width), head // 2 + 1), _title(name), color, font, anchor="mm")
    return whole


def _title(name: str) -> str:
    """The name of a controller with its index lowered, as in the figures."""
    stem, index = stem_and_index(name)
    return stem + index.translate(_LOWERED)


def _font(size: int) -> Any:
    """The font of the figures."""
    from matplotlib.font_manager import findfont
    from PIL import ImageFont

    return ImageFont.truetype(findfont("DejaVu Sans"), size)


def _gif(pictures: list[Image], duration: float) -> bytes:
    """A GIF that repeats; one palette for all pictures, so that nothing flickers."""
    from PIL import Image

    width, height = pictures[0].size
    sampled = pictures[:: max(1, len(pictures) // 4)]
    together = Image.new("RGB", (width, height * len(sampled)), "white")
    for i, picture in enumerate(sampled):
        together.paste(picture, (0, i * height))
    sample = together.quantize(_COLORS, Image.Quantize.MAXCOVERAGE)
    indexed = [picture.quantize(palette=sample, dither=Image.Dither.NONE) for picture in pictures]
    pauses = [round(1000 * duration)] * len(indexed)
    pauses[-1] += 800  # what is reached can be seen
    content = io.BytesIO()
    indexed[0].save(
        content, "GIF", save_all=True, append_images=indexed[1:], duration=pauses, loop=0, optimize=True, disposal=1
    )
    return content.getvalue()


def _mp4(pictures: list[Image], duration: float) -> bytes:
    """H.264 in the pixel format that every player knows."""
    ffmpeg = _ffmpeg()
    width, height = pictures[0].size
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        command = [ffmpeg, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        command += ["-r", f"{1.0 / duration:g}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(film)]
        raw = b"".join(picture.tobytes() for picture in pictures)
        done = subprocess.run(command, input=raw, capture_output=True, check=False)
        if done.returncode:
            message = done.stderr.decode(errors="replace").strip()[-300:]
            raise MPCOfflineError(f"ffmpeg {ffmpeg}", expected="a film", actual=message, hint="Write a .gif instead.")
        return film.read_bytes()


def _ffmpeg() -> str:
    """The program ffmpeg: on the PATH, or that of the package imageio-ffmpeg (moviepy brings it)."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise MPCOfflineError(
            "MP4",
            expected="ffmpeg on the PATH, or the package imageio-ffmpeg",
            actual="neither",
            hint='pip install "mpcoffline[video]", or write a .gif.',
        ) from error
