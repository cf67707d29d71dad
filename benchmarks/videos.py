"""Clips and key frames: a policy on the first test scenarios, drawn as the environment draws itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.labels import env_label
from benchmarks.policies import make_policy
from benchmarks.trajectories import Act, Trajectory, acting, play, step_seconds
from rise_agents.agent import Progress
from rise_agents.files import replace_file, replacing

Frame = NDArray[np.uint8]
FRAMES_PER_SECOND = 10
HOLD = 12  # frames that the last picture of an episode stays
KEY_FRAMES = 4
_BAR, _GAP = 40, 10  # px, height of the caption, and between key frames
_COLOURS = {"reached": "#1a7f37", "collision": "#c1121f", "not reached": "#9a6700"}


@dataclass(frozen=True)
class Clip:
    """One drawn episode."""

    frames: list[Frame]
    times: list[float]  # s
    outcome: str
    closest: int  # the frame after the step with the least clearance
    clearance: float  # m, least
    ended: str = ""  # in the last picture, if not the outcome


def film(act: Act, env_id: str, seed: int, noise_model: str, noise_level: float) -> Clip:
    """Draw the episode that ``seed`` names, with the noise that the benchmark gives it.

    Raises:
        ValueError: an environment that draws no pictures.
    """
    frames: list[Frame] = []
    episode = play(act, env_id, seed, noise_model, noise_level, watch=lambda env: frames.append(_frame(env)))
    times = [i * step_seconds(env_id) for i in range(len(frames))]
    word, least = outcome(episode), episode.outcomes["min_clearance"]
    goal = ", goal reached" if episode.arrived else ", goal not reached"
    return Clip(frames, times, word, episode.closest, least, word + goal * (word == "collision"))


def outcome(episode: Trajectory) -> str:
    """How an episode ended, in a word or two."""
    return "collision" if episode.cost.any() else "reached" if episode.arrived else "not reached"


def _frame(env: gym.Env) -> Frame:
    frame = env.render()
    assert isinstance(frame, np.ndarray)  # noqa: S101  render_mode is rgb_array
    return frame


def caption(frame: Frame, left: str, right: str = "", colour: str = "#24292f") -> Frame:
    """``frame`` under a bar with words at either side; both sides padded to multiples of 16 px for codecs."""
    height, width = frame.shape[:2]
    size = (-(-width // 16) * 16, -(-(height + _BAR) // 16) * 16)
    canvas = Image.new("RGB", size, "white")
    canvas.paste(Image.fromarray(frame), ((size[0] - width) // 2, size[1] - height))
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(18)
    draw.text((12, _BAR // 2), left, fill="#24292f", font=font, anchor="lm")
    draw.text((size[0] - 12, _BAR // 2), right, fill=colour, font=font, anchor="rm")
    return np.asarray(canvas)


def strip(clip: Clip, count: int = KEY_FRAMES) -> Frame:
    """``count`` frames of an episode side by side at half size, from start to end, one of them the closest moment."""
    picks = np.linspace(0, len(clip.frames) - 1, count).round().astype(int)
    if count > 2:
        inner = 1 + int(np.abs(picks[1:-1] - clip.closest).argmin())
        picks[inner] = clip.closest
    cells = []
    for n, pick in enumerate(picks):
        last, words = n == count - 1, ""
        if pick == clip.closest:
            words = f"least, within the step: {clip.clearance:.2f} m"
        words = clip.ended or clip.outcome if last else words
        cell = Image.fromarray(
            caption(clip.frames[pick], f"t = {clip.times[pick]:.2f} s", words, _COLOURS[clip.outcome])
        )
        half = np.asarray(cell.resize((cell.width // 2, cell.height // 2), Image.Resampling.LANCZOS))
        cells.append(np.pad(half, ((0, 0), (0, _GAP), (0, 0)), constant_values=255))
    return np.concatenate(cells, axis=1)


def captioned(clip: Clip, title: str, mark: str = "") -> list[Frame]:
    """The frames of an episode under ``title``, with ``mark`` and time beside it, the last one for longer."""
    frames: list[Frame] = []
    for i, frame in enumerate(clip.frames):
        ended = i == len(clip.frames) - 1
        words = clip.ended or clip.outcome if ended else f"{mark}{clip.times[i]:.2f} s"
        done = caption(frame, title, words, _COLOURS[clip.outcome] if ended else "#57606a")
        frames += [done] * (HOLD if ended else 1)
    return frames


def write_strip(path: Path, clip: Clip) -> None:
    """Write key frames of an episode as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    replace_file(path, iio.imwrite("<bytes>", strip(clip), extension=".png"))


def write_film(path: Path, frames: Sequence[Frame], per_second: float = FRAMES_PER_SECOND) -> None:
    """Write frames as MP4.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as partial:
        iio.imwrite(
            partial,
            np.stack(frames),
            extension=".mp4",
            fps=per_second,
            codec="libx264",
            macro_block_size=16,
            output_params=["-preset", "veryfast"],  # half the time of the usual one, files a tenth larger
        )


def record(
    output: Path,
    progress: Progress,
    env: str,
    row: str,
    checkpoint: Path | None,
    noise_model: str,
    noise_level: float,
    seeds: list[int],
    settings: dict[str, Any],
    label: str,
) -> None:
    """Write an MP4 of the episodes that ``seeds`` name, and a PNG strip of key frames of the first."""
    policy = make_policy(env, row, checkpoint, settings, noise_level)
    title = f"{label} · {env_label(env)} · noise level {noise_level:g}"
    frames: list[Frame] = []
    for n, seed in enumerate(seeds):
        clip = film(acting(policy, seed), env, seed, noise_model, noise_level)
        frames += captioned(clip, title, f"scenario {n} · ")
        if not n:
            write_strip(output.with_name(f"{output.stem}-frames.png"), clip)
        progress((n + 0.5) / len(seeds), {})
    write_film(output, frames)
