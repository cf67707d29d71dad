"""Where an episode of the Panda task starts and how its sphere moves: numbers and chance, no engine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rise_envs import obstacles, streams

Array = NDArray[np.float64]
Point = tuple[float, float, float]

_BLOCK = 64  # steps whose redraws of the velocity are drawn together
_GOALS, _SPHERES = 8, 16  # candidates drawn together: goals, and spheres for each
_MOST = 2000  # goals tried before giving up; fair parameters need a handful
_SIZE = 4 + 4 * _SPHERES  # draws for a goal and its spheres


@dataclass(frozen=True)
class Params:
    """The numbers of the task, in SI units; the arm's base is at (-0.6, 0, 0), the table top at z = 0.

    Attributes:
        goal_radius: distance between hand and goal that counts as reached (m), panda-gym's tolerance.
        goal_low: lower corner of the box that goals are drawn from (m).
        goal_high: upper corner of that box (m).
        goal_min_distance: least distance of a goal from the hand at the start (m).
        reach: goals farther than this from the shoulder are not offered (m): the hand, held
            downwards, cannot get there.
        radius: range of the sphere's radius (m).
        max_speed: greatest speed of the sphere (m/s).
        redraw_interval: mean time between two draws of the sphere's velocity (s).
        sphere_low: lower corner of the box that the sphere's centre stays in (m).
        sphere_high: upper corner of that box (m).
        goal_gap: least distance between the sphere's surface and the goal (m), so that the hand fits there.
        placed: range of where the sphere starts along the line from hand to goal, as a fraction of it.
        max_offset: greatest offset of that place along each axis (m).
        start_clearance: least clearance of the arm from the sphere at the start (m) ...
        start_time: ... and for this long, if nobody moves but the sphere (s).
        max_hand_speed: about the greatest speed of the hand (m/s), a scale for agents.
        hand_radius: radius of the ball around the hand's reference point that stands for the hand (m).
        noise_scale: standard deviation of the reading's position (m), velocity (m/s) and radius (m) at noise
            level 1: the ratio of noise to obstacle size that the vehicle task has.
    """

    goal_radius: float = 0.05
    goal_low: tuple[float, float, float] = (-0.35, -0.4, 0.05)
    goal_high: tuple[float, float, float] = (0.15, 0.4, 0.5)
    goal_min_distance: float = 0.25
    reach: float = 0.70
    radius: tuple[float, float] = (0.05, 0.10)
    max_speed: float = 0.15
    redraw_interval: float = 1.5
    sphere_low: tuple[float, float, float] = (-0.35, -0.5, 0.05)
    sphere_high: tuple[float, float, float] = (0.25, 0.5, 0.6)
    goal_gap: float = 0.12
    placed: tuple[float, float] = (0.35, 0.75)
    max_offset: float = 0.06
    start_clearance: float = 0.04
    start_time: float = 0.2
    max_hand_speed: float = 2.0
    hand_radius: float = 0.05
    noise_scale: tuple[float, float, float] = (0.05, 0.05, 0.02)

    @property
    def dt(self) -> float:
        """Duration of a control step (s): panda-gym's 20 substeps of 2 ms."""
        return 0.04

    @property
    def motion(self) -> obstacles.Motion:
        """How the sphere moves."""
        return obstacles.Motion(
            dt=self.dt,
            max_speed=self.max_speed,
            redraw_interval=self.redraw_interval,
            low=self.sphere_low,
            high=self.sphere_high,
            goal_gap=self.goal_gap,
        )


DEFAULTS = Params()


def reachable(goal: Array, params: Params) -> NDArray[np.bool_]:
    """Whether the arm, hand held downwards, reaches the goals (..., 3): their distance from its shoulder."""
    across = np.hypot(goal[..., 0] + 0.6, goal[..., 1]) - 0.088
    return np.hypot(across, goal[..., 2] - 0.121) <= params.reach


def candidates(
    key: NDArray[np.uint64], hand: Array, start_clearance: float, params: Params
) -> Iterator[tuple[Array, float, Array]]:
    """Fair places to start from, as far as can be said without the arm.

    Args:
        key: the episode's key for this purpose, (1,).
        hand: position of the hand (m), (3,).
        start_clearance: least distance between the hand and the sphere's surface (m).
        params: the task.

    Yields:
        A goal (3,), the radius of the sphere and its centre (3,). A goal comes with up to ``_SPHERES`` centres
        before the next is tried, so that goals spread as drawn.
    """
    low, high = np.array(params.goal_low), np.array(params.goal_high)
    smallest, largest = params.radius
    for first in range(0, _MOST, _GOALS):
        u = streams.uniform(key, _SIZE * (first + np.arange(_GOALS)[:, None]) + np.arange(_SIZE))
        goals = low + (high - low) * u[:, :3]
        fit = np.linalg.norm(goals - hand, axis=1) >= params.goal_min_distance
        for row in np.flatnonzero(fit & reachable(goals, params)):
            goal, radius = goals[row], float(smallest + (largest - smallest) * u[row, 3])
            v = u[row, 4:].reshape(_SPHERES, 4)
            along = params.placed[0] + (params.placed[1] - params.placed[0]) * v[:, :1]
            centers = hand + along * (goal - hand) + params.max_offset * (2 * v[:, 1:] - 1)
            fair = (centers >= params.sphere_low).all(1) & (centers <= params.sphere_high).all(1)
            fair &= np.linalg.norm(centers - goal, axis=1) >= radius + params.goal_gap
            fair &= np.linalg.norm(centers - hand, axis=1) >= radius + start_clearance
            for center in centers[fair]:
                yield goal, radius, center


class Sphere:
    """One moving ball of `rise_envs.obstacles`, in plain numbers: the same motion at a tenth of the cost.

    Args:
        center: centre at the start (m), (3,).
        radius: radius (m).
        goal: the goal that the ball keeps off (m), (3,).
        velocity: velocity wanted at the start (m/s), (3,).
        key: the key of its motion, (1,).
        motion: how it moves.

    Attributes:
        center: centre now (m).
        velocity: velocity in the coming step (m/s).
        radius: radius (m).
    """

    def __init__(
        self,
        center: Array,
        radius: float,
        goal: Array,
        velocity: Array,
        key: NDArray[np.uint64],
        motion: obstacles.Motion,
    ) -> None:
        self.center: Point = tuple(center.tolist())
        self.radius = radius
        self._goal, self._key, self._motion = goal, key, motion
        self._steps = 0
        self._redraws: list[list[float]] = []
        self.velocity = self._turned(tuple(velocity.tolist()))

    @property
    def reading(self) -> Array:
        """The true reading c = (position, velocity, radius), (7,)."""
        return np.array((*self.center, *self.velocity, self.radius))

    def advance(self) -> None:
        """Move on by one control step and settle the velocity of the next."""
        self.center = self._ahead(self.velocity)
        self._steps += 1
        if self._steps > len(self._redraws):
            # The coin tosses of many steps cost no more than those of one: NaN where the velocity stays.
            steps = np.arange(len(self._redraws), len(self._redraws) + _BLOCK) + 1
            stays = np.full((_BLOCK, 1, 3), np.nan)
            self._redraws += obstacles.redraw(stays, self._key, steps, self._motion)[:, 0].tolist()
        x, y, z = self._redraws[self._steps - 1]
        self.velocity = self._turned(self.velocity if math.isnan(x) else (x, y, z))

    def _ahead(self, velocity: Point) -> Point:
        (x, y, z), (u, v, w), dt = self.center, velocity, self._motion.dt
        return x + dt * u, y + dt * v, z + dt * w

    def _turned(self, velocity: Point) -> Point:
        """``velocity``, turned if the coming step would leave the box or enter the free ball at the goal."""
        ahead, m = self._ahead(velocity), self._motion
        inside = all(low <= x <= high for low, x, high in zip(m.low, ahead, m.high, strict=True))
        if inside and math.dist(ahead, self._goal) >= self.radius + m.goal_gap:
            return velocity
        kept = obstacles.keep_inside(
            np.array([[self.center]]), np.array([[velocity]]), np.array([[self.radius]]), self._goal[None], m
        )
        return tuple(kept[0, 0].tolist())
