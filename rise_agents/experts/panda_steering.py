"""How the Panda's experts steer: a barrier QP, and the side on which to pass the sphere.

The controller `steer` is a quadratic program with control barrier functions (Ames et al., IEEE TAC 2017) in
the three components of the action. It stays as close to a wanted action as the barriers of every capsule, of
the table and of the arm's reach allow. For a capsule at distance d from the sphere the barrier asks that
d − margin be at least (1 − decay)·(d − margin) after the step. The wanted action heads for the goal and, near
the sphere, along the sphere's surface.

On which side is decided by `choose_side`: roll-outs of `steer` itself on the motion model, one per side, afresh
in every step. Both experts follow that choice, so that they agree on it. Neither keeps a memory: sticking to a
side once taken made the actions several times harder to imitate, and reached the goal no more often.

SI units. Compiled with numba, for one arm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rise_agents.experts.box_qp import solve_qp
from rise_agents.experts.panda_model import DT, FOLLOW, KEEP, STEP, Arm, Scene, advance, look, write_gradient
from rise_envs import panda_kinematics as panda

Array = NDArray[np.float64]

N_SIDES = 6


class Steering(NamedTuple):
    """Tunables, a named tuple because numba compiles for it.

    Attributes:
        decay: share of its distance to the margin that a barrier may lose in a step.
        margin: clearance that the barriers keep (m).
        watch: capsules farther from the sphere than this have no barrier (m).
        turn_far: clearance at which the wanted action begins to turn along the sphere (m) ...
        turn_near: ... and at which it has turned fully (m).
        turn: how far it turns at most; 1 is along the surface.
        floor: least height of the hand point over the table (m).
        reach: greatest distance of the hand point from the circle of the shoulder (m).
        slow_down: distance to the goal within which the wanted action shrinks (m).
        price: of the squared breach of a barrier, in units of squared action.
        horizon: steps of a roll-out.
    """

    decay: float = 0.3
    margin: float = 0.04
    watch: float = 0.20
    turn_far: float = 0.15
    turn_near: float = 0.03
    turn: float = 0.6
    floor: float = 0.02
    reach: float = 0.73
    slow_down: float = 0.06
    price: float = 1000.0
    horizon: int = 16


class Program(NamedTuple):
    """The rows of one QP, and of how many arrays they fill the front."""

    rows: Array  # (R, 3), unit length
    bound: Array  # (R,)


@njit(cache=True)
def make_program() -> Program:
    """Arrays for the rows of all capsules, the table and the reach."""
    size = panda.N_CAPSULES + 2
    return Program(np.empty((size, 3)), np.empty(size))


@njit(cache=True)
def _add_row(n: int, gradient: Array, drift: float, least: float, program: Program) -> int:
    """Add row number ``n``, gradient · displacement + drift ≥ least, scaled to unit length in the action."""
    rows = program.rows
    square = 0.0
    for r in range(3):
        rows[n, r] = STEP * (
            gradient[0] * FOLLOW[0, r] + gradient[1] * FOLLOW[1, r] + gradient[2] * FOLLOW[2, r]
        )
        square += rows[n, r] ** 2
    length = np.sqrt(square)
    # The least that any action in the box gives is enough, or no action changes anything: no row is needed.
    slack = drift - least - abs(rows[n, 0]) - abs(rows[n, 1]) - abs(rows[n, 2])
    if slack > 0.0 or length < 1e-3 * STEP:
        return n
    for r in range(3):
        rows[n, r] /= length
    program.bound[n] = (least - drift) / length
    return n + 1


@njit(cache=True)
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def write_barriers(velocity: Array, scene: Scene, t: Steering, arm: Arm, program: Program) -> int:
    """Write the rows of the sphere, the table and the arm's reach, and return how many there are."""
    n = 0
    normal, gradient, coast = np.empty(3), np.empty(3), np.empty(3)
    for r in range(3):
        coast[r] = DT * (KEEP[r, 0] * velocity[0] + KEEP[r, 1] * velocity[1] + KEEP[r, 2] * velocity[2])
    for k in range(panda.N_CAPSULES):
        gap = arm.distance[k] - scene.radius
        if gap < t.watch:
            write_gradient(k, scene.center, arm, normal, gradient)
            change = _dot(gradient, coast) - _dot(normal, scene.drift)
            n = _add_row(n, gradient, change, -t.decay * (gap - t.margin), program)
    height = arm.hand[2] - t.floor
    gradient[0], gradient[1], gradient[2] = 0.0, 0.0, 1.0
    n = _add_row(n, gradient, coast[2], -t.decay * height, program)
    # The shoulder's circle, for a hand held down: radius 0.088 m about the base's axis, 0.121 m high.
    x, y, z = arm.hand[0] - panda.BASE[0], arm.hand[1], arm.hand[2] - 0.121
    across = np.hypot(x, y)
    far = np.hypot(across - 0.088, z) + 1e-9
    slope = -(across - 0.088) / (far * (across + 1e-9))
    gradient[0], gradient[1], gradient[2] = slope * x, slope * y, -z / far
    return _add_row(n, gradient, _dot(gradient, coast), -t.decay * (t.reach - far), program)


@njit(cache=True)
def write_wanted(scene: Scene, side: Array, t: Steering, arm: Arm, wanted: Array) -> None:
    """The action without barriers, (3,): to the goal, and near the sphere along its surface on one side."""
    for r in range(3):
        wanted[r] = scene.goal[r] - arm.hand[r]
    away = np.sqrt(_dot(wanted, wanted)) + 1e-9
    speed = min(1.0, away / t.slow_down)
    for r in range(3):
        wanted[r] *= speed / away
    k = int(np.argmin(arm.distance))
    near = (t.turn_far - (arm.distance[k] - scene.radius)) / (t.turn_far - t.turn_near)
    if near <= 0.0 or _dot(side, side) == 0.0:
        return
    normal, gradient, along = np.empty(3), np.empty(3), np.empty(3)
    write_gradient(k, scene.center, arm, normal, gradient)
    length = np.sqrt(_dot(gradient, gradient)) + 1e-6
    into = -_dot(gradient, wanted) / (length * speed + 1e-9)
    outward = _dot(side, gradient) / length**2
    for r in range(3):
        along[r] = side[r] - outward * gradient[r]
    size = np.sqrt(_dot(along, along)) + 1e-6
    share = t.turn * min(1.0, near) * min(1.0, max(0.0, into + 0.3))
    for r in range(3):
        wanted[r] = (1.0 - share) * wanted[r] + share * speed * along[r] / size
    size = np.sqrt(_dot(wanted, wanted)) + 1e-9
    for r in range(3):
        wanted[r] *= speed / size


@njit(cache=True)
def steer(
    velocity: Array, scene: Scene, side: Array, t: Steering, arm: Arm, program: Program, action: Array
) -> float:
    """The barrier QP for one arm, in place.

    Args:
        velocity: of the hand (m/s), (3,).
        scene: goal and sphere.
        side: direction in which to pass the sphere, (3,); zero for none.
        t: tunables.
        arm: kinematics that `look` wrote for the scene.
        program: scratch.
        action: receives the action, (3,), inside [−1, 1].

    Returns:
        The largest breach of a barrier by the action, in units of action; about 0 if all can be kept.
    """
    wanted = np.empty(3)
    write_wanted(scene, side, t, arm, wanted)
    n = write_barriers(velocity, scene, t, arm, program)
    return solve_qp(wanted, program.rows, program.bound, n, t.price, action)


@njit(cache=True)
def roll_out(
    q: Array,
    velocity: Array,
    scene: Scene,
    side: Array,
    t: Steering,
    arm: Arm,
    program: Program,
    actions: Array,
) -> tuple[float, float]:
    """Play `steer` with one side on the model, the sphere keeping its velocity.

    Arguments as in `steer`, with the joint angles ``q`` (7,) in front; ``actions`` (horizon, 3) receives what
    was done.

    Returns:
        The price of the roll-out (m), mean distance to the goal region plus ten times the mean intrusion into
        half the margin, and its least clearance (m).
    """
    q, velocity, center, action = q.copy(), velocity.copy(), scene.center.copy(), np.empty(3)
    price, least = 0.0, np.inf
    for step in range(len(actions)):
        now = Scene(scene.goal, center, scene.drift, scene.radius)
        look(q, center, arm)
        steer(velocity, now, side, t, arm, program, action)
        gap = arm.distance.min() - scene.radius
        least = min(least, gap)
        away = 0.0
        for r in range(3):
            actions[step, r] = action[r]
            center[r] += scene.drift[r]
            away += (scene.goal[r] - arm.hand[r]) ** 2
        price += max(0.0, np.sqrt(away) - 0.04) + 10.0 * max(0.0, 0.5 * t.margin - gap)
        advance(q, velocity, action, arm)
    return price / len(actions), least


@njit(cache=True)
def write_sides(hand: Array, goal: Array, sides: Array) -> None:
    """Directions around the way from hand to goal, (N_SIDES, 3), in place."""
    x, y, z = goal[0] - hand[0], goal[1] - hand[1], goal[2] - hand[2]
    length = np.sqrt(x * x + y * y + z * z) + 1e-9
    x, y, z = x / length, y / length, z / length
    flat = np.hypot(x, y) + 1e-9
    left_x, left_y = -y / flat, x / flat
    up_x, up_y, up_z = -z * left_y, z * left_x, x * left_y - y * left_x
    for i in range(N_SIDES):
        cos, sin = np.cos(2.0 * np.pi * i / N_SIDES), np.sin(2.0 * np.pi * i / N_SIDES)
        sides[i, 0] = cos * left_x + sin * up_x
        sides[i, 1] = cos * left_y + sin * up_y
        sides[i, 2] = sin * up_z


@njit(cache=True)
def choose_side(
    q: Array,
    velocity: Array,
    scene: Scene,
    side: Array,
    t: Steering,
    arm: Arm,
    program: Program,
    actions: Array,
) -> bool:
    """Find the side with the cheapest roll-out, in place.

    Compared are no side and directions around the way to the goal. While the straight way keeps clear of the
    sphere, there is nothing to choose.

    Args:
        q: joint angles (rad), (7,).
        velocity: of the hand (m/s), (3,).
        scene: goal and sphere.
        side: receives the direction, (3,); zero for none.
        t: tunables.
        arm: scratch.
        program: scratch.
        actions: receives the actions of that roll-out, (horizon, 3).

    Returns:
        Whether the straight way is clear.
    """
    trial, sides = np.empty_like(actions), np.zeros((N_SIDES + 1, 3))
    look(q, scene.center, arm)
    write_sides(arm.hand, scene.goal, sides[1:])
    best, clear = np.inf, False
    for i in range(N_SIDES + 1):
        price, least = roll_out(q, velocity, scene, sides[i], t, arm, program, trial)
        clear = i == 0 and least > t.turn_far
        if price < best:
            best = price
            for r in range(3):
                side[r] = sides[i, r]
                for step in range(len(actions)):
                    actions[step, r] = trial[step, r]
        if clear:
            break
    return clear
