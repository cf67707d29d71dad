"""``cbf`` expert of the ground vehicle: a control-barrier-function filter on a look-ahead point.

The point p = q + l·(cos θ, sin θ), l metres ahead of the vehicle's centre q, moves with ::

    ṗ = v·e + l·ω·e⊥,       e = (cos θ, sin θ),  e⊥ = (−sin θ, cos θ),

so it can be driven in any direction, which the centre cannot. A disc of radius (vehicle radius + l) about p
covers the vehicle. So for each moving disc (o, v_o, r) the distance ::

    h = |p − o| − r − (vehicle radius + l) − margin

is a control barrier function, whose condition ḣ ≥ −γ·h is linear in the action::

    n·(v·e + l·ω·e⊥) ≥ n·v_o − γ·h,       n = (p − o) / |p − o|.

The action is the point of the action box nearest to a nominal one, which follows the field of
:mod:`~rise_agents.experts.vehicle_guidance`, under these constraints (a quadratic program, solved exactly).
Where they contradict each other or the box, it is the one whose worst violation is least.

Source: Ames, Xu, Grizzle & Tabuada, "Control barrier function based quadratic programs for safety critical
systems", IEEE Transactions on Automatic Control 62(8), 2017.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.experts.planar_qp import nearest_point
from rise_agents.experts.vehicle_guidance import Discs, Guidance, direction, dot, unit
from rise_agents.readings import checked_batch
from rise_envs.ground_vehicle import Params
from rise_envs.settings import check_fields
from rise_envs.task import Task

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Config:
    """Settings of the filter, in SI units.

    Attributes:
        look_ahead: l, distance of the controlled point ahead of the centre (m).
        margin: clearance that the barrier keeps (m).
        gamma: γ, rate at which the barrier may be approached (1/s).
        turn_gain: nominal ω per radian of heading error (1/s).
        slowest: least nominal speed while turning, as a share of the greatest.
        turn_weight: price of a changed ω (rad/s) against a changed v (m/s).
        omega_max: bound of ω either way (rad/s).
        guidance: the field that the nominal action follows.
    """

    look_ahead: float = 0.5
    margin: float = 0.1
    gamma: float = 2.0
    turn_gain: float = 3.0
    slowest: float = 0.1
    turn_weight: float = 0.5
    omega_max: float = Params.omega_max
    guidance: Guidance = field(default_factory=Guidance)

    def __post_init__(self) -> None:
        check_fields(type(self), vars(self))
        for name in ("look_ahead", "gamma", "turn_gain", "turn_weight", "omega_max"):
            if not getattr(self, name) > 0:
                raise ValueError(f"vehicle_cbf.Config.{name} must be positive, got {getattr(self, name)!r}")


class VehicleCBF:
    """The expert: memoryless, deterministic, reads the observation only.

    Args:
        task: description of the ground-vehicle task, with any number of discs.
        seed: ignored (nothing is random); there so that all experts are made alike.
        config: settings.
    """

    def __init__(self, task: Task, seed: int = 0, config: Config = Config()) -> None:
        self.task, self.config = task, config
        self.low = np.array([0.0, -config.omega_max])
        self.high = np.array([task.max_speed, config.omega_max])

    def predict(
        self,
        observation: Mapping[str, Array],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Actions (v, ω), (2,) or (B, 2), and None: the expert keeps no state."""
        rows, single = checked_batch(self.task, observation)
        state, discs = rows["observation"], self.read(rows)
        action = self.filtered(state, discs, self.nominal(state, rows["desired_goal"], discs))
        return (action[0] if single else action), None

    def read(self, rows: Mapping[str, Array]) -> Discs:
        """The discs that a batch of observations speaks of."""
        return Discs.read(*self.task.split(rows["obstacle"]), self.task.robot_radius)

    def nominal(self, state: Array, goal: Array, discs: Discs) -> Array:
        """Actions (B, 2) that follow the field from states (B, 3) to goals (B, 2), without the barrier."""
        position, rotation = self.task.pose(state)
        wanted = direction(position, goal, discs, self.config.guidance)
        forward, left = dot(wanted, rotation[..., 0]), dot(wanted, rotation[..., 1])
        v = self.high[0] * np.maximum(forward, self.config.slowest)
        omega = self.config.turn_gain * np.arctan2(left, forward)
        return np.clip(np.stack((v, omega), -1), self.low, self.high)

    def filtered(self, state: Array, discs: Discs, nominal: Array) -> Array:
        """The safe actions nearest to the nominal ones (B, 2): the quadratic program of this module."""
        c = self.config
        position, rotation = self.task.pose(state)
        ahead, aside = rotation[..., 0], rotation[..., 1]
        normal, distance = unit((position + c.look_ahead * ahead)[:, None] - discs.centre)
        barrier = distance - discs.keep_off - c.look_ahead - c.margin
        slopes = np.stack((dot(normal, ahead[:, None]), c.look_ahead * dot(normal, aside[:, None])), -1)
        needed = dot(normal, discs.velocity) - c.gamma * barrier
        scale = np.array([1.0, c.turn_weight])  # the metric of the program: v² + (weight·ω)²
        point, _ = nearest_point(nominal * scale, slopes / scale, needed, self.low * scale, self.high * scale)
        return np.clip(point / scale, self.low, self.high)
