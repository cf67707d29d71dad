"""Pictures say what is true: places, sizes and headings are measured in the pixels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pygame
import pytest

import rise_envs  # noqa: F401
from rise_envs import rendering
from rise_envs.rendering import SIZE, STRIP, draw_vehicle_scene
from rise_envs.vehicle_world import Params

PARAMS = Params()
HALF = PARAMS.obstacle_half + rendering.MARGIN
SCALE = SIZE / (2 * HALF)  # px per m
STATE, GOAL = np.array([-5.0, 2.0, 0.7]), np.array([6.0, -7.0])
READING = np.array([3.0, 4.0, 0.6, 0.0, 1.5])
PERCEIVED = np.array([-4.0, -6.0, 0.0, 0.8, 2.0])


def scene(
    state: np.ndarray = STATE,
    reading: np.ndarray = READING,
    perceived: np.ndarray | None = None,
    step: tuple[float, float] = (0.05, 0.03),
) -> np.ndarray:
    trail = [state[:2] - [0.5, 0.5], state[:2] - step, state[:2]]
    return draw_vehicle_scene(state, GOAL, len(reading) // 5, reading, perceived, trail, PARAMS)


def pixel(picture: np.ndarray, x: float, y: float, half: float = HALF) -> np.ndarray:
    scale = SIZE / (2 * half)
    return picture[int((half - y) * scale), int((x + half) * scale)].astype(int)


def like(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 12) -> np.ndarray:
    """Where the view (without the strip of text) has about that colour, (SIZE, SIZE) bool."""
    near: np.ndarray = np.abs(picture[:SIZE].astype(int) - colour) <= tolerance
    return np.all(near, axis=-1)


def middle(mask: np.ndarray) -> np.ndarray:
    """Mean position (m) of the marked pixels."""
    rows, columns = np.nonzero(mask)
    return np.array([(columns.mean() + 0.5) / SCALE - HALF, HALF - (rows.mean() + 0.5) / SCALE])


def test_pictures_are_plain_arrays_of_their_own() -> None:
    a, b = scene(perceived=PERCEIVED), scene(perceived=PERCEIVED)
    assert a.shape == (SIZE + STRIP, SIZE, 3)
    assert a.dtype == np.uint8
    assert a.flags.c_contiguous and a.flags.owndata and a.flags.writeable
    np.testing.assert_array_equal(a, b)
    a[:] = 0
    np.testing.assert_array_equal(b, scene(perceived=PERCEIVED))


def test_everything_is_where_and_as_large_as_it_is() -> None:
    still = np.array([3.0, 4.0, 0.0, 0.0, 1.5])  # no arrow over the disc
    picture = scene(reading=still, step=(0.0, 0.0))
    red = picture[:SIZE, :, 0].astype(int) - picture[:SIZE, :, 1] > 60  # half-covered pixels of the rim too
    np.testing.assert_allclose(middle(red), [3, 4], atol=0.03)
    assert red.sum() / SCALE**2 == pytest.approx(np.pi * 1.5**2, rel=0.04)
    blue = like(picture, rendering.VEHICLE) | like(picture, rendering.VEHICLE_RIM)
    np.testing.assert_allclose(middle(blue), STATE[:2], atol=0.15)
    np.testing.assert_allclose(middle(like(picture, rendering.GOAL_FILL)), GOAL, atol=0.1)
    assert tuple(pixel(picture, 12.5, 12.5)) == rendering.OUTSIDE
    assert tuple(pixel(picture, 0.5, 0.5)) == rendering.FLOOR


@pytest.mark.parametrize("step", [(0.2, 0.1), (-0.1, 0.15)])
def test_an_arrow_shows_where_the_vehicle_goes_in_a_second(step: tuple[float, float]) -> None:
    way = np.array(step) / PARAMS.dt
    rim = PARAMS.robot_radius * way / np.hypot(*way)
    orange = like(scene(step=step), rendering.MOTION)
    rows, columns = np.nonzero(orange)
    found = np.stack((columns / SCALE - HALF, HALF - rows / SCALE), -1) - STATE[:2]
    along = found @ way / np.hypot(*way)
    assert along.max() == pytest.approx(np.hypot(*way), abs=0.12)
    assert along.min() == pytest.approx(np.hypot(*rim), abs=0.12)
    assert not like(scene(step=(0.0, 0.0)), rendering.MOTION).any()


@pytest.mark.parametrize("heading", [0.0, 2.0, -2.5])
def test_the_wedge_points_along_the_heading(heading: float) -> None:
    picture = scene(state=np.array([-5.0, 2.0, heading]))
    ahead = 0.3 * np.array([np.cos(heading), np.sin(heading)])
    assert pixel(picture, *(STATE[:2] + ahead)).min() > 200
    assert tuple(pixel(picture, *(STATE[:2] - ahead))) == rendering.VEHICLE


def test_the_arrow_shows_the_velocity() -> None:
    fast = np.array([3.0, 4.0, -0.6, 0.8, 0.8])
    ahead, behind = fast[:2] + 1.5 * fast[2:4], fast[:2] - 1.5 * fast[2:4]
    picture = scene(reading=fast)
    assert tuple(pixel(picture, *ahead)) == rendering.OBSTACLE_RIM
    assert pixel(picture, *behind).min() > 200


def test_the_disc_as_read_is_dashed_and_only_there_when_there_is_one() -> None:
    assert not like(scene(), rendering.READING).any()
    picture = scene(perceived=PERCEIVED)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    rim = np.stack([pixel(picture, -4 + 2 * np.cos(a), -6 + 2 * np.sin(a)) for a in angle])
    dark = np.all(np.abs(rim - rendering.READING) < 60, axis=-1)
    assert 0.35 < dark.mean() < 0.75
    assert (dark[1:] != dark[:-1]).sum() >= 12  # dashes, not a half circle
    filled = pixel(picture, -3.0, -5.5)
    assert filled.min() > 200  # and not filled


def test_several_discs() -> None:
    two = np.concatenate((READING, [-8.0, -8.0, 0.0, 0.0, 1.0]))
    picture = scene(reading=two)
    assert tuple(pixel(picture, 3.0, 5.0)) == rendering.OBSTACLE
    assert tuple(pixel(picture, -8.0, -8.5)) == rendering.OBSTACLE


def test_a_collision_is_marked() -> None:
    touching = np.array([STATE[0] + 1.0, STATE[1], 0.0, 0.0, 0.8])
    assert like(scene(reading=touching), rendering.WARNING).sum() > 100
    assert not like(scene(), rendering.WARNING).any()


def test_the_view_widens_when_the_vehicle_has_left_the_arena() -> None:
    away = np.array([30.0, -20.0, 0.0])
    picture = scene(state=away)
    half = 30.0 + PARAMS.robot_radius + rendering.MARGIN
    assert tuple(pixel(picture, 29.82, -20.0, half)) == rendering.VEHICLE
    assert tuple(pixel(picture, 2.4, 4.6, half)) == rendering.OBSTACLE


@pytest.mark.parametrize("perceived", [[0.0, 0, 0, 0, -3], [500.0, -500, 30, 30, 40], [2.0, 2, 0, 0, 0]])
def test_absurd_readings_are_drawn_without_complaint(perceived: list[float]) -> None:
    assert scene(perceived=np.array(perceived)).shape == (SIZE + STRIP, SIZE, 3)


def test_drawing_changes_no_episode_and_needs_no_display() -> None:
    pygame.display.quit()
    drawn: Any = gym.make("RISE-GroundVehicle-v0", render_mode="rgb_array")
    plain = gym.make("RISE-GroundVehicle-v0")
    drawn.reset(seed=0), plain.reset(seed=0)
    for _ in range(5):
        drawn.unwrapped.perceived = np.zeros(5)
        first, again = drawn.render(), drawn.render()
        np.testing.assert_array_equal(first, again)
        action = np.array([2.0, 0.5], np.float32)
        a, b = drawn.step(action), plain.step(action)
        for key in a[0]:
            np.testing.assert_array_equal(a[0][key], b[0][key])
    assert not pygame.display.get_init()
    drawn.reset()
    assert drawn.unwrapped.perceived is None


def test_rendering_without_a_mode_says_so() -> None:
    env: Any = gym.make("RISE-GroundVehicle-v0").unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None
    with pytest.raises(ValueError, match="render_mode"):
        type(env)(render_mode="ansi")


@pytest.fixture
def no_screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def test_human_mode_opens_and_closes_a_window(no_screen: None) -> None:
    env = gym.make("RISE-GroundVehicle-v0", render_mode="human")
    env.reset(seed=0)
    assert pygame.display.get_init()
    screen = pygame.display.get_surface()
    assert screen is not None
    picture = pygame.surfarray.array3d(screen).swapaxes(0, 1)
    assert picture.shape == (SIZE + STRIP, SIZE, 3)
    assert like(picture, rendering.GOAL_FILL).any()
    env.step(env.action_space.sample())
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_where_there_is_no_display_no_window_seems_to_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """SDL would draw into nothing, and who is to drive would wait for a window."""
    pygame.display.quit()
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(pygame.error, match="no window can be opened here"):
        rendering.Window((10, 10, 3), fps=1000)
    assert not pygame.display.get_init()


def test_a_window_closed_by_its_user_stays_closed(no_screen: None) -> None:
    window = rendering.Window((SIZE + STRIP, SIZE, 3), fps=1000)
    window.show(scene())
    assert window.is_open
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    window.show(scene())
    assert not window.is_open
    window.show(scene())
    window.close()
