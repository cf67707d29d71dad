"""Agents that are trained a little, for the rows that need trained ones."""

from __future__ import annotations

import functools
from typing import Any

from rise_agents import agent_class, make_agent
from rise_envs import ENVS, STAND_INS

BENCHMARKED = tuple(env for env in ENVS if env not in STAND_INS)


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
    agent = make_agent(name, env, {**agent_class(name).BRIEF, **chosen}, seed=1)
    return agent.learn(source_of(agent, env))
