"""Compiled functions do what their Python says: the same episodes without the compiler."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

# A few steps of a small batch; all that is shown, number by number.
_SCRIPT = """
import json, sys, warnings
import gymnasium as gym, numpy as np
import rise_envs
warnings.simplefilter("ignore", RuntimeWarning)  # whole numbers that wrap around, which is what they are for
envs = gym.make_vec(sys.argv[1], 3, vectorization_mode="vector_entry_point")
observation, _ = envs.reset(seed=[1, 2, 3])
rng = np.random.default_rng(0)
space = envs.single_action_space
shown = [observation["observation"], observation["obstacle"]]
for _ in range(4):
    action = space.low + rng.random((3, *space.shape)) * (space.high - space.low)
    observation, reward, *_, info = envs.step(action.astype(space.dtype))
    shown += [observation["observation"], observation["obstacle"], reward, info["cost"], info["clearance"]]
print(json.dumps([float(x).hex() for part in shown for x in np.ravel(part)]))
"""


@pytest.mark.parametrize(
    ("env_id", "tolerance"),
    [
        ("RISE-GroundVehicle-v0", 0.0),
        # Its lanes count in single precision, and the compiler may put their sums in another order.
        ("RISE-SafePandaKinematic-v0", 2e-5),
    ],
)
def test_compiled_and_interpreted_episodes_are_the_same(env_id, tolerance):
    shown = []
    for off in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "-c", _SCRIPT, env_id],
            capture_output=True,
            text=True,
            env={**os.environ, "NUMBA_DISABLE_JIT": off},
        )
        assert done.returncode == 0, done.stderr
        shown.append([float.fromhex(x) for x in json.loads(done.stdout)])
    np.testing.assert_allclose(shown[0], shown[1], rtol=0, atol=tolerance)


_EXPERT = """
import json, sys, warnings
import gymnasium as gym, numpy as np
import rise_envs
from rise_agents.experts import make_expert
warnings.simplefilter("ignore", RuntimeWarning)
envs = gym.make_vec(sys.argv[1], 2, vectorization_mode="vector_entry_point")
observation, _ = envs.reset(seed=[1, 2])
# The obstacle in the way, so that there is something to avoid.
ahead = 0.6 * observation["achieved_goal"] + 0.4 * observation["desired_goal"]
observation["obstacle"][:, : ahead.shape[1]] = ahead
action, _ = make_expert(sys.argv[2], sys.argv[1]).predict(observation)
print(json.dumps([float(x).hex() for x in np.ravel(action)]))
"""


@pytest.mark.parametrize(
    ("env_id", "expert"),
    [
        ("RISE-GroundVehicle-v0", "cbf"),
        ("RISE-SafePandaKinematic-v0", "cbf"),
        ("RISE-SafePandaKinematic-v0", "mpc"),
    ],
)
def test_compiled_and_interpreted_experts_act_the_same(env_id, expert):
    acted = []
    for off in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "-c", _EXPERT, env_id, expert],
            capture_output=True,
            text=True,
            env={**os.environ, "NUMBA_DISABLE_JIT": off},
        )
        assert done.returncode == 0, done.stderr
        acted.append([float.fromhex(x) for x in json.loads(done.stdout)])
    np.testing.assert_allclose(acted[0], acted[1], rtol=0, atol=1e-6)
