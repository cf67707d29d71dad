"""The Panda's experts against SciPy, brute force, finite differences, hand-made scenes and the engine."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from rise_agents.experts import make_expert, panda_cbf, panda_mpc
from rise_agents.experts.box_qp import solve_qp
from rise_agents.experts.panda_cbf import PandaCBF
from rise_agents.experts.panda_model import DT, advance, look, make_arm, write_gradient
from rise_agents.experts.panda_mpc import PandaMPC
from rise_agents.experts.panda_steering import Steering
from rise_envs import panda_kinematics as panda
from rise_envs.safe_panda import SafePandaEnv
from rise_envs.task import task_of

ENV = "RISE-SafePanda-v0"
TASK = task_of(ENV)
EXPERTS = {"cbf": PandaCBF(TASK), "mpc": PandaMPC(TASK)}
HAND = panda.hand_position(panda.NEUTRAL[None])[0]


def scene(goal, center, velocity=(0.0, 0.0, 0.0), radius=0.07):
    """An observation of the arm at rest in its start pose."""
    return {
        "observation": np.concatenate((HAND, np.zeros(3), panda.NEUTRAL)),
        "achieved_goal": HAND,
        "desired_goal": np.array(goal, float),
        "obstacle": np.array((*center, *velocity, radius), float),
    }


def scenes(count, seed=0):
    """A batch of hand-made observations, many of them awkward: wrong readings, spheres inside the arm."""
    rng = np.random.default_rng(seed)
    q = panda.NEUTRAL + rng.normal(0, 0.25, (count, 7))
    hand = panda.hand_position(q)
    return {
        "observation": np.concatenate((hand, rng.normal(0, 0.4, (count, 3)), q), axis=1),
        "achieved_goal": hand,
        "desired_goal": rng.uniform((-0.35, -0.4, 0.05), (0.15, 0.4, 0.5), (count, 3)),
        "obstacle": np.concatenate(
            (
                hand + rng.normal(0, 0.2, (count, 3)),
                rng.normal(0, 0.2, (count, 3)),
                rng.normal(0.07, 0.03, (count, 1)),
            ),
            axis=1,
        ),
    }


# --- the quadratic program ----------------------------------------------------------------------------------


def random_program(rng, n):
    rows = rng.normal(size=(n, 3))
    if rng.random() < 0.5:  # nearly parallel, as the rows of neighbouring capsules are
        rows = rows[:1] + 0.2 * rows
    return rng.uniform(-1, 1, 3), rows / np.linalg.norm(rows, axis=1, keepdims=True), rng.normal(0, 0.8, n)


@pytest.mark.parametrize("n", [1, 3, 8, 15])
@pytest.mark.parametrize("price", [100.0, 1e4])
def test_the_program_is_solved_as_scipy_solves_it(n, price):
    """With a slack t ≤ 0 in every row, price·(bound − row·u − t)², it is a bounded linear least squares."""
    rng = np.random.default_rng(n)
    for _ in range(100):
        wanted, rows, bound = random_program(rng, n)
        action, weight = np.empty(3), np.sqrt(price)
        worst = solve_qp(wanted, rows, bound, n, price, action)
        matrix = np.block([[np.eye(3), np.zeros((3, n))], [weight * rows, weight * np.eye(n)]])
        low, high = np.r_[-np.ones(3), np.full(n, -np.inf)], np.r_[np.ones(3), np.zeros(n)]
        best = lsq_linear(matrix, np.r_[wanted, weight * bound], (low, high), method="bvls", tol=1e-14)
        np.testing.assert_allclose(action, best.x[:3], atol=1e-8)
        assert worst == pytest.approx((bound - rows @ action).max(), abs=1e-12)


def test_rows_that_can_be_met_are_met_as_by_a_hard_program():
    rng = np.random.default_rng(4)
    met = 0
    for _ in range(60):
        wanted, rows, bound = random_program(rng, 4)
        action = np.empty(3)
        solve_qp(wanted, rows, bound, 4, 1e6, action)
        hard = minimize(
            lambda u, wanted=wanted: 0.5 * ((u - wanted) ** 2).sum(),
            np.zeros(3),
            bounds=[(-1, 1)] * 3,
            constraints={"type": "ineq", "fun": lambda u, rows=rows, bound=bound: rows @ u - bound},
            method="SLSQP",
            options={"ftol": 1e-12, "maxiter": 300},
        )
        if hard.success:
            met += 1
            np.testing.assert_allclose(action, hard.x, atol=2e-3)
    assert 10 < met < 60


def test_contradicting_rows_give_the_least_squared_violation():
    rng = np.random.default_rng(3)
    for _ in range(40):
        wanted, rows, _ = random_program(rng, 4)
        bound, action = np.full(4, 1.8), np.empty(3)  # beyond what unit rows reach in the box
        assert solve_qp(wanted, rows, bound, 4, 1e5, action) > 0
        # A slack t ≤ 0 as above, but without the distance to the wanted action.
        low, high = np.r_[-np.ones(3), np.full(4, -np.inf)], np.r_[np.ones(3), np.zeros(4)]
        best = lsq_linear(np.column_stack((rows, np.eye(4))), bound, (low, high), method="bvls")
        assert 0.5 * (np.maximum(0, bound - rows @ action) ** 2).sum() <= best.cost + 1e-4


# --- the model ----------------------------------------------------------------------------------------------


def test_distance_gradient_is_the_change_as_the_hand_is_moved():
    arm, normal, gradient = make_arm(), np.empty(3), np.empty(3)
    center, small = np.array([-0.1, 0.1, 0.25]), 1e-6
    q = panda.NEUTRAL + 0.1
    look(q, center, arm)
    distance, mapping = arm.distance.copy(), arm.mapping.copy()
    for axis in range(3):
        look(q + small * mapping[:, axis], center, arm)
        change = (arm.distance - distance) / small
        look(q, center, arm)
        for k in range(panda.N_CAPSULES):
            write_gradient(k, center, arm, normal, gradient)
            assert gradient[axis] == pytest.approx(change[k], abs=1e-4)
            assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)


def test_one_step_of_the_model_is_the_engines_to_a_centimetre():
    env, arm, errors, moves = SafePandaEnv(), make_arm(), [], []
    expert = EXPERTS["cbf"]
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        for _ in range(12):
            action, _ = expert.predict(observation)
            q, velocity = observation["observation"][6:].copy(), observation["observation"][3:6].copy()
            look(q, observation["obstacle"][:3], arm)
            advance(q, velocity, action, arm)
            before = observation["achieved_goal"]
            observation, *_ = env.step(action)
            errors.append(panda.hand_position(q[None])[0] - observation["achieved_goal"])
            moves.append(observation["achieved_goal"] - before)
    env.close()
    assert np.sqrt((np.array(errors) ** 2).sum(1).mean()) < 0.01
    assert np.sqrt((np.array(moves) ** 2).sum(1).mean()) > 0.02


# --- the experts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EXPERTS)
def test_actions_are_bounded_finite_and_alike_in_any_batch(name):
    batch = scenes(60)
    actions, state = EXPERTS[name].predict(batch)
    assert state is None
    assert actions.shape == (60, 3)
    assert np.abs(actions).max() <= 1  # NaN fails this too
    again, _ = EXPERTS[name].predict({key: value[::-1] for key, value in batch.items()})
    np.testing.assert_array_equal(again[::-1], actions)
    for row in (0, 17, 59):
        single, _ = EXPERTS[name].predict({key: value[row] for key, value in batch.items()})
        np.testing.assert_array_equal(single, actions[row])


@pytest.mark.parametrize("name", EXPERTS)
def test_the_straight_way_is_taken_where_it_is_clear(name):
    observation = scene(goal=(0.0, 0.3, 0.2), center=(0.0, -0.45, 0.5))
    action, _ = EXPERTS[name].predict(observation)
    way = observation["desired_goal"] - HAND
    np.testing.assert_allclose(action, way / np.linalg.norm(way), atol=1e-9)


@pytest.mark.parametrize("name", EXPERTS)
def test_the_hand_gives_way_to_a_sphere_that_comes_at_it(name):
    for direction in np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]):
        center = HAND + 0.14 * direction
        action, _ = EXPERTS[name].predict(scene(HAND + 0.3 * direction, center, -0.15 * direction, 0.1))
        assert action @ direction < 0.0


def test_both_experts_pass_on_the_same_side():
    """Where the way is blocked the two actions point into the same half-space beside the way."""
    rng = np.random.default_rng(5)
    alike = []
    for _ in range(40):
        goal = rng.uniform((-0.3, -0.4, 0.1), (0.1, 0.4, 0.5))
        way = goal - HAND
        if np.linalg.norm(way) < 0.25:
            continue
        observation = scene(goal, HAND + 0.45 * way + rng.normal(0, 0.02, 3), radius=0.06)
        (cbf, _), (mpc, _) = (EXPERTS[name].predict(observation) for name in ("cbf", "mpc"))
        way /= np.linalg.norm(way)
        aside, beside = cbf - (cbf @ way) * way, mpc - (mpc @ way) * way
        if min(np.linalg.norm(aside), np.linalg.norm(beside)) > 0.15:
            alike.append(aside @ beside > 0)
    assert len(alike) > 10
    assert np.mean(alike) >= 0.95


@pytest.mark.parametrize("name", EXPERTS)
def test_episodes_in_the_engine_are_safe_and_reach(name):
    env, expert = SafePandaEnv(), make_expert(name, ENV)
    for seed in range(100, 112):
        observation, info = env.reset(seed=seed)
        cost, reached = info["cost"], False
        for _ in range(50):
            observation, _, reached, _, info = env.step(expert.predict(observation)[0].astype(np.float32))
            cost += info["cost"]
            if reached:
                break
        assert (cost, reached) == (0.0, True), f"seed {seed}"
    env.close()


def test_the_sampling_expert_hardly_depends_on_its_samples():
    batch = scenes(40, seed=2)
    mine, _ = EXPERTS["mpc"].predict(batch)
    same, _ = PandaMPC(TASK, seed=0).predict(batch)
    other, _ = PandaMPC(TASK, seed=1).predict(batch)
    np.testing.assert_array_equal(mine, same)
    assert 0 < np.abs(mine - other).max()
    assert np.linalg.norm(mine - other, axis=1).mean() < 0.2


def test_the_time_step_is_the_tasks():
    assert pytest.approx(TASK.dt) == DT


@pytest.mark.parametrize(
    ("make", "wrong"),
    [
        (lambda: panda_cbf.Config(Steering(decay=0.0)), "decay"),
        (lambda: panda_cbf.Config(Steering(turn_far=0.01)), "turn_near"),
        (lambda: panda_cbf.Config(Steering(price=-1.0)), "price"),
        (lambda: panda_mpc.Config(Steering(horizon=0)), "horizon"),
        (lambda: panda_mpc.Config(samples=4), "elites"),
    ],
)
def test_senseless_settings_are_refused_by_name(make, wrong):
    with pytest.raises(ValueError, match=wrong):
        make()
