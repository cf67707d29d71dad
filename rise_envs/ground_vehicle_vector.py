"""The batched form of ``RISE-GroundVehicle-v0``. See :class:`GroundVehicleVectorEnv`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rise_envs import streams
from rise_envs.ground_vehicle import DEFAULTS, VehicleTask, make_spaces
from rise_envs.vehicle_backend import choose
from rise_envs.vehicle_world import Params, World, copied, observe, sample_starts, start_clearance

Array = Any  # of NumPy or torch
Infos = dict[str, Any]


class GroundVehicleVectorEnv(VehicleTask, VectorEnv):
    """Many ground vehicles in one set of arrays: :class:`rise_envs.ground_vehicle.GroundVehicleEnv`, batched.

    Made by ``gymnasium.make_vec("RISE-GroundVehicle-v0", num_envs=N)``. Every sub-environment has its own
    stream of episodes, seeded as ``SyncVectorEnv`` does it, and follows the same trajectory as the single
    environment, to the last bit, with every backend.

    With ``backend="torch"`` observations, rewards, ends and infos are tensors on ``device``, and actions may be:
    ``gymnasium.make_vec("RISE-GroundVehicle-v0", num_envs=100_000, backend="torch", device="cuda")``.

    Args:
        num_envs: B, the number of episodes that run side by side.
        max_episode_steps: the time limit, applied here.
        autoreset_mode: any of Gymnasium's; with ``DISABLED`` give ``reset(options={"reset_mask": mask})``.
        reward_type: as for the single environment.
        terminate_on_collision: as for the single environment.
        n_obstacles: as for the single environment.
        params: as for the single environment.
        backend: whose arrays are handed out, ``"numpy"`` or ``"torch"``.
        device: of torch.
        compiled: compute in compiled code instead of one array operation after the other: ten times as fast, on
            the CPU only, and there the default.
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
        backend: str = "numpy",
        device: str = "cpu",
        compiled: bool | None = None,
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
        self._backend = choose(backend, device, compiled)
        self._base: Array = None  # of each sub-environment's stream of episodes
        self._episode = self._backend.whole(np.zeros(num_envs, np.int64))
        self._done = self._backend.whole(np.zeros(num_envs, bool))

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], Infos]:
        """Start all episodes, or those of ``options["reset_mask"]`` (B,) bool.

        Raises:
            ValueError: seeds or a mask whose length is not ``num_envs``, or seeds that are no whole numbers ≥ 0.
            gymnasium.error.ResetNeeded: a mask in the first reset, which must start all.
        """
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        mask = np.asarray(mask.cpu() if hasattr(mask, "cpu") else mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(f"options['reset_mask'] must be ({self.num_envs},) bool with at least one True")
        if self._world is None and not mask.all():
            raise gym.error.ResetNeeded("the first reset() must start every sub-environment")
        self._seed(seed, mask)
        rows = self._backend.whole(np.flatnonzero(mask))
        clearance = self._start(rows)
        infos = self._first_infos(rows, clearance)
        masks = {f"_{name}": self._backend.give(self._backend.whole(mask.copy())) for name in infos}
        return self._hand_out(observe(self.world)), self._hand_out(infos) | masks

    def _seed(self, seed: int | list[int | None] | None, mask: NDArray[np.bool_]) -> None:
        """Begin the streams of episodes anew where the mask and a seed say so."""
        n = self.num_envs
        if isinstance(seed, int | np.integer):
            fits = 0 <= seed < 2**63
            seed = np.arange(seed, seed + n, dtype=np.uint64) if fits else [seed + i for i in range(n)]  # type: ignore[assignment]
        seeded = np.array([s is not None for s in seed]) if isinstance(seed, list | tuple) else np.full(n, seed is not None)
        if len(seeded) != n:
            raise ValueError(f"expected {n} seeds, got {len(seeded)}")
        if self._base is None:  # from the operating system, for those who name none
            entropy = np.random.SeedSequence().generate_state(n, np.uint64)
            bases, fresh = entropy.view(np.int64).copy(), np.ones(n, bool)
        else:
            bases, fresh = np.zeros(n, np.int64), seeded & mask
        chosen = seeded & mask
        if chosen.any():
            wanted = seed[chosen] if isinstance(seed, np.ndarray) else [s for s, c in zip(seed, chosen, strict=True) if c]  # type: ignore[arg-type]
            bases[chosen] = streams.seed_bases(wanted)
        rows = self._backend.whole(np.flatnonzero(fresh))
        if self._base is None:
            self._base = self._backend.whole(bases)
        else:
            self._base[rows] = self._backend.whole(bases[fresh])
        self._episode[rows] = 0

    def _start(self, rows: Array) -> Array:
        """Start the next episodes of ``rows`` (indices): their clearances."""
        keys = streams.episode_keys(self._base[rows], self._episode[rows])
        fresh = sample_starts(keys, self.n_obstacles, self.constants, self._backend.dynamics)
        self._episode[rows] += 1
        if len(rows) == self.num_envs:
            self._world = fresh
        else:
            merged = {name: copied(array) for name, array in vars(self.world).items()}
            for name, array in merged.items():
                array[rows] = getattr(fresh, name)
            self._world = World(**merged)
        self._done = copied(self._done)
        self._done[rows] = False
        return start_clearance(fresh, self.constants)

    def _first_infos(self, rows: Array, clearance: Array) -> Infos:
        """The infos of episodes that have just started in ``rows``, zero elsewhere."""
        world = self.world
        everywhere, there = world.state[:, 0] * 0.0, copied(world.state[:, :2]) * 0.0
        infos = {"cost": everywhere, "clearance": copied(everywhere), "is_success": everywhere > 0}
        infos["previous_achieved_goal"] = there
        self._write_first(infos, rows, clearance)
        return infos

    def _write_first(self, infos: Infos, rows: Array, clearance: Array) -> None:
        """Put the infos of episodes that have just started into ``rows``."""
        infos["cost"][rows] = 1.0 * (clearance < 0)
        infos["clearance"][rows] = clearance
        infos["is_success"][rows] = False  # no episode starts at its goal
        infos["previous_achieved_goal"][rows] = self.world.state[rows, :2]

    def step(self, actions: Array) -> tuple[dict[str, Array], Array, Array, Array, Infos]:
        """Drive all vehicles for one step.

        Raises:
            ValueError: actions of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset, or an episode that has ended was not reset.
        """
        world, ended = self.world, self._done
        action = self._backend.action(actions, self.action_space.shape)
        restart = bool(ended.any())
        if restart and self.autoreset_mode == AutoresetMode.DISABLED:
            which = [i for i, over in enumerate(ended.tolist()) if over]
            raise gym.error.ResetNeeded(
                f"sub-environments {which} have ended: reset them with "
                "options={'reset_mask': mask} before the next step"
            )
        state, disc, clearance, rewards, reached = self._backend.dynamics.step(
            world.state, world.goal, world.disc, world.key, world.step, action, self.constants
        )
        self._world = replace(world, state=state, disc=disc, step=world.step + 1)
        hit = clearance < 0
        terminated = reached | hit if self.terminate_on_collision else copied(reached)
        truncated = self._world.step >= self.max_episode_steps
        infos = {"cost": 1.0 * hit, "clearance": clearance, "is_success": reached}
        infos["previous_achieved_goal"] = copied(world.state[:, :2])
        if restart:  # with NEXT_STEP these start anew now, instead of moving
            rows = ended.nonzero()[0] if isinstance(ended, np.ndarray) else ended.nonzero()[:, 0]
            self._write_first(infos, rows, self._start(rows))
            rewards[rows], terminated[rows], truncated[rows] = 0.0, False, False
        self._done = terminated | truncated

        observations, infos = self._hand_out(observe(self.world)), self._hand_out(infos)
        infos |= {f"_{name}": self._everyone() for name in infos}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and bool(self._done.any()):
            observations, infos = self._start_over(observations, infos)
        give = self._backend.give
        return observations, give(rewards), give(terminated), give(truncated), infos

    def _everyone(self) -> Array:
        return self._backend.give(self._backend.whole(np.ones(self.num_envs, bool)))

    def _hand_out(self, arrays: dict[str, Array]) -> dict[str, Array]:
        return {name: self._backend.give(array) for name, array in arrays.items()}

    def _start_over(self, last: dict[str, Array], infos: Infos) -> tuple[dict[str, Array], Infos]:
        """Start the ended episodes at once, keeping their last observation and info."""
        ended, give = copied(self._done), self._backend.give
        rows = self._backend.whole(np.flatnonzero(np.asarray(ended.tolist())))
        start_infos = self._first_infos(rows, self._start(rows))
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in rows.tolist():
            final_obs[i] = {key: copied(value[i]) for key, value in last.items()}
        final_info: Infos = {}
        for name, first in start_infos.items():
            final_info[name], final_info[f"_{name}"] = copied(infos[name]), give(copied(ended))
            final_info[name][give(~ended)] = 0
            infos[name] = copied(infos[name])
            infos[name][give(rows)] = give(first)[give(rows)]
        infos |= {"final_obs": final_obs, "_final_obs": give(copied(ended))}
        infos |= {"final_info": final_info, "_final_info": give(copied(ended))}
        return self._hand_out(observe(self.world)), infos
