"""The world of ``RISE-GroundVehicle-v0``: its constants, its fair starts and its dynamics, pure and batched.

The single and the batched environment both stand on this file, so they cannot differ.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_envs import geometry, obstacles, streams
from rise_envs.obstacles import Motion

Array = NDArray[np.float64]
MAX_ATTEMPTS = 2_000


@dataclass(frozen=True)
class Params:
    """Every constant of the task, in SI units."""

    dt: float = 0.1
    v_min: float = 0.0
    v_max: float = 2.5
    omega_max: float = 1.5
    robot_radius: float = 0.5
    goal_radius: float = 0.75
    arena_half: float = 10.0  # start and goal lie in the square [−arena_half, arena_half]²
    goal_distance: tuple[float, float] = (12.5, 20.0)
    heading_spread: float = np.pi / 3  # start heading off the goal's direction, at most
    obstacle_radius: tuple[float, float] = (0.75, 2.0)
    obstacle_speed: float = 1.0
    redraw_interval: float = 2.0  # mean time between two draws of a disc's velocity
    obstacle_along: tuple[float, float] = (0.35, 0.75)  # share of the way from start to goal
    obstacle_offset: float = 2.5  # to either side of the straight way, at most
    obstacle_half: float = 12.0  # centres stay in the square [−obstacle_half, obstacle_half]²
    goal_gap: float = 1.5  # discs keep this far off the goal point: the whole goal region stays free
    start_margin: float = 1.0  # least clearance over the discs' path in the first start_horizon seconds
    start_horizon: float = 1.0

    def __post_init__(self) -> None:
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

    @property
    def motion(self) -> Motion:
        """How the discs move."""
        high = (self.obstacle_half, self.obstacle_half)
        low = (-self.obstacle_half, -self.obstacle_half)
        return Motion(self.dt, self.obstacle_speed, self.redraw_interval, low, high, self.goal_gap)


@dataclass
class World:
    """The true state of B episodes: vehicle, goal and N discs. Arrays are replaced, never written into."""

    state: Array  # (B, 3)
    goal: Array  # (B, 2)
    position: Array  # (B, N, 2)
    velocity: Array  # (B, N, 2), in the coming step
    radius: Array  # (B, N)
    key: NDArray[np.uint64]  # (B,)
    step: NDArray[np.int64]  # (B,)

    def merge(self, other: World, rows: NDArray[np.bool_]) -> World:
        """This world with the given ``rows`` (B,) bool taken from ``other``, which holds only those."""
        merged = {name: array.copy() for name, array in vars(self).items()}
        for name, array in merged.items():
            array[rows] = getattr(other, name)
        return World(**merged)


def _propose(keys: NDArray[np.uint64], attempt: int, n: int, p: Params) -> tuple[World, NDArray[np.bool_]]:
    """One candidate start per key (B,), and which candidates are valid."""
    size = 5 + 3 * n
    u = streams.uniform(keys[:, None], attempt * size + np.arange(size))

    def draw(column: Any, low: float, high: float) -> Array:
        return low + (high - low) * u[:, column]

    start = draw([0, 1], -p.arena_half, p.arena_half)
    course, distance = draw(2, -np.pi, np.pi), draw(3, *p.goal_distance)
    ahead = np.stack((np.cos(course), np.sin(course)), -1)
    goal = start + distance[:, None] * ahead
    heading = geometry.wrap_angle(course + draw(4, -p.heading_spread, p.heading_spread))

    along = draw(slice(5, 5 + n), *p.obstacle_along) * distance[:, None]
    aside = draw(slice(5 + n, 5 + 2 * n), -p.obstacle_offset, p.obstacle_offset)
    radius = draw(slice(5 + 2 * n, 5 + 3 * n), *p.obstacle_radius)
    left = np.stack((-ahead[:, 1], ahead[:, 0]), -1)
    position = start[:, None] + along[..., None] * ahead[:, None] + aside[..., None] * left[:, None]
    velocity = obstacles.draw_velocity(streams.split(keys, 2), attempt, n, p.motion)
    velocity = obstacles.keep_inside(position, velocity, radius, goal, p.motion)

    offset = position - start[:, None]
    swept = geometry.segment_distance(offset, offset + p.start_horizon * velocity) - radius - p.robot_radius
    valid = (np.abs(goal) <= p.arena_half).all(-1)
    valid &= (swept >= p.start_margin).all(-1)
    valid &= (np.abs(position) <= p.obstacle_half).all((-1, -2))
    valid &= (np.linalg.norm(position - goal[:, None], axis=-1) >= radius + p.goal_gap).all(-1)
    state = np.concatenate((start, heading[:, None]), -1)
    return World(state, goal, position, velocity, radius, keys, np.zeros(len(keys), np.int64)), valid


def sample_starts(keys: NDArray[np.uint64], n_obstacles: int, params: Params) -> World:
    """Fair starts, one for each episode key (B,), each a pure function of its key.

    Raises:
        ValueError: the parameters leave no room for a fair start.
    """
    draws = streams.split(keys, 0)
    world, valid = _propose(draws, 0, n_obstacles, params)
    for attempt in range(1, MAX_ATTEMPTS):
        if valid.all():
            return replace(world, key=keys)
        missing = ~valid
        candidate, valid[missing] = _propose(draws[missing], attempt, n_obstacles, params)
        world = world.merge(candidate, missing)
    raise ValueError(f"no fair start in {MAX_ATTEMPTS} draws for n_obstacles={n_obstacles} and {params}")


def advance(world: World, action: Array, params: Params) -> tuple[World, Array]:
    """One step of the task's dynamics.

    Args:
        world: B episodes.
        action: (v, ω) inside the bounds, (B, 2).
        params: constants of the task.

    Returns:
        The world after the step, and the least clearance (m) over the step and all discs, (B,).
    """
    clearance = geometry.swept_clearance(
        world.state, action, world.position, world.velocity, world.radius, params.dt, params.robot_radius
    )
    position, step = world.position + params.dt * world.velocity, world.step + 1
    velocity = obstacles.redraw(world.velocity, streams.split(world.key, 1), step, params.motion)
    velocity = obstacles.keep_inside(position, velocity, world.radius, world.goal, params.motion)
    state = geometry.unicycle(world.state, action, params.dt)
    moved = World(state, world.goal, position, velocity, world.radius, world.key, step)
    return moved, clearance.min(-1)


def start_clearance(world: World, params: Params) -> Array:
    """Clearance (B,) at an instant, in m."""
    distance = np.linalg.norm(world.position - world.state[:, None, :2], axis=-1)
    return (distance - world.radius - params.robot_radius).min(-1)


def observe(world: World) -> dict[str, Array]:
    """The true observation of B episodes (every array is the caller's own)."""
    return {
        "observation": world.state.copy(),
        "achieved_goal": world.state[:, :2].copy(),
        "desired_goal": world.goal.copy(),
        "obstacle": obstacles.readings(world.position, world.velocity, world.radius),
    }
