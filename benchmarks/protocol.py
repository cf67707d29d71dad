"""What is measured: scenarios, presets, and the plan of one run.

A scenario is one start of one episode: environment, environment seed and noise seed. Every agent meets the
same scenarios with the same noise draws, so results pair up; test seeds lie in a range of their own.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from benchmarks import configs
from benchmarks.configs import Settings, Variant
from benchmarks.labels import REFERENCES, TRUE, split_row
from rise_agents import AGENTS, agent_class, pretrained
from rise_agents.agent import nearest
from rise_agents.experts import expert_names
from rise_agents.filters import FILTERS
from rise_agents.rollout import is_batched_env
from rise_agents.seeds import RUNS, episode_seeds
from rise_envs import ENVS
from rise_envs.noise import make_noise
from rise_envs.task import task_of


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
        tuned: whether the settings of ``benchmarks/configs/tuned.toml`` lie over these, if that is there.
    """

    demos: int
    episodes: int
    noise_levels: tuple[float, ...]
    seeds: int
    clips: int = 3
    settings: Settings = field(default_factory=dict)
    tuned: bool = False


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
        tuned=True,
    ),
}


@dataclass(frozen=True)
class Plan:
    """One run of the benchmark, complete: what ``run.json`` stores and what every result follows from.

    Attributes:
        agents: the rows that were asked for: agents, variants, ``expert`` (a row for each) and ``random``, alone or
            behind a filter, as in ``pcbc+kalman``; ``+true`` stands for true readings at every level.
        envs: environments.
        demos: episodes of demonstrations per environment and expert.
        episodes: test scenarios per condition.
        noise_models: each at all levels; level 0, which is the same for all, counts to the first.
        noise_levels: multiples of the environment's noise scale.
        seeds: training seeds.
        clips: scenarios that a video shows.
        expert: who demonstrates.
        settings: of agents and variants, or either with ``@environment``: what differs from the agents' own.
        variants: those among ``agents``.
        pretrained: nobody is trained: the agents are those that come with the package.

    Raises:
        ValueError: an unknown name (with the nearest known one) or a number out of range.
    """

    agents: tuple[str, ...]
    envs: tuple[str, ...]
    demos: int
    episodes: int
    noise_models: tuple[str, ...]
    noise_levels: tuple[float, ...]
    seeds: int
    clips: int = 3
    expert: str = "mixture"
    settings: Settings = field(default_factory=dict)
    variants: dict[str, Variant] = field(default_factory=dict)
    pretrained: bool = False

    def __post_init__(self) -> None:
        if not (self.agents and self.envs and self.noise_models and self.noise_levels):
            raise ValueError("a run needs at least one agent, environment, noise model and noise level")
        check_names(self.agents, self.settings, self.variants)
        for env in self.envs:
            _known("environment", env, ENVS)
        _known("expert", self.expert, sorted({name for env in ENVS for name in expert_names(env)}))
        _whole("episodes", self.episodes, 1, 1_000_000)
        _whole("demos", self.demos, 1, 500_000)
        _whole("seeds", self.seeds, 1, RUNS)
        for level in self.noise_levels:
            if not 0 <= level < float("inf"):
                raise ValueError(f"noise levels must be finite and not negative, got {level}")
        for model, env in itertools.product(self.noise_models, self.envs):
            make_noise(model, groups=task_of(env).noise_channels)
        if self.pretrained and self.seeds != 1:
            raise ValueError(
                "agents that come with the package are trained: there is one training seed of each"
            )
        for (
            name
        ) in self.agents:  # last: whether an agent imitates says its class, which takes a second to import
            self._check_sources(name)

    def _check_sources(self, name: str) -> None:
        """Raise ``ValueError`` unless a row has an environment, and there what it learns from or consists of."""
        base, _ = split_row(name)
        envs = [env for env in self.envs if self._takes_part(base, env)]
        if not envs:
            theirs = ", ".join(self.variants[base].envs)
            raise ValueError(f"variant {base!r} is for {theirs} only, which is not among the environments")
        for env in envs:
            if self.pretrained and self.agent_of(base):
                self.shipped(base, env)
            elif base == "expert" or self.learns_from_expert(base):
                _known("expert", self.expert_of(base), expert_names(env))

    def _takes_part(self, base: str, env: str) -> bool:
        """Whether a row is run in an environment."""
        only = self.variants[base].envs if base in self.variants else ()
        return not only or env in only

    def agent_of(self, row: str) -> str:
        """The agent that is trained for a row: a key of ``AGENTS``; empty for what is not trained."""
        base, _ = split_row(row)
        if base in self.variants:
            return self.variants[base].agent
        return base if base in AGENTS else ""

    def expert_of(self, row: str) -> str:
        """Who demonstrates for a row."""
        base, _ = split_row(row)
        return (self.variants[base].expert if base in self.variants else "") or self.expert

    def config(self, row: str, env: str) -> dict[str, Any]:
        """The settings of a row's agent in an environment that differ from its defaults."""
        base, _ = split_row(row)
        names = dict.fromkeys((self.agent_of(row), base))  # what a variant says lies over what its agent has
        layers = [self.settings.get(each, {}) for name in names for each in (name, f"{name}@{env}")]
        return {key: value for layer in layers for key, value in layer.items()}

    def shipped(self, row: str, env: str) -> Path:
        """The file of a row's agent that comes with the package: of its own name, or that of whose variant it is.

        Raises:
            ValueError: there is neither; or only the latter, and the row's agent has a demonstrator of its own.
        """
        base, _ = split_row(row)
        if (base, env) in pretrained.available() or (base in self.variants and self.variants[base].expert):
            return pretrained.find(base, env)
        return pretrained.find(self.agent_of(row), env)

    def learns_from_expert(self, row: str) -> bool:
        """Whether the agent of a row is trained in this run, on demonstrations."""
        agent = self.agent_of(row)
        return bool(agent) and not self.pretrained and imitates(agent)

    def rows(self, env: str) -> list[tuple[str, int]]:
        """(row name, training seed) of everything that is evaluated in an environment."""
        rows: list[tuple[str, int]] = []
        for name in dict.fromkeys(self.agents):
            base, filtered = split_row(name)
            if not self._takes_part(base, env):
                continue
            if base == "expert":
                behind = f"+{filtered}" if filtered else ""
                rows += [(f"expert-{expert}{behind}", 0) for expert in expert_names(env)]
            else:
                rows += [(name, seed) for seed in range(1 if base == "random" else self.seeds)]
        return rows

    def experts(self, env: str) -> list[str]:
        """Who demonstrates in an environment to somebody who imitates."""
        rows = [row for row, seed in self.rows(env) if seed == 0 and self.learns_from_expert(row)]
        return list(dict.fromkeys(self.expert_of(row) for row in rows))

    def conditions(self) -> list[tuple[str, float]]:
        """(noise model, noise level) of everything that is measured."""
        first = self.noise_models[0]
        models = dict.fromkeys(self.noise_models)
        return [(model, x) for model in models for x in self.noise_levels if x > 0 or model == first]

    def chunks(self, env: str) -> list[Scenarios]:
        """The scenarios in the portions that jobs take: fixed, so that workers do not change results."""
        size = 1_000 if is_batched_env(env) else 100
        return [Scenarios(at, min(size, self.episodes - at)) for at in range(0, self.episodes, size)]


def check_names(agents: Iterable[str], settings: Iterable[str], variants: Mapping[str, Variant]) -> None:
    """Raise ``ValueError`` unless rows and names of settings are of registered agents and of ``variants``."""
    for name in agents:
        base, filtered = split_row(name)
        _known("agent", base, [*AGENTS, *REFERENCES, *variants])
        if filtered or name.endswith("+"):
            _known("filter", filtered, [*FILTERS, TRUE])
    for name in settings:
        agent, _, env = name.partition("@")
        _known("agent", agent, [*AGENTS, *variants])
        _known("environment", env or next(iter(ENVS)), ENVS)


def with_filters(agents: Iterable[str], filters: Sequence[str]) -> tuple[str, ...]:
    """``agents``, and after each the same behind every filter; chance reads nothing, and no row has two filters."""
    rows = []
    for name in agents:
        alone = name != "random" and not split_row(name)[1]
        rows += [name, *(f"{name}+{each}" for each in filters if alone)]
    return tuple(dict.fromkeys(rows))


def imitates(agent: str) -> bool:
    """Whether an agent learns from demonstrations."""
    return agent_class(agent).learns_from == "demonstrations"


def _known(kind: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise ValueError(f"unknown {kind} {name!r}: {nearest(name, known)}")


def _whole(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high:,}, got {value}")


def make_plan(preset: str, settings: Settings, config_files: Sequence[Path] = (), **chosen: Any) -> Plan:
    """A preset with config files and the user's choices laid over it, in this order.

    Args:
        preset: a key of ``PRESETS``.
        settings: as :class:`Plan` has them.
        config_files: see :mod:`benchmarks.configs`.
        **chosen: other fields of :class:`Plan`; None: as in the preset.

    Raises:
        ValueError: see :class:`Plan`; an unknown preset; or a config file that is none.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}: {nearest(preset, PRESETS)}")
    base = PRESETS[preset]
    values = {f.name: getattr(base, f.name) for f in fields(Preset) if f.name not in ("settings", "tuned")}
    values.update({name: value for name, value in chosen.items() if value is not None})
    shipped = values.get("pretrained", False)  # whose settings are stored with their weights
    if shipped:
        values["seeds"] = chosen.get("seeds") or 1
    read = configs.read(configs.files(base.tuned and not shipped, config_files))
    check_names(values.get("agents", ()), settings, read.variants)
    merged = configs.laid_over([{} if shipped else base.settings, *read.layers, settings])
    named = {split_row(name)[0] for name in values.get("agents", ())}
    variants = {name: variant for name, variant in read.variants.items() if name in named}
    kept = {name: each for name, each in merged.items() if name.partition("@")[0] in (*AGENTS, *variants)}
    return Plan(**values, settings=kept, variants=variants)


def digest(*parts: Any) -> str:
    """Ten characters that stand for the settings of a piece of work: same settings, same file."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:10]
