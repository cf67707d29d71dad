"""Filters: what stands between noisy readings and any policy, and hands it better ones.

A new filter is one file and one line in :data:`FILTERS`. Its class is made as ``Class(policy, task, noise_level)``,
has the ``predict`` and the ``initial_state`` of a policy, and says in ``label`` what a policy behind it is called.
"""

from __future__ import annotations

import importlib
from typing import Any

from rise_agents.agent import nearest
from rise_envs.task import task_of

# name -> "module:Class".
FILTERS: dict[str, str] = {"kalman": "rise_agents.filters.kalman:KalmanFilter"}


def filter_class(name: str) -> Any:
    """The class of a registered filter.

    Raises:
        ValueError: an unknown name, with the nearest known one.
    """
    if name not in FILTERS:
        raise ValueError(f"unknown filter {name!r}: {nearest(name, FILTERS)}")
    module, _, kind = FILTERS[name].partition(":")
    return getattr(importlib.import_module(module), kind)


def make_filter(name: str, policy: Any, env_id: str, noise_level: float) -> Any:
    """``policy`` behind a filter, ready to ``predict``.

    Args:
        name: a key of ``FILTERS``.
        policy: an agent or an expert.
        env_id: a registered environment with a task description.
        noise_level: of the readings that it will meet.

    Raises:
        ValueError: an unknown filter, an environment without a task description, or a level out of range.
    """
    import rise_envs  # noqa: F401  registers the environments

    return filter_class(name)(policy, task_of(env_id), noise_level)
