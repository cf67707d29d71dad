"""The vehicle's experts against brute force, another solver, closed forms, and the task itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from rise_agents.experts import make_expert, vehicle_cbf, vehicle_mpc
from rise_agents.experts.planar_qp import nearest_point
from rise_agents.experts.vehicle_cbf import VehicleCBF
from rise_agents.experts.vehicle_guidance import Discs, Guidance, direction
from rise_agents.experts.vehicle_mpc import VehicleMPC
from rise_agents.rollout import rollout
from rise_envs import vehicle_compiled
from rise_envs.geometry import unicycle
from rise_envs.streams import seed_bases
from rise_envs.task import task_of
from rise_envs.vehicle_world import Params, observe, sample_starts

ENV = "RISE-GroundVehicle-v0"
TASK = task_of(ENV)
LOW, HIGH = np.array([0.0, -1.5]), np.array([2.5, 1.5])
KINDS = {"cbf": VehicleCBF, "mpc": VehicleMPC}


def scenes(count, n=1, key=5):
    """Observations at fair starts."""
    starts = sample_starts(
        seed_bases([key] * count), np.arange(count), n, Params().constants(), vehicle_compiled
    )
    return observe(starts[0])


def scene(state, goal, *discs):
    """One observation, made by hand."""
    return {
        "observation": np.array(state, float),
        "achieved_goal": np.array(state[:2], float),
        "desired_goal": np.array(goal, float),
        "obstacle": np.array(discs, float).ravel(),
    }


# --- the quadratic program -------------------------------------------------------------------------------------


def random_programs(count, m, seed):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, m, 2))
    return 3 * rng.normal(size=(count, 2)), normals, rng.normal(size=(count, m)) + rng.normal(size=(count, 1))


@pytest.mark.parametrize("m", [1, 2, 4])
def test_the_program_is_solved_as_scipy_solves_it(m):
    target, normals, offsets = random_programs(150, m, m)
    point, feasible = nearest_point(target, normals, offsets, LOW, HIGH)
    assert 0.1 < feasible.mean() < 1
    box = list(zip(LOW, HIGH, strict=True))
    for k in range(150):
        # The least violation is a linear program in (u, s).
        rows = np.column_stack((-normals[k], -np.ones(m)))
        best = linprog([0, 0, 1], rows, -offsets[k], bounds=[*box, (0, None)]).x
        assert feasible[k] == (best[2] < 1e-9)
        slack = normals[k] @ point[k] - offsets[k] + best[2]
        assert slack.min() > -1e-6
        limits = {"type": "ineq", "fun": lambda u, k=k, s=best[2]: normals[k] @ u - offsets[k] + s + 1e-9}
        reference = minimize(
            lambda u, k=k: ((u - target[k]) ** 2).sum(), best[:2], bounds=box, constraints=limits, tol=1e-12
        )
        assert ((point[k] - target[k]) ** 2).sum() <= reference.fun + 1e-5
        assert (point[k] >= LOW).all()
        assert (point[k] <= HIGH).all()


def test_the_program_is_no_worse_than_a_fine_grid():
    target, normals, offsets = random_programs(60, 3, 11)
    point, feasible = nearest_point(target, normals, offsets, LOW, HIGH)
    grid = np.stack(np.meshgrid(np.linspace(0, 2.5, 151), np.linspace(-1.5, 1.5, 151)), -1).reshape(-1, 2)
    violation = np.maximum(offsets[:, None] - np.einsum("gd,bmd->bgm", grid, normals), 0).max(-1)
    mine = np.maximum(offsets - np.einsum("bd,bmd->bm", point, normals), 0).max(-1)
    distance = np.where(violation == 0, ((grid - target[:, None]) ** 2).sum(-1), np.inf).min(1)
    assert (((point - target) ** 2).sum(-1)[feasible] <= distance[feasible] + 1e-9).all()
    assert (mine <= violation.min(1) + 1e-8).all()


def test_contradicting_constraints_are_violated_alike():
    # u₀ ≥ 2 and u₀ ≤ 1: the least worst violation is one half, at u₀ = 1.5; u₁ stays at its target.
    normals = np.array([[[1.0, 0.0], [-1.0, 0.0]]])
    point, feasible = nearest_point(np.array([[0.2, 0.7]]), normals, np.array([[2.0, -1.0]]), LOW, HIGH)
    assert not feasible[0]
    np.testing.assert_allclose(point[0], [1.5, 0.7], atol=1e-6)


def test_a_target_that_breaks_nothing_stays():
    target = np.array([[1.0, 0.5], [9.0, -9.0]])
    point, feasible = nearest_point(target, np.ones((2, 1, 2)), np.full((2, 1), -5.0), LOW, HIGH)
    assert feasible.all()
    assert np.array_equal(point, [[1.0, 0.5], [2.5, -1.5]])


# --- the field -------------------------------------------------------------------------------------------------


def test_far_from_discs_the_field_points_at_the_goal():
    discs = Discs.read(np.array([[[0.0, 40.0]]]), np.zeros((1, 1, 2)), np.ones((1, 1)), 0.5)
    np.testing.assert_allclose(
        direction(np.zeros((1, 2)), np.array([[3.0, 4.0]]), discs, Guidance())[0], [0.6, 0.8]
    )


@pytest.mark.parametrize("aside", [-0.5, 0.0, 0.5])
def test_the_field_leaves_discs_in_the_way_on_the_left(aside):
    # Driving along +x into a disc at x = 2.5: turn towards −y, whichever side of the line it is on.
    discs = Discs.read(np.array([[[2.5, aside]]]), np.zeros((1, 1, 2)), np.ones((1, 1)), 0.5)
    wanted = direction(np.zeros((1, 2)), np.array([[10.0, 0.0]]), discs, Guidance())[0]
    assert wanted[1] < -0.5
    np.testing.assert_allclose(np.linalg.norm(wanted), 1)


def test_a_disc_behind_the_vehicle_does_not_bend_the_field():
    discs = Discs.read(np.array([[[-2.0, 0.1]]]), np.zeros((1, 1, 2)), np.ones((1, 1)), 0.5)
    wanted = direction(np.zeros((1, 2)), np.array([[10.0, 0.0]]), discs, Guidance())
    np.testing.assert_allclose(wanted[0], [1, 0])


# --- both experts ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KINDS)
def test_single_and_batched_agree_bit_for_bit_and_rows_do_not_mix(name):
    expert, rows = KINDS[name](task_of(ENV, n_obstacles=2)), scenes(33, n=2)
    rows["obstacle"][::4, :2] = rows["observation"][::4, :2] + 1.6  # some where the filter must act
    together, state = expert.predict(rows)
    assert state is None
    assert together.shape == (33, 2)
    reverse, _ = expert.predict({key: value[::-1] for key, value in rows.items()})
    assert np.array_equal(reverse[::-1], together)
    for k in range(0, 33, 2):
        alone, _ = expert.predict({key: value[k] for key, value in rows.items()})
        assert alone.shape == (2,)
        assert np.array_equal(alone, together[k])


@pytest.mark.parametrize("name", KINDS)
def test_the_way_is_straight_where_nothing_is_in_it(name):
    expert = KINDS[name](TASK)
    action, _ = expert.predict(scene((0, 0, 0), (10, 0), (0, 30, 0, 0, 1)))
    np.testing.assert_allclose(action, [2.5, 0], atol=5e-3)  # an interior point stays off its bounds


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("aside", [-0.8, 0.0, 0.8])
def test_the_experts_agree_on_the_passing_side(name, aside):
    expert, state, sides = KINDS[name](TASK), np.zeros(3), []
    for _ in range(70):
        action, _ = expert.predict(scene(state, (14, 0), (7, aside, 0, 0, 1.5)))
        state = unicycle(state, action, 0.1)
        if 6 < state[0] < 8:
            sides.append(state[1] - aside)
        if np.hypot(state[0] - 14, state[1]) < 0.75:
            break
    else:
        pytest.fail("the goal was not reached in 70 steps")
    assert sides
    assert max(sides) < -2.0  # below the disc by more than both radii, all the way past it


@pytest.mark.parametrize("name", KINDS)
def test_actions_are_finite_and_bounded_whatever_the_readings_say(name):
    odd = [
        (0, 0, 0, 0, 1),  # on top of the vehicle
        (0.5, 0, 0, 0, 1),  # on top of the look-ahead point
        (3, 0, 0, 0, -2),  # a negative radius
        (10, 0, 0, 0, 3),  # the goal inside
        (2, 0, -50, 30, 2),  # absurdly fast
        (0.1, 0, 0, 0, 40),  # everything inside
        (1e4, -1e4, 5, 5, 0),  # far away
    ]
    expert = KINDS[name](TASK)
    for disc in odd:
        for state in ((0, 0, 0), (0, 0, np.pi), (10, 0, -np.pi / 2)):
            action, _ = expert.predict(scene(state, (10, 0), disc))
            assert np.isfinite(action).all(), (disc, state)
            assert (action >= LOW).all()
            assert (action <= HIGH).all()
    twins, _ = KINDS[name](task_of(ENV, n_obstacles=2)).predict(scene((0, 0, 0), (10, 0), odd[0], odd[1]))
    assert np.isfinite(twins).all()


@pytest.mark.parametrize("name", KINDS)
def test_noise_of_any_strength_never_breaks_an_expert(name):
    expert, rows = KINDS[name](TASK), scenes(60)
    rows["obstacle"] += 5 * np.random.default_rng(0).normal(size=rows["obstacle"].shape)
    action, _ = expert.predict(rows)
    assert np.isfinite(action).all()
    assert ((action >= LOW) & (action <= HIGH)).all()


# --- the barrier -----------------------------------------------------------------------------------------------


def test_a_feasible_action_keeps_the_barrier_condition():
    config = vehicle_cbf.Config()
    expert, rng = VehicleCBF(TASK, config=config), np.random.default_rng(3)
    state = np.column_stack((np.zeros((500, 2)), rng.uniform(-np.pi, np.pi, 500)))
    angle, gap = rng.uniform(-np.pi, np.pi, 500), rng.uniform(0.3, 1.5, 500)
    radius, heading = rng.uniform(0.75, 2, 500), np.stack((np.cos(state[:, 2]), np.sin(state[:, 2])), -1)
    point = config.look_ahead * heading
    away = np.stack((np.cos(angle), np.sin(angle)), -1)
    cover = radius + TASK.robot_radius + config.look_ahead + config.margin
    centre = point - away * (cover + gap)[:, None]
    velocity = 0.7 * rng.uniform(-1, 1, (500, 2))
    discs = Discs.read(centre[:, None], velocity[:, None], radius[:, None], TASK.robot_radius)
    action = expert.filtered(state, discs, np.column_stack((np.full(500, 2.5), rng.uniform(-1.5, 1.5, 500))))

    # Move by finite differences, exactly along the arc: the barrier's rate must respect its bound.
    h = 1e-5
    later = unicycle(state, action, h)
    moved = later[:, :2] + config.look_ahead * np.stack((np.cos(later[:, 2]), np.sin(later[:, 2])), -1)
    rate = (np.linalg.norm(moved - centre - h * velocity, axis=1) - cover - gap) / h
    possible = np.array([  # the best rate over the corners of the box: where it is too small nothing helps
        (away * (v * heading + w * config.look_ahead * heading[:, ::-1] * [-1, 1])).sum(1)
        for v in (0, 2.5) for w in (-1.5, 1.5)
    ]).max(0) - (away * velocity).sum(1)  # fmt: skip
    feasible = possible >= -config.gamma * gap
    assert feasible.mean() > 0.9
    assert (rate[feasible] >= -config.gamma * gap[feasible] - 1e-3).all()
    np.testing.assert_allclose(rate[~feasible], possible[~feasible], atol=1e-3)


def test_a_disc_that_blocks_the_way_slows_the_vehicle():
    # Nose to nose with a wide disc: the nominal action would drive on.
    expert = VehicleCBF(TASK)
    action, _ = expert.predict(scene((0, 0, 0), (10, 0), (2.2, 0, 0, 0, 1.0)))
    assert action[0] < 0.5
    assert abs(action[1]) > 1.0


# --- the plan --------------------------------------------------------------------------------------------------


def planned(expert, observation):
    """The guess, the parameters and the plan as stages (K + 1, 6) for one observation."""
    rows = {key: value[None] for key, value in observation.items()}
    discs = expert.cbf.read(rows)
    guess = expert.rollout(rows["observation"], rows["desired_goal"], discs)[0]
    parts = (rows["observation"][0], guess[1:, :2], discs.centre, discs.velocity, discs.keep_off)
    parameters = np.concatenate([np.ravel(part) for part in parts])
    plan = expert.solve(guess, parameters)
    return guess, parameters, np.append(plan, [0, 0, 0]).reshape(-1, 6)


CROSSING = scene((0, 0, 0.1), (12, 0), (5, -2, 0, 0.9, 1.5))


def test_the_plan_obeys_the_exact_dynamics_the_bounds_and_the_clearance():
    expert = VehicleMPC(TASK)
    _, _, stages = planned(expert, CROSSING)
    for k in range(20):
        np.testing.assert_allclose(unicycle(stages[k, :3], stages[k, 3:5], 0.1), stages[k + 1, :3], atol=1e-5)
        assert (stages[k, 3:5] >= LOW - 1e-4).all()
        assert (stages[k, 3:5] <= HIGH + 1e-4).all()
        if k:
            disc = CROSSING["obstacle"][:2] + 0.1 * k * CROSSING["obstacle"][2:4]
            clearance = np.linalg.norm(stages[k, :2] - disc) - 1.5 - 0.5
            assert clearance >= expert.config.margin - 1e-3


def test_both_solvers_find_the_same_plan():
    expert = VehicleMPC(TASK, config=vehicle_mpc.Config(tolerance=1e-8, max_iterations=200))
    guess, parameters, stages = planned(expert, CROSSING)
    low, high = tuple(expert.cbf.low), tuple(expert.cbf.high)
    other = vehicle_mpc._program("ipopt", 1, 0.1, low, high, expert.config)(guess.ravel()[:-3], parameters)
    assert other is not None
    np.testing.assert_allclose(np.append(other, [0, 0, 0]).reshape(-1, 6)[:, :5], stages[:, :5], atol=1e-4)


def test_solving_another_problem_in_between_changes_nothing():
    expert, rows = VehicleMPC(TASK), scenes(6)
    first, _ = expert.predict(CROSSING)
    expert.predict(rows)
    assert np.array_equal(expert.predict(CROSSING)[0], first)


def test_ipopt_takes_over_where_fatrop_fails():
    hasty = VehicleMPC(TASK, config=vehicle_mpc.Config(max_iterations=4))
    guess, parameters, stages = planned(hasty, CROSSING)  # IPOPT may iterate five times as often
    low, high = tuple(hasty.cbf.low), tuple(hasty.cbf.high)
    program = vehicle_mpc._program("fatrop", 1, 0.1, low, high, hasty.config)
    assert program(guess.ravel()[:-3], parameters) is None
    np.testing.assert_allclose(stages[0, 3:5], VehicleMPC(TASK).predict(CROSSING)[0], atol=2e-3)


def test_without_a_plan_the_action_is_the_barrier_experts():
    hasty = VehicleMPC(TASK, config=vehicle_mpc.Config(max_iterations=1))
    rows = {key: value[None] for key, value in CROSSING.items()}
    guess = hasty.rollout(rows["observation"], rows["desired_goal"], hasty.cbf.read(rows))[0]
    parameters = planned(VehicleMPC(TASK), CROSSING)[1]
    assert hasty.solve(guess, parameters) is None
    assert np.array_equal(hasty.predict(CROSSING)[0], VehicleCBF(TASK).predict(CROSSING)[0])


def test_solvers_print_nothing(capfd):
    VehicleMPC(TASK).predict(CROSSING)
    VehicleMPC(TASK, config=vehicle_mpc.Config(max_iterations=1)).predict(CROSSING)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


# --- on the task -----------------------------------------------------------------------------------------------


def test_the_barrier_expert_is_safe_and_arrives():
    episodes, _ = rollout(make_expert("cbf", ENV), ENV, np.arange(1000))
    assert episodes.safe.mean() >= 0.995
    assert episodes.reached.mean() >= 0.98


@pytest.mark.parametrize("name", ["mpc", "mixture"])
def test_the_planning_experts_are_safe_and_arrive(name):
    episodes, _ = rollout(make_expert(name, ENV), ENV, np.arange(16))
    assert episodes.reached.all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mpc", "mixture"])
def test_the_planning_experts_are_safe_and_arrive_over_many_scenarios(name):
    episodes, _ = rollout(make_expert(name, ENV), ENV, np.arange(1000))
    assert episodes.safe.mean() >= 0.995
    assert episodes.reached.mean() >= 0.98


def test_demonstrations_are_smooth():
    _, transitions = rollout(make_expert("cbf", ENV), ENV, np.arange(100), record=True)
    change = np.abs(np.diff(transitions.actions, axis=0))
    inside = np.ones(len(change), bool)
    inside[transitions.offsets[1:-1] - 1] = False
    assert change[inside].mean(0)[0] < 0.05
    assert change[inside].mean(0)[1] < 0.1


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"gamma must be positive, got 0"):
        vehicle_cbf.Config(gamma=0)
    with pytest.raises(ValueError, match=r"steps must be positive"):
        vehicle_mpc.Config(steps=0)
    with pytest.raises(ValueError, match=r"Guidance\.softness must be positive"):
        Guidance(softness=0.0)
