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
from rise_envs.task import env_class, task_of

_SEED, _EXPERT, _DIGEST = "rise_seed", "rise_expert", "rise_sha256"


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

    check_id(dataset_id)
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
            created = minari.create_dataset_from_buffers(
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
            created.storage.update_metadata({_DIGEST: d.digest()})  # HDF5 notices no flipped bit
    finally:
        env.close()


def load(dataset_id: str, env_id: str) -> Demonstrations:
    """Demonstrations of ``env_id`` from the local Minari dataset ``dataset_id``.

    The environment is the one named here, built from our registry: a stored environment specification is never
    used, since building it would run what it says.

    Raises:
        ValueError: an environment that describes no task.
        DatasetError: no such dataset, damaged since :func:`export`, or not safe episodes of that environment.
    """
    task_of(env_id)
    try:
        metadata, episodes = _read(dataset_id)
        demonstrations = from_arrays(env_id, _arrays(episodes), _card(dataset_id, episodes))
    except DatasetError as error:
        raise DatasetError(f"Minari dataset {dataset_id!r}: {error}") from None
    except Exception as error:  # of Minari, HDF5 or NumPy: whatever a file can hold
        raise DatasetError(f"Minari dataset {dataset_id!r} cannot be loaded: {error}") from None
    if metadata.get(_DIGEST, demonstrations.digest()) != demonstrations.digest():
        raise DatasetError(f"Minari dataset {dataset_id!r} is damaged: its SHA-256 does not match")
    return demonstrations


def _read(dataset_id: str) -> tuple[dict[str, Any], list[Any]]:
    """The metadata and the episodes of a local dataset, without building an environment."""
    import minari
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage.datasets_root_dir import get_dataset_path

    metadata = dict(MinariStorage.read_raw_metadata(get_dataset_path(dataset_id) / "data"))
    for name in ("observation_space", "action_space"):
        # Minari would build the stored environment to ask for its spaces, and with it run what a file names.
        if not isinstance(metadata.get(name), str):
            raise DatasetError(f"its metadata has no {name}")
    episodes = list(minari.load_dataset(dataset_id).iterate_episodes())
    if not episodes:
        raise DatasetError("it holds no episode")
    return metadata, episodes


def _arrays(episodes: list[Any]) -> dict[str, Any]:
    """Minari's episodes as the named arrays of :class:`Demonstrations`."""

    def info(name: str, default: int) -> Any:
        return np.array([int(e.infos[name][0]) if name in (e.infos or {}) else default for e in episodes])

    if any("clean_observation" in (e.infos or {}) for e in episodes):
        raise DatasetError("its readings are noisy: record inside of the noise wrapper, not around it")
    for key in OBSERVATIONS:
        if not all(isinstance(e.observations, dict) and key in e.observations for e in episodes):
            raise DatasetError(
                f"observations have no {key!r}: they must be dicts of {', '.join(OBSERVATIONS)}"
            )
    if any("cost" not in (e.infos or {}) for e in episodes):
        raise DatasetError("its infos have no 'cost': record what every step cost, that of the reset being 0")
    lengths = [len(e.actions) for e in episodes]
    arrays: dict[str, Any] = {
        "actions": np.concatenate([e.actions for e in episodes]).astype(np.float64),
        "rewards": np.concatenate([e.rewards for e in episodes]).astype(np.float64),
        "costs": np.concatenate([e.infos["cost"][1:] for e in episodes]).astype(np.float64),
        "offsets": np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
        "seeds": info(_SEED, -1).astype(np.int64),
        "expert": info(_EXPERT, 0).astype(np.int64),
    }
    for key in OBSERVATIONS:
        arrays[f"observations.{key}"] = np.concatenate([e.observations[key][:-1] for e in episodes])
        arrays[f"final.{key}"] = np.stack([e.observations[key][-1] for e in episodes])
    return arrays


def _card(dataset_id: str, episodes: list[Any]) -> dict[str, Any]:
    transitions = sum(len(e.actions) for e in episodes)
    return {"source": f"minari:{dataset_id}", "episodes": len(episodes), "transitions": transitions}
