"""The numbers of the Panda tasks."""

from __future__ import annotations

from dataclasses import dataclass

from rise_envs import obstacles
from rise_envs.settings import check_fields

START_HAND = (0.0384397, 0.0, 0.1974001)  # the hand point in the neutral pose (m)


@dataclass(frozen=True)
class Params:
    """The numbers of the task, in SI units; the arm's base is at (-0.6, 0, 0), the table top at z = 0.

    Attributes:
        goal_radius: distance between hand and goal that counts as reached (m), panda-gym's tolerance.
        goal_low: lower corner of the box that goals are drawn from (m).
        goal_high: upper corner of that box (m).
        goal_min_distance: least distance of a goal from the hand at the start (m).
        reach: goals farther than this from the shoulder are not offered (m): the hand, held
            downwards, cannot get there.
        radius: range of the sphere's radius (m).
        max_speed: greatest speed of the sphere (m/s).
        redraw_interval: mean time between two draws of the sphere's velocity (s).
        sphere_low: lower corner of the box that the sphere's centre stays in (m).
        sphere_high: upper corner of that box (m).
        goal_gap: least distance between the sphere's surface and the goal (m), so that the hand fits there.
        placed: range of where the sphere starts along the line from hand to goal, as a fraction of it.
        max_offset: greatest offset of that place along each axis (m).
        start_clearance: least clearance of the arm from the sphere at the start (m) ...
        start_time: ... and for this long, if nobody moves but the sphere (s).
        max_hand_speed: about the greatest speed of the hand (m/s), a scale for agents.
        hand_radius: radius of the ball around the hand's reference point that stands for the hand (m).
        noise_scale: standard deviation of the reading's position (m), velocity (m/s) and radius (m) at noise
            level 1: the ratio of noise to obstacle size that the vehicle task has.
    """

    goal_radius: float = 0.05
    goal_low: tuple[float, float, float] = (-0.35, -0.4, 0.05)
    goal_high: tuple[float, float, float] = (0.15, 0.4, 0.5)
    goal_min_distance: float = 0.25
    reach: float = 0.70
    radius: tuple[float, float] = (0.05, 0.10)
    max_speed: float = 0.15
    redraw_interval: float = 1.5
    sphere_low: tuple[float, float, float] = (-0.35, -0.5, 0.05)
    sphere_high: tuple[float, float, float] = (0.25, 0.5, 0.6)
    goal_gap: float = 0.12
    placed: tuple[float, float] = (0.35, 0.75)
    max_offset: float = 0.06
    start_clearance: float = 0.04
    start_time: float = 0.2
    max_hand_speed: float = 2.0
    hand_radius: float = 0.05
    noise_scale: tuple[float, float, float] = (0.05, 0.05, 0.02)

    def __post_init__(self) -> None:
        check_fields(type(self), vars(self))
        for name in ("goal_radius", "reach", "redraw_interval", "max_hand_speed"):
            require(getattr(self, name) > 0, f"{name} must be > 0", self)
        for name in ("max_speed", "goal_gap", "max_offset", "start_time", "hand_radius"):
            require(getattr(self, name) >= 0, f"{name} must not be negative", self)
        require(min(self.noise_scale) >= 0, "noise_scale must not be negative", self)
        for name in ("radius", "placed"):
            low, high = getattr(self, name)
            require(0 <= low <= high, f"{name} must not be negative and in rising order", self)
        for name in ("goal", "sphere"):
            corners = zip(getattr(self, f"{name}_low"), getattr(self, f"{name}_high"), strict=True)
            require(all(a <= b for a, b in corners), f"{name}_low must not exceed {name}_high", self)
        require(
            self.goal_min_distance > self.goal_radius,
            "goal_min_distance must exceed goal_radius, or episodes start at the goal",
            self,
        )

    @property
    def dt(self) -> float:
        """Duration of a control step (s), panda-gym's 20 substeps of 2 ms."""
        return 0.04

    @property
    def motion(self) -> obstacles.Motion:
        """How the sphere moves."""
        return obstacles.Motion(
            dt=self.dt,
            max_speed=self.max_speed,
            redraw_interval=self.redraw_interval,
            low=self.sphere_low,
            high=self.sphere_high,
            goal_gap=self.goal_gap,
        )


def require(condition: bool, what: str, params: Params) -> None:
    """Raise ``ValueError`` that says what a parameter must be."""
    if not condition:
        raise ValueError(f"panda_scene.Params.{what}, got {params}")


DEFAULTS = Params()
