"""PPO under a cost limit, with a Lagrange multiplier that a PID controller sets.

Stooke, Achiam and Abbeel, "Responsive safety in reinforcement learning by PID Lagrangian methods", ICML 2020:
with J the mean cost of an episode and d its limit, after every roll-out ::

    Δ = J − d,   I ← (I + K_I Δ)₊,   ∂ = (J − J_before)₊,   λ = (K_P Δ + I + K_D ∂)₊

and the policy follows the advantage A_r − λ A_c, standardised. The paper divides by 1 + λ, for the same end of a
step size that λ leaves alone; standardising the sum instead of A_r keeps λ the price of cost in units of reward
while the spread of A_r shrinks in training (with it, the vehicle learned faster and ended safer).

This is what it says in formulas; :mod:`rise_agents.constrained_ppo` puts it into a PPO.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
