"""From evidence to a belief: a Gaussian over the true reading, whose mean weighs estimates that are right on average.

A network sees the evidence of :mod:`.history` and answers, for positions, velocities and radius, with weights of the
estimates at hand (the reading itself, and those of each memory), a correction and a deviation::

    μ = Σ_j w_j ĉ_j + κ ⊙ σ,   w = softmax(·),   |κ| ≤ 5.

So the network decides whom to trust and how far to be sure, and need not learn to average. On true readings all
estimates agree and σ is small: the belief is then the reading.

Shapes: B rows (each ball of each episode is one), L memories, D dimensions, C = 2D + 1 channels, K inputs.
Everything is seen in the frame that an episode began in: origin at the robot, first axis towards the goal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from rise_agents.belief.history import Evidence, Readings
from rise_envs.task import Task

Array = NDArray[np.float64]

LOG_SIGMA_RANGE = (-6.0, 2.0)  # σ in units of the task's noise scale
_CORRECTION = 5.0
_FINEST = 0.02  # of the noise scale: finer differences look alike


class Frame(NamedTuple):
    """The frame that an episode began in, in the world: origin (B, D), rotation (B, D, D) with its axes as columns."""

    origin: Array
    rotation: Array

    @classmethod
    def of(cls, task: Task, state: Array, goal: Array) -> Frame:
        """That of episodes with the given first states (B, S) and goals (B, D); in space it is turned about z only."""
        origin, _ = task.pose(state)
        x, y = (goal - origin)[:, 0], (goal - origin)[:, 1]
        length = np.hypot(x, y)
        cos, sin = np.where(length > 0, x, 1.0), y
        cos, sin = cos / np.where(length > 0, length, 1.0), sin / np.where(length > 0, length, 1.0)
        zero, one = np.zeros_like(cos), np.ones_like(cos)
        rows = [cos, -sin, sin, cos] if task.dim == 2 else [cos, -sin, zero, sin, cos, zero, zero, zero, one]
        return cls(origin, np.stack(rows, -1).reshape(-1, task.dim, task.dim))

    def point(self, world: Array) -> Array:
        """Points (B, D) of the world in this frame."""
        return self.vector(world - self.origin)

    def vector(self, world: Array) -> Array:
        """Vectors (B, D) of the world in this frame."""
        return (world[:, None] @ self.rotation)[:, 0]

    def readings(self, task: Task, c: Array) -> Readings:
        """Readings (B, C) of the world in this frame."""
        d = task.dim
        return Readings(self.point(c[:, :d]), self.vector(c[:, d : 2 * d]), c[:, 2 * d])

    def to_world(self, c: Array) -> Array:
        """Readings (B, C) in this frame, of the world."""
        d = self.origin.shape[1]
        turned = self.rotation.swapaxes(-1, -2)
        position = (c[:, None, :d] @ turned)[:, 0] + self.origin
        return np.concatenate((position, (c[:, None, d : 2 * d] @ turned)[:, 0], c[:, 2 * d :]), -1)


class Estimates(NamedTuple):
    """Values to choose among: positions (B, 1 + 2L, D), velocities (B, 2 + 2L, D), radii (B, 1 + L, 1)."""

    position: Any
    velocity: Any
    radius: Any


def counts(memories: int) -> tuple[int, int, int]:
    """How many estimates there are of position, velocity and radius."""
    return 1 + 2 * memories, 2 + 2 * memories, 1 + memories


def outputs(memories: int, dim: int) -> int:
    """How many numbers the network answers with."""
    return sum(counts(memories)) + 2 * (2 * dim + 1)


def estimates(reading: Readings, seen: Evidence) -> Estimates:
    """What could be true: the reading, what each memory says, and for the velocity rest."""
    now, velocity = reading.position[:, None], reading.velocity[:, None]
    return Estimates(
        np.concatenate((now, seen.carried, seen.fitted), 1),
        np.concatenate((velocity, seen.velocity, seen.slope, 0.0 * velocity), 1),
        np.concatenate((reading.radius[:, None], seen.radius), 1)[..., None],
    )


def inputs(task: Task, reading: Readings, seen: Evidence, steps: Array, goal: Array) -> Array:
    """What the network sees of rows, (B, K): how estimates differ, how readings scatter, where the ball seems to be.

    Args:
        task: gives the units.
        reading: of this step.
        seen: what is remembered, this step included.
        steps: readings so far, (B,), at least 1.
        goal: in the frame of the episode, (B, D).
    """
    metre, speed, size = _units(task)
    now = reading.position[:, None]
    differences = (
        (seen.carried - now) / metre,
        (seen.fitted - now) / metre,
        (seen.slope - seen.velocity)
        / speed,  # readings of velocity that contradict the motion betray an error
        (seen.velocity - reading.velocity[:, None]) / speed,
        ((seen.radius - reading.radius[:, None]) / size)[..., None],
    )
    flat = [_compressed(part).reshape(len(now), -1) for part in differences]
    scatter = np.log(seen.scatter / np.array([metre, speed, size]) + _FINEST)
    place = seen.carried[:, 0]
    return np.concatenate(
        (
            *flat,
            scatter.reshape(len(now), -1),
            np.log(seen.weight),
            np.log(steps)[:, None],
            reading.position / metre,
            place / metre,
            (place - goal) / metre,
            goal / metre,
            reading.velocity / speed,
            seen.velocity.reshape(len(now), -1) / speed,
            reading.radius[:, None] / size,
            seen.radius / size,
        ),
        -1,
    )


def posterior(answer: Any, offered: Estimates, scale: Any, memories: int) -> tuple[Any, Any]:
    """Mean and deviation of the belief, each (B, C), of NumPy or torch.

    Args:
        answer: the network's, (B, outputs).
        offered: the estimates.
        scale: of the noise at level 1 in each channel, (C,).
        memories: how many: L.
    """
    xp = array_namespace(answer)
    start, means = 0, []
    for count, values in zip(counts(memories), offered, strict=True):
        chosen = answer[:, start : start + count]
        weight = xp.exp(chosen - xp.max(chosen, axis=-1, keepdims=True))
        weight = weight / xp.sum(weight, axis=-1, keepdims=True)
        means.append(xp.sum(weight[..., None] * values, axis=1))
        start += count
    channels = scale.shape[0]
    correction = xp.clip(answer[:, start : start + channels], -_CORRECTION, _CORRECTION)
    log_sigma = xp.clip(answer[:, start + channels :], *LOG_SIGMA_RANGE)
    sigma = xp.exp(log_sigma) * scale
    return xp.concat(means, axis=-1) + correction * sigma, sigma


def _units(task: Task) -> tuple[float, float, float]:
    """The noise scale of positions (m), velocities (m/s) and radius (m); those of the first ball stand for all."""
    scale = task.noise_scale
    return scale[0], scale[task.dim], scale[2 * task.dim]


def _compressed(x: Array) -> Array:
    """Signed logarithm: differences of a hundredth and of ten units can both be told."""
    return np.sign(x) * np.log1p(np.abs(x) / _FINEST)
