"""Agents that imitate or learn to reach goals safely from noisy readings.

>>> from rise_agents import make_agent, load_agent
>>> agent = make_agent("rise", "RISE-GroundVehicle-v0", seed=0)
"""

from __future__ import annotations

import os
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from rise_agents.agent import Agent, acting_settings, config_from_dict, nearest
from rise_envs.registry import Entry, check_new, checked_entry, checked_name, find_class
from rise_envs.streams import checked_seed

__version__ = "0.1.0"

#: From name to module and class. A new agent is one file and one line here.
AGENTS: dict[str, str] = {
    "rise": "rise_agents.rise:Rise",
    "pcbc": "rise_agents.pcbc:PCBC",
    "cppo": "rise_agents.cppo:CPPO",
    "rise-belief": "rise_agents.belief.agent:RiseBelief",
}


_NEEDS = (
    *("name", "Config", "PRESETS", "BRIEF", "learns_from", "evaluate_deterministic"),
    *("learn", "predict", "save", "from_checkpoint"),
)


def agent_class(name: str) -> Any:
    """The class of a registered agent.

    Raises:
        ValueError: an unknown name, with the nearest known one.
    """
    if name not in AGENTS:
        raise ValueError(f"unknown agent {name!r}: {nearest(name, AGENTS)}")
    return find_class(AGENTS[name])


def register_agent(name: str, entry: Entry) -> None:
    """Add an agent to :data:`AGENTS`: command lines, benchmark and :func:`load_agent` then know it.

    Args:
        name: the ``name`` of its class.
        entry: the class (or ``"module:Class"``), which keeps :class:`rise_agents.agent.Agent`.

    Raises:
        ValueError: a name that is malformed, taken or another one than the class says, or a class that lacks something.
    """
    kind = f"agent {checked_name('an agent', name, ('expert', 'random'))!r}"
    found, text = checked_entry(kind, entry, _NEEDS)
    check_new(kind, AGENTS.get(name), text)
    if found.name != name:
        raise ValueError(f"{kind}: {text!r} calls itself {found.name!r}, by which its checkpoints are found")
    if found.learns_from not in ("demonstrations", "environment"):
        raise ValueError(
            f"{kind}: learns_from must be 'demonstrations' or 'environment', got {found.learns_from!r}"
        )
    if not is_dataclass(found.Config):
        raise ValueError(f"{kind}: Config must be a (frozen) dataclass, got {found.Config!r}")
    AGENTS[name] = text


def make_agent(
    name: str, env_id: str, config: dict[str, Any] | None = None, seed: int = 0, device: str = "cpu"
) -> Agent:
    """An untrained agent for an environment.

    Args:
        name: a key of ``AGENTS``.
        env_id: a registered environment.
        config: settings that differ from the agent's defaults, by the field names of its ``Config``.
        seed: of weights, batches and samples.
        device: a torch device.

    Raises:
        ValueError: an unknown agent or setting, a setting out of range, or a seed that is no whole number ≥ 0.
    """
    return agent_class(name)(env_id, {} if config is None else config, _seed(seed), device)


def load_agent(
    path_or_name: str | os.PathLike[str],
    env: str | None = None,
    device: str = "cpu",
    settings: dict[str, Any] | None = None,
) -> Agent:
    """A trained agent: from a checkpoint, or by name one of those that come with the package.

    Args:
        path_or_name: a file; or, if there is no such file, the name of an agent (:mod:`rise_agents.pretrained`).
        env: the environment that it must be of. A name needs it.
        device: a torch device.
        settings: how it acts, laid over what is stored: of the settings that its class names in ``ACTING``.

    Raises:
        rise_agents.checkpoint.CheckpointError: unreadable, damaged, or of another environment.
        ValueError: a name without weights for ``env`` in the package, or without ``env``; a setting that does not
            exist, that is out of range, or that training depended on.
    """
    from rise_agents import checkpoint

    path = _file_of(path_or_name, env)
    arrays, description = checkpoint.load(path)
    name, own = description.get("agent"), description["env"]
    if not isinstance(name, str) or name not in AGENTS:
        remedy = "import the module that registers it first (--import), or update the package"
        raise checkpoint.CheckpointError(path, f"holds an unknown agent {name!r}", remedy)
    if env is not None and own != env:
        raise checkpoint.CheckpointError(
            path, f"was trained on {own!r}, not {env!r}", "train on that environment"
        )
    if settings:
        _check_acting(name, settings)
    try:
        _seed(description["seed"])
        config = {**description["config"], **(settings or {})}
        return agent_class(name).from_checkpoint(arrays, {**description, "config": config}, device)
    except Exception as error:  # a right digest says who wrote a file, not that it makes sense
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise checkpoint.CheckpointError(path, f"is no whole agent ({reason})", "train it again") from None


def _file_of(path_or_name: str | os.PathLike[str], env: str | None) -> str | os.PathLike[str]:
    """The file that is meant: a path as it is, a name as the file that comes with the package."""
    from rise_agents import pretrained

    if (
        not isinstance(path_or_name, str)
        or not pretrained.is_name(path_or_name)
        or Path(path_or_name).exists()
    ):
        return path_or_name
    meant = path_or_name in AGENTS or path_or_name in dict(pretrained.available())
    meant = meant or (env is not None and "." not in path_or_name)  # with a dot it looks like a file
    return pretrained.find(path_or_name, env) if meant else path_or_name


def _check_acting(name: str, settings: dict[str, Any]) -> None:
    """Raise ``ValueError`` unless an agent of this name can be told to act so after its training."""
    kind = agent_class(name)
    config_from_dict(kind.Config, settings)
    known = acting_settings(kind)
    for setting in settings:
        if setting not in known:
            told = f"known: {', '.join(sorted(known))}" if known else "it has none"
            raise ValueError(f"{setting!r} is no setting that a trained {name} acts by; {told}")


def _seed(seed: Any) -> int:
    """A seed that torch's generators take; raises ``ValueError`` for anything else."""
    whole = checked_seed(seed)
    if whole >= 1 << 63:
        raise ValueError(f"a seed must be below 2**63, got {whole}")
    return whole
