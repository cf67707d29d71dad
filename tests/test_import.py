"""What importing the package costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {
    "torch",
    "pybullet",
    "mujoco",
    "stable_baselines3",
    "panda_gym",
    "gymnasium_robotics",
    "scipy",
    "pandas",
}


@pytest.mark.parametrize("module", ["rise_envs", "rise_envs.noise_wrappers", "rise_envs.cost"])
def test_importing_the_environments_loads_numpy_and_gymnasium_only(module):
    script = f"import sys, {module}; print(*({HEAVY} & set(sys.modules)))"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
    assert done.stderr == ""
