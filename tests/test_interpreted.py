"""Compiled functions do what their Python says: the same episodes, to the last bit, without the compiler."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

# A few steps of a small batch, and their sum of everything shown, to the last bit.
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
for _ in range(int(sys.argv[2])):
    action = space.low + rng.random((3, *space.shape)) * (space.high - space.low)
    observation, reward, *_, info = envs.step(action.astype(space.dtype))
    shown += [observation["observation"], observation["obstacle"], reward, info["cost"]]
print(json.dumps([float(x).hex() for part in shown for x in np.ravel(part)]))
"""


# Not the arm: it is built on pointers, which only compiled code has.
@pytest.mark.parametrize("env_id", ["RISE-GroundVehicle-v0"])
def test_compiled_and_interpreted_episodes_have_the_same_bits(env_id):
    shown = []
    for off in ("0", "1"):
        command = [sys.executable, "-c", _SCRIPT, env_id, "3"]
        done = subprocess.run(
            command, capture_output=True, text=True, env={**os.environ, "NUMBA_DISABLE_JIT": off}
        )
        assert done.returncode == 0, done.stderr
        shown.append(json.loads(done.stdout))
    assert shown[0] == shown[1]
