"""Driving by hand: keys that are pressed, what they do, and what is kept."""

from __future__ import annotations

import runpy
import sys

import gymnasium as gym
import numpy as np
import pygame
import pytest

from rise_agents import demonstrations, make_agent, play
from rise_agents.demonstrations import minari_io
from rise_agents.play import Keyboard, main
from rise_envs import rendering
from rise_envs.task import env_class

VEHICLE = "RISE-GroundVehicle-v0"


def post(kind, key):
    pygame.event.post(pygame.event.Event(kind, key=key))


@pytest.fixture
def screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.display.set_mode((64, 64))
    pygame.event.clear()
    yield
    pygame.display.quit()


def test_keys_stand_for_actions(screen):
    keyboard = Keyboard(VEHICLE, env_class(VEHICLE)().action_space)
    assert keyboard.action().tolist() == [0.0, 0.0]
    for key in (pygame.K_UP, pygame.K_LEFT):
        post(pygame.KEYDOWN, key)
    keyboard.listen()
    assert keyboard.action().tolist() == [2.5, 1.5]
    keyboard.listen()  # held until they are released
    assert keyboard.action().tolist() == [2.5, 1.5]
    post(pygame.KEYUP, pygame.K_UP)
    post(pygame.KEYDOWN, pygame.K_RIGHT)
    keyboard.listen()
    assert keyboard.action().tolist() == [0.0, 0.0]  # left and right at once
    post(pygame.KEYUP, pygame.K_LEFT)
    keyboard.listen()
    assert keyboard.action().tolist() == [0.0, -1.5]
    assert keyboard.action().dtype == np.float32
    assert not keyboard.again and not keyboard.quit
    post(pygame.KEYDOWN, pygame.K_r)
    keyboard.listen()
    assert keyboard.again and not keyboard.quit
    post(pygame.KEYDOWN, pygame.K_q)
    keyboard.listen()
    assert keyboard.quit and not keyboard.again


class Person(rendering.Window):
    """A window before which somebody sits who steers towards the goal and sees nothing else."""

    env = None
    seen: list[np.ndarray]
    presses = staticmethod(lambda person: None)

    def show(self, picture):
        super().show(picture)
        type(self).seen.append(picture)
        type(self).presses(self)


def steers(person):
    """Presses what a person would: ahead, and towards the goal."""
    world = Person.env.unwrapped.world
    (x, y, theta), (gx, gy) = world.state[0], world.goal[0]
    error = (np.arctan2(gy - y, gx - x) - theta + np.pi) % (2 * np.pi) - np.pi
    post(pygame.KEYDOWN, pygame.K_UP)
    for key, wanted in ((pygame.K_LEFT, error > 0.1), (pygame.K_RIGHT, error < -0.1)):
        post(pygame.KEYDOWN if wanted else pygame.KEYUP, key)


@pytest.fixture
def person(monkeypatch):
    """Somebody sits before the window."""
    make = gym.make

    def made(*args, **kwargs):
        Person.env = make(*args, **kwargs)
        return Person.env

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(play.gym, "make", made)
    monkeypatch.setattr(rendering, "Window", Person)
    Person.seen, Person.presses = [], staticmethod(steers)
    yield Person
    pygame.display.quit()


def test_what_is_driven_well_is_kept(person, tmp_path, capsys):
    out = tmp_path / "mine"
    arguments = [VEHICLE, "--rate", "0", "--out", str(out)]
    assert main([*arguments, "--episodes", "3"]) == 0
    keys, *said = capsys.readouterr().out.splitlines()
    assert keys == "drive with up, down, left, right; r: another episode; q: end"
    outcomes = [line.partition(": ")[2].partition(" after")[0] for line in said[:3]]
    good = [i for i, outcome in enumerate(outcomes) if outcome == "goal reached"]
    assert 0 < len(good) < 4 and said[-1] == f"{len(good)} good episodes in {out}"
    kept = demonstrations.load(out)
    assert kept.seeds.tolist() == good  # training seeds of range 0 begin at 0
    assert kept.card["expert"] == "person" and kept.card["tried"] == good[-1] + 1

    # What was kept is what the environment does, with true readings.
    env = gym.make(VEHICLE)
    for i, seed in enumerate(kept.seeds.tolist()):
        observation, _ = env.reset(seed=seed)
        for row in range(kept.offsets[i], kept.offsets[i + 1]):
            for key, value in kept.observations.items():
                np.testing.assert_array_equal(value[row], observation[key])
            observation, reward, terminated, _, _ = env.step(kept.actions[row].astype(np.float32))
            assert reward == kept.rewards[row]
        assert terminated
        np.testing.assert_array_equal(kept.final["observation"][i], observation["observation"])

    # Who comes back goes on, with other episodes.
    assert main([*arguments, "--episodes", "2"]) == 0
    more = demonstrations.load(out)
    assert more.seeds.tolist()[: len(kept)] == kept.seeds.tolist()
    assert len(set(more.seeds.tolist())) == len(more) and (more.seeds < kept.card["tried"] + 2).all()
    np.testing.assert_array_equal(more.first(len(kept)).actions, kept.actions)
    assert main([*arguments, "--seed", "1", "--episodes", "1"]) == 2
    assert "holds another set" in capsys.readouterr().err

    agent = make_agent("pcbc", VEHICLE, {"updates": 20}).learn(more)
    assert agent.predict(more.subsample(4))[0].shape[1] == 2


def test_driven_episodes_go_to_minari(person, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    main([VEHICLE, "--rate", "0", "--episodes", "3", "--out", str(tmp_path / "mine")])
    kept = demonstrations.load(tmp_path / "mine")
    minari_io.export(kept, "lab/driven-v0")
    assert minari_io.load("lab/driven-v0", VEHICLE).digest() == kept.digest()


def test_the_reading_is_drawn_beside_the_obstacle(person):
    main([VEHICLE, "--rate", "0", "--episodes", "1", "--noise-level", "1"])
    read = [
        np.all(np.abs(p.astype(int) - rendering.READING) <= 12, -1)[: rendering.SIZE] for p in person.seen[1:]
    ]
    assert all(mask.any() for mask in read)
    assert (read[1] != read[2]).any()  # another error in every step


def test_keys_that_end_and_begin_anew(person, capsys):
    """R leaves an episode, Q all of it."""
    keys = iter([pygame.K_UP] * 5 + [pygame.K_r] + [pygame.K_UP] * 5 + [pygame.K_q])

    def presses(window):
        post(pygame.KEYDOWN, next(keys))

    person.presses = staticmethod(presses)
    assert main([VEHICLE, "--rate", "0"]) == 0
    assert capsys.readouterr().out.count("\n") == 1  # which keys drive
    assert next(keys, None) is None


def test_closing_the_window_ends_it(person, tmp_path, capsys):
    def presses(window):
        if len(person.seen) == 4:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    person.presses = staticmethod(presses)
    assert main([VEHICLE, "--rate", "0", "--out", str(tmp_path / "mine")]) == 0
    assert "nothing was written" in capsys.readouterr().out
    assert not (tmp_path / "mine" / demonstrations.DATA).exists()


def test_the_arm_can_be_driven(person, capsys):
    def presses(window):
        post(pygame.KEYDOWN, (pygame.K_RIGHT, pygame.K_UP, pygame.K_w)[len(person.seen) % 3])

    person.presses = staticmethod(presses)
    assert main(["RISE-SafePanda-v0", "--rate", "0", "--episodes", "1"]) == 0
    keys, ended = capsys.readouterr().out.splitlines()
    assert keys.startswith("drive with down, up, right, left, w, s;") and ended.startswith("episode 1: ")


def test_an_interruption_is_told_by_the_exit_code(person):
    def presses(window):
        raise KeyboardInterrupt

    person.presses = staticmethod(presses)
    assert main([VEHICLE, "--rate", "0"]) == 130


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "required: ENV"),
        (["RISE-GroundVehicl-v0"], f"did you mean '{VEHICLE}'"),
        (["RISE-SafePandaKinematic-v0"], "draws no pictures"),
        ([VEHICLE, "--noise-model", "stepp"], "did you mean 'step'"),
        ([VEHICLE, "--noise-level", "-1"], "noise_level"),
        ([VEHICLE, "--rate", "-1"], "--rate"),
        ([VEHICLE, "--episodes", "0"], "--episodes"),
        ([VEHICLE, "--seed", "1000"], "seed must be in"),
        ([VEHICLE, "--out", "/dev/null/x"], "cannot write"),
    ],
)
def test_arguments_that_make_no_sense(argv, message, capsys):
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("rise_agents.play: ") and message in error and error.count("\n") == 1


def test_without_a_screen(monkeypatch, capsys):
    def none(*args, **kwargs):
        raise pygame.error("No available video device")

    monkeypatch.setattr(pygame.display, "set_mode", none)
    assert main([VEHICLE]) == 1
    assert (
        capsys.readouterr().err
        == "rise_agents.play: no window can be opened here: No available video device\n"
    )


def test_the_keys_of_the_arm_are_as_the_camera_sees_it():
    """Right is right in the picture, down is towards the viewer, W is up."""
    from rise_envs.panda_rendering import camera

    hand, pairs = np.array([0.0, 0.0, 0.2]), env_class("RISE-SafePanda-v0").KEYS
    towards = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1), "w": (0, -1), "s": (0, 1)}
    for axis, keys in enumerate(pairs):
        for key, sign in zip(keys, (1, -1), strict=True):
            moved = hand + 0.05 * sign * np.eye(3)[axis]
            shift = camera().project(moved)[0] - camera().project(hand)[0]
            assert shift @ towards[key] > 0.5 * np.abs(shift).max()


def test_it_can_be_called_by_the_name_of_the_environments(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["play", "RISE-GroundVehicel-v0"])
    monkeypatch.delitem(sys.modules, "rise_agents.play")
    with pytest.raises(SystemExit) as end:
        runpy.run_module("rise_envs.play", run_name="__main__")
    assert end.value.code == 2
    assert "did you mean 'RISE-GroundVehicle-v0'" in capsys.readouterr().err
