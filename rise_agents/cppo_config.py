"""The settings of C-PPO, see :mod:`rise_agents.cppo`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rise_agents import readings
from rise_agents.agent import nearest, require
from rise_agents.lagrangian import Controller

FRAMES = (*readings.FRAMES, "raw")


@dataclass(frozen=True)
class Config:
    """Settings of C-PPO.

    Attributes:
        train_env: the id of the environment to train in; empty: the agent's own. A faster model of it, say.
        frame: what the policy sees: ``world``, ``body`` or ``features`` of a RISE task, or ``raw``: the
            flattened observation of any environment.
        total_steps: environment steps to train for.
        n_envs: environments side by side.
        n_steps: steps of each environment between two updates.
        batch_size: of a gradient step.
        n_epochs: passes over a roll-out.
        learning_rate: of all networks at the start.
        final_learning_rate: at the end; linear in between.
        gamma: discount of rewards.
        gae_lambda: of the advantage of rewards.
        cost_gamma: discount of costs.
        cost_gae_lambda: of the advantage of costs.
        clip_range: of the policy's probability ratio.
        entropy_coef: weight of the policy's entropy.
        max_grad_norm: gradients are clipped to this norm.
        hidden: widths of policy, value and cost networks.
        log_std: logarithm of the policy's standard deviation at the start, with actions in [−1, 1].
        cost_limit: mean undiscounted cost of an episode that is allowed.
        kp: proportional gain of the multiplier's controller.
        ki: integral gain.
        kd: derivative gain.
        pid_delay: updates that the derivative looks back.
        pid_smoothing: share of the past in the running mean cost.
        lambda_init: the multiplier at the start.
        restart_every: updates after which all episodes start anew, with seeds of their own. There the training can
            be stored, and an interrupted one goes on from there.
    """

    train_env: str = ""
    frame: str = "body"
    total_steps: int = 1_000_000
    n_envs: int = 16
    n_steps: int = 128
    batch_size: int = 512
    n_epochs: int = 10
    learning_rate: float = 3e-4
    final_learning_rate: float = 3e-5
    gamma: float = 0.99
    gae_lambda: float = 0.95
    cost_gamma: float = 0.99
    cost_gae_lambda: float = 0.95
    clip_range: float = 0.2
    entropy_coef: float = 0.0
    max_grad_norm: float = 0.5
    hidden: tuple[int, ...] = (64, 64)
    log_std: float = -0.5
    cost_limit: float = 0.1
    kp: float = 0.1
    ki: float = 0.01
    kd: float = 0.01
    pid_delay: int = 10
    pid_smoothing: float = 0.9
    lambda_init: float = 0.0
    restart_every: int = 20

    def __post_init__(self) -> None:
        if self.frame not in FRAMES:
            raise ValueError(f"unknown frame {self.frame!r}: {nearest(str(self.frame), FRAMES)}")
        for name in (
            "total_steps",
            "n_envs",
            "n_steps",
            "batch_size",
            "n_epochs",
            "pid_delay",
            "restart_every",
        ):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= 1, f"{name} must be a whole number of at least 1", value
            )
        for name in ("gamma", "gae_lambda", "cost_gamma", "cost_gae_lambda"):
            require(0 <= getattr(self, name) <= 1, f"{name} must lie in [0, 1]", getattr(self, name))
        for name in ("learning_rate", "clip_range", "max_grad_norm"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"{name} must be positive and finite", value)
        for name in ("final_learning_rate", "entropy_coef", "cost_limit", "kp", "ki", "kd", "lambda_init"):
            value = getattr(self, name)
            require(0 <= value < np.inf, f"{name} must be finite and not negative", value)
        require(0 <= self.pid_smoothing < 1, "pid_smoothing must lie in [0, 1)", self.pid_smoothing)
        require(np.isfinite(self.log_std), "log_std must be finite", self.log_std)
        fits = bool(self.hidden) and all(isinstance(width, int) and width >= 1 for width in self.hidden)
        require(fits, "hidden must be widths of at least 1", self.hidden)
        self.check_batch(self.n_envs)

    def check_batch(self, n_envs: int) -> None:
        """Raise ``ValueError`` if a roll-out of ``n_envs`` environments cannot be cut into equal batches."""
        size = n_envs * self.n_steps
        fits = size % self.batch_size == 0
        require(fits, f"batch_size must divide n_envs · n_steps = {n_envs} · {self.n_steps}", self.batch_size)

    def controller(self) -> Controller:
        """The multiplier's controller at the start of training."""
        return Controller(
            *(self.cost_limit, self.kp, self.ki, self.kd, self.pid_delay, self.pid_smoothing),
            integral=self.lambda_init,
            multiplier=self.lambda_init,
        )
