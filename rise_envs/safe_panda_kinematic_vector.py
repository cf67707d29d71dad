"""The batched form of ``RISE-SafePandaKinematic-v0``. See :class:`SafePandaKinematicVectorEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from rise_envs import goals, streams
from rise_envs.actions import finite_action
from rise_envs.episodes import EpisodeStreams, Seeds, check_running, reset_mask, space_of_many
from rise_envs.panda_scene import DEFAULTS, Params
from rise_envs.panda_starts import constants
from rise_envs.panda_task import PandaTask, make_spaces
from rise_envs.panda_world import World, advance, begin, observe, replaced, report
from rise_envs.safe_panda_kinematic import check_no_pictures
from rise_envs.settings import whole

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
Infos = dict[str, Any]


class SafePandaKinematicVectorEnv(PandaTask, VectorEnv):
    """Many arms in one set of arrays: :class:`rise_envs.safe_panda_kinematic.SafePandaKinematicEnv`, batched.

    Made by ``gymnasium.make_vec("RISE-SafePandaKinematic-v0", num_envs=N)``. Every sub-environment has its own
    stream of episodes, seeded as ``SyncVectorEnv`` does it, and follows the same trajectory as the single
    environment, to the last bit.

    Args:
        num_envs: B, the number of episodes that run side by side.
        max_episode_steps: the time limit, applied here.
        autoreset_mode: any of Gymnasium's; with ``DISABLED`` give ``reset(options={"reset_mask": mask})``.
        reward_type: as for the single environment.
        terminate_on_collision: as for the single environment.
        params: as for the single environment.
        render_mode: there are no pictures: None.
    """

    action_space: spaces.Box
    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = 50,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        params: Params | Mapping[str, Any] = DEFAULTS,
        render_mode: str | None = None,
    ) -> None:
        check_no_pictures(render_mode)
        num_envs = whole("num_envs", num_envs, 1)
        max_episode_steps = whole("max_episode_steps", max_episode_steps, 1)
        super().__init__(reward_type, terminate_on_collision, params)
        self.num_envs, self.render_mode, self.max_episode_steps = num_envs, None, max_episode_steps
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = make_spaces(self.params)
        self.observation_space = space_of_many(self.single_observation_space, num_envs)
        self.action_space = space_of_many(self.single_action_space, num_envs)
        self._constants = constants(self.params)
        self._streams = EpisodeStreams(num_envs)
        self._world: World | None = None
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self,
        *,
        seed: Seeds = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Array], Infos]:
        """Start all episodes, or those of ``options["reset_mask"]`` (B,) bool.

        Raises:
            ValueError: seeds or a mask whose length is not ``num_envs``, or seeds that are no whole numbers ≥ 0.
            gymnasium.error.ResetNeeded: a mask in the first reset, which must start all.
        """
        mask = reset_mask(options, self.num_envs, first=self._world is None)
        self._streams.seed(seed, mask)
        world = self._start(np.flatnonzero(mask))
        infos = self._report_starts(world, mask)
        return observe(world), infos | {f"_{name}": mask.copy() for name in infos}

    def _start(self, rows: Rows) -> World:
        """Start the next episodes of ``rows``: the world with them."""
        fresh = begin(streams.episode_keys(*self._streams.next(rows)), self._constants)
        self._ended[rows] = False
        whole = self._world is None or len(rows) == self.num_envs
        self._world = fresh if whole else replaced(cast(World, self._world), rows, fresh)
        return self._world

    def _report_starts(self, world: World, mask: Mask) -> Infos:
        """The infos of episodes that have just started where the mask says so, zero elsewhere."""
        infos = report(world, world.arms.hand, np.zeros(self.num_envs, bool))
        for name, values in infos.items():
            values[~mask] = None if name == "collision_link" else 0
        return infos

    def step(self, actions: Any) -> tuple[dict[str, Array], Array, Mask, Mask, Infos]:
        """Move all arms and spheres for one step.

        Raises:
            ValueError: actions of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset, or an episode that has ended was not reset.
        """
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() to start the episodes")
        commanded = finite_action(actions, self.action_space.shape)
        ended = self._ended
        if self.autoreset_mode == AutoresetMode.DISABLED:
            check_running(ended)
        before = self._world.arms.hand
        world = self._world = advance(self._world, commanded, self._constants)
        if ended.any():  # with NEXT_STEP these start anew now, instead of moving
            ended = ended.copy()
            world = self._start(np.flatnonzero(ended))
            before = np.where(ended[:, None], world.arms.hand, before)
        hand, goal = world.arms.hand, world.goal
        reached = (goals.distance(hand, goal) <= self.params.goal_radius) & ~ended
        infos = report(world, before, reached)
        rewards = self.compute_reward(hand, goal, infos)
        terminated, truncated = reached, world.step >= self.max_episode_steps
        if self.terminate_on_collision:
            terminated = reached | (infos["cost"] > 0)
        if ended.any():
            rewards[ended], terminated[ended] = 0.0, False
        self._ended = terminated | truncated
        infos |= {f"_{name}": np.ones(self.num_envs, bool) for name in infos}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            return (*self._start_over(world, rewards, terminated, truncated, infos),)
        return observe(world), rewards, terminated, truncated, infos

    def _start_over(
        self, world: World, rewards: Array, terminated: Mask, truncated: Mask, infos: Infos
    ) -> tuple[dict[str, Array], Array, Mask, Mask, Infos]:
        """Start the ended episodes at once, keeping their last observation and info."""
        ended = self._ended.copy()
        rows, last = np.flatnonzero(ended), observe(world)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in rows:
            final_obs[i] = {key: value[i].copy() for key, value in last.items()}
        final_info: Infos = {}
        fresh = self._start(rows)
        for name, first in self._report_starts(fresh, ended).items():
            final_info[name], final_info[f"_{name}"] = infos[name].copy(), ended.copy()
            final_info[name][~ended] = None if name == "collision_link" else 0
            infos[name][rows] = first[rows]
        infos |= {"final_obs": final_obs, "_final_obs": ended.copy()}
        infos |= {"final_info": final_info, "_final_info": ended}
        return observe(fresh), rewards, terminated, truncated, infos
