"""An environment of your own, with a task description, and an expert for it.

python -m benchmarks.run --import docs/examples/omni_base.py --envs OmniBase-v0 --expert barrier
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rise_agents.experts import register_expert
from rise_agents.experts.planar_qp import nearest_point
from rise_agents.readings import checked_batch
from rise_envs import goals, register_env, streams
from rise_envs.actions import finite_action
from rise_envs.episodes import EpisodeStreams, check_reset
from rise_envs.geometry import segment_distance
from rise_envs.obstacles import Motion, draw_velocity, keep_inside, readings, redraw
from rise_envs.task import Task


@dataclass(frozen=True)
class Params:
    """Every constant, in SI units."""

    dt: float = 0.1
    axis_speed: float = 1.5
    robot_radius: float = 0.3
    goal_radius: float = 0.3
    obstacle_half: float = 5.0  # the disc's centre stays in the square [−obstacle_half, obstacle_half]²
    obstacle_speed: float = 0.6
    redraw_interval: float = 2.0  # mean time between two draws of the disc's velocity
    goal_gap: float = 0.7  # the disc keeps off the goal

    @property
    def motion(self) -> Motion:
        """How the disc moves."""
        corner = (self.obstacle_half, self.obstacle_half)
        low = (-self.obstacle_half, -self.obstacle_half)
        return Motion(self.dt, self.obstacle_speed, self.redraw_interval, low, corner, self.goal_gap)


P = Params()


class OmniBase(goals.GoalAPI, gym.Env):
    """A base on omnidirectional wheels crosses a hall of 10 m, past a disc that wanders in its way.

    State (x, y) in m, action (vx, vy) in m/s, reading (px, py, vx, vy, r) of the disc.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    params, reward_type, terminate_on_collision = P, "dense", False
    noise_scale = {"obstacle": np.full(5, 0.3)}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        far, half, speed = np.full(2, 20.0), np.full(2, P.obstacle_half), np.full(2, P.obstacle_speed)
        self.observation_space = spaces.Dict(
            observation=spaces.Box(-far, far, dtype=np.float64),
            achieved_goal=spaces.Box(-far, far, dtype=np.float64),
            desired_goal=spaces.Box(-half, half, dtype=np.float64),
            obstacle=spaces.Box(np.r_[-half, -speed, 0.4], np.r_[half, speed, 0.8], dtype=np.float64),
        )
        self.action_space = spaces.Box(-P.axis_speed, P.axis_speed, (2,), np.float32)
        self.perceived: Any = None  # where a noise wrapper leaves the reading, to be drawn
        self._streams, self._step = EpisodeStreams(1), -1

    @staticmethod
    def task(**_: Any) -> Task:
        """What the numbers mean: all that agents, experts and filters know of this environment."""
        return Task(
            dim=2,
            n_obstacles=1,
            noise_scale=(0.3,) * 5,
            robot_radius=P.robot_radius,
            goal_radius=P.goal_radius,
            dt=P.dt,
            max_speed=P.axis_speed * np.sqrt(2),
            pose=lambda state: (state, np.broadcast_to(np.eye(2), (len(state), 2, 2))),
            body_state=(),
            state_size=2,
            obstacle_speed=P.obstacle_speed,
            redraw_interval=P.redraw_interval,
            moved=lambda state, action, dt: state[:, None] + dt * action,
        )

    @property
    def noise_channels(self) -> dict[str, Any]:
        """What ``step@position`` and its like are limited to."""
        return {"obstacle": self.task().noise_channels}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start an episode; all of its chance comes from one key, which the seed names."""
        seed = check_reset(seed, options)
        super().reset(seed=seed)
        self._streams.seed(seed, rng=self.np_random)
        key = streams.episode_keys(*self._streams.next(np.array([0]))).view(np.uint64)
        u, self._key, self._step = (
            streams.uniform(streams.split(key, 0), np.arange(5)),
            streams.split(key, 1),
            0,
        )
        self._at, self._goal = np.array([-4.5, 7 * u[0] - 3.5]), np.array([4.5, 7 * u[1] - 3.5])
        way = self._goal - self._at
        aside = np.array([-way[1], way[0]]) / np.linalg.norm(way)
        self._disc = (self._at + (0.4 + 0.3 * u[2]) * way + (2 * u[3] - 1) * 0.8 * aside)[None, None]
        self._radius = np.array([[0.4 + 0.4 * u[4]]])
        self._turn(draw_velocity(self._key, 0, 1, P.motion))
        self._trail, self.perceived = [self._at], None
        return self._observation(), self._info(self._at, float(self._clearance(self._at, self._disc[0, 0])))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        """Drive for one step; base and disc both move in a straight line, so the clearance is exact."""
        velocity = np.clip(finite_action(action, (2,)), self.action_space.low, self.action_space.high)
        if self._step < 0:
            raise gym.error.ResetNeeded("call reset() to start an episode")
        before, self._at = self._at, self._at + P.dt * velocity
        here, self._disc = self._disc, self._disc + P.dt * self._velocity
        clearance = segment_distance(before - here[0, 0], self._at - self._disc[0, 0])
        self._step += 1
        self._turn(redraw(self._velocity, self._key, self._step, P.motion))
        self._trail.append(self._at)
        info = self._info(before, float(clearance - self._radius[0, 0] - P.robot_radius))
        reward = float(self.compute_reward(self._at, self._goal, info))
        return self._observation(), reward, info["is_success"], False, info

    def _turn(self, wanted: Any) -> None:
        self._velocity = keep_inside(self._disc, wanted, self._radius, self._goal[None], P.motion)

    def _clearance(self, at: Any, disc: Any) -> Any:
        return np.linalg.norm(at - disc) - self._radius[0, 0] - P.robot_radius

    def _observation(self) -> dict[str, Any]:
        parts = {
            "observation": self._at.copy(),
            "achieved_goal": self._at.copy(),
            "desired_goal": self._goal.copy(),
        }
        return {**parts, "obstacle": readings(self._disc, self._velocity, self._radius)[0]}

    def _info(self, before: Any, clearance: float) -> dict[str, Any]:
        reached = bool(goals.distance(self._at, self._goal) <= P.goal_radius)
        cost = 1.0 if clearance < 0 else 0.0
        return {
            **{"cost": cost, "clearance": clearance, "is_success": reached},
            "previous_achieved_goal": before.copy(),
        }

    def render(self) -> Any:
        """The scene as the vehicle's environment draws it."""
        from rise_envs.rendering import draw_vehicle_scene  # pygame is loaded by those who draw only

        disc = readings(self._disc, self._velocity, self._radius)[0]
        state = np.array([*self._at, 0.0])
        return draw_vehicle_scene(state, self._goal, 1, disc, self.perceived, self._trail, P)


class Barrier:
    """The velocity nearest to the straight way to the goal that keeps n · u ≥ n · v − γ (clearance − margin)."""

    def __init__(self, task: Task, seed: int = 0) -> None:
        self.task, self.limit = task, np.full(2, task.max_speed / np.sqrt(2))

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """Velocities (B, 2), or (2,) for one observation."""
        rows, single = checked_batch(self.task, observation)
        position, velocity, radius = self.task.split(rows["obstacle"])
        away = rows["observation"][:, None] - position  # (B, N, 2)
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        normal = away / distance
        clearance = distance[..., 0] - radius - self.task.robot_radius
        wanted = 2.0 * (rows["desired_goal"] - rows["observation"])
        # A little to the left: who comes straight at the middle of a disc would stand before it.
        left = np.stack((-normal[..., 1], normal[..., 0]), -1).sum(1)
        wanted = wanted + 2.0 * left * np.exp(-clearance.min(1, keepdims=True))
        needed = (normal * velocity).sum(-1) - 2.0 * (clearance - 0.1)
        action, _ = nearest_point(wanted, normal, needed, -self.limit, self.limit)
        return (action[0] if single else action), None


register_env("OmniBase-v0", OmniBase, max_episode_steps=150)
register_expert("OmniBase-v0", "barrier", Barrier)
