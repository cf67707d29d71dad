"""The moving pictures of the pages of environments and agents.

    python docs/pictures.py                # of all environments, and of the agents that come with the package
    python docs/pictures.py --only rise    # of one of them

Each shows the first validation scenario that ends safely at its goal. They are committed: drawing takes minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.policies import make_policy
from benchmarks.trajectories import acting, play
from benchmarks.videos import Clip, film
from rise_agents import AGENTS, pretrained
from rise_agents.experts import EXPERTS
from rise_agents.seeds import episode_seeds
from rise_envs import ENVS, STAND_INS
from rise_envs.task import env_class

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH, COLOURS, FRAMES = 400, 192, 30  # px, of the palette, at most in a picture
TRIED = 50  # scenarios


def success(env_id: str, row: str, trained: Path | None, level: float) -> Clip:
    """The first scenario that ends well, drawn; raises ``ValueError`` if none of the first does."""
    for seed in map(int, episode_seeds("validation", 0, start=0, count=TRIED)):
        policy = make_policy(env_id, row, trained)
        episode = play(acting(policy, seed), env_id, seed, "step", level)
        if episode.arrived and not episode.cost.any():
            return film(acting(policy, seed), env_id, seed, "step", level)
    raise ValueError(f"{row} in {env_id}: none of {TRIED} scenarios ends safely at its goal")


def write_gif(path: Path, clip: Clip) -> None:
    """Write some frames of an episode, the last one for longer."""
    step = -(-len(clip.frames) // FRAMES)
    kept = [*clip.frames[:-1:step], clip.frames[-1]]
    height = round(WIDTH * kept[0].shape[0] / kept[0].shape[1])
    small = [Image.fromarray(each).resize((WIDTH, height), Image.Resampling.LANCZOS) for each in kept]
    # One palette for all, or surfaces would flicker: of greys in even steps, and of what is coloured most often.
    colours = np.concatenate([np.asarray(each).reshape(-1, 3) for each in small[:: -(-len(small) // 6)]])
    vivid = colours[np.ptp(colours.astype(int), axis=-1) > 24]
    common = Image.fromarray(vivid[None]).quantize(COLOURS, Image.Quantize.FASTOCTREE)
    palette = Image.new("P", (1, 1))
    greys = np.linspace(0, 255, 256 - COLOURS).repeat(3).astype(int)
    palette.putpalette([*(common.getpalette() or [])[: 3 * COLOURS], *greys])
    first, *rest = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in small]
    path.parent.mkdir(parents=True, exist_ok=True)
    times = [max(100, 2500 // len(small))] * len(rest) + [1500]  # ms
    first.save(path, save_all=True, append_images=rest, duration=times, loop=0, optimize=True)


def pictures() -> Iterator[tuple[Path, str, str, Path | None, float]]:
    """Where to put each picture, and what it shows: environment, row, checkpoint, noise level."""
    for env_id in ENVS:
        if env_id in STAND_INS or "rgb_array" not in env_class(env_id).metadata["render_modes"]:
            continue
        if expert := next((name for env, name in EXPERTS if env == env_id), None):
            yield IMAGES / "envs" / f"{env_id}.gif", env_id, f"expert-{expert}", None, 1.0
        for agent in AGENTS:
            if (agent, env_id) in pretrained.available():
                trained = pretrained.find(agent, env_id)
                yield IMAGES / "agents" / f"{agent}-{env_id}.gif", env_id, agent, trained, 1.0


def main(arguments: list[str]) -> None:
    """Draw them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", help="part of the names of the files to make")
    chosen = parser.parse_args(arguments)
    for path, env_id, row, trained, level in pictures():
        if (chosen.only or "") in path.name:
            write_gif(path, success(env_id, row, trained, level))
            print(f"{path.relative_to(IMAGES.parent)}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
