"""C-PPO as an agent: what it learns, how it acts, what a checkpoint keeps."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from toy_envs import Bandit, Lever, Walk

from rise_agents import cppo, load_agent, make_agent
from rise_agents.agent import merge_states
from rise_agents.cppo import CPPO
from rise_envs import STAND_INS

VEHICLE = "RISE-GroundVehicle-v0"
SMALL = {"n_envs": 4, "n_steps": 32, "batch_size": 64, "n_epochs": 4, "hidden": [16], "total_steps": 256}
TOY = {**SMALL, "frame": "raw"}


@pytest.fixture(scope="module")
def vehicle_agent() -> CPPO:
    return make_agent("cppo", VEHICLE, {**SMALL, "log_std": 0.5}, seed=1).learn()


@pytest.fixture(scope="module")
def observations() -> dict:
    env = gym.make_vec(VEHICLE, 9)
    return env.reset(seed=1 << 30)[0]


def serial(kind, n=4, **kwargs):
    return SyncVectorEnv([lambda: kind(**kwargs)] * n, autoreset_mode=AutoresetMode.SAME_STEP)


def test_it_learns_to_spend_the_cost_limit_and_no_more():
    """Reward a, cost max(a, 0), limit ½, one step: the best policy on average costs ½."""
    config = {**TOY, "total_steps": 8_000, "n_envs": 32, "n_steps": 8, "learning_rate": 1e-2}
    config |= {"kp": 1.0, "ki": 0.1, "pid_smoothing": 0.5}
    figures = {}
    agent = make_agent("cppo", "ToyBandit-v0", {**config, "cost_limit": 0.5})
    agent.learn(serial(Bandit, 32), lambda share, now: figures.update({**now, "share": share}))
    assert figures["share"] >= 1.0
    assert figures["cost"] == pytest.approx(0.5, abs=0.2)
    free = make_agent("cppo", "ToyBandit-v0", {**config, "cost_limit": 100.0}).learn(serial(Bandit, 32))
    assert free.predict(np.zeros(1), deterministic=True)[0] > 1.5


def test_discrete_actions_come_for_free():
    agent = make_agent("cppo", "ToyLever-v0", {**TOY, "total_steps": 2048, "learning_rate": 1e-2})
    agent.learn(serial(Lever))
    action, _ = agent.predict(np.zeros((300, 1)), deterministic=True)
    assert action.shape == (300,) and (action == 1).all()
    drawn, state = agent.predict(np.zeros((300, 1)))
    assert (drawn == 1).mean() > 0.8 and state[1].tolist() == [1] * 300


@pytest.mark.parametrize("dict_space", [False, True])
def test_it_trains_in_any_environment_with_a_cost(dict_space):
    agent = make_agent("cppo", "ToyWalk-v0", {**TOY, "batch_size": 32}).learn(Walk(dict_space=dict_space))
    place = np.ones(2)
    observation = {"place": place, "again": place[:, None]} if dict_space else place
    action, _ = agent.predict(observation, deterministic=True)
    assert action.shape == (2,) and (np.abs(action) <= 1).all()


def test_an_environment_without_cost_is_refused():
    with pytest.raises(ValueError, match="no info\\['cost'\\]"):
        make_agent("cppo", "CartPole-v1", {**TOY, "n_envs": 2}).learn()


def test_a_rollout_that_cannot_be_cut_into_equal_batches_is_refused():
    with pytest.raises(ValueError, match="batch_size must divide n_envs · n_steps = 1 · 32, got 64"):
        make_agent("cppo", "ToyWalk-v0", TOY).learn(Walk())


def test_training_is_deterministic_and_leaves_torch_as_it_was():
    threads = torch.get_num_threads()
    agents = [make_agent("cppo", VEHICLE, SMALL, seed=seed).learn() for seed in (2, 2, 3)]
    assert torch.get_num_threads() == threads
    first, again, other = (agent._arrays for agent in agents)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(first["policy.action_net.weight"], other["policy.action_net.weight"])


@pytest.mark.parametrize("frame", ["world", "body", "features", "raw"])
def test_every_frame_trains_on_a_ready_environment(frame):
    venv = gym.make_vec(VEHICLE, 4, autoreset_mode=AutoresetMode.SAME_STEP, max_episode_steps=20)
    agent = make_agent("cppo", VEHICLE, {**SMALL, "frame": frame}).learn(venv)
    observation, _ = venv.reset(seed=0)  # not ours to close
    assert venv.single_action_space.contains(agent.predict(observation)[0][0])


def test_the_mean_action_is_that_of_the_stored_torch_policy(vehicle_agent, observations):
    """Against the policy rebuilt by SB3 from the stored weights."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    arrays = vehicle_agent._arrays
    inputs = vehicle_agent._actor.units(vehicle_agent._inputs(observations))
    box = gym.spaces.Box(-np.inf, np.inf, (inputs.shape[1],))
    policy = ActorCriticPolicy(box, gym.spaces.Box(-1, 1, (2,)), lambda _: 0.0, net_arch=[16])
    weights = {
        name[7:]: torch.as_tensor(value) for name, value in arrays.items() if name.startswith("policy.")
    }
    policy.load_state_dict(weights)
    with torch.no_grad():
        mean = policy.get_distribution(torch.as_tensor(inputs)).distribution.mean.numpy()
    expected = [0, -1.5] + (np.clip(mean, -1, 1) + 1) / 2 * [2.5, 3.0]
    action, state = vehicle_agent.predict(observations, deterministic=True)
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert state is None


def test_actions_stay_inside_the_bounds(vehicle_agent, observations):
    space = gym.make_vec(VEHICLE, 1).single_action_space
    many = {key: np.repeat(value, 50, 0) for key, value in observations.items()}
    action, _ = vehicle_agent.predict(many)
    assert action.dtype == np.float32 and all(space.contains(row) for row in action)
    assert (action == space.high).any() and (action == space.low).any()


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_row_does_not_depend_on_its_batch(vehicle_agent, observations, deterministic):
    keys = np.arange(9, dtype=np.uint64) * 7
    batch, batch_state = vehicle_agent.predict(
        observations, vehicle_agent.initial_state(keys), None, deterministic
    )
    for i in range(9):
        state = vehicle_agent.initial_state(keys[i : i + 1])
        one = {key: value[i] for key, value in observations.items()}
        action, state = vehicle_agent.predict(one, state, np.array([True]), deterministic)
        assert action.shape == (2,)
        np.testing.assert_allclose(action, batch[i], rtol=1e-6)
        assert [part[0] for part in state] == [part[i] for part in batch_state]


def test_exploration_follows_the_policys_normal_distribution(vehicle_agent, observations):
    one = {key: np.repeat(value[:1], 4000, 0) for key, value in observations.items()}
    actor = vehicle_agent._actor
    output = actor.output(vehicle_agent._inputs(one))
    keys, counter = vehicle_agent.initial_state(np.arange(4000))
    drawn = np.concatenate([actor.explore(output, keys, counter + np.uint64(k)) - output for k in range(4)])
    np.testing.assert_allclose(drawn.mean(0), 0, atol=4 * actor.sigma.max() / np.sqrt(len(drawn)))
    np.testing.assert_allclose(drawn.std(0), actor.sigma, rtol=0.03)
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.04


def test_streams_go_on_within_an_episode_and_begin_anew_with_the_next(vehicle_agent, observations):
    first, state = vehicle_agent.predict(observations)
    second, state = vehicle_agent.predict(observations, state)
    assert (first != second).any(-1).all()
    start = np.arange(9) == 4
    _, begun = vehicle_agent.predict(observations, state, start)
    assert begun[1].tolist() == [3, 3, 3, 3, 1, 3, 3, 3, 3]
    assert np.array_equal(begun[0] != state[0], start)
    # A fresh state is not touched by episode_start, and rows may be exchanged between states.
    fresh = vehicle_agent.initial_state(np.arange(9))
    marked, _ = vehicle_agent.predict(observations, merge_states(state, fresh, start), start)
    alone, _ = vehicle_agent.predict(observations, fresh)
    np.testing.assert_array_equal(marked[4], alone[4])


def test_sb3_evaluates_it(vehicle_agent):
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    env = Monitor(gym.make(VEHICLE))
    env.reset(seed=0)
    mean, _ = evaluate_policy(vehicle_agent, env, n_eval_episodes=2, deterministic=False)
    assert np.isfinite(mean)


def test_a_checkpoint_predicts_the_same_in_a_new_process(vehicle_agent, observations, tmp_path):
    vehicle_agent.save(tmp_path / "agent.ckpt")
    np.savez(tmp_path / "observations.npz", **observations)
    code = f"""if True:
        import numpy as np
        from rise_agents import load_agent
        agent = load_agent({str(tmp_path / "agent.ckpt")!r}, {VEHICLE!r})
        observations = dict(np.load({str(tmp_path / "observations.npz")!r}))
        state = agent.initial_state(np.arange(9))
        mean, drawn = (agent.predict(observations, state, None, d)[0] for d in (True, False))
        np.savez({str(tmp_path / "actions.npz")!r}, mean=mean, drawn=drawn)
    """
    subprocess.run([sys.executable, "-c", code], check=True)
    actions = np.load(tmp_path / "actions.npz")
    np.testing.assert_array_equal(actions["mean"], vehicle_agent.predict(observations, deterministic=True)[0])
    state = vehicle_agent.initial_state(np.arange(9))
    np.testing.assert_array_equal(actions["drawn"], vehicle_agent.predict(observations, state)[0])


def test_a_checkpoint_keeps_everything(vehicle_agent, tmp_path):
    vehicle_agent.save(tmp_path / "first")
    loaded = load_agent(tmp_path / "first")
    loaded.save(tmp_path / "second")
    assert loaded.config == vehicle_agent.config and loaded.seed == 1
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()


def test_an_untrained_agent_says_so(observations, tmp_path):
    agent = make_agent("cppo", VEHICLE)
    with pytest.raises(RuntimeError, match="untrained"):
        agent.predict(observations)
    with pytest.raises(RuntimeError, match="untrained"):
        agent.save(tmp_path / "agent")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frame": "boddy"}, "did you mean 'body'"),
        ({"train_env": "RISE-GroundVehicl-v0"}, "train_env: .*RISE-GroundVehicle"),
        ({"total_step": 5}, "did you mean 'total_steps'"),
        ({"n_envs": 0}, "n_envs must be"),
        ({"n_steps": 2.5}, "n_steps must be"),
        ({"batch_size": 1000}, "batch_size must divide"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"cost_limit": -1.0}, "cost_limit must be"),
        ({"cost_limit": float("nan")}, "cost_limit must be"),
        ({"gamma": 1.1}, "gamma must lie in"),
        ({"hidden": []}, "hidden must be"),
        ({"pid_smoothing": 1.0}, "pid_smoothing must lie in"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        make_agent("cppo", VEHICLE, settings)


@pytest.mark.parametrize(
    ("source", "train_env", "used"),
    [
        (None, "", VEHICLE),
        (VEHICLE, "", VEHICLE),
        (None, "CartPole-v1", "CartPole-v1"),
        (VEHICLE, "CartPole-v1", "CartPole-v1"),
        ("RISE-SafePanda-v0", "CartPole-v1", "RISE-SafePanda-v0"),
    ],
)
def test_it_trains_where_it_is_told_to(monkeypatch, source, train_env, used):
    """An environment that is asked for by name wins over the setting, the setting over the agent's own."""
    asked = []

    def make(env_id, n_envs):
        asked.append((env_id, n_envs))
        return gym.make_vec(VEHICLE, n_envs, autoreset_mode=AutoresetMode.SAME_STEP)

    monkeypatch.setattr(cppo, "make_training_env", make)
    agent = make_agent("cppo", VEHICLE, {**SMALL, "train_env": train_env}).learn(source)
    assert asked == [(used, 4)] and agent.env_id == VEHICLE


def test_what_could_not_be_stored_is_not_trained():
    for env_id in ("Nowhere-v0", "json:Nowhere-v0"):
        with pytest.raises(ValueError, match=rf"env_id: no environment '{env_id}' is registered"):
            make_agent("cppo", env_id, TOY)


def test_frames_need_a_task():
    with pytest.raises(ValueError, match="raw"):
        make_agent("cppo", "CartPole-v1")


def test_readings_of_another_number_of_obstacles_are_refused():
    venv = gym.make_vec(VEHICLE, 4, autoreset_mode=AutoresetMode.SAME_STEP, n_obstacles=2)
    with pytest.raises(ValueError, match="'obstacle'"):
        make_agent("cppo", VEHICLE, SMALL).learn(venv)


def test_a_stand_in_has_the_settings_of_what_it_models(monkeypatch):
    monkeypatch.setitem(STAND_INS, "CartPole-v1", VEHICLE)
    agent = make_agent("cppo", "CartPole-v1", {"frame": "raw"})
    assert agent.config.n_envs == CPPO.PRESETS[VEHICLE]["n_envs"] != CPPO.Config.n_envs


def test_presets_are_valid():
    for env_id, preset in CPPO.PRESETS.items():
        assert env_id in gym.registry
        make_agent("cppo", env_id, preset)
