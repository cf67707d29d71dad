"""Rewards and ends of goals, single and in batches, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rise_envs import goals

GOAL = np.array([3.0, 4.0])
HERE, NEAR, BEFORE = np.array([0.0, 0.0]), np.array([3.0, 3.5]), np.array([-3.0, -4.0])


def info(before: np.ndarray = BEFORE, cost: float = 0.0) -> dict[str, Any]:
    return {"previous_achieved_goal": before, "cost": cost}


def test_distance() -> None:
    assert goals.distance(HERE, GOAL) == 5
    assert goals.distance(np.stack((HERE, NEAR)), np.stack((GOAL, GOAL))).tolist() == [5, 0.5]


def test_sparse_reward() -> None:
    assert goals.reward(HERE, GOAL, {}, 0.75, "sparse") == -1
    assert goals.reward(NEAR, GOAL, {}, 0.75, "sparse") == 0
    assert goals.reward(NEAR, GOAL, {}, 0.5, "sparse") == 0  # the rim belongs to the goal


def test_dense_reward() -> None:
    assert goals.reward(HERE, GOAL, info(), 0.5, "dense") == pytest.approx((10 - 5) / 0.5)
    assert goals.reward(NEAR, GOAL, info(HERE), 0.5, "dense") == pytest.approx((5 - 0.5) / 0.5 + 1)
    assert goals.reward(BEFORE, GOAL, info(HERE), 0.5, "dense") == pytest.approx(-10)


@pytest.mark.parametrize("reward_type", goals.REWARD_TYPES)
@pytest.mark.parametrize("box", [list, tuple, lambda x: np.array(x, dtype=object)])
def test_batches_are_rows(reward_type: str, box: Any) -> None:
    rng = np.random.default_rng(0)
    achieved, desired, before = rng.normal(size=(3, 40, 2))
    costs = rng.integers(0, 2, 40).astype(float)
    infos = [info(b, c) for b, c in zip(before, costs, strict=True)]
    rewards = goals.reward(achieved, desired, box(infos), 0.9, reward_type)
    ends = goals.terminated(achieved, desired, box(infos), 0.9, True)
    assert rewards.shape == ends.shape == (40,)
    for i, one in enumerate(infos):
        assert rewards[i] == goals.reward(achieved[i], desired[i], one, 0.9, reward_type)
        assert ends[i] == goals.terminated(achieved[i], desired[i], one, 0.9, True)
    assert 0 < ends.sum() < 40


def test_infos_of_a_vector_environment_are_one_dict_of_arrays() -> None:
    rng = np.random.default_rng(1)
    achieved, desired, before = rng.normal(size=(3, 7, 3))
    table = {"previous_achieved_goal": before, "cost": np.arange(7.0) % 2}
    rows = [info(b, c) for b, c in zip(before, table["cost"], strict=True)]
    np.testing.assert_array_equal(
        goals.reward(achieved, desired, table, 0.5, "dense"),
        goals.reward(achieved, desired, rows, 0.5, "dense"),
    )
    np.testing.assert_array_equal(
        goals.terminated(achieved, desired, table, 0.5, True),
        goals.terminated(achieved, desired, rows, 0.5, True),
    )


def test_terminated() -> None:
    assert not goals.terminated(HERE, GOAL, info(cost=1.0), 0.5, False)
    assert goals.terminated(HERE, GOAL, info(cost=1.0), 0.5, True)
    assert not goals.terminated(HERE, GOAL, info(), 0.5, True)
    assert goals.terminated(NEAR, GOAL, info(), 0.5, False)


@pytest.mark.parametrize("lost", [{}, [{}, {}], np.array([{}, {}])])
def test_lost_infos_are_named(lost: Any) -> None:
    with pytest.raises(ValueError, match="copy_info_dict=True"):
        goals.reward(np.zeros((2, 2)), np.ones((2, 2)), lost, 0.5, "dense")
    assert goals.reward(np.zeros((2, 2)), np.ones((2, 2)), lost, 0.5, "sparse").tolist() == [-1, -1]


def test_unknown_reward_type() -> None:
    with pytest.raises(ValueError, match="got 'shaped'"):
        goals.check_reward_type("shaped")
    assert goals.check_reward_type("sparse") == "sparse"
