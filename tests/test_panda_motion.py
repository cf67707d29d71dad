"""The arm's motion without the engine against the engine, and its linear algebra against NumPy."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from rise_envs import panda_dynamics as dynamics
from rise_envs import panda_kinematics as panda
from rise_envs import panda_lanes as lanes
from rise_envs.panda_clearance import LINKS
from rise_envs.panda_lanes import LANES, REAL
from rise_envs.panda_motion import Arms
from rise_envs.panda_sim import NO_LINK, PandaSim

AWAY = ((0.9, 0.9, 0.9), (0.0, 0.0, 0.0), 0.05)  # a sphere out of the way: place, velocity, radius
FAR = (10.0, NO_LINK)  # its clearance


@pytest.fixture(scope="module")
def sim() -> Iterator[PandaSim]:
    made = PandaSim()
    yield made
    made.close()


def spheres(count: int) -> np.ndarray:
    return np.tile([*AWAY[0], *AWAY[1], AWAY[2]], (count, 1))


def positive(size: int, rng: np.random.Generator) -> np.ndarray:
    """Well conditioned positive definite matrices (L, size, size)."""
    half = rng.normal(size=(LANES, size, size))
    return half @ half.transpose(0, 2, 1) + np.eye(size)


def last(array: np.ndarray) -> np.ndarray:
    """The arms' axis moved from the front to the end, in single precision."""
    return np.ascontiguousarray(np.moveaxis(array, 0, -1), dtype=REAL)


def scratch(*shape: int) -> np.ndarray:
    return np.zeros((*shape, LANES), REAL)


# --- linear algebra and rigid bodies ----------------------------------------------------------------------


def test_six_unknowns_are_solved_and_seven_inverted_as_by_numpy() -> None:
    rng = np.random.default_rng(1)
    matrix, side = positive(6, rng), rng.normal(size=(LANES, 6))
    expected = np.linalg.solve(matrix, side[..., None])[..., 0]
    factored, result = last(np.tril(matrix)), last(side)
    lanes.factor(factored)
    lanes.solve(factored, result)
    np.testing.assert_allclose(result, last(expected), atol=1e-4)

    matrix = positive(7, rng)
    inverse = last(np.tril(matrix))
    lanes.invert(inverse, scratch(7))
    np.testing.assert_allclose(inverse, last(np.linalg.inv(matrix)), atol=1e-4)


def test_cosines_and_sines_need_no_sine() -> None:
    rng = np.random.default_rng(2)
    angle, change = rng.uniform(-4, 4, (7, LANES)), rng.uniform(-0.9, 0.9, (7, LANES))
    cos, sin = scratch(7), scratch(7)
    lanes.write_turns(angle.astype(REAL), cos, sin, scratch(7))
    np.testing.assert_allclose([cos, sin], [np.cos(angle), np.sin(angle)], atol=3e-6)
    lanes.turn(cos, sin, change.astype(REAL))
    np.testing.assert_allclose([cos, sin], [np.cos(angle + change), np.sin(angle + change)], atol=4e-6)


def test_mass_matrix_and_gravity_are_the_engines(sim: PandaSim) -> None:
    spread = np.array([0.7, 0.6, 0.4, 0.7, 0.4, 0.5, 0.4])
    q = panda.NEUTRAL + np.random.default_rng(0).uniform(-1, 1, (LANES, 7)) * spread
    axes, origin = scratch(8, 3, 3), scratch(8, 3)
    axes[0], origin[0] = np.eye(3)[..., None], panda.BASE[:, None]
    lanes.write_frames(last(np.cos(q)), last(np.sin(q)), axes, origin)
    spatial, body, twist, matrix, torque = (
        scratch(12),
        scratch(7, 15),
        scratch(7, 6),
        scratch(7, 7),
        scratch(7),
    )
    dynamics.write_bodies(axes, origin, scratch(7), spatial, body, twist)
    dynamics.write_dynamics(twist, body, spatial, matrix, torque)
    for m in range(LANES):
        full, rest = [*q[m], 0.0, 0.0], [0.0] * 9  # the fingers are joints of their own there
        engine = sim._bullet.calculateMassMatrix(sim._arm, full, physicsClientId=sim._client)
        np.testing.assert_allclose(matrix[..., m], np.tril(np.array(engine)[:7, :7]), atol=1e-5)
        holding = sim._bullet.calculateInverseDynamics(
            sim._arm, full, rest, rest, physicsClientId=sim._client
        )
        np.testing.assert_allclose(-torque[:, m], holding[:7], atol=2e-4)


# --- motion -----------------------------------------------------------------------------------------------


def _both(sim: PandaSim, actions: np.ndarray, push_up: bool) -> tuple[Arms, np.ndarray, np.ndarray]:
    """The model and the engine under the same actions (T, B, 3): last arms, all hands, all states of the engine."""
    steps, count = actions.shape[:2]
    engine, hands = np.empty((steps, count, 13)), np.empty((steps, count, 3))
    for arm in range(count):
        sim.reset()
        for step in range(steps):
            # Push up where the hand is low, so that the table is never touched.
            actions[step, arm, 2] += 1.5 * (push_up and sim.state()[2] < 0.2)
            np.clip(actions, -1, 1, out=actions)
            sim.step(actions[step, arm], *AWAY, FAR)
            engine[step, arm] = sim.state()
    arms = Arms.at_rest(count)
    for step in range(steps):
        arms, *_ = arms.step(actions[step].astype(np.float64), spheres(count))
        hands[step] = arms.hand
    return arms, hands, engine


def test_the_hand_moves_as_in_the_engine(sim: PandaSim) -> None:
    actions = np.random.default_rng(3).uniform(-1, 1, (50, 12, 3)).astype(np.float32)
    arms, hands, engine = _both(sim, actions, push_up=True)
    assert engine[..., 2].min() > 0.05
    error = np.linalg.norm(hands - engine[..., :3], axis=-1)
    assert error[0].mean() < 0.0005 and error.mean() < 0.005
    assert np.abs(arms.q - engine[-1, :, 6:]).max() < 0.1
    assert np.linalg.norm(arms.velocity - engine[-1, :, 3:6], axis=-1).mean() < 0.05


def test_the_table_stops_the_hand_as_in_the_engine(sim: PandaSim) -> None:
    """Straight down, then along the table, against friction."""
    actions = np.zeros((20, 3, 3), np.float32)
    actions[..., 2] = -1
    actions[8:, 1, 1] = 1
    actions[8:, 2, 0] = -1
    _, hands, engine = _both(sim, actions, push_up=False)
    assert engine[8:, :, 2].max() < 0.01
    np.testing.assert_allclose(hands[..., 2], engine[..., 2], atol=0.003)
    np.testing.assert_allclose(hands[8, 0], engine[8, 0, :3], atol=0.004)
    moved, expected = hands[-1] - hands[8], engine[-1, :, :3] - engine[8, :, :3]
    np.testing.assert_allclose(moved, expected, atol=0.1 * np.abs(expected).max())


def test_joints_stop_at_their_limits_as_in_the_engine(sim: PandaSim) -> None:
    """Backwards to where the elbow, and forwards to where the arm, will not go on."""
    actions = np.zeros((50, 3, 3), np.float32)
    actions[:, 0], actions[:, 1], actions[:, 2] = (-1, 0, 0), (-1, 0, 1), (1, 0, 1)
    arms, _, engine = _both(sim, actions, push_up=False)
    for q in (arms.q, engine[-1, :, 6:]):
        assert (q > panda.JOINT_LOW - 0.01).all() and (q < panda.JOINT_HIGH + 0.01).all()
        room = np.minimum(q - panda.JOINT_LOW, panda.JOINT_HIGH - q).min(1)
        assert (room[:2] < 0.03).all()


def test_arms_do_not_depend_on_their_company_or_their_place() -> None:
    """Also where some of the company touches the table or a joint limit."""
    rng = np.random.default_rng(4)
    count = LANES + 3
    actions = rng.uniform(-1.5, 1.5, (25, count, 3))  # some beyond the bounds
    actions[:, ::3, 2] = 0.8
    sphere = np.column_stack((rng.uniform(-0.3, 0.3, (count, 6)), rng.uniform(0.05, 0.1, count))) + np.array(
        [0, 0, 0.4, 0, 0, 0, 0]
    )
    together, clipped, turned = (Arms.at_rest(count) for _ in range(3))
    alone = [Arms.at_rest(1) for _ in range(count)]
    for action in actions:
        together, *seen = together.step(action, sphere)
        clipped, *_ = clipped.step(np.clip(action, -1, 1), sphere)
        turned, *_ = turned.step(action[::-1].copy(), sphere[::-1].copy())
        for i in range(count):
            alone[i], clearance, nearest = alone[i].step(action[i : i + 1], sphere[i : i + 1])
            assert (clearance[0], nearest[0]) == (seen[0][i], seen[1][i])
    assert together.hand[:, 2].min() < 0.01
    for name in ("q", "speed", "hand", "velocity"):
        whole = getattr(together, name)
        np.testing.assert_array_equal(whole, np.concatenate([getattr(arm, name) for arm in alone]))
        np.testing.assert_array_equal(whole, getattr(clipped, name))
        np.testing.assert_array_equal(whole[::-1], getattr(turned, name))


def test_an_arm_at_rest_is_where_the_kinematics_puts_it() -> None:
    arms = Arms.at_rest(2)
    np.testing.assert_allclose(arms.hand, panda.hand_position(arms.q), atol=1e-6)
    assert not arms.speed.any() and not arms.velocity.any()


_RECORD = """\
import numpy as np
from rise_envs.panda_motion import Arms, _step
arms, sphere = Arms.at_rest(40), np.tile([0.1, 0.1, 0.3, 0.1, 0.0, 0.0, 0.07], (40, 1))
for action in np.random.default_rng(0).uniform(-1, 1, (20, 40, 3)):
    arms, clearance, _ = arms.step(action, sphere)
print(sum(_step.stats.cache_hits.values()), arms.q.tobytes().hex(), clearance.tobytes().hex())
"""


@pytest.mark.slow
def test_who_compiles_computes_what_the_next_one_loads(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes that compile at the same time, and one that comes after them."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def start() -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-c", _RECORD], stdout=subprocess.PIPE, text=True)

    pair = [start(), start()]
    said = [process.communicate()[0] for process in pair] + [start().communicate()[0]]
    assert said[0][0] == "0" and said[2][0] == "1"
    assert len({line[1:] for line in said}) == 1


# --- clearance --------------------------------------------------------------------------------------------


def test_clearance_is_the_least_of_the_capsules_over_the_step() -> None:
    """Against the kinematics at the ends of the step, and between them never by more than the arm moves."""
    rng = np.random.default_rng(5)
    count = 200
    arms = Arms.at_rest(count)
    sphere = np.column_stack(
        (
            arms.hand + rng.uniform(-0.15, 0.15, (count, 3)),
            rng.uniform(-0.1, 0.1, (count, 3)),
            rng.uniform(0.05, 0.1, count),
        )
    )
    for _ in range(6):
        action = rng.uniform(-1, 1, (count, 3))
        after, clearance, nearest = arms.step(action, sphere)
        ends = []
        for q, time in ((arms.q, 0.0), (after.q, 0.04)):
            ends.append(panda.clearance(q, sphere[:, :3] + time * sphere[:, 3:6], sphere[:, 6]))
        least = np.minimum(ends[0][0], ends[1][0])
        assert (clearance <= least + 1e-5).all()
        assert (clearance >= least - 0.04).all()
        assert (clearance > least - 1e-5).mean() > 0.5
        known = [str(LINKS[capsule]) for capsule in ends[0][1]]
        same = clearance > ends[0][0] - 1e-6
        assert all("finger" in known[i] or LINKS[nearest[i]] == known[i] for i in np.flatnonzero(same))
        sphere = np.column_stack((sphere[:, :3] + 0.04 * sphere[:, 3:6], sphere[:, 3:]))
        arms = after


def test_the_link_that_goes_deepest_is_named_as_by_the_engine(sim: PandaSim) -> None:
    sim.reset()
    rng = np.random.default_rng(6)
    centers = rng.uniform([-0.7, -0.2, 0.05], [0.15, 0.2, 0.8], (400, 3))
    sphere = np.column_stack((centers, np.zeros((400, 3)), np.full(400, 0.05)))
    _, clearance, nearest = Arms.at_rest(400).step(np.zeros((400, 3)), sphere)
    agree, seen = [], set()
    for i, center in enumerate(centers):
        distance, link = sim.clearance(center, 0.05)
        if -0.05 < distance < 0.05 and abs(clearance[i] - distance) < 0.01:
            agree.append(LINKS[nearest[i]] == sim.link_names[link])
            seen.add(sim.link_names[link])
    assert len(agree) > 60 and np.mean(agree) > 0.85
    assert {"panda_hand", "panda_leftfinger", "panda_rightfinger"} & seen and len(seen) >= 6
