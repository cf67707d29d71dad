"""A Franka Panda arm that reaches for a goal while a sphere moves through its workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import goals, obstacles, streams
from rise_envs.actions import checked_action
from rise_envs.task import Task

if TYPE_CHECKING:
    from rise_envs.panda_sim import PandaSim

Array = NDArray[np.float64]


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
        max_offset: greatest distance of that place from the line (m).
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
    max_offset: float = 0.08
    start_clearance: float = 0.04
    start_time: float = 0.2
    max_hand_speed: float = 1.5
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


def reachable(goal: Array, params: Params) -> NDArray[np.bool_]:
    """Whether the arm, hand held downwards, reaches the goals (..., 3): their distance from its shoulder."""
    across = np.hypot(goal[..., 0] + 0.6, goal[..., 1]) - 0.088
    return np.hypot(across, goal[..., 2] - 0.121) <= params.reach


def draw_scenes(
    key: NDArray[np.uint64], attempt: int, n: int, hand: Array, params: Params
) -> tuple[Array, float, Array]:
    """Candidate number ``attempt`` for the start of an episode: a goal, and spheres near the way to it.

    Args:
        key: the episode's key for this purpose, (1,).
        attempt: number of the candidate; each has its own draws.
        n: how many spheres to propose.
        hand: position of the hand (m), (3,).
        params: the task.

    Returns:
        The goal (3,), the radius (one for all spheres) and the centres (≤ n, 3) of the spheres that keep the
        gap to the goal and lie in their box; of none if the goal itself is unfit.
    """
    size = 4 + 3 * n
    u = streams.uniform(key, np.uint64(attempt * size) + np.arange(size, dtype=np.uint64))
    low, high = np.array(params.goal_low), np.array(params.goal_high)
    goal = low + (high - low) * u[:3]
    radius = params.radius[0] + (params.radius[1] - params.radius[0]) * float(u[3])
    way = goal - hand
    length = float(np.linalg.norm(way))
    if length < params.goal_min_distance or not reachable(goal, params):
        return goal, radius, np.empty((0, 3))

    along, offset, angle = u[4:].reshape(3, n, 1)
    along = params.placed[0] + (params.placed[1] - params.placed[0]) * along
    side = np.cross(way, np.eye(3)[np.argmin(np.abs(way))])
    side /= np.linalg.norm(side)
    up = np.cross(way / length, side)
    angle = 2 * np.pi * angle
    center = hand + along * way + params.max_offset * offset * (np.cos(angle) * side + np.sin(angle) * up)
    fits = (center >= params.sphere_low).all(1) & (center <= params.sphere_high).all(1)
    fits &= np.linalg.norm(center - goal, axis=1) >= radius + params.goal_gap
    return goal, radius, center[fits]


class SafePandaEnv(gym.Env):
    """Reach with a Franka Panda arm among a moving sphere.

    ## Description
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 - Gymnasium's own form

    def __init__(
        self,
        render_mode: str | None = None,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        params: Params | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        from rise_envs import panda_sim  # loads the engine

        self.render_mode = render_mode
        self.reward_type = goals.check_reward_type(reward_type)
        self.terminate_on_collision = terminate_on_collision
        self.params = params = params or Params()
        self.perceived: Array | None = None
        self.action_space: spaces.Box = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = spaces.Dict(
            observation=_box((-2.0,) * 3 + (-10.0,) * 3 + (-2 * np.pi,) * 7),
            achieved_goal=_box((-2.0,) * 3),
            desired_goal=_box(params.goal_low, params.goal_high),
            obstacle=_box(
                (*params.sphere_low, *(-params.max_speed,) * 3, params.radius[0]),
                (*params.sphere_high, *(params.max_speed,) * 3, params.radius[1]),
            ),
        )
        self._motion = params.motion
        self._started = False
        self._sim: PandaSim | None = panda_sim.PandaSim(visuals=render_mode is not None)

    @staticmethod
    def task(params: Params | None = None, **_: Any) -> Task:
        """What agents may know of the task (same keyword arguments as the environment's)."""
        p = params or Params()
        position, velocity, radius = p.noise_scale
        return Task(
            dim=3,
            n_obstacles=1,
            noise_scale=(position,) * 3 + (velocity,) * 3 + (radius,),
            robot_radius=p.hand_radius,
            goal_radius=p.goal_radius,
            dt=p.dt,
            max_speed=p.max_hand_speed,
            pose=hand_pose,
            body_state=tuple(range(13)),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start an episode: the arm at rest in its neutral pose, goal and sphere drawn afresh."""
        super().reset(seed=seed, options=options)
        sim = self._engine()
        sim.reset()
        key = np.atleast_1d(streams.draw_key(self.np_random))
        self._motion_key = streams.split(key, 1)
        self._hand, _ = sim.hand
        wanted = obstacles.draw_velocity(self._motion_key, 0, 1, self._motion)
        speed = float(np.linalg.norm(wanted))
        start = self._draw_start(sim, streams.split(key, 0), speed)
        self._goal, self._radius, self._center = start
        self._velocity = self._kept_inside(wanted)
        self._steps = 0
        self._started = True
        self.perceived = None
        clearance, _ = sim.clearance(self._center, self._radius)
        return self._observe(sim), self._info(self._hand, clearance, None)

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Move the hand by 5 cm × ``action`` (as far as the arm follows) while the sphere moves on.

        Raises:
            ValueError: the action is not finite or of the wrong shape; nothing has moved.
            RuntimeError: the environment is closed or was never reset.
        """
        sim = self._engine()
        if not self._started:
            raise RuntimeError("step() before the first reset(): call reset() to start an episode")
        commanded = checked_action(action, self.action_space).astype(np.float32)
        before = self._hand
        clearance, link = sim.step(commanded, self._center, self._velocity[0, 0], self._radius)
        self._hand, _ = sim.hand
        self._center = self._center + self.params.dt * self._velocity[0, 0]
        self._steps += 1
        self._velocity = self._kept_inside(
            obstacles.redraw(self._velocity, self._motion_key, self._steps, self._motion)
        )
        info = self._info(before, clearance, sim.link_names[link] if clearance < 0 else None)
        observation = self._observe(sim)
        reward = float(self.compute_reward(self._hand, self._goal, info))
        terminated = bool(self.compute_terminated(self._hand, self._goal, info))
        return observation, reward, terminated, False, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array:
        """Reward of goals (3,) or (B, 3), see `rise_envs.goals.reward`."""
        return goals.reward(achieved_goal, desired_goal, info, self.params.goal_radius, self.reward_type)

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> NDArray[np.bool_]:
        """Whether goals (3,) or (B, 3) end the episode, see `rise_envs.goals.terminated`."""
        return goals.terminated(
            achieved_goal, desired_goal, info, self.params.goal_radius, self.terminate_on_collision
        )

    def compute_truncated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> NDArray[np.bool_]:
        """Never: the time limit is Gymnasium's wrapper."""
        return np.zeros(np.shape(achieved_goal)[:-1], dtype=bool)

    def close(self) -> None:
        """Free the engine. May be called again."""
        if self._sim is not None:
            self._sim.close()
        self._sim = None

    def _engine(self) -> PandaSim:
        if self._sim is None:
            raise RuntimeError("this environment is closed: make a new one to go on")
        return self._sim

    def _draw_start(self, sim: PandaSim, key: NDArray[np.uint64], speed: float) -> tuple[Array, float, Array]:
        """Goal, radius and centre of the first candidate that is fair and leaves the arm clear."""
        needed = self.params.start_clearance + self.params.start_time * speed
        for attempt in range(1000):
            goal, radius, centers = draw_scenes(key, attempt, 32, self._hand, self.params)
            for center in centers:
                if sim.clearance(center, radius, needed)[0] >= needed:
                    return goal, radius, center
        raise RuntimeError("no fair start in 1000 draws: the parameters leave the sphere no room")

    def _kept_inside(self, velocity: Array) -> Array:
        return obstacles.keep_inside(
            self._center[None, None], velocity, np.array([[self._radius]]), self._goal[None], self._motion
        )

    def _observe(self, sim: PandaSim) -> dict[str, Array]:
        hand, velocity = sim.hand
        reading = obstacles.readings(self._center[None, None], self._velocity, np.array([[self._radius]]))[0]
        return {
            "observation": np.concatenate((hand, velocity, sim.joint_angles)),
            "achieved_goal": hand.copy(),
            "desired_goal": self._goal.copy(),
            "obstacle": reading,
        }

    def _info(self, before: Array, clearance: float, link: str | None) -> dict[str, Any]:
        return {
            "cost": float(clearance < 0),
            "clearance": clearance,
            "collision_link": link,
            "is_success": bool(goals.distance(self._hand, self._goal) <= self.params.goal_radius),
            "previous_achieved_goal": before.copy(),
        }


def hand_pose(state: Array) -> tuple[Array, Array]:
    """The hand's frame for states (B, 13): its position (B, 3) and axes as the world's (B, 3, 3)."""
    return state[:, :3], np.broadcast_to(np.eye(3), (len(state), 3, 3))


def _box(low: tuple[float, ...], high: tuple[float, ...] | None = None) -> spaces.Box:
    bound = np.array(low, dtype=np.float64)
    return spaces.Box(bound, -bound if high is None else np.array(high, dtype=np.float64), dtype=np.float64)
