"""A Kalman filter (Kalman, 1960) between noisy readings and a policy.

Every coordinate of every ball is a state (p, v), of which each reading measures both::

    p' = p + dt v,   v' = (1 − q) v + w,   w ~ (0, (1 − (1 − q)²) s²),   q = dt / redraw_interval.

Within a step a ball moves in a straight line, and the velocity read is that of the coming step: positions follow
without error. A velocity is kept with probability 1 − q, and with q drawn anew, with mean 0 and the variance
s² = obstacle_speed² / (3 D) of a coordinate. So it is constant but for these draws, and w has the mean and the variance
that they give: of all linear estimators this one then has the least mean squared error. Walls and the goal, which
turn a ball, are left out. Radii are constants. Nothing is known of positions and radii before the first reading;
velocities begin with the law of the draws.

What it assumes of the noise: fresh Gaussian errors in every step and channel, with the deviation that the task
publishes times the noise level, which it is told. Under ``step`` that is the truth. An error that stays (``episode``,
``drift``) it cannot average away: there it smooths nothing, and believes its estimate more than it should.

Shapes: B batch, N obstacles, D dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import State, initial_state
from rise_agents.readings import checked_batch
from rise_envs.settings import finite
from rise_envs.task import Task

Array = NDArray[np.float64]


class KalmanFilter:
    """A policy that is handed filtered readings.

    The state is ``(mean, covariance, steps, *state of the policy)``, each with the batch first: the estimates as a
    reading (B, C); of each coordinate the variance of its position, its covariance with the velocity and the
    velocity's variance, (B, N, D, 3); how many readings there were, (B,). At level 0 readings pass as they are.

    Args:
        policy: an agent or an expert.
        task: says how the obstacles move and how they are measured.
        noise_level: of the readings, known to the filter.

    Raises:
        ValueError: a level that is negative or not finite.
    """

    label = "behind a Kalman filter"

    def __init__(self, policy: Any, task: Task, noise_level: float) -> None:
        self.policy, self.task = policy, task
        self.noise_level = finite("noise_level", noise_level, 0.0)
        self.evaluate_deterministic = getattr(policy, "evaluate_deterministic", True)
        deviation = self.noise_level * np.asarray(task.noise_scale)[None]
        position, velocity, _ = (part[0] ** 2 for part in task.split(deviation))
        self._noise = position, velocity  # variances of the readings, (N, D) each
        self._kept = max(0.0, 1.0 - task.dt / task.redraw_interval)
        self._prior = task.obstacle_speed**2 / (3 * task.dim)

    def initial_state(self, keys: NDArray[np.uint64]) -> State:
        """The state at the start of the episodes with the given keys, (B,)."""
        return (*self._blank(len(keys)), *(initial_state(self.policy, keys) or ()))

    def predict(
        self,
        observation: Mapping[str, Any],
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray, State]:
        """The policy's actions, (A,) or (B, A), on filtered readings; arguments as those of every ``predict``."""
        rows, single = checked_batch(self.task, observation)
        reading = rows["obstacle"]
        mean, covariance, steps = self._blank(len(reading)) if state is None else state[:3]
        if episode_start is not None:
            steps = np.where(np.reshape(episode_start, len(steps)), 0, steps)
        if self.noise_level > 0:
            mean, covariance = self.update(reading, mean, covariance, steps)
            observation = {**observation, "obstacle": mean[0] if single else mean}
        inner = state[3:] if state else ()
        action, inner = self.policy.predict(observation, inner or None, episode_start, deterministic)
        return action, (mean, covariance, steps + 1, *(inner or ()))

    def update(
        self, reading: Array, mean: Array, covariance: Array, steps: NDArray[np.int64]
    ) -> tuple[Array, Array]:
        """What is known of the obstacles after a reading.

        Args:
            reading: (B, C).
            mean: what was known before, (B, C).
            covariance: of each coordinate, (B, N, D, 3).
            steps: readings before this one, (B,); where it is 0, nothing was known.

        Returns:
            Mean and covariance, as given.
        """
        (z_p, z_v, z_r), (p, v, r) = self.task.split(reading), self.task.split(mean)
        first = (steps == 0)[:, None, None]
        (pp, pv, vv), (noise_p, noise_v) = np.moveaxis(covariance, -1, 0), self._noise
        # One step ahead; before the first reading v = 0, and the position is whatever is read.
        p, v = np.where(first, z_p, p + self.task.dt * v), np.where(first, 0.0, self._kept * v)
        dt, keep = self.task.dt, self._kept
        pp, pv, vv = (
            np.where(first, noise_p, pp + 2 * dt * pv + dt**2 * vv),
            np.where(first, 0.0, keep * (pv + dt * vv)),
            np.where(first, self._prior, keep**2 * vv + (1 - keep**2) * self._prior),
        )
        # Errors of both readings are independent, so they can be taken in one after the other. The first position
        # is known as well as it was read, which is what taking it in would say.
        gain_p, gain_v = _gain(pp, noise_p), _ratio(pv, pp + noise_p)
        gain_p, gain_v = np.where(first, 0.0, gain_p), np.where(first, 0.0, gain_v)
        error = z_p - p
        p, v = p + gain_p * error, v + gain_v * error
        pp, pv, vv = (1 - gain_p) * pp, (1 - gain_p) * pv, vv - gain_v * pv
        gain_p, gain_v = _ratio(pv, vv + noise_v), _gain(vv, noise_v)
        error = z_v - v
        p, v = p + gain_p * error, v + gain_v * error
        pp, pv, vv = pp - gain_p * pv, (1 - gain_v) * pv, (1 - gain_v) * vv
        r = r + (z_r - r) / (steps[:, None] + 1.0)  # the mean of all readings
        estimate = np.concatenate((p, v, r[..., None]), -1).reshape(reading.shape)
        return estimate, np.stack((pp, pv, vv), -1)

    def _blank(self, batch: int) -> tuple[NDArray, ...]:
        n, dim = self.task.n_obstacles, self.task.dim
        reading = self.task.widths["obstacle"]
        return np.zeros((batch, reading)), np.zeros((batch, n, dim, 3)), np.zeros(batch, np.int64)


def _gain(variance: Array, noise: Array) -> Array:
    """How far an estimate follows a reading of itself, in [0, 1]; 1 where the reading is exact."""
    total = variance + noise
    return np.where(total > 0, variance / np.where(total > 0, total, 1.0), 1.0)


def _ratio(covariance: Array, total: Array) -> Array:
    """How far an estimate follows the reading of another one; 0 where that is known exactly."""
    return np.where(total > 0, covariance / np.where(total > 0, total, 1.0), 0.0)
