"""What an agent may know of an environment without making it: the meaning of its numbers.

Every RISE environment class has a static method ``task(**kwargs) -> Task``. Agents, experts, noise wrappers
and reports read this description, so that none of them names an environment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rise_envs.registry import find_class

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """The description of one goal-reaching task among moving balls.

    Shapes: B batch, S state, N obstacles, D dimensions, C = N·(2D + 1) reading channels.

    Attributes:
        dim: D, the dimension of positions: 2 or 3.
        n_obstacles: how many balls: N.
        noise_scale: standard deviation of each reading channel at noise level 1, (C,), in SI units.
        robot_radius: radius (m) of the ball around the reference point that stands for the robot.
        goal_radius: distance (m) between reference point and goal that counts as reached.
        dt: duration of a control step (s).
        max_speed: greatest speed of the reference point (m/s), the scale of its motion.
        pose: maps states (B, S) to the robot's frame: position (B, D) and rotation (B, D, D), whose columns
            are the frame's axes in world coordinates.
        body_state: columns of the state that keep their meaning when the world is seen from the robot.
        state_size: S, the number of them in a state.
        obstacle_speed: greatest speed of a ball (m/s): speeds are drawn from U[0, obstacle_speed], directions
            uniformly.
        redraw_interval: mean time between two draws of a ball's velocity (s).
        moved: maps states (B, S), K actions for each (B, K, A) and ``dt`` to where the reference point is one step
            later, (B, K, D): the robot's kinematics, for who may use them.
        body: for a robot that is more than a ball, maps states (B, S) to the K capsules that it consists of: both
            ends of their axes (m), (B, K, 2, D), and their radii (m), (K,). For who draws it.
    """

    dim: int
    n_obstacles: int
    noise_scale: tuple[float, ...]
    robot_radius: float
    goal_radius: float
    dt: float
    max_speed: float
    pose: Callable[[Array], tuple[Array, Array]]
    body_state: tuple[int, ...]
    state_size: int
    obstacle_speed: float
    redraw_interval: float
    moved: Callable[[Array, Array, float], Array]
    body: Callable[[Array], tuple[Array, Array]] | None = None

    @cached_property
    def widths(self) -> dict[str, int]:
        """How many numbers each part of an observation has that a policy reads."""
        reading = self.n_obstacles * (2 * self.dim + 1)
        return {"observation": self.state_size, "desired_goal": self.dim, "obstacle": reading}

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of these parts in a single observation."""
        return {key: (width,) for key, width in self.widths.items()}

    @cached_property
    def noise_channels(self) -> dict[str, tuple[int, ...]]:
        """Which numbers of a reading are positions, velocities and radii, which noise can be limited to."""
        parts = self.split(np.arange(self.widths["obstacle"], dtype=np.float64)[None])
        return {
            name: tuple(part.astype(int).ravel().tolist())
            for name, part in zip(("position", "velocity", "radius"), parts, strict=True)
        }

    def split(self, reading: Array) -> tuple[Array, Array, Array]:
        """Readings (B, C) as positions (B, N, D), velocities (B, N, D) and radii (B, N)."""
        c = reading.reshape(-1, self.n_obstacles, 2 * self.dim + 1)
        return c[..., : self.dim], c[..., self.dim : 2 * self.dim], c[..., -1]


def env_class(env_id: str) -> Any:
    """The class behind a registered environment id, found without making an environment.

    Raises:
        gymnasium.error.Error: the id is not registered.
        ValueError: it is registered with something other than a class or a ``module:Class`` string.
    """
    entry = gym.spec(env_id).entry_point
    if isinstance(entry, str):
        entry = find_class(entry)
    if not isinstance(entry, type):
        raise ValueError(f"environment {env_id!r}: its entry point {entry!r} is no class")
    return entry


def metadata_of(env_id: str) -> dict[str, Any]:
    """The ``metadata`` of a registered environment: its class's, or where that has none, as a wrapper's, its own."""
    metadata = env_class(env_id).metadata
    if isinstance(metadata, dict):
        return metadata
    env = gym.make(env_id)
    env.close()
    return env.metadata


def describes_task(env_id: str) -> bool:
    """Whether a registered environment publishes a task description: without one, only its numbers are known."""
    return hasattr(env_class(env_id), "task")


def task_of(env_id: str, **kwargs: Any) -> Task:
    """The task description of a registered environment (``kwargs`` as for ``gymnasium.make``).

    Raises:
        ValueError: the environment publishes no task description.
    """
    if not describes_task(env_id):
        raise ValueError(f"environment {env_id!r} describes no task: give its class a static method task()")
    return env_class(env_id).task(**kwargs)
