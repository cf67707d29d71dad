"""Recording demonstrations: an expert's safe and successful episodes, over any number of processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import config_to_dict
from rise_agents.checkpoint import versions
from rise_agents.demonstrations.dataset import OBSERVATIONS, Demonstrations
from rise_agents.experts import make_expert
from rise_agents.rollout import Transitions, policy_keys, rollout
from rise_agents.seeds import PER_RUN, episode_seeds
from rise_agents.workers import make_pool, stop
from rise_envs.task import env_class

CHUNK = 50  # candidate episodes per job, at most


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
        finally:  # enough episodes, or interrupted: what is still running is not needed
            stop(pool)


def _params(env_id: str) -> dict[str, Any]:
    """The constants of the environment, where it publishes them."""
    env = env_class(env_id)()
    env.close()
    params = getattr(env, "params", None)
    return config_to_dict(params) if is_dataclass(params) else {}


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
        "params": _params(env_id),
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
