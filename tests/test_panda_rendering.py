"""Pictures of the arm's task say what is true: places, sizes and what hides what, measured in the pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from rise_envs import panda_rendering as drawing
from rise_envs.panda_rendering import VIEW, WIDTH, camera, draw_panda_scene
from rise_envs.rendering import GOAL, OBSTACLE, READING, VEHICLE, WARNING
from rise_envs.safe_panda import SafePandaEnv

GOAL_AT = np.array([-0.1, 0.3, 0.3])
BALL = np.array([0.05, -0.25, 0.25, 0.0, 0.0, 0.0, 0.08])  # before everything
TRAIL = [np.array([0.1, 0.1 * i, 0.3]) for i in range(3)]
Shot = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def env() -> Iterator[SafePandaEnv]:
    env = SafePandaEnv(render_mode="rgb_array")
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def shot(env: SafePandaEnv) -> Shot:
    """The engine's picture of the arm at rest in its neutral pose."""
    assert env._sim is not None
    return env._sim.photograph(camera().view, camera().projection, WIDTH, VIEW, drawing.LIGHT)


def scene(
    shot: Shot,
    reading: np.ndarray = BALL,
    perceived: np.ndarray | None = None,
    clearance: float = 0.2,
    goal: np.ndarray = GOAL_AT,
) -> np.ndarray:
    return draw_panda_scene(shot, goal, 0.05, reading, perceived, TRAIL, clearance, 0.04)


def like(picture: np.ndarray, colour: tuple[int, int, int], tolerance: float = 0.04) -> np.ndarray:
    """Where the view has about that hue, light or shaded, (VIEW, WIDTH) bool."""
    view = picture[:VIEW].astype(float)
    share = view / np.maximum(view.sum(-1, keepdims=True), 1)
    return (np.abs(share - np.array(colour) / sum(colour)) < tolerance).all(-1) & (np.ptp(view, axis=-1) > 60)


def test_the_camera_is_the_engines(shot: Shot) -> None:
    """Points of the table's top and of the fingers lie where, and as deep as, the engine drew them."""
    _, buffer, shown = shot
    depth = camera().metres(buffer)
    points = np.array([[0.2, 0.3, 0.0], [0.1, -0.2, 0.0], [-0.3, -0.3, 0.0], [0.0384, 0.0, 0.19]])
    pixels, depths = camera().project(points)
    for (x, y), expected in zip(pixels.astype(int), depths, strict=True):
        assert shown[y, x]
        assert depth[y, x] == pytest.approx(expected, abs=0.02)
    (x, y), _ = camera().project(np.array([-0.3, 0.6, 0.0]))
    assert not shown[int(y), int(x)]  # beyond the table's edge


def test_spheres_are_where_they_are_and_as_large(shot: Shot) -> None:
    for radius in (0.05, 0.1):
        reading = np.array([*BALL[:6], radius])
        rows, columns = np.nonzero(like(scene(shot, reading), OBSTACLE))
        (x, y), depth = camera().project(BALL[:3])
        assert columns.mean() + 0.5 == pytest.approx(x, abs=3)
        assert rows.mean() + 0.5 == pytest.approx(y, abs=3)
        pixels = np.pi * (radius * camera().focal / depth) ** 2
        assert len(rows) == pytest.approx(pixels, rel=0.12)


def test_what_lies_behind_the_arm_is_hidden(shot: Shot) -> None:
    shoulder = np.array([-0.6, 0.0, 0.35])
    hidden = np.array([*(shoulder - 0.3 * (drawing.EYE - shoulder)), 0, 0, 0, 0.05])
    before = np.array([*(shoulder + 0.3 * (drawing.EYE - shoulder)), 0, 0, 0, 0.05])
    assert like(scene(shot, before), OBSTACLE).sum() > 500
    rows, columns = np.nonzero(like(scene(shot, hidden), OBSTACLE))
    (x, y), _ = camera().project(shoulder)
    assert not ((np.abs(columns - x) < 5) & (np.abs(rows - y) < 5)).any()


def test_the_sphere_as_read_is_translucent_and_dashed(shot: Shot) -> None:
    perceived = np.array([0.2, 0.2, 0.3, 0.0, 0.1, 0.0, 0.06])
    plain, drawn = scene(shot), scene(shot, perceived=perceived)
    (x, y), depth = camera().project(perceived[:3])
    reach = perceived[6] * camera().focal / depth
    r, c = int(y + 0.5 * reach), int(x - 0.4 * reach)
    inside = (drawn[r, c].astype(float) - plain[r, c]) / (np.array(READING) - plain[r, c])
    assert ((inside > 0.15) & (inside < 0.5)).all()  # what lies behind shows through
    turn = np.linspace(0, 2 * np.pi, 200)
    ring = drawn[(y + reach * np.sin(turn)).astype(int), (x + reach * np.cos(turn)).astype(int)]
    dark = np.abs(ring.astype(float) - READING).max(-1) < 40
    assert 0.3 < dark.mean() < 0.8 and np.abs(np.diff(dark.astype(int))).sum() > 10
    changed = (plain != drawn)[:VIEW].any(-1)
    assert changed.sum() < 4 * np.pi * reach**2  # nothing else


def test_a_reading_of_no_size_or_behind_the_camera_is_no_trouble(shot: Shot) -> None:
    for perceived in (
        [0.1, 0.1, 0.3, 0, 0, 0, -0.02],
        [3.0, -3.0, 3.0, 1, 1, 1, 0.05],
        [9, 9, 9, 0, 0, 0, 5],
    ):
        assert scene(shot, perceived=np.array(perceived, float)).shape == (480, 720, 3)


def test_goal_trail_and_warning(shot: Shot) -> None:
    picture = scene(shot)
    (x, y), _ = camera().project(GOAL_AT)
    assert like(picture, GOAL)[int(y), int(x)]
    for point in TRAIL[1:]:
        (x, y), _ = camera().project(point - [0, 0.05, 0])
        assert picture[int(y), int(x), 2] > picture[int(y), int(x), 0] + 60
    assert like(picture, VEHICLE, 0.1).sum() > 50
    ring = camera().project(BALL[:3] + np.array([0, 0, BALL[6] + 0.006]))[0].astype(int)
    near = scene(shot, clearance=-0.01)[ring[1] - 3 : ring[1] + 4, ring[0] - 3 : ring[0] + 4]
    assert (np.abs(near.astype(int) - WARNING).max(-1) < 40).any()


def test_rendering_an_episode_adds_nothing_to_the_simulation(env: SafePandaEnv) -> None:
    assert env._sim is not None
    bullet, client = env._sim._bullet, env._sim._client
    bodies = bullet.getNumBodies(physicsClientId=client)
    for seed in range(3):
        env.reset(seed=seed)
        first = env.render()
        env.step(np.ones(3))
        second = env.render()
        assert first is not None and second is not None and (first != second).any()
    assert bullet.getNumBodies(physicsClientId=client) == bodies == 2
