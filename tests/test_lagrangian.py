"""The multiplier against hand-made sequences; the learner against stable-baselines3's own PPO."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger
from toy_envs import Walk

from rise_agents.bridge import Bridge
from rise_agents.constrained_ppo import ConstrainedPPO
from rise_agents.lagrangian import Controller, constrained_advantage

PLAIN = Controller(limit=1.0, kp=0.5, ki=0.25, kd=2.0, delay=1, smoothing=0.0)


def run(controller: Controller, costs: list[float]) -> list[float]:
    multipliers = []
    for cost in costs:
        controller = controller.update(cost)
        multipliers.append(controller.multiplier)
    return multipliers


def test_multiplier_follows_the_hand_computed_sequence():
    # J      Δ     I = (I + Δ/4)₊   ∂ = (J − J_before)₊   λ = (Δ/2 + I + 2∂)₊
    # 3      2     0.5              0 (no past)           1.5
    # 5      4     1.5              2                     7.5
    # 4      3     2.25             0                     3.75
    # 0     −1     2.0              0                     1.5
    assert run(PLAIN, [3, 5, 4, 0]) == pytest.approx([1.5, 7.5, 3.75, 1.5])


def test_multiplier_and_integral_stop_at_zero():
    limits = replace(PLAIN, limit=10.0)
    assert run(limits, [0, 0, 0]) == [0, 0, 0]
    # After any number of cheap roll-outs the integral starts from 0, not from a debt: Δ = 4 → 2 + 1 + 2·14.
    assert run(limits, [0] * 50 + [14])[-1] == pytest.approx(0.5 * 4 + 0.25 * 4 + 2 * 14)


def test_derivative_looks_back_by_the_delay():
    only = Controller(limit=100.0, kp=0.0, ki=0.0, kd=1.0, delay=3, smoothing=0.0)
    # Differences to three updates before, or to the first while there are fewer; falling costs count nothing.
    assert run(only, [1, 2, 4, 8, 16, 3, 4]) == [0, 1, 3, 7, 14, 0, 0]


def test_smoothing_is_an_exponential_mean_that_starts_at_the_first_cost():
    only = Controller(limit=0.0, kp=1.0, ki=0.0, kd=0.0, smoothing=0.75)
    assert run(only, [4, 0, 8]) == pytest.approx([4, 3, 3 * 0.75 + 2])


def test_no_gain_keeps_the_multiplier_at_its_start():
    fixed = Controller(limit=0.0, kp=0.0, ki=0.0, kd=0.0, integral=0.7, multiplier=0.7)
    assert run(fixed, [5, 0, 9]) == [0.7] * 3


def test_advantage_prices_cost_at_the_multiplier_and_is_standardised():
    reward, cost = np.float32([[1, 3], [5, 7]]), np.float32([[0, 0], [2, 2]])
    # 1, 3, 5 − 6, 7 − 6: mean 1, deviations 0, 2, −2, 0.
    expected = np.array([[0, 2], [-2, 0]]) / np.sqrt(2)
    np.testing.assert_allclose(constrained_advantage(reward, cost, 3.0), expected, rtol=1e-6)


@pytest.mark.parametrize("multiplier", [0.0, 2.0])
def test_a_constant_cost_changes_nothing_and_constant_reward_is_finite(multiplier):
    reward, constant = np.float32([[1, 2], [3, 5]]), np.ones((2, 2), np.float32)
    plain = (reward - reward.mean()) / reward.std()
    np.testing.assert_allclose(constrained_advantage(reward, constant, multiplier), plain, rtol=1e-5)
    assert not constrained_advantage(constant, constant, multiplier).any()


def bridge(n: int = 3, **walk: object) -> Bridge:
    venv = SyncVectorEnv([lambda: Walk(**walk)] * n, autoreset_mode=AutoresetMode.SAME_STEP)
    return Bridge(venv, lambda observation: observation.astype(np.float32), 2)


SETTINGS = {"n_steps": 16, "batch_size": 24, "n_epochs": 3, "seed": 3, "device": "cpu"}


def learner(env: Bridge, controller: Controller, **settings: object) -> ConstrainedPPO:
    costs = {"cost_gamma": 0.99, "cost_gae_lambda": 0.95, "cost_hidden": (8,), "report": lambda *_: None}
    ppo = ConstrainedPPO(controller=controller, env=env, **{**SETTINGS, **costs, **settings})
    ppo.set_logger(Logger(folder=None, output_formats=[]))
    return ppo


NO_GAIN = Controller(limit=0.0, kp=0.0, ki=0.0, kd=0.0)


class StandardisedBuffer(RolloutBuffer):
    """SB3's buffer, advantages standardised over the roll-out instead of over each batch."""

    def compute_returns_and_advantage(self, last_values, dones):
        super().compute_returns_and_advantage(last_values, dones)
        self.advantages = (self.advantages - self.advantages.mean()) / (self.advantages.std() + 1e-8)


def test_without_a_multiplier_it_is_ppo_of_stable_baselines_bit_for_bit():
    ours = learner(bridge(), NO_GAIN)
    ours.learn(300, log_interval=None)
    theirs = PPO(
        "MlpPolicy", bridge(), normalize_advantage=False, rollout_buffer_class=StandardisedBuffer, **SETTINGS
    )
    theirs.set_logger(Logger(folder=None, output_formats=[]))
    theirs.learn(300, log_interval=None)
    for name, weight in theirs.policy.state_dict().items():
        assert torch.equal(ours.policy.state_dict()[name], weight), name
    assert ours.controller.multiplier == 0


@pytest.mark.parametrize("ends", ["truncated", "terminated"])
def test_cost_advantage_equals_the_reward_advantage_where_cost_is_reward(ends):
    """Same numbers through SB3's path and ours; episodes of 7 steps in roll-outs of 16."""
    ppo = learner(bridge(ends=ends), NO_GAIN, gamma=0.9, gae_lambda=0.8, cost_gamma=0.9, cost_gae_lambda=0.8)

    def values(inputs):
        with torch.no_grad():
            return (
                ppo.policy.predict_values(torch.as_tensor(inputs).reshape(-1, 2))
                .numpy()
                .reshape(inputs.shape[:-1])
            )

    ppo.cost_values = values
    compared, train = [], ppo.train

    def checked_train():
        advantages, returns = ppo.cost_advantage()
        np.testing.assert_allclose(advantages, ppo.rollout_buffer.advantages, atol=1e-5)
        np.testing.assert_allclose(returns, ppo.rollout_buffer.returns, atol=1e-5)
        compared.append(True)
        train()

    ppo.train = checked_train
    ppo.learn(3 * 16 * 3, log_interval=None)
    assert len(compared) == 3


def after_one_rollout(monkeypatch, critic: float, **walk: object) -> ConstrainedPPO:
    """A learner whose cost critic always says ``critic``, stopped before its first update."""
    ppo = learner(bridge(1, **walk), NO_GAIN, n_steps=4, batch_size=4, cost_gamma=0.5, cost_gae_lambda=1.0)
    monkeypatch.setattr(ppo, "cost_values", lambda inputs: np.full(inputs.shape[:-1], critic, np.float32))
    monkeypatch.setattr(ppo, "train", lambda: None)
    ppo.learn(4, log_interval=None)
    return ppo


def test_cost_advantage_by_hand(monkeypatch):
    """Cost 1 a step, γ ½, λ 1, episodes of 2 steps, critic 0: returns 1 + ½, 1, 1 + ½, 1."""
    ppo = after_one_rollout(monkeypatch, 0.0, cost="constant", length=2, ends="terminated")
    advantages, returns = ppo.cost_advantage()
    np.testing.assert_allclose(returns[:, 0], [1.5, 1, 1.5, 1])
    np.testing.assert_allclose(advantages, returns)


def test_a_time_limit_and_the_end_of_the_rollout_are_estimated_by_the_critic(monkeypatch):
    """Critic 10, γ ½: cut after step 3 of 4, returns are 1 + 3/2, 1 + 6/2, 1 + 10/2, then 1 + 10/2 again."""
    ppo = after_one_rollout(monkeypatch, 10.0, cost="constant", length=3, ends="truncated")
    _, returns = ppo.cost_advantage()
    np.testing.assert_allclose(returns[:, 0], [3, 4, 6, 6])
    ppo = after_one_rollout(monkeypatch, 10.0, cost="constant", length=3, ends="terminated")
    np.testing.assert_allclose(ppo.cost_advantage()[1][:, 0], [1.75, 1.5, 1, 6])


def weights_are_finite(ppo: ConstrainedPPO) -> bool:
    modules = (ppo.policy, ppo.cost_critic)
    return all(bool(torch.isfinite(p).all()) for module in modules for p in module.parameters())


@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_constant_cost_and_a_limit_of_zero_train_finitely(limit):
    ppo = learner(bridge(cost="constant"), Controller(limit=limit))
    ppo.learn(200, log_interval=None)
    # J = 7 in every roll-out of 16 steps; five of them.
    expected = run(Controller(limit=limit), [7.0] * 5)[-1]
    assert ppo.controller.multiplier == pytest.approx(expected)
    assert weights_are_finite(ppo)


def test_a_rollout_in_which_no_episode_ends_leaves_the_multiplier_alone():
    ppo = learner(bridge(cost="constant", length=1000), Controller(limit=0.0, integral=0.4, multiplier=0.4))
    ppo.learn(200, log_interval=None)
    assert ppo.controller.multiplier == 0.4 and ppo.controller.history == ()
    assert weights_are_finite(ppo)


def test_the_cost_critic_learns_what_episodes_cost():
    """Cost 1 a step, γ 0: the value is 1 everywhere."""
    ppo = learner(bridge(cost="constant"), NO_GAIN, cost_gamma=0.0, learning_rate=0.01, n_epochs=20)
    ppo.learn(400, log_interval=None)
    assert ppo.cost_values(ppo._last_obs) == pytest.approx(1.0, abs=0.1)


def test_snapshot_holds_both_optimisers_the_controller_and_the_generators():
    ppo = learner(bridge(), Controller(limit=0.1))
    ppo.learn(100, log_interval=None)
    arrays, notes = ppo.snapshot()
    for name, weight in ppo.policy.state_dict().items():
        np.testing.assert_array_equal(arrays[f"policy.{name}"], weight.numpy())
    for prefix, optimizer in (("optimizer", ppo.policy.optimizer), ("cost_optimizer", ppo.cost_optimizer)):
        for i, state in optimizer.state_dict()["state"].items():
            np.testing.assert_array_equal(arrays[f"{prefix}.{i}.exp_avg"], state["exp_avg"].numpy())
    assert (
        Controller(**{**notes["controller"], "history": tuple(notes["controller"]["history"])})
        == ppo.controller
    )
    torch.set_rng_state(torch.as_tensor(arrays["random.torch"]))
    assert notes["steps"] == ppo.num_timesteps == 144
