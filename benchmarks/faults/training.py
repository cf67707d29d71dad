"""Agents that are trained a little, for the rows that need trained ones."""

from __future__ import annotations

import functools
from dataclasses import fields
from typing import Any

from benchmarks.protocol import PRESETS
from rise_agents import agent_class, make_agent
from rise_envs import ENVS, STAND_INS

BENCHMARKED = tuple(env for env in ENVS if env not in STAND_INS)
_LITTLE: dict[str, Any] = {
    "updates": 40, "vae_updates": 40, "batch_size": 32, "vae_batch_size": 32,
    "total_steps": 256, "n_envs": 2, "n_steps": 32, "train_env": "",
}  # fmt: skip


def settings(agent: str, env: str, **chosen: Any) -> dict[str, Any]:
    """Settings with which an agent trains for a second or so."""
    known = {field.name for field in fields(agent_class(agent).Config)}
    smoke = PRESETS["smoke"].settings
    little = {name: value for name, value in {**_LITTLE, **chosen}.items() if name in known}
    return {**smoke.get(agent, {}), **smoke.get(f"{agent}@{env}", {}), **little}


@functools.cache
def recorded(env: str) -> Any:
    """A few demonstrations."""
    from rise_agents.demonstrations import generate

    return generate(env, "cbf", 4)


def source_of(agent: Any, env: str) -> Any:
    """What an agent learns from."""
    return recorded(env) if agent.learns_from == "demonstrations" else env


def train(name: str, env: str, **chosen: Any) -> Any:
    """A trained agent."""
    agent = make_agent(name, env, settings(name, env, **chosen), seed=1)
    return agent.learn(source_of(agent, env))
