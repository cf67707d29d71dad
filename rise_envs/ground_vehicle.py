"""``RISE-GroundVehicle-v0``: a unicycle reaches a goal past moving discs. See :class:`GroundVehicleEnv`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import geometry, goals, obstacles, streams
from rise_envs.actions import checked_action
from rise_envs.obstacles import Motion
from rise_envs.task import Task

Array = NDArray[np.float64]


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

    @property
    def motion(self) -> Motion:
        """How the discs move."""
        box = (self.obstacle_half, self.obstacle_half)
        low = (-self.obstacle_half, -self.obstacle_half)
        return Motion(self.dt, self.obstacle_speed, self.redraw_interval, low, box, self.goal_gap)


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

    offset = position - start[:, None]
    swept = geometry.segment_distance(offset, offset + p.start_horizon * velocity) - radius - p.robot_radius
    valid = (np.abs(goal) <= p.arena_half).all(-1)
    valid &= (swept >= p.start_margin).all(-1)
    valid &= (np.abs(position) <= p.obstacle_half).all((-1, -2))
    valid &= (np.linalg.norm(position - goal[:, None], axis=-1) >= radius + p.goal_gap).all(-1)
    velocity = obstacles.keep_inside(position, velocity, radius, goal, p.motion)
    state = np.concatenate((start, heading[:, None]), -1)
    return World(state, goal, position, velocity, radius, keys, np.zeros(len(keys), np.int64)), valid


def sample_starts(keys: NDArray[np.uint64], n_obstacles: int, params: Params) -> World:
    """Fair starts, one for each episode key (B,), each a pure function of its key."""
    draws = streams.split(keys, 0)
    world, valid = _propose(draws, 0, n_obstacles, params)
    attempt = 0
    while not valid.all():
        attempt += 1
        missing = ~valid
        candidate, good = _propose(draws[missing], attempt, n_obstacles, params)
        world = world.merge(candidate, missing)
        valid[missing] = good
    return replace(world, key=keys)


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


def _pose(state: Array) -> tuple[Array, Array]:
    cos, sin = np.cos(state[..., 2]), np.sin(state[..., 2])
    return state[..., :2], np.stack((np.stack((cos, -sin), -1), np.stack((sin, cos), -1)), -2)


def make_spaces(n_obstacles: int, p: Params) -> tuple[spaces.Dict, spaces.Box]:
    reach = p.arena_half + 200 * p.dt * p.v_max  # nobody drives further in an episode
    disc_high = [p.obstacle_half] * 2 + [p.obstacle_speed] * 2 + [p.obstacle_radius[1]]
    disc_low = [-p.obstacle_half] * 2 + [-p.obstacle_speed] * 2 + [p.obstacle_radius[0]]

    def box(low: Any, high: Any) -> spaces.Box:
        return spaces.Box(np.asarray(low, np.float64), np.asarray(high, np.float64), dtype=np.float64)

    observation = spaces.Dict(
        observation=box([-reach, -reach, -np.pi], [reach, reach, np.pi]),
        achieved_goal=box([-reach] * 2, [reach] * 2),
        desired_goal=box([-p.arena_half] * 2, [p.arena_half] * 2),
        obstacle=box(disc_low * n_obstacles, disc_high * n_obstacles),
    )
    low, high = np.float32([p.v_min, -p.omega_max]), np.float32([p.v_max, p.omega_max])
    return observation, spaces.Box(low, high, dtype=np.float32)


class VehicleTask:
    """What the single and the batched environment share: arguments, spaces, goal API, description."""

    def __init__(
        self, reward_type: str, terminate_on_collision: bool, n_obstacles: int, params: Params
    ) -> None:
        if n_obstacles < 1 or int(n_obstacles) != n_obstacles:
            raise ValueError(f"n_obstacles must be a whole number of at least 1, got {n_obstacles!r}")
        self.reward_type = goals.check_reward_type(reward_type)
        self.terminate_on_collision = bool(terminate_on_collision)
        self.n_obstacles, self.params = int(n_obstacles), params

    @staticmethod
    def task(n_obstacles: int = 1, params: Params | None = None, **_: Any) -> Task:
        """The meaning of the numbers, for agents (see :class:`rise_envs.task.Task`).

        The reading noise at level 1 is the paper's N(0, 1) on every channel, in SI units.
        """
        p = params or Params()
        scale = (1.0,) * (5 * n_obstacles)
        return Task(2, n_obstacles, scale, p.robot_radius, p.goal_radius, p.dt, p.v_max, _pose, ())

    @property
    def noise_scale(self) -> dict[str, Array]:
        """Standard deviation of the readings at noise level 1, per channel."""
        return {"obstacle": np.ones(5 * self.n_obstacles)}

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """Reward of one transition or of a batch: see :func:`rise_envs.goals.reward`."""
        return goals.reward(achieved_goal, desired_goal, info, self.params.goal_radius, self.reward_type)

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """Whether the goal is reached (or, with ``terminate_on_collision``, the step cost something)."""
        return goals.terminated(
            achieved_goal, desired_goal, info, self.params.goal_radius, self.terminate_on_collision
        )

    def compute_truncated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """Never: the time limit truncates."""
        return np.zeros(np.shape(achieved_goal)[:-1], bool)[()]


class GroundVehicleEnv(VehicleTask, gym.Env):
    """A ground vehicle reaches a goal past a moving disc whose motion cannot be predicted.

    ## Description
    The vehicle is a disc of radius 0.5 m with unicycle kinematics, integrated exactly over each step of
    0.1 s. One disc (or ``n_obstacles`` of them) moves at up to 1 m/s; its velocity is drawn anew every 2 s on
    average, it turns at the arena's walls, and it keeps off the goal. The paper's first task.

    ## Action space
    `Box(2,)`, float32; values outside are clipped, non-finite ones raise `ValueError`.

    | index | action | unit | bounds |
    |---|---|---|---|
    | 0 | linear velocity v | m/s | [0, 2.5] |
    | 1 | angular velocity ω | rad/s | [−1.5, 1.5] |

    ## Observation space
    `Dict`, float64.

    | key | content | unit | bounds |
    |---|---|---|---|
    | `observation` | state s = (x, y, θ) | m, rad | ±60, ±π |
    | `achieved_goal` | (x, y) | m | ±60 |
    | `desired_goal` | goal g = (gx, gy) | m | ±10 |
    | `obstacle` | per disc the reading c = (px, py, vx, vy, r), true here: wrap for noise | m, m/s, m | ±12, ±1, [0.75, 2] |

    The velocity in the reading is that of the coming step.

    ## Reward
    `dense` (default): progress towards the goal in units of the goal radius, plus 1 on reaching it.
    `sparse`: 0 at the goal, −1 elsewhere. Cost is apart: `info["cost"]`.

    ## Info, each step
    `cost` 1.0 if vehicle and disc overlapped at any time within the step, else 0.0 · `clearance` least signed
    distance within the step (m) · `is_success` · `previous_achieved_goal` where the step began.

    ## Start
    Start and goal uniform in a 20 m square, 12.5 to 20 m apart; heading within 60° of the goal's direction; disc of
    radius 0.75 to 2 m at 35–75 % of the way, at most 2.5 m off it, at least 1 m clear of the vehicle over its
    path of the first second. `reset(seed=…)` replays an episode bit for bit.

    ## End
    Terminates within 0.75 m of the goal (and on collision with `terminate_on_collision=True`); truncated
    after 200 steps.

    ## Arguments
    `render_mode` (`"rgb_array"` or `"human"`), `reward_type`, `terminate_on_collision`, `n_obstacles`, `params`.

    ## Versions
    v0: first.

    ## Source
    Tayal, Tayal and Prakash, "RISE: Robust Imitation through Stochastic Encoding", section IV-B.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        n_obstacles: int = 1,
        params: Params = Params(),
    ) -> None:
        super().__init__(reward_type, terminate_on_collision, n_obstacles, params)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}")
        self.render_mode = render_mode
        self.observation_space, self.action_space = make_spaces(self.n_obstacles, params)
        self.perceived: Array | None = None  # the reading as a noise wrapper last handed it out
        self._world: World | None = None
        self._trail: list[Array] = []
        self._window: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start an episode; with ``seed`` the one that this seed names."""
        super().reset(seed=seed)
        keys = np.array([streams.draw_key(self.np_random)])
        self._world, self.perceived = sample_starts(keys, self.n_obstacles, self.params), None
        self._trail = [self._world.state[0, :2]]
        info = self._info(start_clearance(self._world, self.params)[0], self._world.state[0, :2])
        if self.render_mode == "human":
            self.render()
        return self._observe(), {**info, "cost": 0.0}

    def step(self, action: Any) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Drive for one step.

        Raises:
            ValueError: an action of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        before = self._world.state[0, :2]
        driven = checked_action(action, self.action_space)
        self._world, clearance = advance(self._world, driven[None], self.params)
        self._trail.append(self._world.state[0, :2])
        observation, info = self._observe(), self._info(clearance[0], before)
        achieved, goal = observation["achieved_goal"], observation["desired_goal"]
        reward = float(self.compute_reward(achieved, goal, info))
        terminated = bool(self.compute_terminated(achieved, goal, info))
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, False, info

    def _observe(self) -> dict[str, Array]:
        return {key: rows[0] for key, rows in observe(self._world).items()}

    def _info(self, clearance: float, before: Array) -> dict[str, Any]:
        world = self._world
        return {
            "cost": float(clearance < 0),
            "clearance": float(clearance),
            "is_success": bool(goals.distance(world.state[0, :2], world.goal[0]) <= self.params.goal_radius),
            "previous_achieved_goal": before.copy(),
        }

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as an RGB array (H, W, 3), or in a window with ``render_mode="human"``."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() without a render_mode: make the environment with render_mode='rgb_array'"
            )
            return None
        from rise_envs import rendering  # pygame is loaded by those who draw only

        w = self._world
        frame = rendering.draw_vehicle_scene(
            w.state[0],
            w.goal[0],
            self.n_obstacles,
            observe(w)["obstacle"][0],
            self.perceived,
            self._trail,
            self.params,
        )
        if self.render_mode == "rgb_array":
            return frame
        self._window = self._window or rendering.Window(frame.shape, self.metadata["render_fps"])
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Close the window, if there is one. May be called twice."""
        if self._window is not None:
            self._window.close()
            self._window = None
