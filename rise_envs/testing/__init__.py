"""What every environment keeps, as checks that anybody can run on an environment of their own.

>>> from rise_envs.testing import check_env
>>> check_env("RISE-GroundVehicle-v0", episodes=5)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import rise_envs
from rise_envs.task import describes_task
from rise_envs.testing import any_env, goal_env
from rise_envs.testing.subject import ContractError, Subject, hold

__all__ = ["CHECKS", "ContractError", "check_env", "checks_of", "hold"]


class Check(NamedTuple):
    """One thing that is checked.

    Attributes:
        run: raises if it does not hold.
        any: whether it holds of environments without a task description, too.
    """

    run: Callable[[Subject], None]
    any: bool = False


CHECKS: dict[str, Check] = {
    "gymnasium's checker": Check(any_env.checker, any=True),
    "time limit": Check(any_env.time_limit, any=True),
    "seeds name episodes": Check(any_env.seeds, any=True),
    "replay": Check(any_env.replay, any=True),
    "resets without a seed": Check(any_env.unseeded, any=True),
    "vector environments": Check(any_env.vectors, any=True),
    "ownership": Check(any_env.ownership, any=True),
    "drawing": Check(any_env.drawing, any=True),
    "close": Check(any_env.close, any=True),
    "spaces": Check(goal_env.spaces_fit),
    "task description": Check(goal_env.task_agrees),
    "infos": Check(goal_env.infos),
    "perceived": Check(goal_env.perceived),
    "misuse": Check(goal_env.misuse),
    "goals": Check(goal_env.goals),
}


def check_env(env_id: str, episodes: int = 20) -> None:
    """Check a registered environment.

    Args:
        env_id: registered with :func:`rise_envs.register_env`.
        episodes: how many of its episodes are looked at.

    Raises:
        ContractError: what it does not keep.
        ValueError: no such environment is registered.
    """
    if env_id not in rise_envs.ENVS:
        raise ValueError(f"{env_id!r} is not registered: rise_envs.register_env does so")
    subject = Subject(env_id, episodes)
    for name in checks_of(env_id):
        try:
            CHECKS[name].run(subject)
        except Exception as error:  # whatever an environment of somebody else raises
            raise ContractError(f"{env_id}: {name}: {type(error).__name__}: {error}") from error


def checks_of(env_id: str) -> list[str]:
    """The names of the checks that an environment is subject to."""
    return [name for name, check in CHECKS.items() if check.any or describes_task(env_id)]
