"""An agent of your own: it does what experts did in the situations that look most alike.

Locally weighted regression on the k nearest demonstrations, after Pari et al., "The Surprising Effectiveness of
Representation Learning for Visual Imitation", RSS 2022, with the frames of this package in place of learned features.

    python -m benchmarks.run --import docs/examples/neighbours.py --agents neighbours pcbc
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rise_agents import checkpoint, cloning, readings, register_agent
from rise_agents.agent import config_to_dict, make_config, require, silent
from rise_agents.readings import checked_batch
from rise_agents.search import EVERYWHERE, Choice, Space


@dataclass(frozen=True)
class Config:
    """Settings; all are checked when they are made.

    Attributes:
        frame: how observations are seen.
        neighbours: k.
        memory: transitions that are kept, at most.
        transitions: of the demonstrations, see :class:`rise_agents.cloning.CloningConfig`.
    """

    frame: str = "features"
    neighbours: int = 8
    memory: int = 20_000
    transitions: int = 0

    def __post_init__(self) -> None:
        require(self.frame in readings.FRAMES, f"frame must be one of {readings.FRAMES}", self.frame)
        for name in ("neighbours", "memory"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1", getattr(self, name))
        require(self.transitions >= 0, "transitions must not be negative", self.transitions)


class Neighbours:
    """Imitation without a network: learning is remembering."""

    name = "neighbours"
    Config = Config
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {}  # by environment: what serves better there
    BRIEF: ClassVar[dict[str, Any]] = {"memory": 500}  # trains in a second: for tests
    SEARCH: ClassVar[dict[str, Space]] = {
        EVERYWHERE: {"neighbours": Choice((4, 8, 16, 32))}
    }  # for benchmarks.tune
    ACTING = frozenset({"neighbours"})  # settings that change nothing of what is learned
    learns_from = "demonstrations"
    evaluate_deterministic = True

    def __init__(self, env_id: str, config: dict[str, Any], seed: int = 0, device: str = "cpu") -> None:
        self.env_id, self.seed, self.device = env_id, seed, device
        self.config = make_config(type(self), env_id, config)
        self.task, self.units = cloning.make_task(env_id), cloning.ActionUnits.of(env_id)
        self._arrays: dict[str, Any] = {}

    def _seen(self, rows: dict[str, Any]) -> Any:
        """Robot and reading inputs (B, R + C) in the agent's frame."""
        return np.concatenate(readings.inputs(self.task, self.config.frame, rows), -1)

    def learn(self, source: Any, progress: Any = silent, resume: Any = None) -> Neighbours:
        """Remember demonstrations; ``progress`` is told the share done and figures of the moment."""
        demonstrations = cloning.check_source(source, self)  # refuses those of another environment
        step = -(-len(demonstrations.actions) // self.config.memory)
        seen = self._seen(demonstrations.observations)[::step]
        units = readings.Standardiser.fit(seen)
        actions = demonstrations.actions[::step].astype(np.float32)
        self._arrays = {"seen": units(seen), "actions": actions, **units.arrays("units")}
        progress(1.0, {"remembered": len(actions)})
        return self

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """Actions (B, A), or (A,): the mean of the neighbours' actions, nearer ones counting more."""
        if not self._arrays:
            raise cloning.untrained(self.name)
        rows, single = checked_batch(self.task, observation)
        units = readings.Standardiser.from_arrays(self._arrays, "units")
        actions = self.units.clip(np.stack([self._action(row) for row in units(self._seen(rows))]))
        return (actions[0] if single else actions), None

    def _action(self, seen: Any) -> Any:
        gaps = np.linalg.norm(self._arrays["seen"] - seen, axis=-1)
        near = np.argsort(gaps, kind="stable")[: self.config.neighbours]
        weights = np.exp(gaps[near[0]] - gaps[near])
        return (weights[:, None] * self._arrays["actions"][near]).sum(0) / weights.sum()

    def save(self, path: Any) -> None:
        """Store the agent, in a file that can run no code."""
        if not self._arrays:
            raise cloning.untrained(self.name)
        known = {"agent": self.name, "env": self.env_id, "seed": self.seed}
        checkpoint.save(path, self._arrays, {**known, "config": config_to_dict(self.config)})

    @classmethod
    def from_checkpoint(cls, arrays: dict[str, Any], description: dict[str, Any], device: str) -> Neighbours:
        """The agent that :meth:`save` stored; a file can hold anything, so its arrays are checked."""
        agent = cls(description["env"], description["config"], description["seed"], device)
        inputs, rows = sum(cloning.input_widths(agent)), len(arrays["actions"])
        shapes = {"seen": (rows, inputs), "actions": (rows, agent.units.size)}
        checkpoint.expect(arrays, {**shapes, "units.mean": (inputs,), "units.scale": (inputs,)})
        agent._arrays = arrays
        return agent


register_agent("neighbours", Neighbours)
