"""RISE environments: safe goal reaching among moving obstacles that are only read with noise.

Importing this package registers every ``RISE-*`` id with Gymnasium and costs NumPy and Gymnasium only; the
physics engine is loaded when an environment that needs it is made.
"""

from __future__ import annotations

import gymnasium as gym

from rise_envs.cost import CostFromTuple, CostToTuple, RequireCost, cost_of
from rise_envs.noise import NOISE_MODELS, make_noise
from rise_envs.noise_models import NoiseModel
from rise_envs.noise_wrappers import ObservationNoise, VectorObservationNoise

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
]

# id -> (entry point, vector entry point, steps per episode). A new environment is one file and one line here.
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

# id -> the environment that it models. To train on; results are reported from the one that is modelled.
STAND_INS = {"RISE-SafePandaKinematic-v0": "RISE-SafePanda-v0"}

for _id, (_entry, _vector_entry, _steps) in ENVS.items():
    if _id not in gym.registry:
        gym.register(_id, entry_point=_entry, vector_entry_point=_vector_entry, max_episode_steps=_steps)
