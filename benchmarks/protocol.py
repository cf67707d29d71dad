"""What is measured: scenarios, presets, and the plan of one run.

A scenario is one start of one episode: environment, environment seed and noise seed. Every agent meets the
same scenarios with the same noise draws, so results pair up; test seeds lie in a range of their own.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any

from benchmarks.labels import REFERENCES
from rise_agents import AGENTS, agent_class, pretrained
from rise_agents.agent import nearest
from rise_agents.experts import expert_names
from rise_agents.rollout import is_batched_env
from rise_agents.seeds import RUNS, episode_seeds
from rise_envs import ENVS
from rise_envs.noise import make_noise


@dataclass(frozen=True)
class Scenarios:
    """Numbers ``start`` to ``start + count`` of the test scenarios of an environment."""

    start: int
    count: int

    def seeds(self) -> Any:
        """The environment seeds, (count,); noise draws of the same scenario come from a stream of their own."""
        return episode_seeds("test", 0, self.start, self.count)


@dataclass(frozen=True)
class Preset:
    """How much is trained and measured.

    Attributes:
        demos: episodes of demonstrations per environment.
        episodes: test scenarios per condition.
        noise_levels: multiples of the environment's noise scale.
        seeds: training seeds.
        clips: scenarios that a video shows.
        settings: per agent or per ``agent@environment``, settings that differ from the agent's own.
    """

    demos: int
    episodes: int
    noise_levels: tuple[float, ...]
    seeds: int
    clips: int = 3
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)


_BRIEF = {"updates": 300, "batch_size": 64}
PRESETS = {
    "smoke": Preset(
        demos=24,
        episodes=16,
        noise_levels=(1.0,),
        seeds=1,
        clips=1,
        settings={
            "pcbc": _BRIEF,
            "rise": {**_BRIEF, "vae_updates": 300, "vae_batch_size": 64},
            "cppo": {"total_steps": 2_048},
            # In the engine: what compiles the batched arm takes longer than this training.
            "cppo@RISE-SafePanda-v0": {"train_env": "", "n_envs": 4, "n_steps": 128},
        },
    ),
    "quick": Preset(demos=1_000, episodes=1_000, noise_levels=(0.0, 0.5, 1.0, 2.0), seeds=1),
    "paper": Preset(
        demos=10_000,
        episodes=1_000,
        noise_levels=(0.0, 0.25, 0.5, 1.0, 1.5, 2.0),
        seeds=5,
        settings={
            "pcbc": {"updates": 60_000},
            "rise": {"updates": 60_000, "vae_updates": 30_000},
            "cppo": {"total_steps": 10_000_000},
        },
    ),
}


@dataclass(frozen=True)
class Plan:
    """One run of the benchmark, complete: what ``run.json`` stores and what every result follows from.

    With ``pretrained`` nobody is trained: the agents are those that come with the package.

    Raises:
        ValueError: an unknown name (with the nearest known one) or a number out of range.
    """

    agents: tuple[str, ...]
    envs: tuple[str, ...]
    demos: int
    episodes: int
    noise_model: str
    noise_levels: tuple[float, ...]
    seeds: int
    clips: int = 3
    expert: str = "mixture"
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    pretrained: bool = False

    def __post_init__(self) -> None:
        if not (self.agents and self.envs and self.noise_levels):
            raise ValueError("a run needs at least one agent, one environment and one noise level")
        for name in self.agents:
            _known("agent", name, [*AGENTS, *REFERENCES])
        for env in self.envs:
            _known("environment", env, ENVS)
        _known("expert", self.expert, sorted({name for env in ENVS for name in expert_names(env)}))
        _whole("episodes", self.episodes, 1, 1_000_000)
        _whole("demos", self.demos, 1, 500_000)
        _whole("seeds", self.seeds, 1, RUNS)
        for level in self.noise_levels:
            if not 0 <= level < float("inf"):
                raise ValueError(f"noise levels must be finite and not negative, got {level}")
        make_noise(self.noise_model)
        for name in self.settings:
            agent, _, env = name.partition("@")
            _known("agent", agent, AGENTS)
            _known("environment", env or next(iter(ENVS)), ENVS)
        self._check_pretrained()
        for (
            env
        ) in self.envs:  # last: whether an agent imitates says its class, which takes a second to import
            if self.expert in expert_names(env):
                continue
            if any(name == "expert" or self.learns_from_expert(name) for name in self.agents):
                _known("expert", self.expert, expert_names(env))

    def _check_pretrained(self) -> None:
        if not self.pretrained:
            return
        if self.seeds != 1 or self.settings:
            raise ValueError(
                "agents that come with the package are trained: they take neither seeds nor settings"
            )
        for env in self.envs:
            for agent in self.agents:
                if agent in AGENTS:
                    pretrained.find(agent, env)

    def config(self, agent: str, env: str) -> dict[str, Any]:
        """The settings of an agent in an environment that differ from its defaults."""
        return {**self.settings.get(agent, {}), **self.settings.get(f"{agent}@{env}", {})}

    def learns_from_expert(self, name: str) -> bool:
        """Whether somebody of this name is trained in this run, on demonstrations."""
        return not self.pretrained and name in AGENTS and imitates(name)

    def rows(self, env: str) -> list[tuple[str, int]]:
        """(row name, training seed) of everything that is evaluated in an environment."""
        rows: list[tuple[str, int]] = []
        for agent in dict.fromkeys(self.agents):
            if agent == "expert":
                rows += [(f"expert-{name}", 0) for name in expert_names(env)]
            else:
                rows += [(agent, seed) for seed in range(1 if agent == "random" else self.seeds)]
        return rows

    def chunks(self, env: str) -> list[Scenarios]:
        """The scenarios in the portions that jobs take: fixed, so that workers do not change results."""
        size = 1_000 if is_batched_env(env) else 100
        return [Scenarios(at, min(size, self.episodes - at)) for at in range(0, self.episodes, size)]


def imitates(agent: str) -> bool:
    """Whether an agent learns from demonstrations."""
    return agent_class(agent).learns_from == "demonstrations"


def _known(kind: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}: {nearest(name, known)}")


def _whole(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high:,}, got {value}")


def make_plan(preset: str, settings: dict[str, dict[str, Any]], **chosen: Any) -> Plan:
    """A preset with the user's choices laid over it (None: as in the preset).

    Raises:
        ValueError: see :class:`Plan`; or an unknown preset.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}: {nearest(preset, PRESETS)}")
    base = PRESETS[preset]
    values = {f.name: getattr(base, f.name) for f in fields(Preset) if f.name != "settings"}
    values.update({name: value for name, value in chosen.items() if value is not None})
    merged = {name: dict(entries) for name, entries in base.settings.items()}
    for name, entries in settings.items():
        merged[name] = {**merged.get(name, {}), **entries}
    if chosen.get("pretrained"):  # whose settings are stored with their weights
        values["seeds"], merged = chosen.get("seeds") or 1, settings
    return Plan(**values, settings=merged)


def digest(*parts: Any) -> str:
    """Ten characters that stand for the settings of a piece of work: same settings, same file."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:10]
