"""Demonstrations: an expert's safe and successful episodes, generated, checked, stored and loaded.

``python -m rise_agents.demonstrations --env RISE-GroundVehicle-v0 --expert mixture --episodes 10000 --out DIR``

A set is a folder of two files: ``demonstrations.safetensors`` (flat arrays and episode offsets) and
``card.json`` (environment and its parameters, expert, seeds, versions, rejection rate, SHA-256 of the arrays).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy as st
from numpy.typing import NDArray

import rise_envs
from rise_agents.checkpoint import replace_file, versions
from rise_agents.experts import make_expert
from rise_agents.rollout import Transitions, policy_keys, rollout
from rise_agents.seeds import PER_RUN, episode_seeds
from rise_agents.workers import make_pool
from rise_envs.task import env_class

SCHEMA = 1
CHUNK = 50  # candidate episodes per job, at most
ARRAYS, CARD = "demonstrations.safetensors", "card.json"
OBSERVATIONS = ("observation", "achieved_goal", "desired_goal", "obstacle")


class DatasetError(ValueError):
    """A demonstration set that cannot be used: names the path and the reason."""


@dataclass(frozen=True)
class Demonstrations:
    """T transitions of E episodes; rows ``offsets[i]:offsets[i + 1]`` belong to episode i.

    Attributes:
        env_id: the environment they were recorded in.
        observations: per key, (T, K), true readings.
        actions: (T, A), as the environment takes them.
        rewards: (T,).
        costs: (T,), zero throughout, since only safe episodes are kept.
        final: per key, (E, K): the observation in which each episode ended.
        offsets: (E + 1,).
        seeds: (E,), the environment seed of each episode.
        expert: (E,), index into ``card["experts"]``.
        card: everything else that is known of the set.
    """

    env_id: str
    observations: dict[str, NDArray[np.float64]]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64]
    costs: NDArray[np.float64]
    final: dict[str, NDArray[np.float64]]
    offsets: NDArray[np.int64]
    seeds: NDArray[np.int64]
    expert: NDArray[np.int64]
    card: dict[str, Any]

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.seeds)

    def subsample(self, rows: int) -> dict[str, NDArray[np.float64]]:
        """At most ``rows`` observations, evenly spread over all transitions."""
        step = max(1, -(-len(self.actions) // rows))
        return {key: value[::step] for key, value in self.observations.items()}

    def first(self, episodes: int) -> Demonstrations:
        """The first ``episodes`` episodes."""
        episodes = min(episodes, len(self))
        end = self.offsets[episodes]
        return Demonstrations(
            self.env_id,
            {key: value[:end] for key, value in self.observations.items()},
            self.actions[:end],
            self.rewards[:end],
            self.costs[:end],
            {key: value[:episodes] for key, value in self.final.items()},
            self.offsets[: episodes + 1],
            self.seeds[:episodes],
            self.expert[:episodes],
            {**self.card, "episodes": episodes, "transitions": int(end)},
        )

    def arrays(self) -> dict[str, NDArray]:
        """Everything that is stored as numbers, by name."""
        parts = {f"observations.{key}": value for key, value in self.observations.items()}
        parts |= {f"final.{key}": value for key, value in self.final.items()}
        for name in ("actions", "rewards", "costs", "offsets", "seeds", "expert"):
            parts[name] = getattr(self, name)
        return parts

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Store the set; the card is written last, so a folder with a card is complete."""
        body = st.save({name: np.ascontiguousarray(array) for name, array in self.arrays().items()})
        card = {**self.card, "schema": SCHEMA, "env": self.env_id, "sha256": hashlib.sha256(body).hexdigest()}
        replace_file(Path(folder) / ARRAYS, body)
        replace_file(Path(folder) / CARD, (json.dumps(card, indent=2, sort_keys=True) + "\n").encode())


def load(folder: str | os.PathLike[str]) -> Demonstrations:
    """A stored set, after checking digest, shapes, bounds and finiteness against the environment it names.

    Raises:
        DatasetError: anything about it is missing or wrong.
    """
    folder = Path(folder)
    try:
        card = json.loads((folder / CARD).read_text())
        body = (folder / ARRAYS).read_bytes()
    except OSError as error:
        raise DatasetError(f"{folder}: no demonstration set ({error.strerror}: {error.filename})") from None
    except ValueError as error:
        raise DatasetError(f"{folder / CARD}: not readable as JSON ({error})") from None
    if not isinstance(card, dict) or card.get("schema") != SCHEMA:
        raise DatasetError(f"{folder / CARD}: not a card of schema {SCHEMA}")
    if hashlib.sha256(body).hexdigest() != card.get("sha256"):
        raise DatasetError(f"{folder / ARRAYS}: damaged, its SHA-256 is not the card's")
    try:
        arrays = st.load(body)
        demonstrations = from_arrays(str(card["env"]), arrays, card)
    except DatasetError as error:
        raise DatasetError(f"{folder}: {error}") from None
    except Exception as error:
        raise DatasetError(f"{folder}: arrays or card lack an entry ({error})") from None
    return demonstrations


def from_arrays(env_id: str, arrays: dict[str, NDArray], card: dict[str, Any]) -> Demonstrations:
    """A checked set from named arrays, the inverse of :meth:`Demonstrations.arrays`."""
    grouped: dict[str, Any] = {
        group: {key: arrays[f"{group}.{key}"] for key in OBSERVATIONS} for group in ("observations", "final")
    }
    rest: dict[str, Any] = {
        name: arrays[name] for name in ("actions", "rewards", "costs", "offsets", "seeds", "expert")
    }
    demonstrations = Demonstrations(env_id=env_id, **grouped, **rest, card=card)
    check(demonstrations)
    return demonstrations


def check(d: Demonstrations) -> None:
    """Raise :class:`DatasetError` unless every array has the shape, bounds and meaning it claims."""
    if d.env_id not in rise_envs.ENVS:
        raise DatasetError(f"unknown environment {d.env_id!r}, known: {', '.join(rise_envs.ENVS)}")
    env = env_class(d.env_id)(**d.card.get("env_kwargs", {}))
    total, episodes = len(d.actions), len(d.seeds)
    try:
        if d.offsets[0] != 0 or d.offsets[-1] != total or (np.diff(d.offsets) < 1).any():
            raise DatasetError("offsets do not cut the transitions into episodes")
        if len(d.offsets) != episodes + 1 or len(d.expert) != episodes:
            raise DatasetError("offsets, seeds and expert differ in their number of episodes")
        for key in OBSERVATIONS:
            space = env.observation_space[key]
            _check_rows(f"observations.{key}", d.observations[key], total, space)
            _check_rows(f"final.{key}", d.final[key], episodes, space)
        _check_rows("actions", d.actions, total, env.action_space)
        if d.rewards.shape != (total,) or not np.isfinite(d.rewards).all():
            raise DatasetError("rewards are not one finite number for each transition")
        if d.costs.shape != (total,) or (d.costs != 0).any():
            raise DatasetError("costs are not zero throughout: an episode is not safe")
    finally:
        env.close()


def _check_rows(name: str, array: NDArray, rows: int, space: Any) -> None:
    if array.shape != (rows, *space.shape) or array.dtype != np.float64:
        raise DatasetError(f"{name} is {array.dtype} {array.shape}, not float64 {(rows, *space.shape)}")
    if not np.isfinite(array).all():
        raise DatasetError(
            f"{name} holds a number that is not finite in row {np.argwhere(~np.isfinite(array))[0][0]}"
        )
    margin = 1e-6 * (1 + np.abs(space.high))  # actions are float32 in the environment
    outside = (array < space.low - margin) | (array > space.high + margin)
    if outside.any():
        raise DatasetError(f"{name} leaves the bounds of the environment in row {np.argwhere(outside)[0][0]}")


def _candidates(
    env_id: str, expert: str, seed: int, start: int, count: int
) -> tuple[Transitions, Any, Any, Any]:
    """Roll out candidate episodes; returns them with what is needed to choose and describe them."""
    policy = make_expert(expert, env_id, seed=seed)
    seeds = episode_seeds("train", seed, start, count)
    episodes, transitions = rollout(policy, env_id, seeds, record=True)
    choose = getattr(policy, "choose", None)
    chosen = choose(policy_keys(seeds)) if choose else np.zeros(count, np.int64)
    assert transitions is not None  # noqa: S101  record=True
    return transitions, episodes.reached, seeds, np.asarray(chosen, np.int64)


def generate(
    env_id: str,
    expert: str = "mixture",
    episodes: int = 1000,
    seed: int = 0,
    workers: int = 1,
    finished: Callable[[int, int], None] = lambda kept, tried: None,
) -> Demonstrations:
    """The first ``episodes`` safe and successful episodes of an expert, in the order of their seeds.

    Args:
        env_id: a registered environment.
        expert: a name of :data:`rise_agents.experts.EXPERTS`.
        episodes: E.
        seed: which range of training seeds to use.
        workers: processes; the result is the same for any number.
        finished: told how many episodes were kept and tried so far.

    Raises:
        ValueError: an unknown expert, or one that fails so often that the seeds run out.
    """
    make_expert(expert, env_id, seed=seed)  # an unknown name is told here, not in a worker
    parts: list[tuple[Transitions, Any, Any, Any]] = []
    kept = tried = 0
    for part in _ordered(env_id, expert, episodes, seed, workers):
        parts.append(part)
        kept, tried = kept + int(part[1].sum()), tried + len(part[1])
        finished(min(kept, episodes), tried)
        if kept >= episodes:
            break
        if tried >= 20 * CHUNK and kept < 0.05 * tried:
            raise ValueError(
                f"expert {expert!r} succeeds in {kept} of {tried} episodes of {env_id}: no use going on"
            )
    return _assemble(env_id, expert, episodes, seed, parts)


def _ordered(env_id: str, expert: str, episodes: int, seed: int, workers: int) -> Any:
    """Chunks of candidates in order, computed by ``workers`` processes a little ahead of need."""
    chunk = min(CHUNK, max(10, episodes))
    if workers <= 1 or episodes <= chunk:
        for start in range(0, PER_RUN, chunk):
            yield _candidates(env_id, expert, seed, start, chunk)
        return
    with make_pool(workers) as pool:
        try:
            queue: list[Any] = [
                pool.submit(_candidates, env_id, expert, seed, i * chunk, chunk)
                for i in range(max(workers, -(-episodes // chunk)))
            ]
            for number in range(PER_RUN // chunk):
                if number >= len(queue):
                    queue.append(pool.submit(_candidates, env_id, expert, seed, number * chunk, chunk))
                yield queue[number].result()
                queue[number] = None  # frees the arrays
        finally:
            pool.shutdown(cancel_futures=True)


def _assemble(env_id: str, expert: str, episodes: int, seed: int, parts: list) -> Demonstrations:
    """The first ``episodes`` good episodes of ordered chunks."""
    good = np.concatenate([reached for _, reached, _, _ in parts])
    needed = np.flatnonzero(good)[:episodes]
    tried = int(needed[-1]) + 1
    lengths = np.concatenate([np.diff(t.offsets) for t, _, _, _ in parts])
    keep = np.zeros(len(good), bool)
    keep[needed] = True
    rows = np.repeat(keep, lengths)
    chunks = [t for t, _, _, _ in parts]

    def flat(name: str) -> NDArray:
        return np.concatenate([getattr(t, name) for t in chunks])[rows]

    observations = {k: np.concatenate([t.observations[k] for t in chunks])[rows] for k in OBSERVATIONS}
    final = {k: np.concatenate([t.final[k] for t in chunks])[keep] for k in OBSERVATIONS}
    policy = make_expert(expert, env_id, seed=seed)
    card = {
        "expert": expert,
        "experts": list(getattr(policy, "names", (expert,))),
        "seed": seed,
        "split": "train",
        "env_kwargs": {},
        "episodes": len(needed),
        "transitions": int(rows.sum()),
        "tried": tried,
        "rejection_rate": 1 - len(needed) / tried,
        "versions": versions(),
    }
    return Demonstrations(
        env_id,
        observations,
        flat("actions"),
        flat("rewards"),
        flat("costs"),
        final,
        np.concatenate(([0], np.cumsum(lengths[keep]))).astype(np.int64),
        np.concatenate([s for _, _, s, _ in parts])[keep],
        np.concatenate([e for _, _, _, e in parts])[keep],
        card,
    )


if __name__ == "__main__":
    from rise_agents.demonstrate import main

    raise SystemExit(main())
