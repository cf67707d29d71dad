"""``RISE-SafePanda-v0``: an arm reaches a goal past a moving sphere. See :class:`SafePandaEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import goals
from rise_envs.actions import finite_numbers
from rise_envs.episodes import EpisodeStreams, check_reset
from rise_envs.panda_scene import DEFAULTS, Params
from rise_envs.panda_task import PandaTask, make_spaces
from rise_envs.streams import episode_keys

if TYPE_CHECKING:
    from rise_envs.panda_sim import PandaSim

Array = NDArray[np.float64]


class SafePandaEnv(PandaTask, gym.Env):
    """A Franka Panda arm reaches a goal past a moving sphere whose motion cannot be predicted.

    ## Description
    The arm stands on a table, its gripper shut and pointing down, and is moved by displacements of its hand:
    engine (Bullet, 20 substeps of 2 ms per step of 0.04 s), robot, inverse kinematics and motors are
    panda-gym's, and the hand moves exactly as in ``PandaReach-v3``. A sphere moves through the workspace at
    up to 0.15 m/s; its velocity is drawn anew every 1.5 s on average, it turns at the walls of its box and
    keeps off the goal. It is a ghost: nothing holds the arm back, but no part of the arm may touch it. The
    paper's second task.

    ## Action space
    `Box(3,)`, float32; values outside are clipped, non-finite ones raise `ValueError` and change nothing.

    | index | action | unit | bounds |
    |---|---|---|---|
    | 0–2 | commanded displacement of the hand (dx, dy, dz) | 0.05 m | [−1, 1] |

    The motors achieve a good half of a commanded displacement within the step.

    ## Observation space
    `Dict`, float64, world frame. The arm's base is at (−0.6, 0, 0), the table's top at z = 0.

    | key | content | unit | bounds |
    |---|---|---|---|
    | `observation` | hand position (3), hand velocity (3), joint angles (7) | m, m/s, rad | ±2, ±10, ±2π |
    | `achieved_goal` | hand position | m | ±2 |
    | `desired_goal` | goal g | m | the box of goals |
    | `obstacle` | the reading c = (position 3, velocity 3, radius) | m, m/s, m | box, ±0.15, [0.05, 0.1] |

    The reading is the true one (wrap the environment for noise); its velocity is that of the coming step. The
    hand's position is that of the point between the finger tips, as panda-gym reports it.

    ## Reward
    `dense` (default): progress towards the goal in units of the goal radius, plus 1 on reaching it.
    `sparse`: 0 at the goal, −1 elsewhere. Cost is apart: `info["cost"]`.

    ## Info, each step
    `cost` 1.0 if any link of the arm (hand and fingers included) overlapped the sphere at any time within the
    step, else 0.0 · `clearance` least signed distance of the whole arm from the sphere within the step (m), by
    the engine's closest points, the sphere's motion within the step included · `collision_link` name of the
    link that went deepest, or `None` · `is_success` · `previous_achieved_goal` where the step began.

    ## Start
    The arm at rest in its neutral pose, hand at (0.04, 0, 0.20). Goal uniform in x ∈ [−0.35, 0.15],
    y ∈ [−0.4, 0.4], z ∈ [0.05, 0.5] m where the hand can get, at least 0.25 m from it; sphere of radius 0.05
    to 0.10 m at 35–75 % of the straight way, up to 0.06 m off it along each axis, at least 0.12 m (plus its
    radius) off the goal, at least 4 cm clear of the whole arm, and so for 0.2 s at its speed. Draws that are
    not are drawn anew. Who drives straight at the goal collides in about 92 % of episodes. `reset(seed=…)`
    replays an episode bit for bit, whatever happened before.

    ## End
    Terminates within 0.05 m of the goal (and on collision with `terminate_on_collision=True`); truncated after
    50 steps.

    ## Arguments
    `render_mode` (`"rgb_array"`), `reward_type`, `terminate_on_collision`, `params`
    (:class:`rise_envs.panda_scene.Params`, or a dict of some of its fields: every constant of
    the task).

    ## Versions
    v0: first.

    ## Source
    Tayal, Tayal and Prakash, "RISE: Robust Imitation through Stochastic Encoding", section IV-C. Arm and
    engine: Gallouédec, Cazin, Dellandréa and Chen, "panda-gym: Open-source goal-conditioned environments for
    robotic learning", 2021.
    """

    action_space: spaces.Box
    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    KEYS = (("down", "up"), ("right", "left"), ("w", "s"))  # of a keyboard: as the camera sees the axes

    def __init__(
        self,
        render_mode: str | None = None,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        params: Params | Mapping[str, Any] = DEFAULTS,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        super().__init__(reward_type, terminate_on_collision, params)
        self.render_mode = render_mode
        self.observation_space, self.action_space = make_spaces(self.params)
        self.perceived: Array | None = None  # the reading as a noise wrapper last handed it out
        self._streams = EpisodeStreams(1)
        self._sphere: Array | None = None  # its true reading, (1, 7)
        from rise_envs import panda_sim, panda_starts  # the engine is loaded by those who run the arm only

        self._starts, self._constants = panda_starts, panda_starts.constants(self.params)
        self._sim: PandaSim | None = panda_sim.PandaSim(visuals=render_mode is not None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start an episode; with ``seed`` the one that this seed names.

        Raises:
            ValueError: a seed that is negative or no whole number, options that are no dict, or parameters that
                leave no room for a fair start.
            RuntimeError: the environment is closed.
        """
        seed = check_reset(seed, options)
        super().reset(seed=seed)
        sim = self._open_sim()
        self._streams.seed(seed, rng=self.np_random)
        key = episode_keys(*self._streams.next(np.array([0])))
        goal, sphere, self._motion_key, *_ = self._starts.begin(key, self._constants)
        sim.reset()
        self._state, self.perceived = sim.state(), None
        self._goal, self._sphere, self._time = goal[0], sphere, np.zeros(1, np.int64)
        self._least = self._nearest = sim.clearance(sphere[0, :3], float(sphere[0, 6]))
        self._there: list[float] = self._goal.tolist()
        self._away = goals.gap(sim.hand, self._there)  # m, from the goal
        self._trail = [self._state[:3]]
        return self._observe(sphere), self._info(self._state[:3], reached=False)

    def place(self, goal: Any, obstacle: Any) -> None:
        """Put goal and sphere where somebody else has them: a virtual obstacle that another process moves.

        Args:
            goal: (3,), m.
            obstacle: the true reading, (7,); it holds for the coming step.

        Raises:
            ValueError: wrong shapes, numbers that are not finite, or a radius that is not positive. Nothing has
                changed then.
        """
        sim, _ = self._open_sim(), self._started()
        self._goal, self._sphere = goals.checked_placement(goal, obstacle, 3, 1)
        self._there = self._goal.tolist()
        self._away = goals.gap(sim.hand, self._there)
        self._nearest = sim.clearance(self._sphere[0, :3], float(self._sphere[0, 6]))

    def step(self, action: Any) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Move the arm and the sphere for one step.

        Raises:
            ValueError: an action of the wrong shape, or not finite. Nothing has moved then.
            RuntimeError: the environment is closed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        sim, sphere = self._open_sim(), self._started()
        wanted = [min(1.0, max(-1.0, x)) for x in finite_numbers(action, (3,))]
        commanded, before, away = np.array(wanted, np.float32), self._state[:3], self._away
        x, y, z, u, v, w, radius = sphere[0].tolist()
        self._least, self._nearest = sim.step(commanded, (x, y, z), (u, v, w), radius, self._nearest)
        sphere = self._sphere = self._starts.advance(
            sphere, self._goal[None], self._motion_key, self._time, self._constants.rules
        )
        self._time = self._time + 1
        self._state = sim.state()
        if self.render_mode is not None:
            self._trail.append(self._state[:3])
        self._away = goals.gap(sim.hand, self._there)
        reached = self._away <= self.params.goal_radius
        info = self._info(before, reached)
        reward = goals.step_reward(away, self._away, reached, self.params.goal_radius, self.reward_type)
        terminated = reached or (self.terminate_on_collision and info["cost"] > 0)
        return self._observe(sphere), reward, terminated, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as an RGB array (480, 720, 3).

        Raises:
            RuntimeError: the environment is closed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "render() without a render_mode: make the environment with render_mode='rgb_array'"
            )
            return None
        from rise_envs import panda_rendering as drawing  # pygame is loaded by those who draw only

        sim, sphere = self._open_sim(), self._started()
        eye = drawing.camera()
        shot = sim.photograph(eye.view, eye.projection, drawing.WIDTH, drawing.VIEW, drawing.LIGHT)
        return drawing.draw_panda_scene(
            shot,
            self._goal,
            self.params.goal_radius,
            sphere[0],
            self.perceived,
            self._trail,
            self._least[0],
            self.params.dt,
        )

    def close(self) -> None:
        """Free the engine. May be called twice."""
        if self._sim is not None:
            self._sim.close()
            self._sim = None

    def _open_sim(self) -> PandaSim:
        if self._sim is None:
            raise RuntimeError("this environment is closed: make a new one with gymnasium.make()")
        return self._sim

    def _started(self) -> Array:
        if self._sphere is None:
            raise gym.error.ResetNeeded("call reset() to start an episode")
        return self._sphere

    def _observe(self, sphere: Array) -> dict[str, Array]:
        return {
            "observation": self._state.copy(),
            "achieved_goal": self._state[:3].copy(),
            "desired_goal": self._goal.copy(),
            "obstacle": sphere[0].copy(),
        }

    def _info(self, before: Array, reached: bool) -> dict[str, Any]:
        clearance, link = self._least
        hit = clearance < 0
        return {
            "cost": float(hit),
            "clearance": clearance,
            "collision_link": self._open_sim().link_names[link] if hit else None,
            "is_success": reached,
            "previous_achieved_goal": before.copy(),
        }
