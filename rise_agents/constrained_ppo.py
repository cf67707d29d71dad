"""SB3's PPO under a cost limit: see :mod:`rise_agents.lagrangian`.

Shapes: T steps, B sub-environments, K network inputs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from rise_agents.lagrangian import Array, Controller, constrained_advantage
from rise_agents.networks import mlp
from rise_agents.stages import moments, optimiser_state, to_arrays, under

# Our name of each part of the state -> SB3's.
_PARTS = {
    "policy": "policy",
    "optimizer": "policy.optimizer",
    "cost_critic": "cost_critic",
    "cost_optimizer": "cost_optimizer",
}


class ConstrainedPPO(PPO):
    """SB3's PPO whose advantages carry a cost. Its environment is a :class:`rise_agents.bridge.Bridge`.

    Args:
        controller: sets the multiplier.
        cost_gamma: discount of costs.
        cost_gae_lambda: of the cost advantage.
        cost_hidden: widths of the cost critic.
        report: called after every update with the figures of the roll-out.
        restart_every: updates after which all episodes start anew, named by seeds of their own (0: never). What follows
            depends on :meth:`snapshot` only: from there an interrupted training can go on.
        at_restart: called there.
        **ppo: arguments of SB3's PPO.
    """

    def __init__(
        self,
        *,
        controller: Controller,
        cost_gamma: float,
        cost_gae_lambda: float,
        cost_hidden: Sequence[int],
        report: Callable[[float, dict[str, float]], None],
        restart_every: int = 0,
        at_restart: Callable[[], None] = lambda: None,
        **ppo: Any,
    ) -> None:
        self.controller, self.report = controller, report
        self.restart_every, self.at_restart = restart_every, at_restart
        self.cost_gamma, self.cost_gae_lambda, self.cost_hidden = cost_gamma, cost_gae_lambda, cost_hidden
        self.step_costs: list[NDArray] = []  # of this roll-out, T arrays (B,)
        self.episode_costs: list[float] = []  # of the episodes that ended in this roll-out
        self._cut: list[tuple[int, int, Array]] = []  # step, row, last inputs of episodes cut by a time limit
        super().__init__(policy="MlpPolicy", normalize_advantage=False, **ppo)

    def _setup_model(self) -> None:
        super()._setup_model()
        # Nothing here draws from the global generators: without a multiplier this is SB3's PPO to the bit.
        self.cost_rng = np.random.default_rng((self.seed or 0, 1))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(self.cost_rng.integers(2**31)))
            self.cost_critic = mlp(self.rollout_buffer.obs_shape[0], self.cost_hidden, 1).to(self.device)
        self.cost_optimizer = torch.optim.Adam(
            self.cost_critic.parameters(), self.lr_schedule(1), eps=1e-5, fused=True
        )
        unused = spaces.Box(0, 1, (1,))
        self._cost_buffer = RolloutBuffer(
            *(self.n_steps, unused, unused),
            gamma=self.cost_gamma,
            gae_lambda=self.cost_gae_lambda,
            n_envs=self.n_envs,
        )

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """As SB3's, with costs noted, and episodes started anew now and then."""
        updates = self.num_timesteps // (self.n_steps * self.n_envs)
        if self.restart_every and updates and updates % self.restart_every == 0:
            self.at_restart()
            self._last_obs = self.env.restart(updates // self.restart_every)  # type: ignore[union-attr]
            self._last_episode_starts = np.ones(self.n_envs, bool)
        self.step_costs, self.episode_costs, self._cut = [], [], []
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: NDArray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        for i in np.flatnonzero(np.asarray(dones)):
            self.episode_costs.append(infos[i]["episode"]["c"])
            if infos[i]["TimeLimit.truncated"]:
                self._cut.append((len(self.step_costs), int(i), infos[i]["terminal_observation"]))
        self.step_costs.append(self.env.costs)  # type: ignore[union-attr]

    def cost_values(self, inputs: Array) -> Array:
        """The cost critic's estimates (...) for inputs (..., K)."""
        with torch.no_grad():
            return self.cost_critic(torch.as_tensor(inputs, device=self.device)).squeeze(-1).cpu().numpy()

    def cost_advantage(self) -> tuple[Array, Array]:
        """Cost advantages and returns of the roll-out, (T, B) each, by SB3's own estimator."""
        buffer, rollout = self._cost_buffer, self.rollout_buffer
        buffer.rewards = np.array(self.step_costs, np.float32)
        if self._cut:  # as SB3 does for rewards: what a time limit cuts off is estimated, not lost
            step, row, last = (np.array(column) for column in zip(*self._cut, strict=True))
            buffer.rewards[step, row] += self.cost_gamma * self.cost_values(last)
        buffer.values, buffer.episode_starts = self.cost_values(rollout.observations), rollout.episode_starts
        following = torch.as_tensor(self.cost_values(np.asarray(self._last_obs)))
        buffer.compute_returns_and_advantage(following, np.asarray(self._last_episode_starts))
        return buffer.advantages, buffer.returns

    def train(self) -> None:
        """One update: of the multiplier, of policy and value by SB3, of the cost critic."""
        if self.episode_costs:  # a roll-out in which no episode ended says nothing about J
            self.controller = self.controller.update(float(np.mean(self.episode_costs)))
        rollout = self.rollout_buffer
        advantages, returns = self.cost_advantage()
        rollout.advantages = constrained_advantage(rollout.advantages, advantages, self.controller.multiplier)
        inputs = rollout.observations.reshape(-1, rollout.observations.shape[-1])
        super().train()
        self._fit_cost_critic(inputs, returns.reshape(-1))
        self.report(1.0 - self._current_progress_remaining, self._figures())

    def _fit_cost_critic(self, inputs: Array, returns: Array) -> None:
        """Regress on inputs (T·B, K) and returns (T·B,), with as many passes as the policy makes."""
        self._update_learning_rate(self.cost_optimizer)
        x, y = (torch.as_tensor(a, device=self.device) for a in (inputs, returns))
        for _ in range(self.n_epochs):
            order = torch.as_tensor(self.cost_rng.permutation(len(y)), device=self.device)
            for rows in order.split(self.batch_size):
                loss = torch.nn.functional.mse_loss(self.cost_critic(x[rows]).squeeze(-1), y[rows])
                self.cost_optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.cost_critic.parameters(), self.max_grad_norm)
                self.cost_optimizer.step()

    def _figures(self) -> dict[str, float]:
        episodes = list(self.ep_info_buffer or [])
        figures = {"steps": float(self.num_timesteps), "lambda": self.controller.multiplier}
        if episodes:
            figures["return"] = float(np.mean([episode["r"] for episode in episodes]))
            figures["cost"] = float(np.mean([episode["c"] for episode in episodes]))
        return figures

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        """The parts that SB3's ``get_parameters`` and ``set_parameters`` exchange."""
        return [*_PARTS.values()], []

    def snapshot(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """All that continued training needs: arrays, and numbers that JSON can hold.

        The arrays are the weights of ``policy`` and ``cost_critic``, the state of both Adam optimisers
        (``optimizer.INDEX.NAME`` and ``cost_optimizer.INDEX.NAME``, by position of the parameter) and of the
        global generators that SB3 draws from.
        """
        arrays: dict[str, NDArray] = {}
        for name, part in self._parts().items():
            is_module = isinstance(part, torch.nn.Module)
            arrays |= to_arrays(part, name) if is_module else moments(part, name)
        _, words, position, *_ = np.random.get_state()  # noqa: NPY002 - the generator that SB3 shuffles with
        arrays |= {"random.torch": torch.get_rng_state().numpy(), "random.numpy": np.asarray(words)}
        if self.device.type == "cuda":
            arrays["random.cuda"] = torch.cuda.get_rng_state(self.device).numpy()
        notes = {
            "steps": self.num_timesteps,
            "updates": self._n_updates,
            "controller": asdict(self.controller),
            "numpy_position": int(position),
            "cost_rng": self.cost_rng.bit_generator.state,
            "episodes": [{key: each[key] for key in "rlc"} for each in self.ep_info_buffer or []],
        }
        return arrays, notes

    def restore(self, arrays: dict[str, NDArray], notes: dict[str, Any], total: int) -> None:
        """Go on from what :meth:`snapshot` gave, in a training of ``total`` steps.

        ``learn(..., reset_num_timesteps=False)`` does the rest.

        Raises:
            LookupError, TypeError, ValueError, RuntimeError: what is given cannot be from such a training.
        """
        states: dict[str, Any] = {}
        for name, part in self._parts().items():
            is_module = isinstance(part, torch.nn.Module)
            states[_PARTS[name]] = under(arrays, name) if is_module else optimiser_state(part, arrays, name)
        self.set_parameters(states)
        steps, updates, episodes = notes["steps"], notes["updates"], notes["episodes"]
        rollout = self.n_steps * self.n_envs
        possible = type(steps) is int and 0 < steps < total + rollout and steps % rollout == 0
        if not possible or updates != steps // rollout * self.n_epochs:
            raise ValueError(f"{steps!r} steps and {updates!r} updates cannot be")
        if not all(type(each[key]) in (int, float) for each in episodes for key in "rlc"):
            raise ValueError("episodes are not told by numbers")
        self.num_timesteps, self._n_updates = steps, updates
        stored = notes["controller"]
        self.controller = Controller(**{**stored, "history": tuple(stored["history"])})
        self.cost_rng.bit_generator.state = notes["cost_rng"]
        self.ep_info_buffer = deque(episodes, maxlen=self._stats_window_size)
        self.ep_success_buffer = deque(maxlen=self._stats_window_size)
        words = arrays["random.numpy"].astype(np.uint32)
        np.random.set_state(("MT19937", words, notes["numpy_position"], 0, 0.0))  # noqa: NPY002
        torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
        if self.device.type == "cuda":
            torch.cuda.set_rng_state(torch.from_numpy(arrays["random.cuda"].copy()), self.device)

    def _parts(self) -> dict[str, Any]:
        return {
            "policy": self.policy,
            "optimizer": self.policy.optimizer,
            "cost_critic": self.cost_critic,
            "cost_optimizer": self.cost_optimizer,
        }
