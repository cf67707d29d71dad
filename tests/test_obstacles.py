"""The moving balls: where they may go, how often they turn, and that company changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from rise_envs import obstacles, streams
from rise_envs.obstacles import Motion

VEHICLE = Motion(0.1, 1.0, 2.0, (-12.0, -12.0), (12.0, 12.0), 1.5)
PANDA = Motion(0.04, 0.15, 1.5, (-0.35, -0.5, 0.05), (0.25, 0.5, 0.6), 0.12)
MOTIONS = pytest.mark.parametrize("motion", [VEHICLE, PANDA], ids=["2-D", "3-D"])


def starts(motion: Motion, n_rows: int, n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Random centres (B, N, D) that keep the rules, velocities, radii (B, N), goals (B, D) and keys (B,)."""
    rng = np.random.default_rng(seed)
    low, high = np.array(motion.low), np.array(motion.high)
    goal = rng.uniform(low, high, (n_rows, len(low)))
    radius = rng.uniform(0.2, 0.6, (n_rows, n)) * motion.goal_gap
    position = rng.uniform(low, high, (n_rows, n, len(low)))
    for _ in range(1000):
        covers = np.linalg.norm(position - goal[:, None], axis=-1) < radius + motion.goal_gap
        if not covers.any():
            break
        position[covers] = rng.uniform(low, high, (covers.sum(), len(low)))
    keys = streams.bits(streams.key_from_seed(seed), np.arange(n_rows))
    velocity = obstacles.draw_velocity(keys, 0, n, motion)
    return position, obstacles.keep_inside(position, velocity, radius, goal, motion), radius, goal, keys


def run(motion: Motion, world: tuple[np.ndarray, ...], n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (T, B, N, D), as the environments move their balls."""
    position, velocity, radius, goal, keys = world
    path = []
    for step in range(1, n_steps + 1):
        path.append((position, velocity))
        position = position + motion.dt * velocity
        velocity = obstacles.redraw(velocity, keys, step, motion)
        velocity = obstacles.keep_inside(position, velocity, radius, goal, motion)
    return np.array([p for p, _ in path]), np.array([v for _, v in path])


@MOTIONS
def test_balls_stay_in_their_box_and_off_the_goal(motion: Motion) -> None:
    """Exactly so, and at every time within a step: the box is convex, the goal is checked on the way."""
    world = starts(motion, 400, 3)
    position, velocity = run(motion, world, 500)
    _, _, radius, goal, _ = world
    assert (position >= motion.low).all()
    assert (position <= motion.high).all()
    gap = np.linalg.norm(position - goal[:, None], axis=-1) - radius - motion.goal_gap
    assert gap.min() >= 0
    for share in (0.25, 0.5, 0.75):
        within = position + share * motion.dt * velocity - goal[:, None]
        sagitta = (motion.dt * motion.max_speed) ** 2 / (8 * motion.goal_gap)  # a chord across the ball's rim
        assert (np.linalg.norm(within, axis=-1) - radius - motion.goal_gap).min() > -sagitta
    assert np.abs(np.diff(gap, axis=0)).max() > 0  # the balls do move


@MOTIONS
def test_turning_keeps_the_speed_or_rests(motion: Motion) -> None:
    position, wanted, radius, goal, keys = starts(motion, 2000, 2, seed=1)
    wanted = obstacles.draw_velocity(keys, 7, 2, motion)
    slow = replace(motion, dt=20 * motion.dt)  # long steps, so that many would leave
    turned = obstacles.keep_inside(position, wanted, radius, goal, slow)
    before, after = (np.linalg.norm(v, axis=-1) for v in (wanted, turned))
    rests = after == 0
    np.testing.assert_allclose(after[~rests], before[~rests], rtol=1e-12)
    changed = (turned != wanted).any(-1)
    assert changed.mean() > 0.05
    assert rests.mean() < 0.05
    ahead = position + slow.dt * wanted
    free = ((ahead >= slow.low) & (ahead <= slow.high)).all(-1)
    free &= np.linalg.norm(ahead - goal[:, None], axis=-1) >= radius + slow.goal_gap
    assert not changed[free].any()  # nobody turns without a reason


def one_ball(position: list[float], velocity: list[float], goal: list[float]) -> np.ndarray:
    where, v, g = (np.array(x, dtype=float) for x in (position, velocity, goal))
    return obstacles.keep_inside(where[None, None], v[None, None], np.full((1, 1), 0.5), g[None], VEHICLE)[
        0, 0
    ]


def test_mirrors_by_hand() -> None:
    far = [0.0, 0.0]
    assert one_ball([11.95, 3], [0.8, 0.3], far).tolist() == [-0.8, 0.3]  # the wall to the right
    assert one_ball([-11.95, -11.95], [-0.6, -0.7], far).tolist() == [0.6, 0.7]  # a corner
    assert one_ball([11.95, 3], [0.4, 0.3], far).tolist() == [0.4, 0.3]  # not there yet
    # Goal ball of radius 0.5 + 1.5 around the origin: head-on, grazing, and away from it.
    np.testing.assert_allclose(one_ball([2.05, 0], [-1, 0], far), [1, 0])
    np.testing.assert_allclose(one_ball([2.01, 0], [-0.6, 0.8], far), [0.6, 0.8])
    np.testing.assert_allclose(one_ball([2.0, 0], [0.6, 0.8], far), [0.6, 0.8])
    # Wedged between wall and goal ball: mirrored at the ball it would leave through the wall, so it rests.
    assert one_ball([11.99, 0], [-1, 0], [9.985, 0]).tolist() == [0, 0]


@MOTIONS
def test_balls_rarely_rest(motion: Motion) -> None:
    _, velocity = run(motion, starts(motion, 300, 1, seed=2), 400)
    assert (np.linalg.norm(velocity, axis=-1) == 0).mean() < 0.005


@MOTIONS
def test_speeds_and_directions_as_documented(motion: Motion) -> None:
    keys = streams.bits(streams.key_from_seed(3), np.arange(20_000))
    velocity = obstacles.draw_velocity(keys, 5, 2, motion).reshape(-1, len(motion.low))
    speed = np.linalg.norm(velocity, axis=-1)
    assert stats.kstest(speed / motion.max_speed, "uniform").pvalue > 0.01
    direction = velocity / speed[:, None]
    if len(motion.low) == 2:
        angle = np.arctan2(direction[:, 1], direction[:, 0])
        assert stats.kstest(angle / (2 * np.pi) + 0.5, "uniform").pvalue > 0.01
    else:  # on the sphere every coordinate of a uniform direction is uniform (Archimedes)
        for coordinate in direction.T:
            assert stats.kstest((coordinate + 1) / 2, "uniform").pvalue > 0.01
    assert abs(stats.spearmanr(speed, direction[:, 0]).statistic) < 0.02


@MOTIONS
def test_redraws_come_at_the_stated_interval_and_without_memory(motion: Motion) -> None:
    """Waiting times are geometric: mean as stated, P(longer than k steps) = (1 − dt/interval)^k."""
    open_space = replace(motion, low=(-1e9,) * len(motion.low), high=(1e9,) * len(motion.low), goal_gap=0.0)
    keys = streams.bits(streams.key_from_seed(4), np.arange(200))
    velocity, waits, age = obstacles.draw_velocity(keys, 0, 2, motion), [], np.zeros((200, 2), int)
    for step in range(1, 2001):
        fresh = obstacles.redraw(velocity, keys, step, open_space)
        age += 1
        drawn = (fresh != velocity).any(-1)
        waits.append(age[drawn])
        age[drawn] = 0
        velocity = fresh
    wait = np.concatenate(waits)
    share = motion.dt / motion.redraw_interval
    assert wait.mean() * motion.dt == pytest.approx(
        motion.redraw_interval, rel=0.03
    )  # ends cut the long ones
    for k in (1, 10, 30):
        assert (wait > k).mean() == pytest.approx((1 - share) ** k, abs=0.02)


def test_draws_of_balls_and_steps_are_independent() -> None:
    keys = streams.bits(streams.key_from_seed(5), np.arange(20_000))
    draws = np.concatenate([obstacles.draw_velocity(keys, step, 3, VEHICLE) for step in (1, 2)], axis=1)
    columns = draws.reshape(len(keys), -1).T  # 2 steps × 3 balls × 2 coordinates
    off_diagonal = np.corrcoef(columns)[~np.eye(len(columns), dtype=bool)]
    assert np.abs(off_diagonal).max() < 0.03
    speeds = np.linalg.norm(draws, axis=-1).T
    assert np.abs(np.corrcoef(speeds)[~np.eye(6, dtype=bool)]).max() < 0.03


@MOTIONS
def test_a_ball_does_not_know_its_batch(motion: Motion) -> None:
    world = starts(motion, 64, 2, seed=6)
    together = np.stack(run(motion, world, 150))
    order = np.random.default_rng(0).permutation(64)
    shuffled = np.stack(run(motion, tuple(part[order] for part in world), 150))
    np.testing.assert_array_equal(shuffled, together[:, :, order])
    for row in (0, 33):
        alone = np.stack(run(motion, tuple(part[row : row + 1] for part in world), 150))
        np.testing.assert_array_equal(alone, together[:, :, row : row + 1])


def test_steps_may_differ_between_rows() -> None:
    """Rows of a vector environment are at different steps: each draws what it would draw alone."""
    keys = streams.bits(streams.key_from_seed(7), np.arange(500))
    velocity = obstacles.draw_velocity(keys, 0, 2, VEHICLE)
    steps = np.arange(500) % 40
    mixed = obstacles.redraw(velocity, keys, steps, VEHICLE)
    for step in (1, 17):
        rows = steps == step
        alone = obstacles.redraw(velocity[rows], keys[rows], step, VEHICLE)
        np.testing.assert_array_equal(mixed[rows], alone)
    assert (mixed != velocity).any()


def test_nothing_is_written_into() -> None:
    world = starts(PANDA, 50, 2)
    copies = tuple(part.copy() for part in world)
    run(PANDA, world, 100)
    for part, then in zip(world, copies, strict=True):
        np.testing.assert_array_equal(part, then)


def test_readings_are_flat_in_order() -> None:
    position, velocity = np.arange(4.0).reshape(1, 2, 2), 10 + np.arange(4.0).reshape(1, 2, 2)
    c = obstacles.readings(position, velocity, np.array([[5.0, 6.0]]))
    assert c.tolist() == [[0, 1, 10, 11, 5, 2, 3, 12, 13, 6]]
