"""``RISE-GroundVehicle-v0``: a unicycle reaches a goal past moving discs. See :class:`GroundVehicleEnv`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import goals
from rise_envs.actions import finite_numbers
from rise_envs.episodes import EpisodeStreams, check_reset
from rise_envs.settings import as_settings, flag, whole
from rise_envs.task import Task
from rise_envs.vehicle_dynamics import packed
from rise_envs.vehicle_world import Array, Params, World, sample_starts

DEFAULTS = Params()


@functools.cache
def _dynamics() -> Any:
    """The compiled dynamics: numba is loaded by those who drive only. No attribute, as modules cannot be copied."""
    from rise_envs import vehicle_compiled

    return vehicle_compiled


def _pose(state: Array) -> tuple[Array, Array]:
    rotation, sin = np.empty((*state.shape[:-1], 2, 2)), np.sin(state[..., 2])
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(state[..., 2])
    rotation[..., 1, 0], rotation[..., 0, 1] = sin, -sin
    return state[..., :2], rotation


def _moved(state: Array, action: Array, dt: float) -> Array:
    """Where the centre is after actions (v, ω): on an arc, which its chord spans."""
    half = 0.5 * dt * action[..., 1]
    chord = dt * action[..., 0] * np.sinc(half / np.pi)
    heading = state[..., None, 2] + half
    return state[..., None, :2] + chord[..., None] * np.stack((np.cos(heading), np.sin(heading)), -1)


def make_spaces(n_obstacles: int, p: Params) -> tuple[spaces.Dict, spaces.Box]:
    """Observation and action space of one vehicle among ``n_obstacles`` discs."""
    reach = p.arena_half + 200 * p.dt * max(p.v_max, -p.v_min)  # nobody drives further in an episode
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
    low, high = [p.v_min, -p.omega_max], [p.v_max, p.omega_max]
    return observation, spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


class VehicleTask(goals.GoalAPI):
    """What the single and the batched environment share: arguments, state, goal API, description."""

    def __init__(
        self,
        reward_type: str,
        terminate_on_collision: bool,
        n_obstacles: int,
        params: Params | Mapping[str, Any],
    ) -> None:
        self.reward_type = goals.check_reward_type(reward_type)
        self.terminate_on_collision = flag("terminate_on_collision", terminate_on_collision)
        self.n_obstacles, self.params = whole("n_obstacles", n_obstacles, 1), as_settings(Params, params)
        self.constants = self.params.constants(sparse=reward_type == "sparse")

    @staticmethod
    def task(n_obstacles: int = 1, params: Params | Mapping[str, Any] | None = None, **_: Any) -> Task:
        """The meaning of the numbers, for agents (see :class:`rise_envs.task.Task`).

        The reading noise at level 1 is the paper's N(0, 1) on every channel, in SI units.
        """
        p = DEFAULTS if params is None else as_settings(Params, params)
        n_obstacles = whole("n_obstacles", n_obstacles, 1)
        scale = (1.0,) * (5 * n_obstacles)
        return Task(
            dim=2,
            n_obstacles=n_obstacles,
            noise_scale=scale,
            robot_radius=p.robot_radius,
            goal_radius=p.goal_radius,
            dt=p.dt,
            max_speed=p.v_max,
            pose=_pose,
            body_state=(),
            state_size=3,
            obstacle_speed=p.obstacle_speed,
            redraw_interval=p.redraw_interval,
            moved=_moved,
        )

    @property
    def noise_scale(self) -> dict[str, Array]:
        """Standard deviation of the readings at noise level 1, per channel."""
        return {"obstacle": np.array(self.task(self.n_obstacles, self.params).noise_scale)}

    @property
    def noise_channels(self) -> dict[str, dict[str, tuple[int, ...]]]:
        """The channels of each group that noise can be limited to."""
        return {"obstacle": self.task(self.n_obstacles, self.params).noise_channels}


class GroundVehicleEnv(VehicleTask, gym.Env):
    """A ground vehicle reaches a goal past a moving disc whose motion cannot be predicted.

    ## Description
    The vehicle is a disc of radius 0.5 m with unicycle kinematics, integrated exactly over each step of
    0.1 s. One disc (or ``n_obstacles`` of them) moves at up to 1 m/s; its velocity is drawn anew every 2 s on
    average, it turns at the arena's walls, and it keeps off the goal. The paper's first task.

    ## Action space
    `Box(2,)`, float32, in SI units; values outside are clipped, non-finite ones raise `ValueError`.
    For algorithms that want [−1, 1], wrap in `RescaleAction(env, np.float32(-1), np.float32(1))`.

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
    | `obstacle` | per disc the reading c = (px, py, vx, vy, r) | m, m/s, m | ±12, ±1, [0.75, 2] |

    The reading is the true one (wrap the environment for noise); its velocity is that of the coming step.

    ## Reward
    `dense` (default): progress towards the goal in units of the goal radius, plus 1 on reaching it.
    `sparse`: 0 at the goal, −1 elsewhere. Cost is apart: `info["cost"]`.

    ## Info, each step
    `cost` 1.0 if vehicle and disc overlapped at any time within the step, else 0.0 · `clearance` least signed
    distance within the step (m) · `is_success` · `previous_achieved_goal` where the step began.

    ## Start
    Start uniform in a square of 20 m; goal in any direction, 12.5 to 20 m away, inside the square too (draws
    that are not are drawn anew); heading within 60° of the goal's direction; disc of radius 0.75 to 2 m at
    35–75 % of the way, at most 2.5 m off it, at least 1 m clear of the vehicle over its path of the first
    second. `reset(seed=…)` replays an episode bit for bit.

    ## End
    Terminates within 0.75 m of the goal (and on collision with `terminate_on_collision=True`); truncated
    after 200 steps.

    ## Arguments
    `render_mode` (`"rgb_array"` or `"human"`), `reward_type`, `terminate_on_collision`, `n_obstacles`,
    `params` (:class:`rise_envs.vehicle_world.Params`, or a dict of some of its fields: every constant of the task).

    ## Versions
    v0: first.

    ## Source
    Tayal, Tayal and Prakash, "RISE: Robust Imitation through Stochastic Encoding", section IV-B.
    """

    action_space: spaces.Box
    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012
    KEYS = (("up", "down"), ("left", "right"))  # of a keyboard, that push each action up and down

    def __init__(
        self,
        render_mode: str | None = None,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        n_obstacles: int = 1,
        params: Params | Mapping[str, Any] = DEFAULTS,
    ) -> None:
        super().__init__(reward_type, terminate_on_collision, n_obstacles, params)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}")
        self.render_mode = render_mode
        self.observation_space, self.action_space = make_spaces(self.n_obstacles, self.params)
        # The reading as a noise wrapper last handed it out. A window, which draws within the step, shows the
        # one that the step's action was based on.
        self.perceived: Array | None = None
        self._numbers = packed(self.constants)
        _dynamics()
        self._streams = EpisodeStreams(1)
        self._key = self._time = 0
        self._now: Array | None = None  # x, y, θ, goal, and the reading of each disc
        self._trail: list[Array] = []
        self._window: Any = None

    @property
    def world(self) -> World:
        """The true state as a batch of one episode (a copy); assign one to set up a scene of your own.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            ValueError: an assigned world that is not one episode with ``n_obstacles`` discs.
        """
        now = self._started()
        disc = now[5:].reshape(1, self.n_obstacles, 5).copy()
        key, time = np.array([self._key]), np.array([self._time])
        return World(now[None, :3].copy(), now[None, 3:5].copy(), disc, key, time)

    @world.setter
    def world(self, world: World) -> None:
        given = tuple(np.shape(part) for part in (world.state, world.goal, world.disc))
        if given != ((1, 3), (1, 2), (1, self.n_obstacles, 5)):
            raise ValueError(
                f"state, goal and disc must have shapes (1, 3), (1, 2), (1, {self.n_obstacles}, 5), got {given}"
            )
        parts = world.state[0], world.goal[0], world.disc[0].ravel()
        self._now = np.concatenate(parts, dtype=np.float64)
        self._key, self._time = int(world.key[0]), int(world.step[0])

    def place(self, goal: Any, obstacle: Any) -> None:
        """Put goal and discs where somebody else has them: virtual obstacles that another process moves.

        Args:
            goal: (2,), m.
            obstacle: the true reading, (5 · n_obstacles,); it holds for the coming step.

        Raises:
            ValueError: wrong shapes, numbers that are not finite, or a radius that is not positive. Nothing has
                changed then.
        """
        now = self._started()
        goal, discs = goals.checked_placement(goal, obstacle, 2, self.n_obstacles)
        now[3:5], now[5:] = goal, discs.ravel()

    def _started(self) -> Array:
        if self._now is None:
            raise gym.error.ResetNeeded("call reset() to start an episode")
        return self._now

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start an episode; with ``seed`` the one that this seed names.

        Raises:
            ValueError: a seed that is negative or no whole number, options that are no dict, or parameters that
                leave no room for a fair start.
        """
        seed = check_reset(seed, options)
        super().reset(seed=seed)
        self._streams.seed(seed, rng=self.np_random)
        base, number = self._streams.next(np.array([0]))
        world, (clearance,) = sample_starts(base, number, self.n_obstacles, self.constants, _dynamics())
        self.world, self.perceived = world, None
        self._trail = [world.state[0, :2]]
        shown = np.concatenate((world.state[0], world.state[0, :2], self._started()[3:], world.state[0, :2]))
        if self.render_mode == "human":
            self.render()
        return self._observation(shown), self._info(shown, float(clearance), False)

    def step(self, action: Any) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Drive for one step.

        Raises:
            ValueError: an action of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        now, (v, omega) = self._started(), finite_numbers(action, (2,))
        shown = np.empty(9 + 5 * self.n_obstacles)
        clearance, reward, reached = _dynamics().step_alone(
            now, self._key, self._time, v, omega, self._numbers, shown
        )
        self._time += 1
        terminated = reached or (self.terminate_on_collision and clearance < 0.0)
        if self.render_mode is not None:
            self._trail.append(now[:2].copy())
            if self.render_mode == "human":
                self.render()
        return self._observation(shown), reward, terminated, False, self._info(shown, clearance, reached)

    @staticmethod
    def _observation(shown: Array) -> dict[str, Array]:
        """The parts of ``shown``: views of an array that nobody else holds, none of which overlap."""
        return {
            "observation": shown[:3],
            "achieved_goal": shown[3:5],
            "desired_goal": shown[5:7],
            "obstacle": shown[7:-2],
        }

    @staticmethod
    def _info(shown: Array, clearance: float, reached: bool) -> dict[str, Any]:
        return {
            "cost": 1.0 if clearance < 0.0 else 0.0,
            "clearance": clearance,
            "is_success": reached,
            "previous_achieved_goal": shown[-2:],
        }

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as an RGB array (H, W, 3), or in a window with ``render_mode="human"``."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() without a render_mode: make the environment with render_mode='rgb_array'"
            )
            return None
        from rise_envs import rendering  # pygame is loaded by those who draw only

        w = self.world
        frame = rendering.draw_vehicle_scene(
            w.state[0],
            w.goal[0],
            self.n_obstacles,
            w.disc[0].ravel(),
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
