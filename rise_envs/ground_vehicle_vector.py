"""The batched form of ``RISE-GroundVehicle-v0``. See :class:`GroundVehicleVectorEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from rise_envs.episodes import EpisodeStreams, Seeds, check_running, reset_mask, space_of_many
from rise_envs.ground_vehicle import DEFAULTS, VehicleTask, make_spaces
from rise_envs.settings import whole
from rise_envs.vehicle_backend import choose
from rise_envs.vehicle_world import Outcome, Params, World, copied

Array = Any  # of NumPy or torch
Infos = dict[str, Any]


class GroundVehicleVectorEnv(VehicleTask, VectorEnv):
    """Many ground vehicles in one set of arrays: :class:`rise_envs.ground_vehicle.GroundVehicleEnv`, batched.

    Made by ``gymnasium.make_vec("RISE-GroundVehicle-v0", num_envs=N)``. Every sub-environment has its own
    stream of episodes, seeded as ``SyncVectorEnv`` does it, and follows the same trajectory as the single
    environment, to the last bit, with every backend.

    With ``backend="torch"`` observations, rewards, ends and infos are tensors on ``device``, and actions may be:
    ``gymnasium.make_vec("RISE-GroundVehicle-v0", num_envs=100_000, backend="torch", device="cuda")``. In one
    thing infos differ then: ``final_obs`` of ``SAME_STEP`` is one batch of observations, not B dictionaries. The
    goal API (``compute_reward`` and the like) is for arrays of NumPy.

    What a step of a large batch hands out is one piece of memory: copy what you keep of it.

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
            the CPU only, and there the default. With NumPy on one core, with torch on its number of threads.
    """

    action_space: spaces.Box
    _world: World | None = None
    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = 200,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        reward_type: str = "dense",
        terminate_on_collision: bool = False,
        n_obstacles: int = 1,
        params: Params | Mapping[str, Any] = DEFAULTS,
        render_mode: str | None = None,
        backend: str = "numpy",
        device: str = "cpu",
        compiled: bool | None = None,
    ) -> None:
        super().__init__(reward_type, terminate_on_collision, n_obstacles, params)
        if render_mode is not None:
            raise ValueError("the batched vehicles are not drawn: render a single environment instead")
        num_envs = whole("num_envs", num_envs, 1)
        max_episode_steps = whole("max_episode_steps", max_episode_steps, 1)
        self.num_envs, self.render_mode, self.max_episode_steps = num_envs, None, max_episode_steps
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = make_spaces(self.n_obstacles, self.params)
        self.observation_space = space_of_many(self.single_observation_space, num_envs)
        self.action_space = space_of_many(self.single_action_space, num_envs)
        self._backend = choose(backend, device, compiled)
        self._streams = EpisodeStreams(num_envs, self._backend.own)
        self._done = self._backend.own(np.zeros(num_envs, bool))

    @property
    def world(self) -> World:
        """The true state, to be read, never to be written into.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() to start the episodes")
        return self._world

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], Infos]:
        """Start all episodes, or those of ``options["reset_mask"]`` (B,) bool.

        Raises:
            ValueError: seeds or a mask whose length is not ``num_envs``, or seeds that are no whole numbers ≥ 0.
            gymnasium.error.ResetNeeded: a mask in the first reset, which must start all.
        """
        mask = reset_mask(options, self.num_envs, first=self._world is None)
        self._streams.seed(seed, mask)
        self._world = self._world or self._nowhere()
        shown = self._start(self._backend.own(np.flatnonzero(mask)))
        infos = self._infos(shown)
        return self._observation(shown), infos | self._masks(infos, mask)

    def _nowhere(self) -> World:
        """A world that is still to be filled in."""
        n, own = self.num_envs, self._backend.own
        tables = (own(np.zeros((n, *shape))) for shape in ((3,), (2,), (self.n_obstacles, 5)))
        return World(*tables, *(own(np.zeros(n, np.int64)) for _ in range(2)))

    def _start(self, rows: Array, shown: Outcome | None = None) -> Outcome:
        """Start the next episodes of ``rows`` (indices), and let ``shown`` tell of them.

        Without it: what there is to see in all rows, with infos that are zero in the others.
        """
        w = self.world
        if shown is None:
            nothing = w.state[:, 0] * 0.0
            shown = Outcome(
                state=copied(w.state),
                achieved=copied(w.state[:, :2]),
                goal=copied(w.goal),
                obstacle=copied(w.disc).reshape(self.num_envs, -1),
                previous=w.state[:, :2] * 0.0,
                **{name: copied(nothing) for name in ("clearance", "cost", "reward")},
                **{name: nothing > 0.0 for name in ("reached", "terminated", "truncated")},
            )
        base, number = self._streams.next(rows)
        backend = self._backend
        try:
            backend.dynamics.restart(w, shown, rows, base, number, self.constants, backend.threads)
        except ValueError:  # no room for a fair start: the world is half filled in, so it is none
            self._world = None
            raise
        self._done[rows] = False
        return shown

    def step(self, actions: Array) -> tuple[dict[str, Array], Array, Array, Array, Infos]:
        """Drive all vehicles for one step.

        Raises:
            ValueError: actions of the wrong shape, or not finite. Nothing has moved then.
            gymnasium.error.ResetNeeded: before the first reset, or an episode that has ended was not reset.
        """
        world, backend = self.world, self._backend
        action = backend.action(actions, self.action_space.shape)
        restart = bool(self._done.any())
        if self.autoreset_mode == AutoresetMode.DISABLED:
            check_running(self._done)
        shown = backend.dynamics.advance(
            world,
            action,
            self.constants,
            self.max_episode_steps,
            self.terminate_on_collision,
            backend.threads,
        )
        if restart:  # with NEXT_STEP these start anew now, instead of moving
            self._start(_indices(self._done), shown)
        self._done = shown.terminated | shown.truncated
        infos = self._infos(shown)
        infos |= self._masks(infos)
        rewards, terminated, truncated = map(backend.give, (shown.reward, shown.terminated, shown.truncated))
        if self.autoreset_mode == AutoresetMode.SAME_STEP and bool(self._done.any()):
            return self._start_over(shown, infos), rewards, terminated, truncated, infos
        return self._observation(shown), rewards, terminated, truncated, infos

    def _observation(self, shown: Outcome) -> dict[str, Array]:
        give = self._backend.give
        return {
            "observation": give(shown.state),
            "achieved_goal": give(shown.achieved),
            "desired_goal": give(shown.goal),
            "obstacle": give(shown.obstacle),
        }

    def _infos(self, shown: Outcome) -> Infos:
        give = self._backend.give
        return {
            "cost": give(shown.cost),
            "clearance": give(shown.clearance),
            "is_success": give(shown.reached),
            "previous_achieved_goal": give(shown.previous),
        }

    def _masks(self, infos: Infos, mask: NDArray[np.bool_] | bool = True) -> Infos:
        """Gymnasium's masks that say who has the infos."""
        masks = np.empty((len(infos), self.num_envs), bool)
        masks[:] = mask
        masks = self._backend.give(self._backend.own(masks))
        return {f"_{name}": masks[i] for i, name in enumerate(infos)}

    def _start_over(self, last: Outcome, infos: Infos) -> dict[str, Array]:
        """Start the ended episodes at once: their first observations. ``infos`` receives their last."""
        ended, give = copied(self._done), self._backend.give
        rows = _indices(ended)
        first = self._start(rows)
        final: Infos = {}
        for name, fresh in self._infos(first).items():
            final[name], final[f"_{name}"] = copied(infos[name]), give(copied(ended))
            final[name][give(~ended)] = 0
            infos[name] = copied(infos[name])
            infos[name][give(rows)] = fresh[give(rows)]
        seen: Any = self._observation(last)
        if isinstance(last.state, np.ndarray) and give is self._backend.own:  # as Gymnasium does
            parts, seen = seen, np.full(self.num_envs, None, dtype=object)
            for i in rows.tolist():
                seen[i] = {key: value[i].copy() for key, value in parts.items()}
        infos |= {"final_obs": seen, "_final_obs": give(copied(ended))}
        infos |= {"final_info": final, "_final_info": give(copied(ended))}
        return self._observation(first)


def _indices(mask: Array) -> Array:
    """Where a mask of NumPy or torch holds."""
    return mask.nonzero()[0] if isinstance(mask, np.ndarray) else mask.nonzero()[:, 0]
