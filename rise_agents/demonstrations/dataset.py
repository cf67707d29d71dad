"""A set of demonstrations: what it holds, how it is stored, checked and loaded.

A set is a folder of two files: ``demonstrations.safetensors`` (flat arrays and episode offsets) and
``card.json`` (environment and its parameters, expert, seeds, versions, rejection rate, SHA-256 of the arrays).
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy as st
from numpy.typing import NDArray

import rise_envs
from rise_agents.checkpoint import replace_file
from rise_envs.task import env_class

SCHEMA = 1
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

    def within(self, transitions: int) -> Demonstrations:
        """The first whole episodes with at most ``transitions`` transitions, and at least one episode."""
        return self.first(max(1, int(np.searchsorted(self.offsets, transitions, side="right")) - 1))

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
        last = env.compute_terminated(
            d.final["achieved_goal"], d.final["desired_goal"], [{"cost": 0.0}] * episodes
        )
        if not np.all(last):
            raise DatasetError(f"episode {np.argmin(last)} does not end at its goal")
        if ((d.expert < 0) | (d.expert >= len(d.card.get("experts", range(1 << 30))))).any():
            raise DatasetError("expert holds a number that no expert on the card has")
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
