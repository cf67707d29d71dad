"""Where the ground vehicle wants to go: one smooth field of directions, shared by its experts.

Far from any disc the field points at the goal. Near a disc that stands in the way, its part towards the disc
is replaced by a circulation about the disc, always counter-clockwise: the disc is left on the left. Every
expert follows this one field, so demonstrations never mix left and right turns for like readings, whose
average would lead into the disc.

Shapes: B batch, N discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rise_envs.settings import check_fields

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Guidance:
    """The shape of the field.

    Attributes:
        margin: clearance (m) at which the disc counts as touched.
        reach: clearance beyond the margin (m) at which the disc has half its influence.
        softness: scale (m) over which the influence fades.
        swirl: weight of the circulation against the goal's direction.
        foresight: discs are taken where they will be after this time (s).
    """

    margin: float = 0.3
    reach: float = 2.0
    softness: float = 1.0
    swirl: float = 2.0
    foresight: float = 0.3

    def __post_init__(self) -> None:
        check_fields(type(self), vars(self))
        for name, value in vars(self).items():
            if not value >= 0 or (name == "softness" and value == 0):
                raise ValueError(f"Guidance.{name} must be positive, got {value!r}")


@dataclass(frozen=True)
class Discs:
    """What the readings say of the discs: made safe to compute with, whatever the noise did.

    Attributes:
        centre: m, (B, N, 2).
        velocity: m/s, (B, N, 2).
        keep_off: distance (m) between the centres of disc and vehicle at which they touch, (B, N).
    """

    centre: Array
    velocity: Array
    keep_off: Array

    @classmethod
    def read(cls, centre: Array, velocity: Array, radius: Array, robot_radius: float) -> Discs:
        """From readings; a noisy radius below zero counts as zero."""
        return cls(centre, velocity, np.maximum(radius, 0.0) + robot_radius)

    def after(self, time: float) -> Discs:
        """The discs ``time`` seconds later, at constant velocity."""
        return Discs(self.centre + time * self.velocity, self.velocity, self.keep_off)


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis, of length 2 (in an order that no batch size can change)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def unit(vector: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 2) and lengths (...); the x axis stands in for a vector of length zero."""
    length = np.sqrt(dot(vector, vector))
    tiny = length < 1e-9
    scaled = vector / np.where(tiny, 1.0, length)[..., None]
    return np.where(tiny[..., None], (1.0, 0.0), scaled), length


def direction(position: Array, goal: Array, discs: Discs, guidance: Guidance) -> Array:
    """The wanted direction of travel.

    Args:
        position: of the vehicle's centre (m), (B, 2).
        goal: m, (B, 2).
        discs: N discs.
        guidance: the shape of the field.

    Returns:
        Unit vectors (B, 2).
    """
    to_goal, _ = unit(goal - position)
    ahead = discs.after(guidance.foresight)
    normal, distance = unit(position[:, None] - ahead.centre)
    tangent = np.stack((-normal[..., 1], normal[..., 0]), -1)
    clearance = distance - ahead.keep_off - guidance.margin
    # A logistic function of the clearance, as a tanh: it cannot overflow.
    influence = 0.5 - 0.5 * np.tanh((clearance - guidance.reach) / (2 * guidance.softness))
    in_the_way = np.maximum(-dot(normal, to_goal[:, None]), 0.0)
    bend = (influence * in_the_way)[..., None] * (normal + guidance.swirl * tangent)
    return unit(to_goal + bend.sum(1))[0]
