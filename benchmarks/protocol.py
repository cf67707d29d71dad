"""What is measured: scenarios, presets, and the plan of one run.

A scenario is one start of one episode: environment, environment seed and noise seed. Every agent meets the
same scenarios with the same noise draws, so results pair up; test seeds lie in a range of their own.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from benchmarks import configs
from benchmarks.configs import Settings, Variant
from benchmarks.labels import REFERENCES, TRUE, headline, split_row
from benchmarks.presets import PRESETS, Block, Preset
from rise_agents import AGENTS, agent_class, pretrained
from rise_agents.agent import nearest
from rise_agents.experts import EXPERTS, expert_names
from rise_agents.filters import FILTERS
from rise_agents.rollout import check_judged, is_batched_env
from rise_agents.seeds import RUNS, episode_seeds
from rise_envs import ENVS
from rise_envs.noise import make_noise
from rise_envs.task import describes_task, task_of


@dataclass(frozen=True)
class Scenarios:
    """Numbers ``start`` to ``start + count`` of the test scenarios of an environment."""

    start: int
    count: int

    def seeds(self) -> Any:
        """The environment seeds, (count,); noise draws of the same scenario come from a stream of their own."""
        return episode_seeds("test", 0, self.start, self.count)


@dataclass(frozen=True)
class Plan:
    """One run of the benchmark, complete: what ``run.json`` stores and what every result follows from.

    Attributes:
        agents: the rows that were asked for: agents, variants, ``expert`` (a row for each), ``expert-NAME`` and
            ``random``, alone or behind a filter, as in ``pcbc+kalman``; ``+true`` stands for true readings at every
            level.
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
        blocks: what is measured beside all this.

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
    blocks: tuple[Block, ...] = ()

    def __post_init__(self) -> None:
        for env in (*self.envs, *(env for block in self.blocks for env in block.envs)):
            _known("environment", env, ENVS)
        _known("expert", self.expert, sorted({name for _, name in EXPERTS}))
        _whole("episodes", self.episodes, 1, 1_000_000)
        _whole("demos", self.demos, 1, 500_000)
        for block in self.all_blocks():
            self._check_block(block)
        # Last: whether an agent imitates says its class, which takes a second to import.
        for block in self.all_blocks():
            for name in block.agents:
                self._check_sources(name, block)

    def _check_block(self, block: Block) -> None:
        if not (block.agents and self.envs and block.noise_models and block.noise_levels):
            raise ValueError("a run needs at least one agent, environment, noise model and noise level")
        check_names(block.agents, self.settings, self.variants)
        _whole("seeds", block.seeds, 1, RUNS)
        for level in block.noise_levels:
            if not 0 <= level < float("inf"):
                raise ValueError(f"noise levels must be finite and not negative, got {level}")
        for model, env in itertools.product(block.noise_models, self._envs(block)):
            # Without a task, the environment itself names its groups: the wrapper asks it.
            make_noise(model, groups=task_of(env).noise_channels if describes_task(env) else None)
        if self.pretrained and block.seeds != 1:
            raise ValueError(
                "agents that come with the package are trained: there is one training seed of each"
            )

    def all_blocks(self) -> tuple[Block, ...]:
        """What is measured: the rows that were asked for, then :attr:`blocks` as far as they are of this run."""
        own = Block("", self.agents, self.noise_models, self.noise_levels, self.seeds)
        return own, *(block for block in self.blocks if self._envs(block))

    def _envs(self, block: Block) -> list[str]:
        return [env for env in self.envs if not block.envs or env in block.envs]

    def _check_sources(self, name: str, block: Block) -> None:
        """Raise ``ValueError`` unless a row has an environment, and there what it learns from or consists of."""
        base, filtered = split_row(name)
        envs = [env for env in self._envs(block) if self._takes_part(base, env)]
        if not envs:
            theirs = ", ".join(self.variants[base].envs)
            raise ValueError(f"variant {base!r} is for {theirs} only, which is not among the environments")
        for env in envs:
            if filtered in FILTERS:
                task_of(env)  # a filter reads it
            if self.pretrained and self.agent_of(base):
                self.shipped(base, env)
            elif base == "expert" or self.learns_from_expert(base):
                _known("expert", self.expert_of(base), expert_names(env))
            elif _single_expert(base):
                _known("expert", _single_expert(base), expert_names(env))

    def _takes_part(self, base: str, env: str) -> bool:
        """Whether a row is run in an environment."""
        only = self.variants[base].envs if base in self.variants else ()
        return not only or env in only

    def labels(self) -> dict[str, str]:
        """How variants are called, for :func:`benchmarks.labels.name_rows`."""
        return {name: variant.label for name, variant in self.variants.items() if variant.label}

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
        return list(self.measured(env))

    def _rows(self, block: Block, env: str) -> list[tuple[str, int]]:
        """Those of a block."""
        rows: list[tuple[str, int]] = []
        for name in block.agents if env in self._envs(block) else ():
            base, filtered = split_row(name)
            behind = f"+{filtered}" if filtered else ""
            if not self._takes_part(base, env):
                continue
            if base == "expert":
                rows += [(f"expert-{expert}{behind}", 0) for expert in expert_names(env)]
            else:
                untrained = base == "random" or _single_expert(base)
                rows += [(name, seed) for seed in range(1 if untrained else block.seeds)]
        return rows

    def experts(self, env: str) -> list[str]:
        """Who demonstrates in an environment to somebody who imitates."""
        rows = [row for row, seed in self.rows(env) if seed == 0 and self.learns_from_expert(row)]
        return list(dict.fromkeys(self.expert_of(row) for row in rows))

    def asked(self, env: str) -> list[str]:
        """The rows that were asked for in an environment, without those that only blocks bring."""
        return list(dict.fromkeys(row for row, _ in self._rows(self.all_blocks()[0], env)))

    def headline(self) -> tuple[str, float]:
        """(noise model, noise level) that clips and pages show."""
        return self.noise_models[0], headline(self.noise_levels)

    def conditions(self, env: str, row: str, seed: int) -> list[tuple[str, float]]:
        """(noise model, noise level) of everything that a row is measured under; level 0 is of the first model."""
        return self.measured(env)[row, seed]

    def measured(self, env: str) -> dict[tuple[str, int], list[tuple[str, float]]]:
        """The conditions of every row and training seed, in their order."""
        first = self.noise_models[0]
        found: dict[tuple[str, int], dict[tuple[str, float], None]] = {}
        for block in self.all_blocks():
            met = {
                (model if level else first, level): None
                for model in block.noise_models
                for level in block.noise_levels
            }
            for row in self._rows(block, env):
                found.setdefault(row, {}).update(met)
        return {row: list(met) for row, met in found.items()}

    def described(self) -> list[dict[str, Any]]:
        """What each block measures, its rows by their names in the tables; for :mod:`benchmarks.sections`."""
        described = []
        for block in self.all_blocks():
            rows = dict.fromkeys(row for env in self.envs for row, _ in self._rows(block, env))
            described.append({**asdict(block), "rows": list(rows)})
        return described

    def chunks(self, env: str) -> list[Scenarios]:
        """The scenarios in the portions that jobs take."""
        return portions(env, self.episodes)


def portions(env: str, episodes: int) -> list[Scenarios]:
    """``episodes`` scenarios in portions that run side by side: fixed, so that workers do not change results."""
    size = 1_000 if is_batched_env(env) else 100
    return [Scenarios(at, min(size, episodes - at)) for at in range(0, episodes, size)]


def check_names(agents: Iterable[str], settings: Iterable[str], variants: Mapping[str, Variant]) -> None:
    """Raise ``ValueError`` unless rows and names of settings are of registered agents and of ``variants``."""
    for name in agents:
        base, filtered = split_row(name)
        experts = [f"expert-{expert}" for _, expert in EXPERTS] if base.startswith("expert-") else []
        _known("agent", base, [*AGENTS, *REFERENCES, *variants, *experts])
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


def _single_expert(base: str) -> str:
    """The expert that a row ``expert-NAME`` names; empty for others."""
    return base.removeprefix("expert-") if base.startswith("expert-") else ""


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
        ValueError: see :class:`Plan`; an unknown preset; a config file that is none; or an environment whose episodes
            cannot be judged, which else would show when all is trained.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}: {nearest(preset, PRESETS)}")
    base = PRESETS[preset]
    values = {f.name: getattr(base, f.name) for f in fields(Preset) if f.name not in ("brief", "tuned")}
    values.update({name: value for name, value in chosen.items() if value is not None})
    shipped = values.get("pretrained", False)  # whose settings are stored with their weights
    if shipped:
        values["seeds"] = chosen.get("seeds") or 1
    if shipped or chosen.get("agents"):  # who names rows wants these alone
        values["blocks"] = chosen.get("blocks") or ()
    read = configs.read(configs.files(base.tuned and not shipped, config_files))
    names = [*values["agents"], *(name for block in values["blocks"] for name in block.agents)]
    check_names(names, settings, read.variants)
    named = dict.fromkeys(split_row(name)[0] for name in names)
    brief = _brief(named, read.variants) if base.brief and not shipped else {}
    merged = configs.laid_over([brief, *read.layers, settings])
    variants = {name: variant for name, variant in read.variants.items() if name in named}
    kept = {name: each for name, each in merged.items() if name.partition("@")[0] in (*AGENTS, *variants)}
    plan = Plan(**values, settings=kept, variants=variants)
    for env in plan.envs:
        if not describes_task(env):  # who does, is ours or has been through the contract tests
            check_judged(env)
    return plan


def _brief(rows: Iterable[str], variants: Mapping[str, Variant]) -> Settings:
    """Settings with which the agents of rows train in a second or two."""
    agents = (variants[row].agent if row in variants else row for row in rows)
    return {agent: dict(agent_class(agent).BRIEF) for agent in agents if agent in AGENTS}


def digest(*parts: Any) -> str:
    """Ten characters that stand for the settings of a piece of work: same settings, same file."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:10]
