"""A stored agent acts, in another process, as it did when it was stored."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from benchmarks.faults.training import BENCHMARKED, recorded, train
from rise_agents import AGENTS, load_agent
from rise_agents.agent import initial_state

OBSERVATIONS = 1_000
WAYS = (True, False)  # deterministic


def observations(env: str, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Some of an expert's observations with noise on the readings, in any order."""
    seen = recorded(env).observations
    rows = rng.integers(0, len(seen["obstacle"]), count)
    batch = {key: value[rows] for key, value in seen.items()}
    batch["obstacle"] = batch["obstacle"] + 0.1 * rng.normal(size=batch["obstacle"].shape)
    return batch


def actions(agent: Any, batch: dict[str, np.ndarray]) -> list[str]:
    """A digest of each action, with and without draws, and of the states that come back."""
    keys = np.arange(len(batch["obstacle"]), dtype=np.uint64)
    texts = []
    for deterministic in WAYS:
        state = initial_state(agent, keys)
        for _ in range(2):  # the state is handed on
            action, state = agent.predict(batch, state=state, deterministic=deterministic)
            rows = [np.asarray(part) for part in (action, *(state or ()))]
            texts += [
                hashlib.sha256(b"".join(p[i].tobytes() for p in rows)).hexdigest() for i in range(len(keys))
            ]
    return texts


def stored(name: str, env: str, path: Path, count: int, effort: Effort) -> list[str]:
    """Train an agent, store it, act."""
    agent = train(name, env)
    agent.save(path)
    return actions(agent, observations(env, count, effort.rng(0)))


def loaded(env: str, path: Path, count: int, effort: Effort) -> list[str]:
    """Load the agent, act."""
    return actions(load_agent(path), observations(env, count, effort.rng(0)))


def run(effort: Effort, tell: Tell) -> Findings:
    """Every agent in every benchmarked environment; a trial is an action of a loaded agent."""
    findings = Findings()
    pairs = [(name, env) for env in BENCHMARKED for name in AGENTS]
    pairs = pairs if effort.only is None else [pairs[effort.only]]
    count = effort.count(OBSERVATIONS, 10)
    with effort.scratch("agents") as place:
        paths = [place / f"{name}-{env}.rise" for name, env in pairs]
        first = [(*pair, path, count, effort) for pair, path in zip(pairs, paths, strict=True)]
        before = [texts for _, texts in effort.each(stored, first, fresh=True)]
        tell(0.7, {})
        second = [(env, path, count, effort) for (_, env), path in zip(pairs, paths, strict=True)]
        after = [texts for _, texts in effort.each(loaded, second, fresh=True)]
        for number, (pair, old, new) in enumerate(zip(pairs, before, after, strict=True)):
            wrong = sum(a != b for a, b in zip(old, new, strict=True))
            faults = [Fault("other actions", f"{' on '.join(pair)}: {wrong} of {len(old)}")] if wrong else []
            findings.add(number if effort.only is None else effort.only, faults, len(old))
            if faults:
                effort.keep(paths[number], paths[number].name)
    return findings
