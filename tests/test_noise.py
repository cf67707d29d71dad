"""Noise models against their stated distributions, and against hand-made cases."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from rise_envs import streams
from rise_envs.noise import NOISE_MODELS, corrupt, make_noise, parts_of, text_of
from rise_envs.noise_models import (
    Compose,
    Delay,
    Dropout,
    EpisodeBias,
    NoiseModel,
    Only,
    Outlier,
    Quantise,
    StepNoise,
)

EVERY_MODEL = [*NOISE_MODELS, "step+episode", "step+dropout:0.3+delay:2", "dropout+quantise:0.5+drift"]
EVERY_MODEL += ["step@velocity", "delay:2@position+dropout:0.4@velocity+outlier@radius"]
GROUPS = {"position": (0, 1), "velocity": (2, 3), "radius": (4,)}
SCALE = np.array([1.0, 0.05, 3.0, 0.0, 20.0])
MOVING = SCALE > 0


def keys_of(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**64, n, dtype=np.uint64)


def some_readings(n_episodes: int, n_steps: int, channels: int = 5) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n_episodes, n_steps, channels)).cumsum(1)


def errors(noise: str, n_episodes: int, n_steps: int, seed: int = 0) -> np.ndarray:
    """What a model adds to readings of 0, in units of the scale of its channels, (B, T, C)."""
    zeros = np.zeros((n_episodes, n_steps, len(SCALE)))
    added = corrupt(noise, zeros, SCALE, keys_of(n_episodes, seed))
    assert (added[..., ~MOVING] == 0).all()
    return added[..., MOVING] / SCALE[MOVING]


def assert_standard_normal(samples: np.ndarray, deviation: float = 1.0) -> None:
    """Mean, deviation (within 4.5 standard errors) and law of each column of independent samples (n, C)."""
    n = len(samples)
    assert_allclose(samples.mean(0), 0, atol=4.5 * deviation / np.sqrt(n))
    assert_allclose(samples.std(0), deviation, rtol=4.5 / np.sqrt(2 * n))
    for column in samples.T:
        assert stats.kstest(column / deviation, "norm").pvalue > 1e-4


def assert_uncorrelated(a: np.ndarray, b: np.ndarray) -> None:
    a, b = np.ravel(a), np.ravel(b)
    assert abs(np.corrcoef(a, b)[0, 1]) < 4.5 / np.sqrt(len(a))


# What holds for every model


@pytest.mark.parametrize("noise", EVERY_MODEL)
def test_level_0_is_the_identity_to_the_last_bit(noise):
    readings = some_readings(3, 20)
    readings[0, :2] = [-0.0, 0.0, 1e300, -1e-300, np.pi]
    noisy, state = [], make_noise(noise, 0, GROUPS).reset(keys_of(3), 5)
    for t in range(20):
        now, state = make_noise(noise, 0, GROUPS)(readings[:, t], SCALE, np.full(3, t), state)
        noisy.append(now)
    assert np.stack(noisy, 1).tobytes() == readings.tobytes()


@pytest.mark.parametrize("noise", [*NOISE_MODELS, "step+episode+drift+quantise"])
def test_without_scale_amplitude_models_are_the_identity(noise):
    readings = some_readings(3, 20)
    if noise not in ("dropout", "delay"):
        assert_array_equal(corrupt(noise, readings, 0.0, keys_of(3)), readings)


@pytest.mark.parametrize("noise", EVERY_MODEL)
def test_an_episode_gets_the_same_noise_alone_and_in_any_batch(noise):
    readings, keys = some_readings(6, 30), keys_of(6)
    together = corrupt(noise, readings, SCALE, keys, GROUPS)
    some = [4, 1]
    assert_array_equal(corrupt(noise, readings[some], SCALE, keys[some], GROUPS), together[some])
    for row in range(6):
        alone = corrupt(noise, readings[row : row + 1], SCALE, keys[row : row + 1], GROUPS)
        assert_array_equal(alone[0], together[row])


@pytest.mark.parametrize("noise", EVERY_MODEL)
@pytest.mark.parametrize("ahead", [2, 7, 64])
def test_drawing_ahead_changes_no_number(noise, ahead):
    readings, keys, model = some_readings(3, 40), keys_of(3), make_noise(noise, groups=GROUPS)
    state = model.reset(keys, 5, ahead)
    for t, expected in enumerate(corrupt(noise, readings, SCALE, keys, GROUPS).swapaxes(0, 1)):
        noisy, state = model(readings[:, t], SCALE, np.full(3, t), state)
        assert_array_equal(noisy, expected)


@pytest.mark.parametrize("noise", EVERY_MODEL)
def test_rows_on_different_clocks_do_not_mix(noise):
    """Rows 0 and 1 of one batch, row 1 started five steps later, both drawn ahead."""
    readings, keys, model = some_readings(2, 30), keys_of(2), make_noise(noise, groups=GROUPS)
    expected = corrupt(noise, readings, SCALE, keys, GROUPS)

    def first_five(state):
        noisy = None
        for t in range(5):
            noisy, state = model(readings[:1, t], SCALE, np.array([t]), state)
        return noisy, state

    _, early = first_five(model.reset(keys[:1], 5, 4))
    late = model.reset(keys[1:], 5, 4)

    def join(a, b):
        return tuple(map(join, a, b)) if isinstance(a, tuple) else np.concatenate((a, b))

    state = join(early, late)
    for t in range(25):
        now = np.stack((readings[0, t + 5], readings[1, t]))
        noisy, state = model(now, SCALE, np.array([t + 5, t]), state)
        assert_array_equal(noisy[0], expected[0, t + 5])
        assert_array_equal(noisy[1], expected[1, t])


@pytest.mark.parametrize("noise", EVERY_MODEL)
def test_no_argument_is_changed(noise):
    model, keys = make_noise(noise, groups=GROUPS), keys_of(2)

    def frozen(x):
        if isinstance(x, tuple):
            return tuple(map(frozen, x))
        x = x.copy()
        x.flags.writeable = False
        return x

    state = frozen(model.reset(frozen(keys), 5, 2))
    for t in range(6):
        noisy, state = model(frozen(some_readings(2, 1)[:, 0]), frozen(SCALE), frozen(np.full(2, t)), state)
        noisy, state = frozen(noisy), frozen(state)


@pytest.mark.parametrize("noise", [n for n in EVERY_MODEL if n not in ("delay", "quantise")])
def test_other_episodes_get_other_noise(noise):
    readings = np.repeat(some_readings(1, 30), 2, axis=0)
    noisy = corrupt(noise, readings, SCALE, keys_of(2), GROUPS)
    assert (noisy[0] != noisy[1]).any()


# Each model against its law


def test_step_noise_is_normal_and_independent_in_every_way():
    e = errors("step:2", n_episodes=500, n_steps=40) / 2
    assert_standard_normal(e.reshape(-1, e.shape[-1]))
    assert_uncorrelated(e[:, 1:], e[:, :-1])  # steps
    assert_uncorrelated(e[1:], e[:-1])  # episodes
    correlation = np.corrcoef(e.reshape(-1, e.shape[-1]).T)
    assert np.abs(correlation - np.eye(len(correlation))).max() < 4.5 / np.sqrt(500 * 40)


def test_outliers_are_a_contaminated_normal():
    """Share, moments and law against the closed forms of (1 − p) N(0, 1) + p N(0, 10²)."""
    p, n = 0.1, 20_000
    e = errors("outlier:0.1:2", n_episodes=500, n_steps=40).reshape(n, -1) / 2

    def law(x):
        return (1 - p) * stats.norm.cdf(x) + p * stats.norm.cdf(x / 10)

    for column in e.T:
        assert stats.kstest(column, law).pvalue > 1e-4
    variance = 1 - p + 100 * p
    fourth = 3 * (1 - p + 10_000 * p)
    eighth = 105 * (1 - p + 1e8 * p)
    assert_allclose(e.mean(0), 0, atol=4.5 * np.sqrt(variance / n))
    assert_allclose((e**2).mean(0), variance, atol=4.5 * np.sqrt((fourth - variance**2) / n))
    assert_allclose((e**4).mean(0), fourth, atol=4.5 * np.sqrt((eighth - fourth**2) / n))
    # A whole reading is an outlier or none: judged by one channel, the others are 10 times larger as well.
    far = np.abs(e[:, 0]) > 6  # of N(0, 1) one in 10⁹
    assert far.mean() == pytest.approx(2 * p * stats.norm.sf(0.6), abs=4.5 * np.sqrt(p / n))
    assert_standard_normal(e[far][:, 1:], 10)
    steps = far.reshape(500, 40)
    assert_uncorrelated(steps[:, 1:], steps[:, :-1])


@pytest.mark.parametrize(("probability", "deviation"), [(0, 1.0), (1, 10.0)])
def test_certain_outliers(probability, deviation):
    e = errors(f"outlier:{probability}", 500, 40)
    assert_standard_normal(e.reshape(-1, e.shape[-1]), deviation)


def test_a_level_multiplies_the_deviation_of_every_channel():
    clean = np.zeros((400, 25, 5))
    for level in (0.25, 2.0):
        added = corrupt(make_noise("step", level), clean, SCALE, keys_of(400))
        assert_allclose(added.std((0, 1)), level * SCALE, rtol=4.5 / np.sqrt(2 * 10_000))


def test_episode_bias_is_constant_within_and_normal_across_episodes():
    e = errors("episode", n_episodes=8000, n_steps=3)
    assert_array_equal(e, np.broadcast_to(e[:, :1], e.shape))
    assert_standard_normal(e[:, 0])
    assert np.abs(np.corrcoef(e[:, 0].T) - np.eye(4)).max() < 4.5 / np.sqrt(8000)


def test_drift_is_a_random_walk_from_0():
    e = errors("drift:0.2", n_episodes=4000, n_steps=26)
    assert (e[:, 0] == 0).all()
    for t in (1, 4, 25):
        assert_standard_normal(e[:, t], deviation=0.2 * np.sqrt(t))
    increments = np.diff(e, axis=1)
    assert_uncorrelated(increments[:, 1:], increments[:, :-1])


def test_dropout_holds_whole_readings_and_never_the_first():
    readings = some_readings(400, 100)
    noisy = corrupt("dropout:0.3", readings, SCALE, keys_of(400))
    fresh = (noisy == readings).all(-1)
    assert fresh[:, 0].all()
    assert_array_equal(noisy[:, 1:][~fresh[:, 1:]], noisy[:, :-1][~fresh[:, 1:]])
    lost = ~fresh[:, 1:]
    assert lost.mean() == pytest.approx(0.3, abs=4.5 * np.sqrt(0.3 * 0.7 / lost.size))
    assert_uncorrelated(lost[:, 1:], lost[:, :-1])


@pytest.mark.parametrize(("probability", "shares"), [(0.0, 0.0), (1.0, 1.0)])
def test_certain_dropout(probability, shares):
    readings = some_readings(3, 10)
    noisy = corrupt(Dropout(probability), readings, SCALE, keys_of(3))
    expected = np.repeat(readings[:, :1], 10, axis=1) if shares else readings
    assert_array_equal(noisy, expected)


def test_delay_by_hand():
    readings = np.arange(6.0).reshape(1, 6, 1)
    assert_array_equal(corrupt("delay:2", readings, 1.0, keys_of(1))[0, :, 0], [0, 0, 0, 1, 2, 3])
    assert_array_equal(corrupt("delay", readings, 1.0, keys_of(1))[0, :, 0], [0, 0, 1, 2, 3, 4])
    assert_array_equal(corrupt("delay:0", readings, 1.0, keys_of(1)), readings)


def test_quantise_by_hand():
    readings = np.array([[[0.2, -0.3, 0.74, 7.123]]])
    noisy = corrupt("quantise:0.5", readings, np.array([1.0, 1.0, 0.5, 0.0]), keys_of(1))
    assert_allclose(noisy[0, 0], [0.0, -0.5, 0.75, 7.123])


def test_levels_of_the_models_without_amplitude():
    assert make_noise("dropout:0.2", 2) == Dropout(1 - 0.8**2)
    assert make_noise("delay:3", 0.5) == Delay(2)
    assert make_noise("delay:1", 0.25) == Delay(0)
    assert make_noise("quantise", 0.5) == Quantise(0.5)


# Groups of channels


@pytest.mark.parametrize("noise", NOISE_MODELS)
@pytest.mark.parametrize("group", GROUPS)
def test_noise_in_a_group_is_that_of_all_channels_kept_there(noise, group):
    readings, keys, inside = some_readings(4, 30), keys_of(4), list(GROUPS[group])
    everywhere = corrupt(noise, readings, SCALE, keys)
    noisy = corrupt(f"{noise}@{group}", readings, SCALE, keys, GROUPS)
    assert_array_equal(noisy[..., inside], everywhere[..., inside])
    outside = [c for c in range(5) if c not in inside]
    assert noisy[..., outside].tobytes() == readings[..., outside].tobytes()


def test_groups_by_hand():
    readings = np.arange(20.0).reshape(1, 4, 5)
    expected = readings.copy()
    expected[0, :, 2:4] = readings[
        0, [0, 0, 0, 1], 2:4
    ]  # two steps late, the first until there is one so old
    expected[0, :, 4] = [0, 10, 10, 20]  # 4, 9, 14, 19 on a grid of 10
    noisy = corrupt("delay:2@velocity+quantise:0.5@radius", readings, SCALE, keys_of(1), GROUPS)
    assert_array_equal(noisy, expected)


def test_parts_in_groups_have_streams_of_their_own():
    noise, zeros = "step@position+step@velocity+episode@velocity", np.zeros((800, 5, 5))
    e = corrupt(noise, zeros, 1.0, keys_of(800), GROUPS)
    assert (e[..., 4] == 0).all()
    assert_standard_normal(e[..., :2].reshape(-1, 2))
    assert_standard_normal(e[:, 0, 2:4], np.sqrt(2))
    assert_uncorrelated(e[..., :2], e[..., 2:4])


def test_a_level_holds_in_groups_too():
    assert make_noise("step@position+delay:2@radius", 0.5) == Compose(
        (Only(StepNoise(0.5), "position"), Only(Delay(1), "radius"))
    )
    assert make_noise(Only(StepNoise() + Delay(2), "x"), 2, {"x": [3]}) == Only(
        StepNoise(2) + Delay(4), "x", (3,)
    )


# Compositions


def test_variances_of_independent_parts_add():
    e = errors("step+step:2", 400, 50)
    assert_standard_normal(e.reshape(-1, 4), np.sqrt(5))
    total = errors("step+episode", 400, 50)
    bias = total.mean(1, keepdims=True)
    assert bias.std() == pytest.approx(np.sqrt(1 + 1 / 50), rel=4.5 / np.sqrt(2 * 1600))
    assert (total - bias).std() == pytest.approx(np.sqrt(1 - 1 / 50), rel=0.02)


def test_order_matters():
    readings = np.zeros((50, 20, 5))
    scale, keys = np.ones(5), keys_of(50)
    held_last = corrupt("step+dropout:0.5", readings, scale, keys)
    fresh_last = corrupt("dropout:0.5+step", readings, scale, keys)
    assert (np.diff(held_last, axis=1) == 0).mean() == pytest.approx(0.5, abs=0.08)
    assert (np.diff(fresh_last, axis=1) != 0).all()


def test_adding_models_is_composing_them():
    a, b, c = StepNoise(0.5), Delay(2), EpisodeBias()
    assert a + b + c == a + (b + c) == Compose((a, b, c)) == make_noise("step:0.5+delay:2+episode")


def test_noise_is_independent_of_the_environment_with_the_same_seed():
    seeds = np.arange(3000)
    env = np.array([np.random.default_rng(s).normal(size=5) for s in seeds])
    keys = streams.seed_keys(seeds, 0x6E6F6973)
    noise = corrupt("step", np.zeros((3000, 1, 5)), 1.0, keys)[:, 0]
    assert_uncorrelated(env, noise)
    assert_uncorrelated(np.abs(env), np.abs(noise))


# Texts and wrong arguments


def test_texts():
    assert make_noise("step") == StepNoise()
    assert make_noise(" step:2 + dropout:0.3 ") == StepNoise(2) + Dropout(0.3)
    assert make_noise("step:1e+2", level=1.0) == StepNoise(100)
    assert make_noise(StepNoise(3), level=2) == StepNoise(6)
    assert make_noise("outlier:0.1", level=2) == Outlier(0.1, 2)
    assert make_noise(" step:2 @ radius + delay") == Compose((Only(StepNoise(2), "radius"), Delay()))
    assert parts_of("step:2@radius+mine:1:2") == [("step", ("2",), "radius"), ("mine", ("1", "2"), "")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stpe", "unknown noise model 'stpe'.*did you mean 'step'"),
        ("step+quantize", "did you mean 'quantise'"),
        ("", "unknown noise model ''"),
        ("step+", "unknown noise model ''"),
        ("step:x", "must be a number"),
        ("step:1:2", "too many parameters"),
        ("step@", "'step@': after '@' stands one group"),
        ("step@radius@position", "after '@' stands one group"),
        (
            "step@radius:2+delay",
            "no group 'radius:2' of reading channels, there are: position, velocity, radius; did",
        ),
        ("step+delay@radious", "did you mean 'radius'"),
        ("@radius", "unknown noise model ''"),
        ("outlier:2", r"outlier: probability must be a finite number in \[0, 1\]"),
        ("outlier:0.1:-1", "outlier: deviation"),
        ("step:-1", "step: deviation must be a finite number ≥ 0"),
        ("step:nan", "step: deviation"),
        ("drift:inf", "drift: rate"),
        ("dropout:1.5", r"dropout: probability must be a finite number in \[0, 1\]"),
        ("delay:1.5", "delay: steps must be a whole number"),
        ("delay:1e9", r"delay: steps must be a finite number in \[0, 10000\]"),
        (None, "noise must be a NoiseModel or a text"),
        (StepNoise, "noise must be a NoiseModel or a text"),
    ],
)
def test_wrong_models(text, message):
    with pytest.raises(ValueError, match=message):
        make_noise(text, groups=GROUPS)


def test_groups_that_are_not_known():
    readings, keys = some_readings(2, 3), keys_of(2)
    with pytest.raises(ValueError, match="channels of the group 'radius' are not known"):
        corrupt("step@radius", readings, SCALE, keys)
    with pytest.raises(ValueError, match="names none: pass noise_channels"):
        make_noise("step@radius", groups={})
    for wrong in ((5,), (-1,)):
        with pytest.raises(ValueError, match=r"group 'radius' are .* of 5"):
            corrupt("step@radius", readings, SCALE, keys, {"radius": wrong})


@pytest.mark.parametrize("level", [-0.1, np.nan, np.inf, "1", None])
def test_wrong_levels(level):
    with pytest.raises(ValueError, match="noise_level"):
        make_noise("step", level)


def test_a_new_model_needs_one_class_and_one_line(monkeypatch):
    class Flip(NoiseModel):
        def at(self, level):
            return self

        def reset(self, keys, channels, ahead=1):
            return ()

        def __call__(self, reading, scale, step, state):
            return -reading, state

    monkeypatch.setitem(NOISE_MODELS, "flip", Flip)
    readings = some_readings(2, 3)
    assert_array_equal(corrupt("flip+flip", readings, 1.0, keys_of(2)), readings)


@pytest.mark.parametrize(
    "model",
    [*(kind() for kind in NOISE_MODELS.values()), Outlier(0.1, 1e22) + Only(Delay(2), "a"), StepNoise(1e-7)],
)
def test_the_text_of_a_model_makes_it_again(model):
    text = text_of(model)
    assert text is not None and make_noise(text) == model


@pytest.mark.parametrize(
    "model",
    [
        Compose(()),
        Only(StepNoise(), "a", (1,)),
        Only(StepNoise() + Delay(), "a"),
        Compose((StepNoise() + Delay(), Dropout())),
        type("Other", (StepNoise,), {})(),
    ],
)
def test_a_model_that_no_text_makes_has_none(model):
    assert text_of(model) is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"readings": np.zeros((2, 5))},
            r"readings must be finite, \(episodes, steps, channels\), got shape",
        ),
        ({"readings": np.full((2, 3, 5), np.nan)}, r"readings must be finite.*the least nan"),
        ({"scale": -1.0}, r"scale must be a finite number ≥ 0, or 5 of them, got -1.0"),
        ({"scale": np.ones(4)}, r"scale must be"),
        ({"keys": np.array([7], np.uint64)}, r"keys must be 2 whole numbers ≥ 0, one for each episode"),
        ({"keys": [0.5, 1.0]}, r"keys must be 2 whole numbers"),
    ],
)
def test_what_is_corrupted_is_checked(changed, message):
    good = {"readings": np.zeros((2, 3, 5)), "scale": 1.0, "keys": [3, 4]}
    assert corrupt("step", **good).shape == (2, 3, 5)
    with pytest.raises(ValueError, match=message):
        corrupt("step", **good | changed)
