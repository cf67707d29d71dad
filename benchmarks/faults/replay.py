"""The same seed and the same actions give the same episode, bit for bit, however it is run."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from rise_envs import ENVS
from rise_envs.panda_sim import silence

MODES = ("single", "sync", "async", "native")
HISTORIES = ("fresh", "used")
OTHERS = 50  # episodes that a used environment has seen
_OTHER_SEED = 1_000_000
_BATCH = 10
_SLOW = {"RISE-SafePanda-v0": 25}  # steps of an episode, where all of it would take too long
_OTHER_STEPS = 8

Digests = dict[int, str]


def steps_of(env_id: str) -> int:
    """How many steps of each episode are compared."""
    return _SLOW.get(env_id, ENVS[env_id][2])


def actions_of(space: Any, seed: int, steps: int) -> NDArray:
    """The actions of an episode (T, A), between the bounds."""
    draws = np.random.default_rng([seed, 17]).random((steps, *space.shape))
    return (space.low + draws * (space.high - space.low)).astype(space.dtype)


def add(digest: Any, *parts: Any) -> None:
    """Take what a step showed into a digest; floats as they are, to the last bit."""
    for part in parts:
        if isinstance(part, dict):
            add(digest, *(part[key] for key in sorted(part)))
        else:
            digest.update(np.ascontiguousarray(np.asarray(part, np.float64)).tobytes())


def alone(env: gym.Env, seeds: Iterable[int], steps: int) -> Digests:
    """Episodes of a single environment, one after the other."""
    found = {}
    for seed in seeds:
        digest = hashlib.sha256()
        observation, _ = env.reset(seed=seed)
        add(digest, observation)
        for action in actions_of(env.action_space, seed, steps):
            observation, reward, terminated, truncated, info = env.step(action)
            add(digest, observation, reward, info["cost"], terminated, truncated)
            if terminated or truncated:
                break
        found[seed] = digest.hexdigest()
    return found


def together(env: Any, seeds: list[int], steps: int) -> Digests:
    """An episode of each of a batch of environments, side by side, to the first end of each."""
    digests = [hashlib.sha256() for _ in seeds]
    actions = np.stack([actions_of(env.single_action_space, seed, steps) for seed in seeds], 1)
    observation, _ = env.reset(seed=seeds)
    going = np.ones(len(seeds), bool)
    for i, digest in enumerate(digests):
        add(digest, {key: value[i] for key, value in observation.items()})
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        for i in np.flatnonzero(going).tolist():
            shown = {key: value[i] for key, value in observation.items()}
            add(digests[i], shown, reward[i], info["cost"][i], terminated[i], truncated[i])
        going &= ~(terminated | truncated)
        if not going.any():
            break
    return {seed: digest.hexdigest() for seed, digest in zip(seeds, digests, strict=True)}


def digests(env_id: str, mode: str, history: str, seeds: list[int]) -> Digests:
    """A digest of the episode of every seed, in a process of its own.

    Args:
        env_id: a registered environment.
        mode: of :data:`MODES`.
        history: whether the environment saw other episodes before; the seeds then come in another order.
        seeds: any number.
    """
    steps = steps_of(env_id)
    others = [_OTHER_SEED + i for i in range(OTHERS)]
    order = seeds if history == "fresh" else seeds[::-1]
    with silence():  # Bullet's build lines
        if mode == "single":
            env = gym.make(env_id)
            if history == "used":
                alone(env, others, _OTHER_STEPS)
            found = alone(env, order, steps)
            env.close()
            return found
        batch = min(_BATCH, len(seeds))
        kind = "vector_entry_point" if mode == "native" else mode
        envs = gym.make_vec(env_id, batch, vectorization_mode=kind)
    if history == "used":
        for at in range(0, OTHERS, batch):
            together(envs, [_OTHER_SEED + at + i for i in range(batch)], _OTHER_STEPS)
    found = {}
    for at in range(0, len(order), batch):
        part = order[at : at + batch]
        full = [*part, *(_OTHER_SEED + i for i in range(batch - len(part)))]
        found |= {seed: text for seed, text in together(envs, full, steps).items() if seed in seeds}
    envs.close()
    return found


def ways(env_id: str) -> list[tuple[str, str]]:
    """All (mode, history) that an environment has."""
    native = ENVS[env_id][1] is not None
    return [(mode, history) for mode in MODES if native or mode != "native" for history in HISTORIES]


def compare(env_id: str, found: dict[tuple[str, str], Digests]) -> list[tuple[int, Fault]]:
    """Seeds whose episode differs from what most of the others found."""
    faults = []
    for seed in next(iter(found.values())):
        texts = {way: each.get(seed, "missing") for way, each in found.items()}
        usual = Counter(texts.values()).most_common(1)[0][0]
        for (mode, history), text in texts.items():
            if text != usual:
                faults.append((seed, Fault("different episode", f"{env_id}, seed {seed}, {mode}, {history}")))
    return faults


def run(effort: Effort, tell: Tell) -> Findings:
    """Every environment, seed and way to run it."""
    findings = Findings()
    numbers = list(effort.numbers(100, 2))
    seeds = [effort.seed + number for number in numbers]
    tasks = [(env_id, *way, seeds) for env_id in ENVS for way in ways(env_id)]
    found: dict[str, dict[tuple[str, str], Digests]] = {env_id: {} for env_id in ENVS}
    for done, ((env_id, mode, history, _), each) in enumerate(effort.each(digests, tasks, fresh=True)):
        found[env_id][mode, history] = each
        findings.trials += len(each)
        tell((done + 1) / len(tasks), {})
    for env_id, by_way in found.items():
        findings.faults += [(seed - effort.seed, fault) for seed, fault in compare(env_id, by_way)]
    return findings
