"""What every registered agent must keep, whatever it is."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from rise_agents import AGENTS, agent_class, make_agent
from rise_agents.testing import CHECKS, Subject

VEHICLE = "RISE-GroundVehicle-v0"


@pytest.fixture(scope="module")
def subjects(vehicle_demonstrations):
    return {name: Subject(name, VEHICLE, vehicle_demonstrations) for name in AGENTS}


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", AGENTS)
def test_contract(subjects, name, check):
    CHECKS[check](subjects[name])


@pytest.mark.parametrize("name", AGENTS)
def test_stable_baselines_evaluates_it(subjects, name):
    env = DummyVecEnv([lambda: Monitor(gym.make(VEHICLE))] * 2)
    mean, _ = evaluate_policy(subjects[name].agent, env, n_eval_episodes=2)
    assert np.isfinite(mean)


@pytest.mark.parametrize("name", AGENTS)
def test_it_trains_in_one_thread_and_gives_the_others_back(subjects, name):
    seen, before = set(), torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        subjects[name].fresh().learn(
            subjects[name].source, progress=lambda *_: seen.add(torch.get_num_threads())
        )
        assert seen == {1} and torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("name", AGENTS)
def test_unknown_settings_are_refused_with_the_nearest_one(name):
    with pytest.raises(ValueError, match="did you mean 'frame'"):
        make_agent(name, VEHICLE, {"fram": "body"})
    with pytest.raises(ValueError, match="frame"):
        make_agent(name, VEHICLE, {"frame": "moon"})


def test_cloned_agents_refuse_other_sources(vehicle_demonstrations):
    for name in AGENTS:
        if agent_class(name).learns_from != "demonstrations":
            continue
        with pytest.raises(ValueError, match="Demonstrations"):
            make_agent(name, VEHICLE).learn(VEHICLE)
        with pytest.raises(ValueError, match="RISE-SafePanda-v0"):
            make_agent(name, "RISE-SafePanda-v0").learn(vehicle_demonstrations)


def test_unknown_agents_are_refused_with_the_nearest_name():
    with pytest.raises(ValueError, match="did you mean 'rise'"):
        make_agent("risse", VEHICLE)
