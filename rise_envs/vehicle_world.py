"""The world of ``RISE-GroundVehicle-v0``: its constants, and its episodes as arrays of NumPy or torch.

The single and the batched environment both stand on this file, so they cannot differ.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rise_envs.obstacles import Motion
from rise_envs.settings import check_fields
from rise_envs.vehicle_dynamics import MAX_ATTEMPTS, Constants

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Params:
    """Every constant of the task, in SI units.

    Attributes:
        dt: duration of a step (s).
        v_min: least linear velocity (m/s).
        v_max: greatest linear velocity (m/s).
        omega_max: greatest angular velocity either way (rad/s).
        robot_radius: of the vehicle (m).
        goal_radius: distance between vehicle and goal that counts as reached (m).
        arena_half: start and goal lie in the square [−arena_half, arena_half]² (m).
        goal_distance: range of the distance between start and goal (m).
        heading_spread: start heading off the goal's direction, at most (rad).
        obstacle_radius: range of a disc's radius (m).
        obstacle_speed: greatest speed of a disc (m/s).
        redraw_interval: mean time between two draws of a disc's velocity (s).
        obstacle_along: where a disc starts, a range of shares of the way from start to goal.
        obstacle_offset: to either side of the straight way, at most (m).
        obstacle_half: centres stay in the square [−obstacle_half, obstacle_half]² (m).
        goal_gap: discs keep this far off the goal point (m): the whole goal region stays free.
        start_margin: least clearance over the discs' path in the first ``start_horizon`` seconds (m).
        start_horizon: of that clearance (s).
    """

    dt: float = 0.1
    v_min: float = 0.0
    v_max: float = 2.5
    omega_max: float = 1.5
    robot_radius: float = 0.5
    goal_radius: float = 0.75
    arena_half: float = 10.0
    goal_distance: tuple[float, float] = (12.5, 20.0)
    heading_spread: float = np.pi / 3
    obstacle_radius: tuple[float, float] = (0.75, 2.0)
    obstacle_speed: float = 1.0
    redraw_interval: float = 2.0
    obstacle_along: tuple[float, float] = (0.35, 0.75)
    obstacle_offset: float = 2.5
    obstacle_half: float = 12.0
    goal_gap: float = 1.5
    start_margin: float = 1.0
    start_horizon: float = 1.0

    def __post_init__(self) -> None:
        check_fields(type(self), vars(self))
        for field in fields(self):
            value = np.atleast_1d(getattr(self, field.name))
            low = -np.inf if field.name == "v_min" else 0.0
            if not np.isfinite(value).all() or value[0] < low or (np.diff(value) < 0).any():
                raise ValueError(
                    f"Params.{field.name} must be finite, not negative and in rising order, "
                    f"got {getattr(self, field.name)!r}"
                )
        if min(self.dt, self.goal_radius, self.redraw_interval) <= 0 or self.v_min > self.v_max:
            raise ValueError(f"dt, goal_radius, redraw_interval must be > 0 and v_min ≤ v_max, got {self}")
        if self.goal_distance[0] <= self.goal_radius:
            raise ValueError(f"goal_distance must exceed goal_radius, or episodes start at the goal: {self}")
        if self.omega_max * self.dt > 1:
            raise ValueError(f"omega_max · dt must be ≤ 1: no step turns by more than 1 rad, got {self}")

    @property
    def motion(self) -> Motion:
        """How the discs move."""
        high = (self.obstacle_half, self.obstacle_half)
        low = (-self.obstacle_half, -self.obstacle_half)
        return Motion(self.dt, self.obstacle_speed, self.redraw_interval, low, high, self.goal_gap)

    def constants(self, sparse: bool = False) -> Constants:
        """The task as plain numbers, for what is written by coordinates."""
        values: dict[str, Any] = {
            name: tuple(map(float, value)) if isinstance(value, tuple) else float(value)
            for name, value in vars(self).items()
            if name in Constants._fields
        }
        per_goal_radius, rules = 1.0 / self.goal_radius, self.motion.rules
        return Constants(**values, per_goal_radius=per_goal_radius, rules=rules, sparse=sparse)


@dataclass
class World:
    """The true state of B episodes: vehicle, goal and N discs, as arrays of NumPy or torch."""

    state: Any  # (x, y, θ), (B, 3)
    goal: Any  # (B, 2)
    disc: Any  # readings (px, py, vx, vy, r), the velocity that of the coming step, (B, N, 5)
    key: Any  # of the discs' motion, (B,) int64
    step: Any  # steps taken, (B,) int64

    @property
    def position(self) -> Any:
        """Centres of the discs (m), (B, N, 2)."""
        return self.disc[..., :2]

    @property
    def velocity(self) -> Any:
        """Velocities of the discs in the coming step (m/s), (B, N, 2)."""
        return self.disc[..., 2:4]

    @property
    def radius(self) -> Any:
        """Radii of the discs (m), (B, N)."""
        return self.disc[..., 4]

    def copy(self) -> World:
        """A world that shares nothing with this one."""
        return World(*(copied(array) for array in vars(self).values()))


class Outcome(NamedTuple):
    """What a step of B episodes shows. No array is part of the world or of another."""

    state: Any  # (x, y, θ) after the step, (B, 3)
    achieved: Any  # (x, y), (B, 2)
    goal: Any  # (B, 2)
    obstacle: Any  # readings, (B, 5N)
    previous: Any  # (x, y) before the step, (B, 2)
    clearance: Any  # least signed distance within the step (m), (B,)
    cost: Any  # (B,)
    reward: Any  # (B,)
    reached: Any  # whether the goal is reached, (B,) bool
    terminated: Any  # (B,) bool
    truncated: Any  # (B,) bool


def sample_starts(
    base: Any, number: Any, n_obstacles: int, constants: Constants, dynamics: Any
) -> tuple[World, Any]:
    """Fair starts, one for each episode, each a pure function of where it stands in which stream.

    Args:
        base: of :func:`rise_envs.streams.seed_bases`, (B,).
        number: of the episode since seeding, (B,) int64.
        n_obstacles: how many balls: N.
        constants: the task.
        dynamics: :mod:`rise_envs.vehicle_compiled` or :mod:`rise_envs.vehicle_arrays`.

    Returns:
        The world, and the clearances (m), (B,).

    Raises:
        ValueError: the parameters leave no room for a fair start.
    """
    state, goal, disc, motion, clearance, fair = dynamics.begin(base, number, n_obstacles, constants)
    check_fair(fair, n_obstacles, constants)
    return World(state, goal, disc, motion, motion * 0), clearance


def check_fair(fair: bool, n_obstacles: int, constants: Constants) -> None:
    """Raise ``ValueError`` if no fair start was found."""
    if not fair:
        raise ValueError(
            f"no fair start in {MAX_ATTEMPTS} draws for n_obstacles={n_obstacles} and {constants}"
        )


def observe(world: World) -> dict[str, Any]:
    """The true observation of B episodes (every array is the caller's own)."""
    return {
        "observation": copied(world.state),
        "achieved_goal": copied(world.state[:, :2]),
        "desired_goal": copied(world.goal),
        "obstacle": copied(world.disc).reshape(len(world.state), -1),
    }


def copied(array: Any) -> Any:
    """A copy of an array of NumPy or torch."""
    return array.copy() if isinstance(array, np.ndarray) else array.clone()
