"""Recording demonstrations: an expert's safe and successful episodes, over any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rise_agents import archive
from rise_agents.agent import Progress, silent
from rise_agents.checkpoint import versions
from rise_agents.demonstrations.dataset import OBSERVATIONS, DatasetError, Demonstrations, check, params_of
from rise_agents.experts import make_expert
from rise_agents.pool import Pool, TaskError
from rise_agents.rollout import Transitions, policy_keys, rollout
from rise_agents.seeds import PER_RUN, episode_seeds
from rise_envs.settings import whole

CHUNK = 50  # candidate episodes per piece of work, at most
KIND = "candidates"


class Part(NamedTuple):
    """Candidate episodes that follow one another: E episodes, T transitions."""

    transitions: Transitions
    reached: NDArray[np.bool_]  # (E,)
    seeds: NDArray[np.int64]  # (E,)
    expert: NDArray[np.int64]  # (E,)


def _candidates(env_id: str, expert: str, seed: int, start: int, count: int) -> Part:
    """Roll out candidate episodes; returns them with what is needed to choose and describe them."""
    policy = make_expert(expert, env_id, seed=seed)
    seeds = episode_seeds("train", seed, start, count)
    episodes, transitions = rollout(policy, env_id, seeds, record=True)
    choose = getattr(policy, "choose", None)
    chosen = choose(policy_keys(seeds)) if choose else np.zeros(count, np.int64)
    assert transitions is not None  # noqa: S101  record=True
    return Part(transitions, episodes.reached, seeds, np.asarray(chosen, np.int64))


def chunk_size(episodes: int) -> int:
    """Candidates per piece of work where so many episodes are wanted."""
    return min(CHUNK, max(10, episodes))


def part_path(folder: Path, start: int) -> Path:
    """Where the candidates from number ``start`` on are stored."""
    return folder / f"{start:07d}.rise"


def record_part(
    output: Path, progress: Progress, env_id: str, expert: str, seed: int, start: int, count: int
) -> None:
    """Roll out ``count`` candidate episodes from number ``start`` on, and store them."""
    part = _candidates(env_id, expert, seed, start, count)
    arrays: dict[str, NDArray] = {"reached": part.reached, "seeds": part.seeds, "expert": part.expert}
    for name, value in vars(part.transitions).items():
        nested = value if isinstance(value, dict) else {"": value}
        arrays |= {f"transitions.{name}.{key}": array for key, array in nested.items()}
    archive.write(output, KIND, arrays, _facts(env_id, expert, seed, start, count))


def _facts(env_id: str, expert: str, seed: int, start: int, count: int) -> dict[str, Any]:
    """What a piece must agree with to be part of a recording."""
    return {
        **{"env": env_id, "expert": expert, "seed": seed, "start": start, "count": count},
        **{"params": params_of(env_id), "versions": versions()},
    }


def _read_part(path: Path, facts: dict[str, Any]) -> Part:
    try:
        arrays, found = archive.read(path, KIND)
        if found != facts:
            differing = [key for key in facts if found.get(key) != facts[key]]
            both = [{key: each.get(key) for key in differing} for each in (found, facts)]
            raise archive.ArchiveError(f"is of another recording, with {both[0]}, this one has {both[1]}")
        return _as_part(arrays)
    except archive.ArchiveError as error:
        raise DatasetError(f"{path}: {error.reason}; remove {path.parent} to record anew") from None
    except (LookupError, TypeError, ValueError) as error:  # a right digest does not make it whole
        raise DatasetError(f"{path}: lacks a part ({error}); remove it to record it again") from None


def _as_part(arrays: dict[str, NDArray]) -> Part:
    grouped: dict[str, Any] = {}
    for key, array in arrays.items():
        if key.startswith("transitions."):
            _, name, inner = key.split(".")
            if inner:
                grouped.setdefault(name, {})[inner] = array
            else:
                grouped[name] = array
    return Part(Transitions(**grouped), arrays["reached"], arrays["seeds"], arrays["expert"])


def generate(
    env_id: str,
    expert: str = "mixture",
    episodes: int = 1000,
    seed: int = 0,
    workers: int = 1,
    finished: Callable[[int, int], None] = lambda kept, tried: None,
    parts: Path | None = None,
) -> Demonstrations:
    """The first ``episodes`` safe and successful episodes of an expert, in the order of their seeds.

    Args:
        env_id: a registered environment.
        expert: a name of :data:`rise_agents.experts.EXPERTS`.
        episodes: how many: E.
        seed: which range of training seeds to use.
        workers: processes; the result is the same for any number.
        finished: told how many episodes were kept and tried so far.
        parts: a folder for pieces of the work. Those that lie there are not done again, so that a recording that was
            interrupted goes on where it was.

    Raises:
        ValueError: an unknown expert, or one that fails so often that the seeds run out; no number of episodes.
        DatasetError: a piece in ``parts`` is damaged or of another recording.
        TaskError: a worker process died.
    """
    whole("episodes", episodes, 1)
    make_expert(expert, env_id, seed=seed)  # an unknown name is told here, not in a worker
    done: list[Part] = []
    kept = tried = 0
    with nullcontext(parts) if parts else TemporaryDirectory() as folder:
        for part in _ordered(env_id, expert, episodes, seed, workers, Path(folder)):
            done.append(part)
            kept, tried = kept + int(part.reached.sum()), tried + len(part.reached)
            finished(min(kept, episodes), tried)
            if kept >= episodes:
                break
            if tried >= 20 * CHUNK and kept < 0.05 * tried:
                raise ValueError(
                    f"expert {expert!r} succeeds in {kept} of {tried} episodes of {env_id}: no use going on"
                )
    if kept < episodes:
        raise ValueError(
            f"expert {expert!r} has {kept} good episodes of {env_id} in all {tried:,} of seed {seed}"
        )
    try:
        demonstrations = _assemble(env_id, expert, episodes, seed, done)
        check(demonstrations)  # of pieces that were read from files
    except (LookupError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{parts}: a piece is not what it should be ({error}); remove the folder"
        ) from None
    return demonstrations


def _ordered(
    env_id: str, expert: str, episodes: int, seed: int, workers: int, folder: Path
) -> Iterator[Part]:
    """Parts in order; those that ``folder`` lacks are recorded by ``workers`` processes, a little ahead of need."""
    count = chunk_size(episodes)
    needed, begun = -(-episodes // count), 0
    alone = workers <= 1 or needed == 1
    with Pool(workers) as pool:  # starts nothing before it is given something
        for number in range(PER_RUN // count):
            path = part_path(folder, number * count)
            if alone and not path.exists():
                record_part(path, silent, env_id, expert, seed, number * count, count)
            while not path.exists():
                if not pool.busy:
                    begun = number  # also after somebody has taken a piece away
                while pool.free and begun < max(needed, number + 1):
                    start = begun * count
                    if not part_path(folder, start).exists():
                        pool.start(
                            begun, _record, part_path(folder, start), env_id, expert, seed, start, count
                        )
                    begun += 1
                for ended in pool.wait():
                    if ended.error or ended.died:
                        memory = " (out of memory? fewer workers need less)" * (ended.died == "SIGKILL")
                        reason = ended.error or f"its worker process ended with {ended.died}{memory}"
                        raise TaskError(f"recording from episode {ended.key * count} on: {reason}")
            yield _read_part(path, _facts(env_id, expert, seed, number * count, count))


def _record(tell: Progress, output: Path, *arguments: Any) -> None:
    record_part(output, tell, *arguments)


def _assemble(env_id: str, expert: str, episodes: int, seed: int, parts: list[Part]) -> Demonstrations:
    """The first ``episodes`` good episodes of ordered chunks."""
    good = np.concatenate([part.reached for part in parts])
    needed = np.flatnonzero(good)[:episodes]
    tried = int(needed[-1]) + 1
    lengths = np.concatenate([np.diff(part.transitions.offsets) for part in parts])
    keep = np.zeros(len(good), bool)
    keep[needed] = True
    rows = np.repeat(keep, lengths)
    chunks = [part.transitions for part in parts]

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
        "params": params_of(env_id),
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
        np.concatenate([part.seeds for part in parts])[keep],
        np.concatenate([part.expert for part in parts])[keep],
        card,
    )
