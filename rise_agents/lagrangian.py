"""PPO under a cost limit, with a Lagrange multiplier that a PID controller sets.

Stooke, Achiam and Abbeel, "Responsive safety in reinforcement learning by PID Lagrangian methods", ICML 2020:
with J the mean cost of an episode and d its limit, after every roll-out

    Δ = J − d,   I ← (I + K_I Δ)₊,   ∂ = (J − J_before)₊,   λ = (K_P Δ + I + K_D ∂)₊

and the policy follows the advantage A_r − λ A_c, standardised. The paper divides by 1 + λ, for the same end of a
step size that λ leaves alone; standardising the sum instead of A_r keeps λ the price of cost in units of reward
while the spread of A_r shrinks in training (with it, the vehicle learned faster and ended safer).

Shapes: T steps, B sub-environments, K network inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from rise_agents.networks import mlp

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Controller:
    """A PID controller of the multiplier: settings and state; :meth:`update` gives the next one.

    Attributes:
        limit: d, the cost of an episode that is allowed on average.
        kp: K_P, proportional gain.
        ki: K_I, integral gain.
        kd: K_D, derivative gain.
        delay: ∂ compares with the smoothed cost of so many updates ago.
        smoothing: share of the past in the running mean of J that Δ in the K_P term and ∂ use; 0 for none.
        integral: I, already multiplied by its gain; what it starts with is the first multiplier.
        history: smoothed costs of the last ``delay`` + 1 updates, oldest first.
        multiplier: λ.
    """

    limit: float
    kp: float = 0.1
    ki: float = 0.01
    kd: float = 0.01
    delay: int = 10
    smoothing: float = 0.9
    integral: float = 0.0
    history: tuple[float, ...] = ()
    multiplier: float = 0.0

    def update(self, cost: float) -> Controller:
        """The controller after a roll-out whose finished episodes cost ``cost`` on average."""
        before = self.history[-1] if self.history else cost
        smooth = self.smoothing * before + (1 - self.smoothing) * cost
        history = (*self.history, smooth)[-(self.delay + 1) :]
        integral = max(0.0, self.integral + self.ki * (cost - self.limit))
        rise = max(0.0, smooth - history[0])
        multiplier = max(0.0, self.kp * (smooth - self.limit) + integral + self.kd * rise)
        return replace(self, integral=integral, history=history, multiplier=multiplier)


def constrained_advantage(reward: Array, cost: Array, multiplier: float) -> Array:
    """A_r − λ A_c, standardised over the roll-out (finite even where both are constant)."""
    total = reward - multiplier * cost
    return (total - total.mean()) / (total.std() + 1e-8)


class ConstrainedPPO(PPO):
    """SB3's PPO whose advantages carry a cost. Its environment is a :class:`rise_agents.vec_env.Bridge`.

    Args:
        controller: sets the multiplier.
        cost_gamma: discount of costs.
        cost_gae_lambda: of the cost advantage.
        cost_hidden: widths of the cost critic.
        report: called after every update with the figures of the roll-out.
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
        **ppo: Any,
    ) -> None:
        self.controller, self.report = controller, report
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
        """As SB3's, with costs noted."""
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

    def snapshot(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """All that continued training needs: arrays, and numbers that JSON can hold.

        The arrays are the weights of ``policy`` and ``cost_critic``, the state of both Adam optimisers
        (``optimizer.INDEX.NAME`` and ``cost_optimizer.INDEX.NAME``, by position of the parameter) and of the
        global generators that SB3 draws from.
        """
        parts = {"policy": self.policy.state_dict(), "cost_critic": self.cost_critic.state_dict()}
        for name, optimizer in (
            ("optimizer", self.policy.optimizer),
            ("cost_optimizer", self.cost_optimizer),
        ):
            moments = optimizer.state_dict()["state"]
            parts[name] = {f"{i}.{key}": value for i, each in moments.items() for key, value in each.items()}
        arrays = {
            f"{part}.{name}": value.detach().cpu().numpy().copy()
            for part, values in parts.items()
            for name, value in values.items()
        }
        _, words, position, *_ = np.random.get_state()  # noqa: NPY002 - the generator that SB3 shuffles with
        arrays |= {"random.torch": torch.get_rng_state().numpy(), "random.numpy": np.asarray(words)}
        notes = {
            "steps": self.num_timesteps,
            "controller": asdict(self.controller),
            "numpy_position": int(position),
            "cost_rng": self.cost_rng.bit_generator.state,
        }
        return arrays, notes
