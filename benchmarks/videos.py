"""Clips and key frames: a policy on the first test scenarios, drawn as the environment draws itself."""

from __future__ import annotations

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
from rise_agents.agent import Progress, initial_state
from rise_agents.files import replace_file, replacing
from rise_agents.rollout import policy_keys
from rise_envs.noise_wrappers import ObservationNoise
from rise_envs.task import describes_task, task_of

Frame = NDArray[np.uint8]
FRAMES_PER_SECOND = 10
HOLD = 12  # frames that the last picture of an episode stays
KEY_FRAMES = 4
_BAR = 40  # px, height of the caption
_COLOURS = {"reached": "#1a7f37", "collision": "#c1121f", "not reached": "#9a6700"}


@dataclass(frozen=True)
class Clip:
    """One drawn episode."""

    frames: list[Frame]
    times: list[float]  # s
    outcome: str


def film(policy: Any, env_id: str, seed: int, noise_model: str, noise_level: float) -> Clip:
    """Draw the episode that ``seed`` names, with the noise that the benchmark gives it."""
    env: gym.Env = gym.make(env_id, render_mode="rgb_array")
    dt = task_of(env_id).dt if describes_task(env_id) else 1.0 / env.metadata.get("render_fps", 10)
    if noise_level > 0:
        env = ObservationNoise(env, noise_model, noise_level=noise_level)
    try:
        observation, _ = env.reset(seed=seed, options={"noise_seed": seed} if noise_level > 0 else None)
        state, cost, over, reached = initial_state(policy, policy_keys([seed])), 0.0, False, False
        frames, start = [_frame(env)], np.ones(1, bool)
        deterministic = getattr(policy, "evaluate_deterministic", True)
        while not over:
            action, state = policy.predict(observation, state, start, deterministic)
            observation, _, terminated, truncated, info = env.step(action)
            frames.append(_frame(env))
            cost, over, start = cost + info["cost"], terminated or truncated, np.zeros(1, bool)
            reached = info["is_success"]
    finally:
        env.close()
    outcome = "collision" if cost else "reached" if reached else "not reached"
    return Clip(frames, [i * dt for i in range(len(frames))], outcome)


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
    """``count`` frames of an episode side by side, evenly spread from start to end, at half size."""
    picks = np.linspace(0, len(clip.frames) - 1, count).round().astype(int)
    cells = []
    for n, pick in enumerate(picks):
        last = n == count - 1
        words = clip.outcome if last else ""
        cell = Image.fromarray(
            caption(clip.frames[pick], f"t = {clip.times[pick]:.2f} s", words, _COLOURS[clip.outcome])
        )
        cells.append(np.asarray(cell.resize((cell.width // 2, cell.height // 2), Image.Resampling.LANCZOS)))
    return np.concatenate(cells, axis=1)


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
    clips = []
    for n, seed in enumerate(seeds):
        clips.append(film(policy, env, seed, noise_model, noise_level))
        progress((n + 0.5) / len(seeds), {})
    title = f"{label} · {env_label(env)} · noise level {noise_level:g}"
    frames: list[Frame] = []
    for n, clip in enumerate(clips):
        for i, frame in enumerate(clip.frames):
            ended = i == len(clip.frames) - 1
            words = clip.outcome if ended else f"scenario {n} · {clip.times[i]:.2f} s"
            captioned = caption(frame, title, words, _COLOURS[clip.outcome] if ended else "#57606a")
            frames += [captioned] * (HOLD if ended else 1)
    strip_png = iio.imwrite("<bytes>", strip(clips[0]), extension=".png")
    replace_file(output.with_name(f"{output.stem}-frames.png"), strip_png)
    with replacing(output) as partial:
        iio.imwrite(
            partial,
            np.stack(frames),
            extension=".mp4",
            fps=FRAMES_PER_SECOND,
            codec="libx264",
            macro_block_size=16,
            output_params=["-preset", "veryfast"],  # half the time of the usual one, files a tenth larger
        )
