"""An environment of your own without a task description: any Gymnasium environment that says what a step costs.

    python -m benchmarks.run --import docs/examples/calm_pendulum.py --agents cppo random --set cppo.frame=raw

with ``--envs CalmPendulum-v0``, if it alone is wanted.
"""

from __future__ import annotations

from typing import Any

from gymnasium.envs.classic_control.pendulum import PendulumEnv, angle_normalize

from rise_envs import register_env

LIMIT = 5.0  # rad/s


class CalmPendulum(PendulumEnv):
    """Gymnasium's pendulum, to be swung up without turning faster than :data:`LIMIT`."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """A step of the pendulum; what ``info`` says is all that the benchmark judges by."""
        observation, reward, terminated, truncated, info = super().step(action)
        angle, speed = self.state
        spare = LIMIT - abs(float(speed))  # signed distance to what must not be
        upright = bool(abs(angle_normalize(angle)) < 0.2)
        info |= {"cost": 1.0 if spare < 0 else 0.0, "clearance": spare, "is_success": upright}
        return observation, float(reward), terminated, truncated, info


register_env("CalmPendulum-v0", CalmPendulum, max_episode_steps=200)
