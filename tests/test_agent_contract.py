"""What every registered agent must keep, whatever it is."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from rise_agents import AGENTS, agent_class, load_agent, make_agent
from rise_agents.checkpoint import CheckpointError

VEHICLE = "RISE-GroundVehicle-v0"


@pytest.fixture(scope="module")
def agents(vehicle_demonstrations):
    made = {}
    for name in AGENTS:
        agent = make_agent(name, VEHICLE, agent_class(name).BRIEF, seed=3)
        source = vehicle_demonstrations if agent.learns_from == "demonstrations" else VEHICLE
        made[name] = agent.learn(source)
    return made


def observations(vehicle_demonstrations, rows=64):
    rng = np.random.default_rng(0)
    batch = {key: value[:rows].copy() for key, value in vehicle_demonstrations.observations.items()}
    batch["obstacle"] += rng.normal(size=batch["obstacle"].shape)
    return batch


@pytest.mark.parametrize("name", AGENTS)
def test_actions_lie_within_bounds_and_have_the_env_s_shape(agents, vehicle_demonstrations, name):
    space = gym.make(VEHICLE).action_space
    batch = observations(vehicle_demonstrations)
    batch["obstacle"][:10] *= 1e5
    action, _ = agents[name].predict(batch)
    assert action.shape == (64, 2)
    assert all(space.contains(row.astype(np.float32)) for row in action)
    single, _ = agents[name].predict({key: value[0] for key, value in batch.items()})
    assert single.shape == (2,)


@pytest.mark.parametrize("name", AGENTS)
@pytest.mark.parametrize("deterministic", [True, False])
def test_a_row_does_not_depend_on_its_neighbours(agents, vehicle_demonstrations, name, deterministic):
    agent, batch = agents[name], observations(vehicle_demonstrations)
    keys = np.arange(64, dtype=np.uint64)
    start = getattr(agent, "initial_state", lambda keys: None)
    whole, _ = agent.predict(batch, start(keys), None, deterministic)
    for row in (0, 17, 63):
        one = {key: value[row : row + 1] for key, value in batch.items()}
        alone, _ = agent.predict(one, start(keys[row : row + 1]), None, deterministic)
        np.testing.assert_allclose(alone[0], whole[row], atol=1e-5)


@pytest.mark.parametrize("name", AGENTS)
def test_same_seed_same_weights(agents, vehicle_demonstrations, name):
    again = make_agent(name, VEHICLE, agent_class(name).BRIEF, seed=3)
    again.learn(vehicle_demonstrations if again.learns_from == "demonstrations" else VEHICLE)
    batch = observations(vehicle_demonstrations)
    for one, other in zip(
        agents[name].predict(batch, deterministic=True)[:1],
        again.predict(batch, deterministic=True)[:1],
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", AGENTS)
def test_store_and_load_in_a_new_process(agents, vehicle_demonstrations, name, tmp_path):
    """The agent that a fresh process loads acts as this one, bit for bit."""
    agents[name].save(tmp_path / "agent.rise")
    batch = observations(vehicle_demonstrations)
    np.savez(tmp_path / "batch.npz", **batch)
    code = (
        "import sys, numpy as np; from rise_agents import load_agent; "
        "batch = dict(np.load(sys.argv[2])); agent = load_agent(sys.argv[1], 'RISE-GroundVehicle-v0'); "
        "np.save(sys.argv[3], agent.predict(batch, deterministic=True)[0])"
    )
    files = [str(tmp_path / name) for name in ("agent.rise", "batch.npz", "action.npy")]
    subprocess.run([sys.executable, "-c", code, *files], check=True)
    np.testing.assert_array_equal(
        np.load(tmp_path / "action.npy"), agents[name].predict(batch, deterministic=True)[0]
    )
    with pytest.raises(CheckpointError, match="trained on"):
        load_agent(tmp_path / "agent.rise", "RISE-SafePanda-v0")


_ACTS = """
import sys
import numpy as np
from rise_agents import load_agent, make_agent
name, env_id, checkpoint, batch = sys.argv[1:]
make_agent(name, env_id)
agent = load_agent(checkpoint, env_id)
for deterministic in (True, False):
    agent.predict(dict(np.load(batch)), deterministic=deterministic)
print(*{"torch", "stable_baselines3"} & set(sys.modules))
"""


@pytest.mark.parametrize("name", AGENTS)
def test_only_learning_needs_torch(agents, vehicle_demonstrations, name, tmp_path):
    """Importing it takes a second or two, which a bad setting and a process that only acts should not take."""
    agents[name].save(tmp_path / "agent.rise")
    np.savez(tmp_path / "batch.npz", **observations(vehicle_demonstrations))
    arguments = [name, VEHICLE, str(tmp_path / "agent.rise"), str(tmp_path / "batch.npz")]
    done = subprocess.run(
        [sys.executable, "-c", _ACTS, *arguments], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []


@pytest.mark.parametrize("name", AGENTS)
def test_stable_baselines_evaluates_it(agents, name):
    env = DummyVecEnv([lambda: Monitor(gym.make(VEHICLE))] * 2)
    mean, _ = evaluate_policy(agents[name], env, n_eval_episodes=2)
    assert np.isfinite(mean)


@pytest.mark.parametrize("name", AGENTS)
def test_unknown_settings_are_refused_with_the_nearest_one(name):
    with pytest.raises(ValueError, match="did you mean 'frame'"):
        make_agent(name, VEHICLE, {"fram": "body"})
    with pytest.raises(ValueError, match="frame"):
        make_agent(name, VEHICLE, {"frame": "moon"})


@pytest.mark.parametrize("name", AGENTS)
def test_acting_before_learning_is_a_clear_error(name, vehicle_demonstrations):
    with pytest.raises(RuntimeError, match="learn"):
        make_agent(name, VEHICLE).predict(observations(vehicle_demonstrations))


def test_cloned_agents_do_not_store_what_has_not_learned(tmp_path):
    for name in ("rise", "pcbc"):
        with pytest.raises(RuntimeError, match="learn"):
            make_agent(name, VEHICLE).save(tmp_path / "agent.rise")


@pytest.mark.parametrize("name", AGENTS)
def test_observations_that_are_not_finite_are_refused(agents, vehicle_demonstrations, name):
    batch = observations(vehicle_demonstrations)
    batch["obstacle"][5, 2] = np.nan
    with pytest.raises(ValueError, match=r"obstacle.*not finite at \[5, 2\]"):
        agents[name].predict(batch)


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
