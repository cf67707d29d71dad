"""Drive an environment with the keyboard, on noisy readings, and keep what was driven well as demonstrations.

``python -m rise_agents.play RISE-GroundVehicle-v0``. The window shows the obstacle as it is and, dashed, as it is read.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rise_agents import demonstrations
from rise_agents.agent import nearest
from rise_agents.checkpoint import versions
from rise_agents.cli import Parser, at_work, command, prepare_folder
from rise_agents.demonstrations import DATA, Demonstrations
from rise_agents.demonstrations.dataset import OBSERVATIONS, check, params_of
from rise_agents.files import sole_user
from rise_agents.seeds import episode_seeds
from rise_envs import ENVS, ObservationNoise, make_noise
from rise_envs.settings import finite, whole
from rise_envs.task import env_class, metadata_of, task_of

PERSON = "person"
# Which keys push each action to its upper and to its lower bound, where the environment's class has no ``KEYS``.
KEYS = (("right", "left"), ("up", "down"), ("w", "s"))
HOLD = 1.0  # s that the end of an episode is shown
_EXAMPLES = """\
examples:
  python -m rise_agents.play RISE-GroundVehicle-v0
  python -m rise_agents.play RISE-SafePanda-v0 --rate 8 --noise-model episode --noise-level 0.5
                                       the arm at a third of its speed: its episodes last 2 seconds
  python -m rise_agents.play RISE-GroundVehicle-v0 --out demos/mine

Arrow keys drive (up: ahead, left and right: turn; the arm: arrow keys across the table, W and S up and down),
R begins another episode, Q or Escape ends. With --out, episodes that reach the goal without a collision are kept,
with true readings, beside those that the folder holds already.
"""


@dataclass
class Drive:
    """One episode that was driven: what was seen without noise, and what was done.

    Attributes:
        seed: of the environment.
        observations: T + 1 of them.
        actions: T of them.
        rewards: T of them.
        costs: T of them.
        arrived: whether the goal was reached.
    """

    seed: int
    observations: list[dict[str, NDArray]] = field(default_factory=list)
    actions: list[NDArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    arrived: bool = False

    @property
    def outcome(self) -> str:
        """In a word or two."""
        return "collision" if any(self.costs) else "goal reached" if self.arrived else "goal not reached"


class Keyboard:
    """Which keys are held, and what that means.

    Args:
        env_id: of the environment that is driven.
        space: of its actions.
    """

    def __init__(self, env_id: str, space: Any) -> None:
        import pygame

        names = getattr(env_class(env_id), "KEYS", KEYS)
        if len(names) < space.shape[0]:
            raise ValueError(f"{env_id} has {space.shape[0]} actions, and keys for {len(names)}")
        self.names = [name for pair in names[: space.shape[0]] for name in pair]
        self.pairs = [[pygame.key.key_code(name) for name in pair] for pair in names[: space.shape[0]]]
        self.low, self.high = space.low, space.high
        self.held: set[int] = set()
        self.quit = self.again = False

    def listen(self) -> None:
        """Take in what was pressed and released since the last time."""
        import pygame

        self.again = False
        for event in pygame.event.get((pygame.KEYDOWN, pygame.KEYUP)):
            if event.type == pygame.KEYUP:
                self.held.discard(event.key)
                continue
            self.held.add(event.key)
            self.quit |= event.key in (pygame.K_q, pygame.K_ESCAPE)
            self.again |= event.key == pygame.K_r

    def action(self) -> NDArray[np.float32]:
        """The action (A,) that the held keys stand for; without any, the one nearest to standing still."""
        action = np.clip(np.zeros_like(self.low), self.low, self.high)
        for i, (up, down) in enumerate(self.pairs):
            if (up in self.held) != (down in self.held):
                action[i] = self.high[i] if up in self.held else self.low[i]
        return action


class Seat:
    """Environment, window and keyboard.

    Args:
        env_id: of an environment that draws itself.
        noise: of its readings.
        noise_level: of that noise.
        rate: steps per second; 0: as fast as they can be drawn.
    """

    def __init__(self, env_id: str, noise: str, noise_level: float, rate: float) -> None:
        from rise_envs.rendering import Window  # pygame is loaded by who drives only

        self.env = ObservationNoise(gym.make(env_id, render_mode="rgb_array"), noise, noise_level=noise_level)
        self.env.reset(seed=0)
        self.window = Window(self._picture().shape, rate, env_id)
        self.keyboard, self.rate = Keyboard(env_id, self.env.action_space), rate

    @property
    def taken(self) -> bool:
        """Whether somebody is still there."""
        return self.window.is_open and not self.keyboard.quit

    def _picture(self) -> NDArray[np.uint8]:
        return np.asarray(self.env.render(), np.uint8)

    def _listen(self) -> None:
        if self.window.is_open:  # else there are no events
            self.keyboard.listen()

    def drive(self, seed: int) -> Drive | None:
        """The episode that ``seed`` names; None if it was not driven to its end."""
        driven, over = Drive(seed), False
        _, info = self.env.reset(seed=seed)
        driven.observations.append(info["clean_observation"])
        self.window.show(self._picture())
        while not over:
            self._listen()
            if self.keyboard.again or not self.taken:
                return None
            action = self.keyboard.action()
            _, reward, terminated, truncated, info = self.env.step(action)
            driven.observations.append(info["clean_observation"])
            driven.actions.append(action)
            driven.rewards.append(float(reward))
            driven.costs.append(float(info["cost"]))
            driven.arrived, over = bool(info["is_success"]), terminated or truncated
            self.window.show(self._picture())
        return driven

    def tell(self, text: str) -> None:
        """Show the end of an episode for a while, under a title."""
        self.window.name(text)
        for _ in range(round(HOLD * self.rate)):
            self.window.show(self._picture())
        self._listen()

    def close(self) -> None:
        """Close the window and the environment."""
        self.window.close()
        self.env.close()


def as_demonstrations(env_id: str, drives: Sequence[Drive], seed: int, tried: int) -> Demonstrations:
    """Episodes as a checked set.

    Args:
        env_id: the environment.
        drives: episodes that reached their goals without cost, at least one.
        seed: the range of training seeds that they are of.
        tried: episodes that were driven for them.

    Raises:
        DatasetError: one is no such episode.
    """
    lengths = [len(drive.actions) for drive in drives]
    seen = {key: [np.stack([o[key] for o in drive.observations]) for drive in drives] for key in OBSERVATIONS}
    card = {
        **{
            "expert": PERSON,
            "experts": [PERSON],
            "seed": seed,
            "split": "train",
            "params": params_of(env_id),
        },
        **{"episodes": len(drives), "transitions": sum(lengths), "tried": tried},
        **{"rejection_rate": 1 - len(drives) / tried, "versions": versions()},
    }
    made = Demonstrations(
        env_id,
        {key: np.concatenate([rows[:-1] for rows in all_rows]) for key, all_rows in seen.items()},
        np.concatenate([np.array(drive.actions, np.float64) for drive in drives]),
        np.concatenate([np.array(drive.rewards) for drive in drives]),
        np.concatenate([np.array(drive.costs) for drive in drives]),
        {key: np.stack([rows[-1] for rows in all_rows]) for key, all_rows in seen.items()},
        np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
        np.array([drive.seed for drive in drives], np.int64),
        np.zeros(len(drives), np.int64),
        card,
    )
    check(made)
    return made


def as_drives(made: Demonstrations) -> list[Drive]:
    """The episodes of a set, the inverse of :func:`as_demonstrations`."""
    drives = []
    for i, seed in enumerate(made.seeds.tolist()):
        rows = range(int(made.offsets[i]), int(made.offsets[i + 1]))
        seen = [{key: value[row] for key, value in made.observations.items()} for row in rows]
        seen.append({key: value[i] for key, value in made.final.items()})
        actions, rewards, costs = (
            list(made.actions[rows]),
            made.rewards[rows].tolist(),
            made.costs[rows].tolist(),
        )
        drives.append(Drive(seed, seen, actions, rewards, costs, True))
    return drives


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.play",
        description="Drive an environment with the keyboard, on noisy readings.",
        epilog=_EXAMPLES,
    )
    p.add_argument("env", metavar="ENV", help=f"environment: {', '.join(ENVS)}")
    p.add_argument("--noise-model", default="step", metavar="MODEL", help="of the readings (default: step)")
    p.add_argument("--noise-level", type=float, default=1.0, metavar="X", help="of that noise (default: 1)")
    p.add_argument(
        "--rate",
        type=float,
        metavar="N",
        help="steps per second, 0: as fast as they are drawn (default: as the environment says)",
    )
    p.add_argument(
        "--seed", type=int, default=0, metavar="N", help="range of training seeds, 0 to 999 (default: 0)"
    )
    p.add_argument(
        "--episodes", type=int, metavar="N", help="leave after so many episodes (default: when told)"
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="folder for demonstrations (default: keep none)")
    return p


def checked(argv: Sequence[str] | None) -> argparse.Namespace:
    """The arguments; raises ``ValueError`` for whatever can be known to fail before a window opens."""
    a = parser().parse_args(argv)
    if a.env not in ENVS:
        raise ValueError(f"unknown environment {a.env!r}: {nearest(a.env, ENVS)}")
    metadata = metadata_of(a.env)
    if "rgb_array" not in metadata["render_modes"]:
        raise ValueError(f"{a.env} draws no pictures: there is nothing to drive by")
    make_noise(a.noise_model, a.noise_level, task_of(a.env).noise_channels)
    a.rate = finite("--rate", metadata.get("render_fps", 10) if a.rate is None else a.rate, 0.0)
    if a.episodes is not None:
        whole("--episodes", a.episodes, 1)
    episode_seeds("train", a.seed, 0, 1)  # raises where there is no such range
    if a.out is not None:
        prepare_folder(a.out)
    return a


def there_already(a: argparse.Namespace) -> tuple[list[Drive], int]:
    """The episodes that the folder holds, and how many were driven for them.

    Raises:
        ValueError: it holds a set of somebody else, or of another environment or range of seeds.
    """
    if a.out is None or not (a.out / DATA).exists():
        return [], 0
    made = demonstrations.load(a.out)
    if (made.env_id, made.card.get("expert"), made.card.get("seed")) != (a.env, PERSON, a.seed):
        raise ValueError(
            f"{a.out} holds another set, not driven here with --seed {a.seed}: name another folder"
        )
    return as_drives(made), int(made.card["tried"])


def play(a: argparse.Namespace, kept: list[Drive], tried: int) -> list[Drive]:
    """Let somebody drive; what is driven well is added to ``kept`` and, if a folder is named, stored at once."""
    seat = Seat(a.env, a.noise_model, a.noise_level, a.rate)
    print(f"drive with {', '.join(seat.keyboard.names)}; r: another episode; q: end")
    number, last = tried, None if a.episodes is None else tried + a.episodes
    try:
        while seat.taken and number != last:
            (seed,) = episode_seeds("train", a.seed, number, 1).tolist()
            driven = seat.drive(int(seed))
            if driven is None and not seat.taken:
                break
            number += 1
            if driven is None:
                continue
            if driven.outcome == "goal reached":
                kept.append(driven)
                if a.out is not None:
                    as_demonstrations(a.env, kept, a.seed, number).save(a.out)
            print(
                f"episode {number}: {driven.outcome} after {len(driven.actions)} steps, {len(kept)} good ones"
            )
            seat.tell(f"{a.env}: {driven.outcome}")
    finally:
        seat.close()
    return kept


@command("rise_agents.play")
def main(argv: Sequence[str] | None = None) -> int:
    """Drive; returns the exit code: 0 done, 1 no window can be opened, 2 bad arguments, 130 interrupted."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    try:
        a = checked(argv)
        kept, tried = there_already(a)
    except OSError as error:  # of a file that the arguments name
        raise ValueError(str(error)) from None
    with at_work(pygame.error):
        if a.out is None:
            play(a, kept, tried)
        else:
            with sole_user(a.out):
                kept = play(a, kept, tried)
    if a.out is not None:
        print(f"{len(kept)} good episodes in {a.out}" if kept else "no good episode: nothing was written")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
