"""The one roll-out: right by hand, and the same however episodes are put together."""

from __future__ import annotations

import itertools

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.policies import Random
from rise_agents.agent import draw_state, merge_states
from rise_agents.rollout import rollout
from rise_agents.seeds import PER_RUN, SPLITS, episode_seeds
from rise_envs.noise_wrappers import ObservationNoise

VEHICLE = "RISE-GroundVehicle-v0"


class Cruise:
    """Straight on at full speed towards where the vehicle looks, or at rest."""

    def __init__(self, speed):
        self.speed = speed

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.tile(np.float32([self.speed, 0.0]), (len(observation["desired_goal"]), 1)), None


def test_against_a_plain_loop_over_the_single_environment():
    """Costs, clearances, returns, steps and ends equal those of the textbook loop, noise included."""
    policy, seeds = Random(VEHICLE), episode_seeds("validation", 0, 0, 6)
    episodes, log = rollout(policy, VEHICLE, seeds, noise_level=1.0, record=True, slots=4)
    env = ObservationNoise(gym.make(VEHICLE), "step", noise_level=1.0)
    for i, seed in enumerate(seeds):
        observation, _ = env.reset(seed=int(seed), options={"noise_seed": int(seed)})
        cost, total, clearance, steps, over = 0.0, 0.0, np.inf, 0, False
        for row in range(log.offsets[i], log.offsets[i + 1]):
            assert not over
            np.testing.assert_array_equal(observation["obstacle"], log.observations["obstacle"][row])
            observation, reward, terminated, truncated, info = env.step(log.actions[row])
            cost, total, clearance = cost + info["cost"], total + reward, min(clearance, info["clearance"])
            steps, over = steps + 1, terminated or truncated
        assert over
        assert (episodes.cost[i], episodes.steps[i], episodes.arrived[i]) == (cost, steps, terminated)
        assert episodes.min_clearance[i] == clearance
        assert episodes.episode_return[i] == pytest.approx(total)
        assert episodes.safe[i] == (cost == 0)
        assert episodes.reached[i] == (terminated and cost == 0)


@pytest.mark.parametrize("slots", [1, 3, 64])
def test_results_do_not_depend_on_what_runs_side_by_side(slots):
    policy, seeds = Random(VEHICLE), episode_seeds("test", 0, 0, 10)
    one, _ = rollout(policy, VEHICLE, seeds, noise="step+episode", noise_level=1.0)
    other, _ = rollout(policy, VEHICLE, seeds, noise="step+episode", noise_level=1.0, slots=slots)
    for name, values in vars(one).items():
        np.testing.assert_array_equal(vars(other)[name], values)


def test_noise_does_not_move_the_obstacle():
    seeds = episode_seeds("test", 0, 0, 8)
    clean, _ = rollout(Cruise(1.0), VEHICLE, seeds)
    noisy, _ = rollout(Cruise(1.0), VEHICLE, seeds, noise_level=2.0)
    np.testing.assert_array_equal(clean.min_clearance, noisy.min_clearance)


def test_who_stands_still_times_out():
    episodes, log = rollout(Cruise(0.0), VEHICLE, episode_seeds("test", 0, 0, 3), record=True)
    assert (episodes.steps == 200).all()
    assert not episodes.arrived.any()
    np.testing.assert_array_equal(np.diff(log.offsets), 200)


def test_splits_do_not_overlap():
    edges = sorted((low, low + 1000 * PER_RUN) for low in SPLITS.values())
    assert all(end <= start for (_, end), (start, _) in itertools.pairwise(edges))
    assert episode_seeds("test", 2, 5, 3).tolist() == [SPLITS["test"] + 2 * PER_RUN + n for n in (5, 6, 7)]
    with pytest.raises(ValueError, match="episodes"):
        episode_seeds("train", 0, PER_RUN - 1, 2)
    with pytest.raises(ValueError, match="split"):
        episode_seeds("exam", 0, 0, 1)


def test_draw_state_renews_only_rows_that_have_drawn():
    keys = np.arange(4, dtype=np.uint64)
    fresh = (keys, np.zeros(4, np.uint64))
    starts = np.array([True, True, False, False])
    same, counter = draw_state(fresh, starts, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(same, keys)
    later = (keys, np.full(4, 3, np.uint64))
    renewed, counter = draw_state(later, starts, 4, np.random.default_rng(0))
    assert (renewed[:2] != keys[:2]).all()
    assert (renewed[2:] == keys[2:]).all()
    assert counter.tolist() == [0, 0, 3, 3]


def test_merge_states_takes_rows():
    old, new = (np.zeros(3), np.zeros((3, 2))), (np.ones(3), np.ones((3, 2)))
    merged = merge_states(old, new, np.array([False, True, False]))
    assert merged[0].tolist() == [0, 1, 0]
    assert merged[1][:, 1].tolist() == [0, 1, 0]
