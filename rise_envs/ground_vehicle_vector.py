"""The batched form of ``RISE-GroundVehicle-v0``. See :class:`GroundVehicleVectorEnv`."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rise_envs import goals, streams
from rise_envs.actions import checked_action
from rise_envs.ground_vehicle import (
    Array,
    Params,
    VehicleTask,
    World,
    advance,
    make_spaces,
    observe,
    sample_starts,
    start_clearance,
)


class GroundVehicleVectorEnv(VehicleTask, VectorEnv):
    """Many ground vehicles in one set of arrays: :class:`rise_envs.ground_vehicle.GroundVehicleEnv`, batched.

    Made by ``gymnasium.make_vec("RISE-GroundVehicle-v0", num_envs=N)``. Every sub-environment has its own
    generator, seeded as ``SyncVectorEnv`` does it, and follows the same trajectory as the single environment.

    Args:
        num_envs: B, the number of episodes that run side by side.
        max_episode_steps: the time limit, applied here.
        autoreset_mode: any of Gymnasium's; with ``DISABLED`` give ``reset(options={"reset_mask": mask})``.
        reward_type: as for the single environment.
        terminate_on_collision: as for the single environment.
        n_obstacles: as for the single environment.
        params: as for the single environment.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = 200,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        n_obstacles: int = 1,
        params: Params = Params(),
        render_mode: str | None = None,
    ) -> None:
        super().__init__(reward_type, terminate_on_collision, n_obstacles, params)
        if render_mode is not None:
            raise ValueError("the batched vehicles are not drawn: render a single environment instead")
        self.num_envs, self.render_mode, self.max_episode_steps = num_envs, None, max_episode_steps
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = make_spaces(self.n_obstacles, params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._world: World | None = None
        self._done = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start all episodes, or those of ``options["reset_mask"]`` (B,) bool.

        Raises:
            ValueError: a list of seeds or a mask whose length is not ``num_envs``.
        """
        rows = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if rows.shape != (self.num_envs,) or rows.dtype != bool or not rows.any():
            raise ValueError(f"options['reset_mask'] must be ({self.num_envs},) bool with at least one True")
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, got {len(seeds)}")
        for i in np.flatnonzero(rows):
            wanted = None if seeds is None else seeds[i]
            if wanted is not None or self._rngs[i] is None:
                self._rngs[i], _ = seeding.np_random(None if wanted is None else int(wanted))
        if self._world is None and not rows.all():
            raise gym.error.ResetNeeded("the first reset() must start every sub-environment")
        return self._start(rows)

    def _start(self, rows: NDArray[np.bool_]) -> tuple[dict[str, Array], dict[str, Any]]:
        keys = np.array([streams.draw_key(self._rngs[i]) for i in np.flatnonzero(rows)])
        fresh = sample_starts(keys, self.n_obstacles, self.params)
        self._world = fresh if rows.all() else self._world.merge(fresh, rows)
        self._done = self._done & ~rows
        clearance = start_clearance(self._world, self.params)
        infos = self._infos(clearance, self._world.state[:, :2], rows)
        infos["cost"] = np.zeros(self.num_envs)
        return observe(self._world), infos

    def _infos(self, clearance: Array, before: Array, rows: NDArray[np.bool_]) -> dict[str, Any]:
        reached = goals.distance(self._world.state[:, :2], self._world.goal) <= self.params.goal_radius
        values = {
            "cost": (clearance < 0).astype(np.float64),
            "clearance": clearance,
            "is_success": reached,
            "previous_achieved_goal": before.copy(),
        }
        infos: dict[str, Any] = {}
        for name, value in values.items():
            mask = rows.reshape((-1,) + (1,) * (value.ndim - 1))
            infos[name], infos[f"_{name}"] = np.where(mask, value, np.zeros_like(value)), rows.copy()
        return infos

    def step(
        self, actions: NDArray
    ) -> tuple[dict[str, Array], Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Drive all vehicles for one step; raises ``ValueError`` as the single environment does."""
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        driven = checked_action(actions, self.action_space)
        if self.autoreset_mode == AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded(
                f"sub-environments {np.flatnonzero(self._done).tolist()} have ended: reset them with "
                "options={'reset_mask': mask} before the next step"
            )
        before = self._world
        world, clearance = advance(before, driven, self.params)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and self._done.any():
            return self._step_with_starts(world, before, clearance)
        self._world = world
        rewards, terminated, truncated, infos = self._judge(
            clearance, before.state[:, :2], np.ones_like(self._done)
        )
        observations = observe(world)
        self._done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._done.any():
            observations, infos = self._start_over(observations, infos)
        return observations, rewards, terminated, truncated, infos

    def _judge(self, clearance: Array, before: Array, rows: NDArray[np.bool_]) -> tuple[Any, Any, Any, Any]:
        """Rewards, ends and infos of a step in which ``rows`` moved."""
        infos = self._infos(clearance, before, rows)
        achieved, goal = self._world.state[:, :2], self._world.goal
        progress = goals.distance(before, goal) - goals.distance(achieved, goal)
        reached = goals.distance(achieved, goal) <= self.params.goal_radius
        rewards = (
            progress / self.params.goal_radius + reached if self.reward_type == "dense" else reached - 1.0
        )
        terminated = reached | (self.terminate_on_collision & (clearance < 0))
        truncated = self._world.step >= self.max_episode_steps
        return np.where(rows, rewards, 0.0), terminated & rows, truncated & rows, infos

    def _step_with_starts(self, world: World, before: World, clearance: Array) -> tuple[Any, ...]:
        """A step in which the episodes that have ended start anew instead of moving."""
        rows = self._done.copy()
        self._world = world
        _, start_infos = self._start(rows)
        rewards, terminated, truncated, infos = self._judge(clearance, before.state[:, :2], ~rows)
        for name, value in start_infos.items():
            pick = rows.reshape((-1,) + (1,) * (value.ndim - 1))
            infos[name] = np.where(pick, value, infos[name])
        self._done = terminated | truncated
        return observe(self._world), rewards, terminated, truncated, infos

    def _start_over(
        self, last: dict[str, Array], infos: dict[str, Any]
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start the ended episodes at once, keeping their last observation and info."""
        rows = self._done.copy()
        observations, start_infos = self._start(rows)
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(rows):
            final[i] = {key: value[i].copy() for key, value in last.items()}
        final_info: dict[str, Any] = {}
        for name in [name for name in infos if not name.startswith("_")]:
            pick = rows.reshape((-1,) + (1,) * (infos[name].ndim - 1))
            final_info[name], final_info[f"_{name}"] = (
                np.where(pick, infos[name], np.zeros_like(infos[name])),
                rows,
            )
            infos[name] = np.where(pick, start_infos[name], infos[name])
        return observations, {
            **infos, "final_obs": final, "_final_obs": rows, "final_info": final_info, "_final_info": rows,
        }  # fmt: skip
