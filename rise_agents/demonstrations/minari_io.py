"""Demonstrations to and from Minari, the offline datasets of the Farama foundation (HDF5 in its local store)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from gymnasium import spaces

from rise_agents.demonstrations.dataset import (
    OBSERVATIONS,
    DatasetError,
    Demonstrations,
    from_arrays,
)
from rise_envs.task import env_class

_SEED, _EXPERT = "rise_seed", "rise_expert"


def check_id(dataset_id: str) -> None:
    """Raise ``ValueError`` if a dataset of this id cannot be created: malformed, or there already."""
    from minari import list_local_datasets
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(dataset_id)
    except (TypeError, ValueError):  # TypeError: its pattern lets an id without a version pass
        raise ValueError(f"malformed Minari id {dataset_id!r}: it must look like rise/vehicle-v0") from None
    if dataset_id in list_local_datasets():
        raise ValueError(f"the local Minari store holds {dataset_id!r} already: choose another version")


def export(d: Demonstrations, dataset_id: str) -> None:
    """Store demonstrations as the Minari dataset ``dataset_id`` (``namespace/name-v0``).

    Every step's infos carry ``cost``, the episode's environment seed and the index of its expert.

    Raises:
        ValueError: an id that Minari does not accept, or that exists already.
    """
    import minari
    from minari.data_collector import EpisodeBuffer

    env = env_class(d.env_id)()
    action_space = spaces.Box(
        env.action_space.low.astype(np.float64), env.action_space.high.astype(np.float64), dtype=np.float64
    )
    buffers = []
    for i in range(len(d)):
        rows = slice(int(d.offsets[i]), int(d.offsets[i + 1]))
        steps = rows.stop - rows.start
        ends = np.arange(steps) == steps - 1
        observations = {
            key: np.concatenate((d.observations[key][rows], d.final[key][i][None])) for key in OBSERVATIONS
        }
        infos = {
            "cost": np.concatenate(([0.0], d.costs[rows])),
            _SEED: np.full(steps + 1, d.seeds[i]),
            _EXPERT: np.full(steps + 1, d.expert[i]),
        }
        buffers.append(
            EpisodeBuffer(
                id=i,
                observations=observations,
                actions=d.actions[rows],
                rewards=list(d.rewards[rows]),
                terminations=list(ends),
                truncations=[False] * steps,
                infos=infos,
            )
        )
    try:
        with warnings.catch_warnings():
            # Minari asks for authors and links, which a local export has none of.
            warnings.simplefilter("ignore", UserWarning)
            minari.create_dataset_from_buffers(
                dataset_id,
                buffer=buffers,
                env=d.env_id,
                eval_env=d.env_id,
                observation_space=env.observation_space,
                action_space=action_space,
                algorithm_name=str(d.card.get("expert", "unknown")),
                description=f"Safe and successful expert episodes of {d.env_id}",
                data_format="hdf5",
            )
    finally:
        env.close()


def load(dataset_id: str, env_id: str) -> Demonstrations:
    """Demonstrations of ``env_id`` from the local Minari dataset ``dataset_id``.

    The environment is the one named here, built from our registry: a stored environment specification is never
    used, since building it would run what it says.

    Raises:
        DatasetError: no such dataset, or its contents are not safe episodes of that environment.
    """
    import minari

    try:
        dataset = minari.load_dataset(dataset_id)
    except (FileNotFoundError, ValueError, KeyError) as error:
        raise DatasetError(f"Minari dataset {dataset_id!r} cannot be loaded: {error}") from None
    episodes = list(dataset.iterate_episodes())
    if not episodes:
        raise DatasetError(f"Minari dataset {dataset_id!r} holds no episode")

    def info(name: str, default: int) -> Any:
        return np.array([int(e.infos[name][0]) if name in (e.infos or {}) else default for e in episodes])

    lengths = [len(e.actions) for e in episodes]
    arrays: dict[str, Any] = {
        "actions": np.concatenate([e.actions for e in episodes]).astype(np.float64),
        "rewards": np.concatenate([e.rewards for e in episodes]).astype(np.float64),
        "costs": np.concatenate(
            [
                e.infos["cost"][1:] if "cost" in (e.infos or {}) else np.full(len(e.actions), np.nan)
                for e in episodes
            ]
        ).astype(np.float64),
        "offsets": np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
        "seeds": info(_SEED, -1).astype(np.int64),
        "expert": info(_EXPERT, 0).astype(np.int64),
    }
    for key in OBSERVATIONS:
        arrays[f"observations.{key}"] = np.concatenate([e.observations[key][:-1] for e in episodes])
        arrays[f"final.{key}"] = np.stack([e.observations[key][-1] for e in episodes])
    card = {
        "source": f"minari:{dataset_id}",
        "episodes": len(episodes),
        "transitions": sum(lengths),
    }
    return from_arrays(env_id, arrays, card)
