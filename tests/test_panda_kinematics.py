"""The arm's kinematics against the engine, finite differences and NumPy's linear algebra."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from rise_envs import panda_kinematics as panda
from rise_envs.panda_scene import DEFAULTS
from rise_envs.panda_sim import HAND_LINK, PandaSim

RNG = np.random.default_rng(7)
# Poses as in the task: around the neutral one, where the hand points down.
POSES = panda.NEUTRAL + RNG.uniform(-1, 1, (40, 7)) * np.array([0.7, 0.6, 0.4, 0.7, 0.4, 0.5, 0.4])


@pytest.fixture(scope="module")
def sim() -> Iterator[PandaSim]:
    made = PandaSim()
    yield made
    made.close()


def pose(sim: PandaSim, q: np.ndarray) -> None:
    for joint, angle in enumerate(q):
        sim._bullet.resetJointState(sim._arm, joint, angle, physicsClientId=sim._client)


def frames(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rotation, position, hand = np.empty((9, 3, 3)), np.empty((9, 3)), np.empty(3)
    panda.write_frames(q, rotation, position)
    panda.write_hand(rotation, position, hand)
    return rotation, position, hand


def jacobian(q: np.ndarray) -> np.ndarray:
    rotation, position, hand = frames(q)
    matrix = np.empty((6, 7))
    panda.write_jacobian(rotation, position, hand, matrix)
    return matrix


def test_frames_and_hand_are_the_engines(sim: PandaSim) -> None:
    for q in POSES:
        pose(sim, q)
        rotation, position, hand = frames(q)
        for frame, link in enumerate((0, 1, 2, 3, 4, 5, 6, 8), start=1):
            state = sim._bullet.getLinkState(
                sim._arm, link, computeForwardKinematics=True, physicsClientId=sim._client
            )
            np.testing.assert_allclose(position[frame], state[4], atol=1e-6)
            matrix = sim._bullet.getMatrixFromQuaternion(state[5])
            np.testing.assert_allclose(rotation[frame].ravel(), matrix, atol=1e-6)
        state = sim._bullet.getLinkState(
            sim._arm, HAND_LINK, computeForwardKinematics=True, physicsClientId=sim._client
        )
        np.testing.assert_allclose(hand, state[0], atol=1e-6)
    np.testing.assert_allclose(panda.hand_position(POSES)[-1], hand, atol=1e-12)


def test_joint_limits_and_start_pose_are_the_engines(sim: PandaSim) -> None:
    for joint in range(7):
        info = sim._bullet.getJointInfo(sim._arm, joint, physicsClientId=sim._client)
        assert info[8:10] == pytest.approx((panda.JOINT_LOW[joint], panda.JOINT_HIGH[joint]))
    sim.reset()
    np.testing.assert_allclose(sim.state()[6:], panda.NEUTRAL, atol=1e-12)


def test_jacobian_is_the_derivative_of_the_hand() -> None:
    small = 1e-6
    for q in POSES[:10]:
        matrix, rotation = jacobian(q), frames(q)[0][panda.HAND]
        for joint in range(7):
            ahead, behind = q.copy(), q.copy()
            ahead[joint] += small
            behind[joint] -= small
            (turned, _, there), (_, _, here) = frames(ahead), frames(behind)
            np.testing.assert_allclose(matrix[:3, joint], (there - here) / (2 * small), atol=1e-8)
            spin = (turned[panda.HAND] - rotation) @ rotation.T / small  # the matrix of the cross product
            np.testing.assert_allclose(matrix[3:, joint], (spin[2, 1], spin[0, 2], spin[1, 0]), atol=1e-5)


@pytest.mark.parametrize("damping", [0.5, 1e-3])
def test_damped_map_solves_the_damped_least_squares(damping: float) -> None:
    for q in POSES[:10]:
        matrix, mapping = jacobian(q), np.empty((7, 6))
        panda.write_damped_map(matrix, damping, np.empty((6, 6)), mapping)
        expected = matrix.T @ np.linalg.inv(matrix @ matrix.T + damping * np.eye(6))
        np.testing.assert_allclose(mapping, expected, atol=1e-9)


def test_distance_to_a_capsule_by_hand() -> None:
    """The base stands still: its capsule can be measured with a ruler."""
    start = panda.BASE + panda.CAPSULE_START[0]
    edge = panda.CAPSULE_EDGE[0]
    along = edge / np.linalg.norm(edge)
    across = np.cross(along, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    rotation, position, _ = frames(panda.NEUTRAL)
    distance, share = np.empty(panda.N_CAPSULES), np.empty(panda.N_CAPSULES)
    for point, gap, at in (
        (start + 0.4 * edge + 0.3 * across, 0.3, 0.4),
        (start - 0.2 * along, 0.2, 0.0),
        (start + edge + 0.3 * along + 0.4 * across, 0.5, 1.0),
    ):
        panda.write_distances(rotation, position, point, distance, share)
        assert distance[0] == pytest.approx(gap - panda.CAPSULE_RADIUS[0])
        assert share[0] == pytest.approx(at, abs=1e-9)


def test_clearance_is_the_engines_to_millimetres_and_errs_to_the_safe_side(sim: PandaSim) -> None:
    q = np.repeat(POSES, 25, axis=0)
    center = panda.hand_position(q) + RNG.normal(0, 0.12, (len(q), 3))
    radius = RNG.uniform(0.05, 0.1, len(q))
    found, capsule = panda.clearance(q, center, radius)
    engine = np.empty(len(q))
    for row in range(len(q)):
        pose(sim, q[row])
        engine[row] = sim.clearance(center[row], radius[row])[0]
    # Where the task's spheres can be, and near enough to matter.
    there = (center >= DEFAULTS.sphere_low).all(1) & (center <= DEFAULTS.sphere_high).all(1)
    error = (found - engine)[there & (engine > -0.03) & (engine < 0.12)]
    assert len(error) > 200
    assert np.sqrt((error**2).mean()) < 0.003
    assert error.mean() < 0
    assert np.quantile(error, 0.99) < 0.004
    assert capsule.min() >= 0 and capsule.max() < panda.N_CAPSULES
