"""A set of demonstrations: what it holds, how it is stored, checked and loaded.

A set is a folder with ``demonstrations.rise``: flat arrays, episode offsets and the card (environment and its
parameters, expert, seeds, versions, rejection rate) under one SHA-256. ``card.json`` beside it repeats the card for
people and is never read.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rise_envs
from rise_agents import archive
from rise_agents.agent import config_to_dict
from rise_agents.files import replace_file
from rise_envs.task import env_class

KIND = "demonstrations"
DATA, CARD = "demonstrations.rise", "card.json"
NUMBERS = {
    **dict.fromkeys(("actions", "rewards", "costs"), np.float64),
    **dict.fromkeys(("offsets", "seeds", "expert"), np.int64),
}
# What a card may say, beside the environment.
KNOWN = (
    *("expert", "experts", "seed", "split", "params", "episodes", "transitions", "tried", "rejection_rate"),
    *("versions", "source", "note"),
)
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

    def within(self, transitions: int, block: int = 0) -> Demonstrations:
        """One of the disjoint blocks of whole episodes, in order, with at most ``transitions`` transitions each.

        Every block holds as many episodes as fit, and at least one. What is left at the end is too little for a
        block and unused, unless all episodes fit into the first.

        Args:
            transitions: at most so many, but for an episode that has more alone.
            block: number of the block; beyond the last one it begins again with the first.
        """
        starts = [0]
        while starts[-1] < len(self):
            most = self.offsets[starts[-1]] + transitions
            fit = int(np.searchsorted(self.offsets, most, side="right")) - 1
            starts.append(max(fit, starts[-1] + 1))
            if fit == len(self):  # the rest fits as a whole: it may be less than a block
                break
        blocks = max(1, len(starts) - 1 - (fit == len(self)))
        number = block % blocks
        return self.between(starts[number], starts[number + 1])

    def first(self, episodes: int) -> Demonstrations:
        """The first ``episodes`` episodes."""
        return self.between(0, episodes)

    def between(self, start: int, stop: int) -> Demonstrations:
        """The episodes from number ``start`` on, up to but not with number ``stop``."""
        stop = min(stop, len(self))
        rows, episodes = slice(self.offsets[start], self.offsets[stop]), slice(start, stop)
        offsets = self.offsets[start : stop + 1] - self.offsets[start]
        return Demonstrations(
            self.env_id,
            {key: value[rows] for key, value in self.observations.items()},
            self.actions[rows],
            self.rewards[rows],
            self.costs[rows],
            {key: value[episodes] for key, value in self.final.items()},
            offsets,
            self.seeds[episodes],
            self.expert[episodes],
            {**self.card, "episodes": stop - start, "transitions": int(offsets[-1])},
        )

    def arrays(self) -> dict[str, NDArray]:
        """Everything that is stored as numbers, by name."""
        parts = {f"observations.{key}": value for key, value in self.observations.items()}
        parts |= {f"final.{key}": value for key, value in self.final.items()}
        for name in NUMBERS:
            parts[name] = getattr(self, name)
        return parts

    def digest(self) -> str:
        """Stands for all numbers of the set: the same numbers, the same digest."""
        whole = hashlib.sha256(self.env_id.encode())
        for name, array in sorted(self.arrays().items()):
            whole.update(f"{name} {array.dtype} {array.shape}".encode())
            whole.update(np.ascontiguousarray(array).data)
        return whole.hexdigest()

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Store the set, whole or not at all."""
        card = {**self.card, "env": self.env_id}
        archive.write(Path(folder) / DATA, KIND, self.arrays(), card)
        text = json.dumps(card, indent=2, sort_keys=True) + "\n"
        replace_file(Path(folder) / CARD, text.encode())  # last: it is only a copy


def load(folder: str | os.PathLike[str]) -> Demonstrations:
    """A stored set, after checking digest, shapes, bounds and finiteness against the environment it names.

    Raises:
        DatasetError: anything about it is missing or wrong.
    """
    path = Path(folder) / DATA
    try:
        arrays, card = archive.read(path, KIND)
    except archive.ArchiveError as error:
        raise DatasetError(f"{path}: {error.reason}; record the demonstrations again") from None
    try:
        return from_arrays(card.pop("env", None), arrays, card)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None
    except Exception as error:  # a right digest says who wrote a file, not that it makes sense
        raise DatasetError(f"{path}: arrays or card lack an entry ({error})") from None


def from_arrays(env_id: str, arrays: dict[str, NDArray], card: dict[str, Any]) -> Demonstrations:
    """A checked set from named arrays, the inverse of :meth:`Demonstrations.arrays`."""
    names = {f"{group}.{key}" for group in ("observations", "final") for key in OBSERVATIONS} | set(NUMBERS)
    if set(arrays) != names:
        raise DatasetError(f"arrays are missing or unknown: {', '.join(sorted(set(arrays) ^ names))}")
    grouped: dict[str, Any] = {
        group: {key: arrays[f"{group}.{key}"] for key in OBSERVATIONS} for group in ("observations", "final")
    }
    rest: dict[str, Any] = {name: arrays[name] for name in NUMBERS}
    demonstrations = Demonstrations(env_id=env_id, **grouped, **rest, card=card)
    check(demonstrations)
    return demonstrations


def params_of(env_id: str) -> dict[str, Any]:
    """The constants of a registered environment, where it publishes them."""
    env = env_class(env_id)()
    env.close()
    params = getattr(env, "params", None)
    return config_to_dict(params) if is_dataclass(params) else {}


def check(d: Demonstrations) -> None:
    """Raise :class:`DatasetError` unless every array has the shape, bounds and meaning it claims."""
    # Looked up by name in our registry: what a file says of an environment is compared, never built.
    if not isinstance(d.env_id, str) or d.env_id not in rise_envs.ENVS:
        raise DatasetError(f"unknown environment {d.env_id!r}, known: {', '.join(rise_envs.ENVS)}")
    _check_episodes(d)
    _check_card(d)
    env = env_class(d.env_id)()
    try:
        for key in OBSERVATIONS:
            space = env.observation_space[key]
            _check_rows(f"observations.{key}", d.observations[key], len(d.actions), space)
            _check_rows(f"final.{key}", d.final[key], len(d), space)
        _check_rows("actions", d.actions, len(d.actions), env.action_space)
        last = env.compute_terminated(
            d.final["achieved_goal"], d.final["desired_goal"], [{"cost": 0.0}] * len(d)
        )
        if not np.all(last):
            raise DatasetError(f"episode {np.argmin(last)} does not end at its goal")
    finally:
        env.close()


def _check_card(d: Demonstrations) -> None:
    """That the card tells the truth where that can be known, and nothing that we would not understand."""
    for name in d.card:
        if name not in KNOWN:
            raise DatasetError(f"the card says {name!r}, which means nothing here; known: {', '.join(KNOWN)}")
    for name, true in (
        ("params", params_of(d.env_id)),
        ("episodes", len(d)),
        ("transitions", len(d.actions)),
    ):
        claimed = d.card.get(name, true)
        if type(claimed) is not type(true) or claimed != true:
            raise DatasetError(f"was recorded with {name} {claimed!r}, here there are {true!r}")


def _check_episodes(d: Demonstrations) -> None:
    """How transitions make up episodes, and what holds of each."""
    total, episodes = len(d.actions), len(d.seeds)
    for name, kind in NUMBERS.items():
        if getattr(d, name).dtype != kind:
            raise DatasetError(f"{name} are {getattr(d, name).dtype}, not {np.dtype(kind)}")
    if not episodes or d.offsets.shape != (episodes + 1,) or d.expert.shape != (episodes,):
        raise DatasetError("offsets, seeds and expert differ in their number of episodes, or there is none")
    if d.offsets[0] != 0 or d.offsets[-1] != total or (np.diff(d.offsets) < 1).any():
        raise DatasetError("offsets do not cut the transitions into episodes")
    if d.rewards.shape != (total,) or not np.isfinite(d.rewards).all():
        raise DatasetError("rewards are not one finite number for each transition")
    if d.costs.shape != (total,) or (d.costs != 0).any():
        raise DatasetError("costs are not zero throughout: an episode is not safe")
    if ((d.expert < 0) | (d.expert >= len(d.card.get("experts", range(1 << 30))))).any():
        raise DatasetError("expert holds a number that no expert on the card has")


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
