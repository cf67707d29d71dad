"""PC-BC on noisy readings: what noise it meets, in which frame, and that nothing else has changed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rise_agents import cloning, make_agent, readings
from rise_agents.agent import silent
from rise_agents.pcbc import NoisyReadings
from rise_agents.resume import Resume

VEHICLE = "RISE-GroundVehicle-v0"
BRIEF = {"updates": 40, "batch_size": 32}


def noisy_inputs(demonstrations, frame, level, copies, rows):
    """Inputs (M, B, K) in their own units, the raw rows, and the eyes."""
    lesson = cloning.begin(
        make_agent("pcbc", VEHICLE, {"frame": frame}, seed=2), demonstrations, silent, None
    )
    noisy = NoisyReadings(lesson, level, copies)
    raw = tuple(part[rows] for part in noisy.raw())
    eyes = lesson.eyes
    mean, scale = (
        np.concatenate([getattr(part, name) for part in (eyes.robot, eyes.reading)])
        for name in ("mean", "scale")
    )
    return noisy(*raw).numpy() * scale + mean, raw, eyes


@pytest.mark.parametrize("level", [0.5, 2.0])
def test_readings_carry_fresh_noise_of_the_given_level(vehicle_demonstrations, level):
    """In the world frame what is added is seen as it is: independent N(0, (level · scale)²) on every channel."""
    rows = slice(0, 500)
    inputs, (state, goal, reading), eyes = noisy_inputs(vehicle_demonstrations, "world", level, 16, rows)
    robot = np.concatenate((state, goal), -1)
    np.testing.assert_allclose(inputs[..., :5], np.broadcast_to(robot, (16, 500, 5)), atol=1e-5)
    error = (inputs[..., 5:] - reading.numpy()) / (level * np.asarray(eyes.task.noise_scale))
    flat = error.reshape(-1, 5)
    np.testing.assert_allclose(flat.mean(0), 0, atol=0.04)
    np.testing.assert_allclose(np.cov(flat.T), np.eye(5), atol=0.05)
    assert abs(np.corrcoef(error[0].ravel(), error[1].ravel())[0, 1]) < 0.08  # copies are drawn apart


@pytest.mark.parametrize("frame", readings.FRAMES)
def test_the_frame_is_computed_from_what_was_read(vehicle_demonstrations, frame):
    """The inputs are those of an observation whose reading was noisy from the start."""
    rows = slice(100, 103)
    inputs, raw, eyes = noisy_inputs(vehicle_demonstrations, frame, 1.0, 2, rows)
    draws = torch.empty(2, 3, 5).normal_(generator=torch.Generator().manual_seed(2)).numpy()
    for m in range(2):
        for b in range(3):
            state, goal, reading = (part[b].numpy() for part in raw)
            observation = {"observation": state, "desired_goal": goal, "obstacle": reading + draws[m, b]}
            batch = {key: value[None] for key, value in observation.items()}
            expected = np.concatenate(readings.inputs(eyes.task, frame, batch), -1)[0]
            np.testing.assert_allclose(inputs[m, b], expected, rtol=1e-4, atol=1e-4)


def test_true_readings_are_learned_from_by_default(vehicle_demonstrations):
    plain = make_agent("pcbc", VEHICLE, BRIEF, seed=1).learn(vehicle_demonstrations)
    copied = make_agent("pcbc", VEHICLE, {**BRIEF, "n_samples": 4}, seed=1).learn(vehicle_demonstrations)
    noisy = make_agent("pcbc", VEHICLE, {**BRIEF, "train_noise": 1.0}, seed=1).learn(vehicle_demonstrations)
    for name, array in plain._arrays.items():
        np.testing.assert_array_equal(array, copied._arrays[name])
    assert any((array != noisy._arrays[name]).any() for name, array in plain._arrays.items())


def test_noisy_training_goes_on_bit_for_bit(vehicle_demonstrations, tmp_path):
    """Interrupted amid a pass through the data, it draws the noise that it would have drawn."""
    config = {"updates": 90, "batch_size": 64, "train_noise": 1.0, "n_samples": 3, "frame": "features"}
    whole = make_agent("pcbc", VEHICLE, config, seed=4).learn(vehicle_demonstrations)

    class Interrupted(Exception):
        pass

    def stop(share, figures):
        if share >= 0.4:
            raise Interrupted

    path = tmp_path / "state.training"
    with pytest.raises(Interrupted):
        make_agent("pcbc", VEHICLE, config, seed=4).learn(
            vehicle_demonstrations, stop, Resume(path, every=0.0)
        )
    again = make_agent("pcbc", VEHICLE, config, seed=4).learn(vehicle_demonstrations, resume=path)
    for name, array in whole._arrays.items():
        np.testing.assert_array_equal(array, again._arrays[name])


def test_noise_smooths_what_is_learned(vehicle_demonstrations):
    """On noisy readings an agent that met them in training has the lower error of action."""
    config = {"updates": 1_500, "batch_size": 64, "hidden": [32, 32]}
    rng = np.random.default_rng(0)
    noisy = {key: value.copy() for key, value in vehicle_demonstrations.observations.items()}
    noisy["obstacle"] += rng.normal(size=noisy["obstacle"].shape)
    errors = []
    for changed in ({}, {"train_noise": 1.0, "n_samples": 4}):
        agent = make_agent("pcbc", VEHICLE, {**config, **changed}).learn(vehicle_demonstrations)
        wanted = agent.units.to_unit(vehicle_demonstrations.actions)
        got = agent.units.to_unit(agent.predict(noisy)[0].astype(np.float64))
        errors.append(((got - wanted) ** 2).mean())
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.parametrize(
    ("setting", "value"), [("train_noise", -0.1), ("train_noise", float("inf")), ("n_samples", 0)]
)
def test_settings_out_of_range_are_refused(setting, value):
    with pytest.raises(ValueError, match=setting):
        make_agent("pcbc", VEHICLE, {setting: value})
