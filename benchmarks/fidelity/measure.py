"""The same actions and the same agents in Bullet and in the model of it.

Shapes: T steps, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents import demonstrations, make_agent
from rise_agents.experts import make_expert
from rise_agents.rollout import Episodes, Transitions, rollout
from rise_agents.seeds import episode_seeds
from rise_envs import panda_starts, panda_world, streams
from rise_envs.panda_scene import DEFAULTS
from rise_envs.safe_panda import SafePandaEnv

BULLET, MODEL = "RISE-SafePanda-v0", "RISE-SafePandaKinematic-v0"
STEPS = 50
_LOW = 0.2  # m; below this the hand is pushed up where it shall not meet the table
_NEAR = 0.1  # m; clearances beyond this matter to nobody

Array = NDArray[np.float64]
Tell = Callable[[float], None]
Chooser = Callable[[dict[str, Array], int], Array]


@dataclass(frozen=True)
class Paths:
    """The same actions in both, step by step; NaN after the end of an episode.

    Attributes:
        hand: distance between the two hands after each step (m), (T, E).
        clearance: the model's clearance less Bullet's, where Bullet's is within 0.1 m (m), (T, E).
        table: whether Bullet's hand was on the table, (T, E).
    """

    hand: Array
    clearance: Array
    table: NDArray[np.bool_]


@contextmanager
def _bullet() -> Iterator[SafePandaEnv]:
    env = SafePandaEnv()
    try:
        yield env
    finally:
        env.close()


def _follow(seeds: list[int], choose: Chooser, until_done: bool, tell: Tell) -> Paths:
    """Bullet under chosen actions, and the model under the same ones."""
    shape = (STEPS, len(seeds))
    actions, hands, clearances = np.zeros((*shape, 3)), np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    with _bullet() as env:
        for e, seed in enumerate(seeds):
            observation, _ = env.reset(seed=seed)
            for t in range(STEPS):
                actions[t, e] = action = choose(observation, t).astype(np.float32)
                observation, _, terminated, _, info = env.step(action)
                hands[t, e], clearances[t, e] = observation["achieved_goal"], info["clearance"]
                if terminated and until_done:
                    break
            tell((e + 1) / len(seeds))
    constants = panda_starts.constants(DEFAULTS)
    keys = streams.episode_keys(streams.seed_bases(seeds), np.zeros(len(seeds), np.int64))
    world = panda_world.begin(keys, constants)
    off, error = np.full(shape, np.nan), np.full(shape, np.nan)
    for t in range(STEPS):
        world = panda_world.advance(world, actions[t], constants)
        off[t] = np.linalg.norm(world.arms.hand - hands[t], axis=1)
        error[t] = np.where(clearances[t] < _NEAR, world.clearance - clearances[t], np.nan)
    return Paths(off, error, hands[..., 2] < 0.01)


def random_paths(count: int, table: bool, tell: Tell) -> Paths:
    """Uniformly random actions for 50 steps; unless ``table``, the hand is pushed up where it is low."""
    rng = np.random.default_rng(0)

    def choose(observation: dict[str, Array], t: int) -> Array:
        action = rng.uniform(-1, 1, 3)
        if not table and observation["achieved_goal"][2] < _LOW:
            action[2] += 1.5
        return np.clip(action, -1, 1)

    return _follow(_seeds(count), choose, False, tell)


def expert_paths(name: str, count: int, tell: Tell) -> Paths:
    """The actions of an expert that sees Bullet's arm."""
    expert = make_expert(name, BULLET)
    memory: list[Any] = [None]

    def choose(observation: dict[str, Array], t: int) -> Array:
        batch = {key: value[None] for key, value in observation.items()}
        action, memory[0] = expert.predict(batch, memory[0], np.array([t == 0]), True)
        return action[0]

    return _follow(_seeds(count), choose, True, tell)


def _seeds(count: int) -> list[int]:
    return [int(seed) for seed in episode_seeds("test", 0, 0, count)]


@dataclass(frozen=True)
class Loops:
    """The same agent in the same scenarios of both, each with its own arm in the loop.

    Attributes:
        bullet: what happened in Bullet.
        model: what happened in the model.
        hand: distance between the two hands while both episodes last (m), (T, E), NaN afterwards.
    """

    bullet: Episodes
    model: Episodes
    hand: Array


def closed_loop(policy: Any, level: float, count: int, tell: Tell) -> Loops:
    """Run ``policy`` through test scenarios in both, at a level of the reading noise."""
    done, seeds = 0, _seeds(count)

    def finished(number: int) -> None:
        nonlocal done
        done += number
        tell(min(1.0, 0.5 * done / count))

    runs, hands = [], []
    for env_id in (BULLET, MODEL):
        deterministic = getattr(policy, "evaluate_deterministic", True)
        episodes, transitions = rollout(
            policy,
            env_id,
            seeds,
            noise_level=level,
            record=True,
            deterministic=deterministic,
            finished=finished,
        )
        assert transitions is not None  # noqa: S101  they were asked for
        runs.append(episodes)
        hands.append(_hands(transitions))
    return Loops(runs[0], runs[1], np.linalg.norm(hands[0] - hands[1], axis=-1))


def _hands(transitions: Transitions) -> Array:
    """Hands after each step, (T, E, 3), NaN after the end."""
    offsets, count = transitions.offsets, len(transitions.offsets) - 1
    hands = np.full((STEPS, count, 3), np.nan)
    where = transitions.observations["achieved_goal"]
    for e in range(count):
        length = offsets[e + 1] - offsets[e]
        hands[: length - 1, e] = where[offsets[e] + 1 : offsets[e + 1]]
        hands[length - 1, e] = transitions.final["achieved_goal"][e]
    return hands


def trained(name: str, demos: int, updates: int, tell: Tell) -> Any:
    """A quickly trained agent: it has to be the same in both, not good."""

    def recorded(kept: int, tried: int) -> None:
        tell(0.5 * kept / demos)

    data = demonstrations.generate(BULLET, "cbf", demos, finished=recorded)
    config = {"updates": updates} | ({"vae_updates": updates} if name == "rise" else {})
    agent = make_agent(name, BULLET, config)
    agent.learn(data, lambda share, _: tell(0.5 + 0.5 * share))
    return agent
