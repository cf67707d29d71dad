"""``RISE-SafePandaKinematic-v0``: the Panda without an engine. See :class:`SafePandaKinematicEnv`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import goals
from rise_envs.actions import finite_action
from rise_envs.episodes import EpisodeStreams, check_reset
from rise_envs.panda_scene import DEFAULTS, Params
from rise_envs.panda_task import PandaTask, make_spaces
from rise_envs.streams import episode_keys

if TYPE_CHECKING:
    from rise_envs.panda_world import World

Array = NDArray[np.float64]


@functools.cache
def _worlds() -> Any:
    """The arm's world: numba is loaded by those who make one only. No attribute, as modules cannot be copied."""
    from rise_envs import panda_world

    return panda_world


class SafePandaKinematicEnv(PandaTask, gym.Env):
    """The task of ``RISE-SafePanda-v0`` with a model of the arm's motion in place of the physics engine.

    ## Description
    Another dynamics model of the same task, made to be stepped by the thousand: batched, it is hundreds of times
    as fast as an engine. Spaces, starts, sphere, reward, cost and info are those of
    :class:`rise_envs.safe_panda.SafePandaEnv`; the same seed names the same goal, sphere and motion of the
    sphere. Train on it; report results from Bullet.

    What is modelled: Bullet's damped inverse kinematics, the torque-limited motors, the rigid-body dynamics of
    the seven links, in 20 substeps of 2 ms (:mod:`rise_envs.panda_motion`). The clearance is that of twenty
    capsules (:mod:`rise_envs.panda_kinematics`), looked at six times within a step, both ends included.
    How far that is from Bullet is measured by ``python -m benchmarks.fidelity``; see `docs/environments.md`.

    ## Action space
    As `RISE-SafePanda-v0`: `Box(3,)`, float32, displacement of the hand in units of 0.05 m.

    ## Observation space
    As `RISE-SafePanda-v0`.

    ## Reward
    As `RISE-SafePanda-v0`.

    ## Info, each step
    As `RISE-SafePanda-v0`: `cost`, `clearance`, `collision_link`, `is_success`, `previous_achieved_goal`.

    ## Start
    As `RISE-SafePanda-v0`, seed by seed.

    ## End
    As `RISE-SafePanda-v0`.

    ## Arguments
    `reward_type`, `terminate_on_collision`, `params`. There are no pictures: `render_mode` must be `None`.

    ## Versions
    v0: first.

    ## Source
    As `RISE-SafePanda-v0`; the model of the motion is described, with its sources, where it is written.
    """

    action_space: spaces.Box
    metadata = {"render_modes": [], "render_fps": 25}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        params: Params | Mapping[str, Any] = DEFAULTS,
    ) -> None:
        check_no_pictures(render_mode)
        super().__init__(reward_type, terminate_on_collision, params)
        self.render_mode = None
        self.observation_space, self.action_space = make_spaces(self.params)
        self.perceived: Array | None = None  # where a noise wrapper leaves the reading
        self._streams = EpisodeStreams(1)
        self._world: World | None = None
        self._constants = _worlds().panda_starts.constants(self.params)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start an episode; with ``seed`` the one that this seed names.

        Raises:
            ValueError: as for ``RISE-SafePanda-v0``.
        """
        seed = check_reset(seed, options)
        super().reset(seed=seed)
        self._streams.seed(seed, rng=self.np_random)
        world = _worlds().begin(episode_keys(*self._streams.next(np.array([0]))), self._constants)
        self._world, self.perceived = world, None
        return self._observe(world), self._info(world, world.arms.hand, False)

    def step(self, action: Any) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Move the arm and the sphere for one step.

        Raises:
            ValueError: an action of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() to start an episode")
        before = self._world.arms.hand
        commanded = finite_action(action, self.action_space.shape)
        world = self._world = _worlds().advance(self._world, commanded[None], self._constants)
        hand, goal = world.arms.hand[0], world.goal[0]
        reached = bool(goals.distance(hand, goal) <= self.params.goal_radius)
        info = self._info(world, before, reached)
        reward = float(self.compute_reward(hand, goal, info))
        terminated = reached or (self.terminate_on_collision and info["cost"] > 0)
        return self._observe(world), reward, terminated, False, info

    def _observe(self, world: World) -> dict[str, Array]:
        return {key: rows[0] for key, rows in _worlds().observe(world).items()}

    def _info(self, world: World, before: Array, reached: bool) -> dict[str, Any]:
        rows = _worlds().report(world, before, np.array([reached]))
        return {
            "cost": float(rows["cost"][0]),
            "clearance": float(rows["clearance"][0]),
            "collision_link": rows["collision_link"][0],
            "is_success": reached,
            "previous_achieved_goal": rows["previous_achieved_goal"][0],
        }


def check_no_pictures(render_mode: str | None) -> None:
    """Raise ``TypeError`` unless no pictures are asked for: where there is no such argument, others go on without."""
    if render_mode is not None:
        raise TypeError(
            f"RISE-SafePandaKinematic-v0 draws no pictures: render_mode must be None, got {render_mode!r}; "
            "RISE-SafePanda-v0 has 'rgb_array', and the same seeds"
        )
