"""Filters: what stands between noisy readings and any policy, and hands it better ones.

A new filter is one file and one line in :data:`FILTERS`. Its class is made as ``Class(policy, task, noise_level)``,
has the ``predict`` and the ``initial_state`` of a policy, and says in ``label`` what a policy behind it is called.
"""

from __future__ import annotations

from typing import Any

from rise_agents.agent import nearest
from rise_envs.registry import Entry, check_new, checked_entry, checked_name, find_class
from rise_envs.task import task_of

#: From name to module and class.
FILTERS: dict[str, str] = {"kalman": "rise_agents.filters.kalman:KalmanFilter"}


def register_filter(name: str, entry: Entry) -> None:
    """Add a filter to :data:`FILTERS`: rows such as ``pcbc+NAME`` then have it.

    Args:
        name: of the filter; ``true`` stands for true readings.
        entry: its class (or ``"module:Class"``), as the top of this module says.

    Raises:
        ValueError: a name that is malformed or taken, or a class that lacks something.
    """
    kind = f"filter {checked_name('a filter', name, ('true',))!r}"
    text = checked_entry(kind, entry, ("predict", "initial_state", "label"))[1]
    check_new(kind, FILTERS.get(name), text)
    FILTERS[name] = text


def filter_class(name: str) -> Any:
    """The class of a registered filter.

    Raises:
        ValueError: an unknown name, with the nearest known one.
    """
    if name not in FILTERS:
        raise ValueError(f"unknown filter {name!r}: {nearest(name, FILTERS)}")
    return find_class(FILTERS[name])


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
