"""Experts: what demonstrations are recorded from. They have the ``predict`` of a learned agent.

A new expert is one file and one line in :data:`EXPERTS`. Its class is made as ``Class(task, seed=0)``.
"""

from __future__ import annotations

from typing import Any

from rise_agents.agent import nearest
from rise_envs import ENVS, STAND_INS
from rise_envs.registry import Entry, check_new, checked_entry, checked_name, find_class
from rise_envs.streams import checked_seed
from rise_envs.task import describes_task, task_of

EXPERTS: dict[tuple[str, str], str] = {
    ("RISE-GroundVehicle-v0", "cbf"): "rise_agents.experts.vehicle_cbf:VehicleCBF",
    ("RISE-GroundVehicle-v0", "mpc"): "rise_agents.experts.vehicle_mpc:VehicleMPC",
    ("RISE-GroundVehicle-v0", "mixture"): "rise_agents.experts.mixture:Mixture",
    ("RISE-SafePanda-v0", "cbf"): "rise_agents.experts.panda_cbf:PandaCBF",
    ("RISE-SafePanda-v0", "mpc"): "rise_agents.experts.panda_mpc:PandaMPC",
    ("RISE-SafePanda-v0", "mixture"): "rise_agents.experts.mixture:Mixture",
}
"""(environment id, expert's name) → ``module:Class``. An environment's stand-in has the same experts."""


def register_expert(env_id: str, name: str, entry: Entry) -> None:
    """Add an expert for an environment to :data:`EXPERTS`.

    Args:
        env_id: a registered environment with a task description.
        name: of the expert there.
        entry: its class (or ``"module:Class"``), made as ``Class(task, seed=0)``, which has a ``predict``.

    Raises:
        ValueError: a name that is malformed or taken, an environment that is not registered or describes no task,
            or a class without ``predict``.
    """
    kind = f"expert {checked_name('an expert', name)!r} for {env_id}"
    if env_id not in ENVS or env_id in STAND_INS:
        known = [env for env in ENVS if env not in STAND_INS]
        raise ValueError(f"{kind}: no such environment, or a stand-in for one; {nearest(env_id, known)}")
    if not describes_task(env_id):
        raise ValueError(f"{kind}: the environment describes no task; give its class a static method task()")
    text = checked_entry(kind, entry, ("predict",))[1]
    check_new(kind, EXPERTS.get((env_id, name)), text)
    EXPERTS[env_id, name] = text


def expert_names(env_id: str) -> tuple[str, ...]:
    """The names of the experts for an environment.

    Raises:
        ValueError: there are none; the message names the nearest environment that has some.
    """
    names = tuple(name for env, name in EXPERTS if env == STAND_INS.get(env_id, env_id))
    if not names:
        known = sorted({env for env, _ in EXPERTS})
        raise ValueError(f"no expert for environment {env_id!r}; {nearest(env_id, known)}")
    return names


def make_expert(name: str, env_id: str, seed: int = 0, **kwargs: Any) -> Any:
    """An expert, ready to ``predict``.

    Args:
        name: one of :func:`expert_names`.
        env_id: a registered environment.
        seed: of an expert that draws random numbers.
        **kwargs: of the environment's description, as for ``gymnasium.make`` (say ``n_obstacles=3``).

    Raises:
        ValueError: unknown name or environment, or a seed that is no whole number ≥ 0.
    """
    names = expert_names(env_id)
    if name not in names:
        raise ValueError(f"no expert {name!r} for {env_id}; {nearest(name, names)}")
    kind = find_class(EXPERTS[STAND_INS.get(env_id, env_id), name])
    # A mixture lists the experts that it draws from.
    experts = [make_expert(member, env_id, seed, **kwargs) for member in getattr(kind, "names", ())]
    given = {"experts": experts} if experts else {}
    return kind(task_of(env_id, **kwargs), seed=checked_seed(seed), **given)
