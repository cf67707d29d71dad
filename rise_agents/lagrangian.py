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

import itertools
from collections import deque
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
from rise_agents.stages import moments, optimiser_state, to_arrays, under

Array = NDArray[np.float32]
# Our name of each part of the state -> SB3's.
_PARTS = {
    "policy": "policy",
    "optimizer": "policy.optimizer",
    "cost_critic": "cost_critic",
    "cost_optimizer": "cost_optimizer",
}


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

    def restore(self, arrays: dict[str, NDArray], notes: dict[str, Any]) -> None:
        """Go on from what :meth:`snapshot` gave, by ``learn(..., reset_num_timesteps=False)``."""
        states: dict[str, Any] = {}
        for name, part in self._parts().items():
            is_module = isinstance(part, torch.nn.Module)
            states[_PARTS[name]] = under(arrays, name) if is_module else optimiser_state(part, arrays, name)
        self.set_parameters(states)
        self.num_timesteps, self._n_updates = int(notes["steps"]), int(notes["updates"])
        stored = notes["controller"]
        self.controller = Controller(**{**stored, "history": tuple(stored["history"])})
        self.cost_rng.bit_generator.state = notes["cost_rng"]
        self.ep_info_buffer = deque(notes["episodes"], maxlen=self._stats_window_size)
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


def stored_shapes(
    inputs: int, outputs: int, hidden: Sequence[int], boxes: bool
) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the floats that :meth:`ConstrainedPPO.snapshot` gives.

    Args:
        inputs: K.
        outputs: A, or the number of discrete actions.
        hidden: widths of all three networks.
        boxes: whether actions are continuous.
    """
    body, last = [inputs, *hidden], [hidden[-1]]
    parameters = {
        "policy": {
            **({"log_std": (outputs,)} if boxes else {}),
            **_layers("mlp_extractor.policy_net.{}", body),
            **_layers("mlp_extractor.value_net.{}", body),
            **_layers("action_net", [*last, outputs]),
            **_layers("value_net", [*last, 1]),
        },
        "cost_critic": _layers("{}", [*body, 1]),
    }
    shapes: dict[str, tuple[int, ...]] = {}
    for name, optimizer in (("policy", "optimizer"), ("cost_critic", "cost_optimizer")):
        shapes |= {f"{name}.{key}": shape for key, shape in parameters[name].items()}
        for i, shape in enumerate(parameters[name].values()):
            shapes |= {f"{optimizer}.{i}.{key}": shape for key in ("exp_avg", "exp_avg_sq")}
            shapes[f"{optimizer}.{i}.step"] = ()
    return shapes


def _layers(name: str, widths: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Shapes of the fully connected layers of a ``Sequential`` with an activation after each, or of one layer."""
    shapes: dict[str, tuple[int, ...]] = {}
    for i, (width, following) in enumerate(itertools.pairwise(widths)):
        shapes |= {
            f"{name.format(2 * i)}.weight": (following, width),
            f"{name.format(2 * i)}.bias": (following,),
        }
    return shapes
