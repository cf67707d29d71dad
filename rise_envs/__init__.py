"""RISE environments: safe goal reaching among moving obstacles that are only read with noise.

Importing this package registers every ``RISE-*`` id with Gymnasium and costs NumPy and Gymnasium only; the
physics engine is loaded when an environment that needs it is made.
"""

from __future__ import annotations

import re

import gymnasium as gym

from rise_envs.cost import CostFromTuple, CostToTuple, RequireCost, cost_of
from rise_envs.noise import NOISE_MODELS, make_noise, register_noise
from rise_envs.noise_models import NoiseModel
from rise_envs.noise_wrappers import ObservationNoise, VectorObservationNoise
from rise_envs.registry import Entry, check_new, checked_entry, checked_name
from rise_envs.settings import whole

__all__ = [
    "ENVS",
    "NOISE_MODELS",
    "STAND_INS",
    "CostFromTuple",
    "CostToTuple",
    "NoiseModel",
    "ObservationNoise",
    "RequireCost",
    "VectorObservationNoise",
    "cost_of",
    "make_noise",
    "register_env",
    "register_noise",
]

#: id -> (entry point, vector entry point, steps per episode). A new environment is one file and one line here.
ENVS: dict[str, tuple[str, str | None, int]] = {
    "RISE-GroundVehicle-v0": (
        "rise_envs.ground_vehicle:GroundVehicleEnv",
        "rise_envs.ground_vehicle_vector:GroundVehicleVectorEnv",
        200,
    ),
    "RISE-SafePanda-v0": ("rise_envs.safe_panda:SafePandaEnv", None, 50),
    "RISE-SafePandaKinematic-v0": (
        "rise_envs.safe_panda_kinematic:SafePandaKinematicEnv",
        "rise_envs.safe_panda_kinematic_vector:SafePandaKinematicVectorEnv",
        50,
    ),
}

#: id -> the environment that it models. To train on; results are reported from the one that is modelled.
STAND_INS = {"RISE-SafePandaKinematic-v0": "RISE-SafePanda-v0"}


def register_env(
    env_id: str,
    entry: Entry,
    max_episode_steps: int,
    vector_entry: Entry | None = None,
    stands_in_for: str | None = None,
) -> None:
    """Add an environment to :data:`ENVS` and to Gymnasium's registry: command lines then know it.

    Args:
        env_id: as Gymnasium wants it, without a namespace.
        entry: its class, or ``"module:Class"``, which takes no argument that has no default.
        max_episode_steps: of an episode, after which it is truncated.
        vector_entry: the class of its batched form, if it has one.
        stands_in_for: the environment that it models, if it is one to train in only.

    Raises:
        ValueError: an id that is malformed or taken, no class of an environment, or no number of steps.
    """
    kind = f"environment {env_id!r}"
    if not re.search(r"-v\d+$", checked_name("an environment", env_id)):
        raise ValueError(f"{kind}: an id ends with a version, as in {env_id}-v0")
    found, text = checked_entry(kind, entry, ("reset", "step"))
    if not issubclass(found, gym.Env):
        raise ValueError(f"{kind}: {text!r} is no gymnasium.Env")
    vector = None if vector_entry is None else checked_entry(kind, vector_entry, ("reset", "step"))[1]
    if stands_in_for is not None and stands_in_for not in ENVS:
        raise ValueError(f"{kind}: it cannot stand in for {stands_in_for!r}, which is not registered")
    known = gym.registry.get(env_id)
    there = known.entry_point if known is not None else None
    taken = f"{there.__module__}:{there.__qualname__}" if isinstance(there, type) else there
    check_new(kind, None if taken is None else str(taken), text)
    ENVS[env_id] = text, vector, whole(f"{kind}: max_episode_steps", max_episode_steps, 1)
    if stands_in_for is not None:
        STAND_INS[env_id] = stands_in_for
    _tell_gymnasium(env_id)


def _tell_gymnasium(env_id: str) -> None:
    entry, vector, steps = ENVS[env_id]
    known = gym.registry.get(env_id)
    if known is None:
        gym.register(env_id, entry_point=entry, vector_entry_point=vector, max_episode_steps=steps)
    else:  # the same class again, as of a cell of a notebook, perhaps with other numbers
        known.vector_entry_point, known.max_episode_steps = vector, steps


for _id in ENVS:
    _tell_gymnasium(_id)
