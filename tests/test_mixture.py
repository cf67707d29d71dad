"""The mixture: one expert per episode, chosen by the episode's key and by nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from rise_agents.agent import merge_states
from rise_agents.experts import EXPERTS, expert_names, make_expert
from rise_agents.experts.mixture import Mixture
from rise_envs import streams
from rise_envs.task import task_of

TASK = task_of("RISE-GroundVehicle-v0")


class Constant:
    """Always the same action; keeps nothing."""

    def __init__(self, value):
        self.value = value

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation["desired_goal"]), 2), self.value), None


class Counting(Constant):
    """Acts by the number of steps since the episode began, and remembers the last goal it saw."""

    def initial_state(self, keys):
        return np.zeros(len(keys), np.int64), np.zeros((len(keys), 2))

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        steps = np.where(episode_start, 0, state[0])
        action = self.value + np.stack((steps, state[1][:, 0]), -1)
        return action, (steps + 1, observation["desired_goal"].copy())


def make(*experts, seed=0):
    return Mixture(TASK, experts or (Constant(10.0), Counting(20.0)), seed=seed)


def observe(batch, offset=0.0):
    rows = np.arange(batch, dtype=float)[:, None]
    goal = rows + offset + np.zeros(2)
    return {
        "observation": np.zeros((batch, 3)),
        "achieved_goal": np.zeros((batch, 2)),
        "desired_goal": goal,
        "obstacle": np.zeros((batch, 5)),
    }


def test_the_choice_is_fair_and_follows_the_key_only():
    mixture, keys = make(), streams.bits(np.uint64(7), np.arange(10_000))
    choice = mixture.choose(keys)
    assert set(choice) == {0, 1}
    assert abs(choice.mean() - 0.5) < 0.02
    assert (mixture.initial_state(keys)[0] == choice).all()
    assert (make(seed=99).choose(keys[::-1]) == choice[::-1]).all()


def test_each_row_is_driven_by_its_expert_throughout_the_episode():
    mixture, keys = make(), streams.bits(np.uint64(1), np.arange(16))
    state = mixture.initial_state(keys)
    choice = mixture.choose(keys)
    for step in range(3):
        action, state = mixture.predict(observe(16, offset=step), state, np.full(16, step == 0))
        assert (state[0] == choice).all()
        assert (action[choice == 0] == 10).all()
        # The memory of the counting expert: its steps, and the goal of the step before.
        before = np.arange(16) + step - 1 if step else np.zeros(16)
        assert np.array_equal(
            action[choice == 1], 20 + np.stack((np.full(16, step), before), -1)[choice == 1]
        )


def test_rows_do_not_depend_on_their_neighbours():
    mixture, keys = make(), streams.bits(np.uint64(1), np.arange(9))
    whole, rest = mixture.initial_state(keys), mixture.initial_state(keys[4:6])
    for step in range(3):
        both = observe(9, offset=step)
        action, whole = mixture.predict(both, whole, np.full(9, step == 0))
        part, rest = mixture.predict({k: v[4:6] for k, v in both.items()}, rest, np.full(2, step == 0))
        assert np.array_equal(action[4:6], part)
        assert all(np.array_equal(a[4:6], b) for a, b in zip(whole, rest, strict=True))


def test_a_row_can_be_exchanged_for_a_fresh_episode():
    mixture, keys = make(), streams.bits(np.uint64(1), np.arange(40))
    _, state = mixture.predict(observe(20), mixture.initial_state(keys[:20]), np.ones(20, bool))
    rows = np.arange(20) % 3 == 0
    state = merge_states(state, mixture.initial_state(keys[20:]), rows)
    _, state = mixture.predict(observe(20), state, rows)
    assert (state[0] == np.where(rows, mixture.choose(keys[20:]), mixture.choose(keys[:20]))).all()
    assert (state[2] == np.where(rows, 1, 2)).all()


def test_an_episode_start_without_a_new_key_draws_again_and_starts_the_experts_afresh():
    mixture = make()
    _, first = mixture.predict(observe(200))
    starts = np.arange(200) < 100
    action, second = mixture.predict(observe(200, offset=5), first, starts)
    assert (second[0][100:] == first[0][100:]).all()
    changed = second[0][:100] != first[0][:100]
    assert 0.3 < changed.mean() < 0.7
    counting = (second[0] == 1) & starts
    assert (action[counting] == 20).all()
    _, third = mixture.predict(observe(200), second, np.zeros(200, bool))
    assert (third[0] == second[0]).all()


def test_without_a_state_the_keys_follow_from_the_seed():
    choices = [make(seed=seed).predict(observe(64))[1][0] for seed in (3, 3, 4)]
    assert (choices[0] == choices[1]).all()
    assert (choices[0] != choices[2]).any()


def test_a_single_observation_gives_a_single_action_and_a_state_of_one_row():
    single = {key: value[0] for key, value in observe(1).items()}
    action, state = make().predict(single)
    assert action.shape == (2,)
    assert [len(part) for part in state] == [1] * len(state)
    again, state = make().predict(single, state, np.array([False]))
    assert again.shape == (2,)
    assert state[2].tolist() == [2]


def test_a_memory_without_a_beginning_is_refused():
    class Secretive(Constant):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return super().predict(observation)[0], (np.zeros(len(observation["desired_goal"])),)

    with pytest.raises(ValueError, match=r"'cbf' keeps a state: give it initial_state"):
        make(Secretive(1.0), Secretive(2.0)).predict(observe(4))
    with pytest.raises(ValueError, match="one expert for each"):
        Mixture(TASK, (Constant(1.0),))
    with pytest.raises(ValueError, match="empty batch"):
        make().predict(observe(0))


def test_the_registry_makes_every_vehicle_expert():
    env_id = "RISE-GroundVehicle-v0"
    assert expert_names(env_id) == ("cbf", "mpc", "mixture")
    for name in expert_names(env_id):
        expert = make_expert(name, env_id, seed=1, n_obstacles=2)
        assert expert.task.n_obstacles == 2
    assert make_expert("mixture", env_id).names == ("cbf", "mpc")
    assert {env for env, _ in EXPERTS} == {"RISE-GroundVehicle-v0", "RISE-SafePanda-v0"}


def test_unknown_names_are_told_with_the_nearest_known_one():
    with pytest.raises(ValueError, match=r"'cfb'.*did you mean 'cbf'"):
        make_expert("cfb", "RISE-GroundVehicle-v0")
    with pytest.raises(ValueError, match=r"did you mean 'RISE-GroundVehicle-v0'"):
        expert_names("RISE-GroundVehicel-v0")
