"""What the environments of the Panda share: arguments, spaces, goal API, description."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import goals
from rise_envs.panda_scene import DEFAULTS, Params
from rise_envs.settings import as_settings, flag
from rise_envs.task import Task

Array = NDArray[np.float64]

STEP = 0.05  # m of commanded displacement per unit of action
# One step of the hand, fitted by least squares to roll-outs of an expert (5 mm root mean square):
# displacement = FOLLOW·command + KEEP·velocity·dt. Gravity and saturating motors couple x and z.
FOLLOW = np.array([[0.65, 0.0, -0.13], [0.0, 0.67, 0.0], [0.13, 0.0, 0.38]])
KEEP = np.array([[0.31, 0.0, 0.16], [0.0, 0.29, 0.0], [-0.08, 0.0, 0.65]])


class PandaTask(goals.GoalAPI):
    """Mixed into the environments: see :class:`rise_envs.safe_panda.SafePandaEnv` for all meanings."""

    def __init__(
        self, reward_type: str, terminate_on_collision: bool, params: Params | Mapping[str, Any]
    ) -> None:
        self.reward_type = goals.check_reward_type(reward_type)
        self.terminate_on_collision = flag("terminate_on_collision", terminate_on_collision)
        self.params = as_settings(Params, params)

    @staticmethod
    def task(params: Params | Mapping[str, Any] = DEFAULTS, **_: Any) -> Task:
        """The meaning of the numbers, for agents (see :class:`rise_envs.task.Task`).

        The reading noise at level 1 has the ratio to the sphere's size that the vehicle's task has.
        """
        p = as_settings(Params, params)
        scale = tuple(np.repeat(p.noise_scale, (3, 3, 1)).tolist())
        return Task(
            dim=3,
            n_obstacles=1,
            noise_scale=scale,
            robot_radius=p.hand_radius,
            goal_radius=p.goal_radius,
            dt=p.dt,
            max_speed=p.max_hand_speed,
            pose=_pose,
            body_state=tuple(range(13)),
            state_size=13,
            obstacle_speed=p.max_speed,
            redraw_interval=p.redraw_interval,
            moved=_moved,
            body=_body,
        )

    @property
    def noise_scale(self) -> dict[str, Array]:
        """Standard deviation of the reading at noise level 1, per channel."""
        return {"obstacle": np.array(self.task(self.params).noise_scale)}

    @property
    def noise_channels(self) -> dict[str, dict[str, tuple[int, ...]]]:
        """The channels of each group that noise can be limited to."""
        return {"obstacle": self.task(self.params).noise_channels}


def _pose(state: Array) -> tuple[Array, Array]:
    """The hand's frame: its position, axes parallel to the world's."""
    return state[..., :3], np.broadcast_to(np.eye(3), (*state.shape[:-1], 3, 3))


def _body(state: Array) -> tuple[Array, Array]:
    """The capsules of the arms at the joint angles of the states."""
    from rise_envs import panda_kinematics  # numba is loaded by those who ask only

    return panda_kinematics.capsules(state[..., 6:13])


def _moved(state: Array, action: Array, dt: float) -> Array:
    """Where the hand is one step after actions, by the linear model of this file; targets stay above the table."""
    hand, velocity = state[..., None, :3], state[..., None, 3:6]
    command = STEP * action
    command[..., 2] = np.maximum(command[..., 2], -hand[..., 2])
    return hand + command @ FOLLOW.T + dt * velocity @ KEEP.T


def make_spaces(p: Params) -> tuple[spaces.Dict, spaces.Box]:
    """Observation and action space of one arm."""

    def box(low: Any, high: Any) -> spaces.Box:
        return spaces.Box(np.array(low, np.float64), np.array(high, np.float64), dtype=np.float64)

    state = np.repeat([2.0, 10.0, 2 * np.pi], (3, 3, 7))
    speed = np.full(3, p.max_speed)
    observation = spaces.Dict(
        observation=box(-state, state),
        achieved_goal=box(-state[:3], state[:3]),
        desired_goal=box(p.goal_low, p.goal_high),
        obstacle=box((*p.sphere_low, *-speed, p.radius[0]), (*p.sphere_high, *speed, p.radius[1])),
    )
    return observation, spaces.Box(-1.0, 1.0, (3,), np.float32)
