"""The batched form of ``RISE-GroundVehicle-v0``. See :class:`GroundVehicleVectorEnv`."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rise_envs import goals, streams
from rise_envs.actions import checked_action
from rise_envs.ground_vehicle import DEFAULTS, VehicleTask, make_spaces
from rise_envs.vehicle_world import Array, Params, advance, observe, sample_starts, start_clearance

Rows = NDArray[np.bool_]


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

    action_space: spaces.Box
    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = 200,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        n_obstacles: int = 1,
        params: Params = DEFAULTS,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(reward_type, terminate_on_collision, n_obstacles, params)
        if render_mode is not None:
            raise ValueError("the batched vehicles are not drawn: render a single environment instead")
        if min(num_envs, max_episode_steps) < 1:
            raise ValueError(f"num_envs={num_envs} and max_episode_steps={max_episode_steps} must be ≥ 1")
        self.num_envs, self.render_mode, self.max_episode_steps = num_envs, None, max_episode_steps
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = make_spaces(self.n_obstacles, params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = cast(spaces.Box, batch_space(self.single_action_space, num_envs))
        self._rngs: list[np.random.Generator] = []
        self._done = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start all episodes, or those of ``options["reset_mask"]`` (B,) bool.

        Raises:
            ValueError: a list of seeds or a mask whose length is not ``num_envs``.
            gymnasium.error.ResetNeeded: a mask in the first reset, which must start all.
        """
        rows = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if rows.shape != (self.num_envs,) or rows.dtype != bool or not rows.any():
            raise ValueError(f"options['reset_mask'] must be ({self.num_envs},) bool with at least one True")
        if self._world is None and not rows.all():
            raise gym.error.ResetNeeded("the first reset() must start every sub-environment")
        self._rngs = self._generators(seed, rows)
        return self._start(rows)

    def _generators(self, seed: int | list[int | None] | None, rows: Rows) -> list[np.random.Generator]:
        """The generator of each sub-environment, new where ``rows`` has a seed; ``None`` seeds once."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        if seeds is None:
            return self._rngs or [seeding.np_random()[0] for _ in rows]
        if len(seeds) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, got {len(seeds)}")
        return [
            rng if wanted is None or not row else seeding.np_random(int(wanted))[0]
            for rng, wanted, row in zip(self._generators(None, rows), seeds, rows, strict=True)
        ]

    def _start(self, rows: Rows) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start new episodes in ``rows``: the observations of all, the infos of these."""
        keys = np.array([streams.draw_key(self._rngs[i]) for i in np.flatnonzero(rows)])
        fresh = sample_starts(keys, self.n_obstacles, self.params)
        self._world = fresh if rows.all() else self.world.merge(fresh, rows)
        self._done = self._done & ~rows
        clearance = start_clearance(self.world, self.params)
        return observe(self.world), self._infos(clearance, self.world.state[:, :2], rows)

    def _infos(self, clearance: Array, before: Array, rows: Rows) -> dict[str, Any]:
        """Infos of ``rows`` as ``SyncVectorEnv`` lays them out: zero elsewhere, and a mask for each."""
        achieved, goal = self.world.state[:, :2], self.world.goal
        values = {
            "cost": (clearance < 0).astype(np.float64),
            "clearance": clearance,
            "is_success": goals.distance(achieved, goal) <= self.params.goal_radius,
            "previous_achieved_goal": before,
        }
        infos: dict[str, Any] = {}
        for name, value in values.items():
            infos[name], infos[f"_{name}"] = _pick(rows, value, np.zeros_like(value)), rows.copy()
        return infos

    def step(self, actions: NDArray) -> tuple[dict[str, Array], Array, Rows, Rows, dict[str, Any]]:
        """Drive all vehicles for one step.

        Raises:
            ValueError: actions of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset, or an episode that has ended was not reset.
        """
        before = self.world
        driven = checked_action(actions, self.action_space)
        if self.autoreset_mode == AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded(
                f"sub-environments {np.flatnonzero(self._done).tolist()} have ended: reset them with "
                "options={'reset_mask': mask} before the next step"
            )
        self._world, clearance = advance(before, driven, self.params)
        started = self._done  # with NEXT_STEP these start anew now, instead of moving
        start_infos = self._start(started)[1] if started.any() else None

        infos = self._infos(clearance, before.state[:, :2], ~started)
        achieved, goal = self.world.state[:, :2], self.world.goal
        about = {"previous_achieved_goal": before.state[:, :2], "cost": infos["cost"]}
        rewards = np.where(started, 0.0, self.compute_reward(achieved, goal, about))
        terminated = self.compute_terminated(achieved, goal, about) & ~started
        truncated = (self.world.step >= self.max_episode_steps) & ~started
        if start_infos is not None:
            infos = {name: _pick(started, start_infos[name], value) for name, value in infos.items()}

        observations = observe(self.world)
        self._done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._done.any():
            observations, infos = self._start_over(observations, infos)
        return observations, rewards, terminated, truncated, infos

    def _start_over(
        self, last: dict[str, Array], infos: dict[str, Any]
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start the ended episodes at once, keeping their last observation and info."""
        rows = self._done
        observations, start_infos = self._start(rows)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(rows):
            final_obs[i] = {key: value[i].copy() for key, value in last.items()}
        final_info: dict[str, Any] = {}
        for name in [name for name in infos if not name.startswith("_")]:
            value = infos[name]
            final_info[name], final_info[f"_{name}"] = _pick(rows, value, np.zeros_like(value)), rows.copy()
            infos[name] = _pick(rows, start_infos[name], value)
        infos |= {"final_obs": final_obs, "_final_obs": rows.copy()}
        infos |= {"final_info": final_info, "_final_info": rows.copy()}
        return observations, infos


def _pick(rows: Rows, chosen: NDArray, otherwise: NDArray) -> NDArray:
    """``chosen`` (B, ...) in the given ``rows`` (B,), ``otherwise`` in the others; a new array."""
    return np.where(rows.reshape((-1,) + (1,) * (chosen.ndim - 1)), chosen, otherwise)
