"""Config files: settings of agents, and variants of agents, which are rows of their own.

A file is TOML. Tables named after an agent or a variant, or either with ``@environment``, hold settings. A table
``variants.NAME`` makes a row called NAME: ``agent`` says whose variant it is, and all other keys but the following are
settings, laid over those of its agent: ``label`` (as people read it), ``envs`` (only there), ``expert`` (who
demonstrates for this row alone), ``search`` (values that :mod:`benchmarks.tune` tries, beside what it tries of the
agent)::

    [rise]
    beta = 0.1

    [variants.rise-large]
    agent = "rise"
    label = "RISE, large"
    hidden = [512, 512]
    search.batch_size = [256, 1024]

    ["rise-large@RISE-SafePanda-v0"]
    beta = 0.05

``benchmarks/configs/variants.toml`` is always read. Settings of a later file take the place of those of an earlier one.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.labels import REFERENCES
from rise_agents import AGENTS, agent_class
from rise_agents.agent import nearest
from rise_agents.experts import EXPERTS
from rise_envs import ENVS
from rise_envs.settings import check_fields, plain

FOLDER = Path(__file__).with_suffix("")
SHIPPED = FOLDER / "variants.toml"
TUNED = FOLDER / "tuned.toml"  # what was found on validation scenarios; preset ``paper`` begins with it
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

Settings = dict[str, dict[str, Any]]  # by agent, variant, or either with ``@environment``


@dataclass(frozen=True)
class Variant:
    """An agent under settings of its own.

    Attributes:
        agent: whose variant it is, a key of :data:`rise_agents.AGENTS`.
        label: as people read it; none: the row's name.
        envs: the environments that it is run in; none: all.
        expert: who demonstrates for it; none: who demonstrates for everybody.
    """

    agent: str
    label: str = ""
    envs: tuple[str, ...] = ()
    expert: str = ""


@dataclass(frozen=True)
class Configs:
    """What config files say, in their order.

    Attributes:
        variants: by name.
        layers: settings, those of each file.
        searches: of variants, the values to try of settings.
    """

    variants: dict[str, Variant] = field(default_factory=dict)
    layers: tuple[Settings, ...] = ()
    searches: dict[str, dict[str, list[Any]]] = field(default_factory=dict)


def read(paths: Iterable[Path]) -> Configs:
    """The content of config files.

    Raises:
        ValueError: a file that cannot be read or is no such file; the message names file, table and key.
    """
    variants: dict[str, Variant] = {}
    layers: list[Settings] = []
    searches: dict[str, dict[str, list[Any]]] = {}
    for path in paths:
        tables = _tables(path)
        layer: Settings = {}
        for place, name, entries in _named(path, tables.pop("variants", {})):
            variant, layer[name], searches[name] = _variant(place, name, entries, variants)
            variants[name] = variant
        for name, entries in tables.items():
            layer[name] = _of_row(_place(path, name), name, entries, variants)
        layers.append(layer)
    return Configs(variants, tuple(layers), {name: each for name, each in searches.items() if each})


def laid_over(layers: Iterable[Mapping[str, Mapping[str, Any]]]) -> Settings:
    """Settings of which later layers win.

    What a layer says of an agent holds in every environment for which the same layer says nothing else, also where an
    earlier one spoke of that environment alone.
    """
    merged: Settings = {}
    for layer in layers:
        for name in sorted(layer, key=lambda name: "@" in name):
            for other, entries in merged.items():
                if other.startswith(f"{name}@"):
                    merged[other] = {key: value for key, value in entries.items() if key not in layer[name]}
            merged[name] = {**merged.get(name, {}), **layer[name]}
    return merged


def _tables(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ValueError(f"cannot read the config file {str(path)!r}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # of TOML, of UTF-8, or of a name with a null character
        raise ValueError(f"config file {str(path)!r} is no TOML: {error}") from None


def _place(path: Path, table: str) -> str:
    """How an error message begins; quoted, so that it stays one line whatever the names are."""
    return f"config file {str(path)!r}, table {table!r}:"


def _named(path: Path, tables: Any) -> Iterator[tuple[str, str, Any]]:
    """Where each variant stands in the file, its name and its entries."""
    if not isinstance(tables, dict):
        raise ValueError(f"{_place(path, 'variants')} holds tables, as in [variants.NAME], got {tables!r}")
    for name, entries in tables.items():
        yield _place(path, f"variants.{name}"), name, entries


def _of_row(place: str, name: str, entries: Any, variants: Mapping[str, Variant]) -> dict[str, Any]:
    """The settings in a table of an agent or a variant, checked."""
    row, at, env = name.partition("@")
    if row not in AGENTS and row not in variants:
        known = [*AGENTS, *variants, "variants"]
        raise ValueError(f"{place} names no agent and no variant: {nearest(row, known)}")
    _check_env(place, env, at)
    return _settings(place, variants[row].agent if row in variants else row, entries)


def _variant(
    place: str, name: str, entries: Any, known: Mapping[str, Variant]
) -> tuple[Variant, dict[str, Any], dict[str, list[Any]]]:
    """A variant, its settings, and the values of settings that a search tries, all checked."""
    if not _NAME.fullmatch(name) or name in AGENTS or re.split("[-.]", name)[0] in REFERENCES:
        raise ValueError(f"{place} needs a name of letters, digits, '.', '_', '-' that means nothing else")
    if name in known:
        raise ValueError(f"{place} is there already, in this file or in one read before")
    if not isinstance(entries, dict) or entries.get("agent") not in tuple(AGENTS):
        agent = entries.get("agent") if isinstance(entries, dict) else entries
        raise ValueError(f"{place} agent must name an agent, got {agent!r}: {nearest(str(agent), AGENTS)}")
    about = {key: value for key, value in entries.items() if key in Variant.__annotations__}
    variant = Variant(**plain(about))
    _check_variant(place, variant)
    rest = {key: value for key, value in entries.items() if key not in (*about, "search")}
    return variant, _settings(place, variant.agent, rest), _tried(place, variant, entries.get("search", {}))


def _tried(place: str, variant: Variant, tried: Any) -> dict[str, list[Any]]:
    """Lists of settings, each value as it must be."""
    if not isinstance(tried, dict) or not all(isinstance(each, list) and each for each in tried.values()):
        raise ValueError(
            f"{place} search must hold lists of values, as in search.FIELD = [1, 2], got {tried!r}"
        )
    for name, values in tried.items():
        for value in values:
            _settings(place, variant.agent, {name: value})
    return tried


def _check_variant(place: str, variant: Variant) -> None:
    try:
        check_fields(Variant, vars(variant))
    except ValueError as error:
        raise ValueError(f"{place} {error}") from None
    for env in variant.envs:
        _check_env(place, env)
    experts = sorted({name for _, name in EXPERTS})
    if variant.expert and variant.expert not in experts:
        raise ValueError(f"{place} expert {variant.expert!r} is unknown: {nearest(variant.expert, experts)}")
    if variant.expert and agent_class(variant.agent).learns_from != "demonstrations":
        raise ValueError(f"{place} expert: {variant.agent} learns from no expert")


def _check_env(place: str, env: str, at: str = "@") -> None:
    if at and env not in ENVS:
        raise ValueError(f"{place} names no environment {env!r}: {nearest(env, ENVS)}")


def _settings(place: str, agent: str, entries: Any) -> dict[str, Any]:
    """Entries as settings of an agent: they exist and are of the right kind."""
    if not isinstance(entries, dict):
        raise ValueError(f"{place} must be a table of settings, got {entries!r}")
    try:
        check_fields(agent_class(agent).Config, plain(entries))
    except ValueError as error:
        raise ValueError(f"{place} {error}") from None
    return entries


def files(tuned: bool, given: Sequence[Path]) -> list[Path]:
    """The files that a run reads: what is shipped, what was tuned if that is wanted and there, and the user's own."""
    return [SHIPPED, *([TUNED] if tuned and TUNED.exists() else []), *given]
