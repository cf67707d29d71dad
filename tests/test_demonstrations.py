"""Demonstrations: the same for any number of workers, safe, checked on loading, exchanged with Minari."""

from __future__ import annotations

import json
import os
import signal
import time

import gymnasium as gym
import numpy as np
import pytest

from rise_agents import archive
from rise_agents.demonstrations import CARD, DATA, DatasetError, generate, load, minari_io
from rise_agents.demonstrations.__main__ import main
from rise_agents.demonstrations.dataset import check
from rise_agents.demonstrations.recording import part_path, record_part

VEHICLE = "RISE-GroundVehicle-v0"


@pytest.fixture
def stored(vehicle_demonstrations, tmp_path):
    vehicle_demonstrations.save(tmp_path)
    return tmp_path


def test_replaying_the_actions_in_the_single_environment_gives_the_same_episodes(vehicle_demonstrations):
    """Recorded in the batched environment, replayed by seed in the single one, bit for bit, and safe."""
    d, env = vehicle_demonstrations, gym.make(VEHICLE)
    for i in range(5):
        observation, _ = env.reset(seed=int(d.seeds[i]))
        for row in range(d.offsets[i], d.offsets[i + 1]):
            for key, value in observation.items():
                np.testing.assert_array_equal(value, d.observations[key][row])
            observation, reward, terminated, truncated, info = env.step(d.actions[row])
            assert reward == pytest.approx(d.rewards[row], abs=1e-12)
            assert info["cost"] == 0
        assert terminated and not truncated
        for key, value in observation.items():
            np.testing.assert_array_equal(value, d.final[key][i])


def test_workers_do_not_change_the_result(vehicle_demonstrations):
    alone, shared = generate(VEHICLE, "cbf", 120), generate(VEHICLE, "cbf", 120, workers=2)
    for name, array in alone.arrays().items():
        np.testing.assert_array_equal(shared.arrays()[name], array)
    assert alone.card == shared.card
    np.testing.assert_array_equal(
        alone.actions[: len(vehicle_demonstrations.actions)], vehicle_demonstrations.actions
    )


def test_unsafe_and_unsuccessful_episodes_are_left_out_and_counted(monkeypatch):
    """An expert that heads straight for the goal collides in most episodes; those that stay are safe."""

    class Straight:
        def __init__(self, *args, **kwargs):
            pass

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            way = observation["desired_goal"] - observation["achieved_goal"]
            turn = np.arctan2(way[:, 1], way[:, 0]) - observation["observation"][:, 2]
            turn = (turn + np.pi) % (2 * np.pi) - np.pi
            return np.column_stack((np.full(len(way), 2.5), np.clip(3 * turn, -1.5, 1.5))), None

    monkeypatch.setattr(
        "rise_agents.demonstrations.recording.make_expert", lambda *args, **kwargs: Straight()
    )
    d = generate(VEHICLE, "straight", 20)
    assert len(d) == 20
    assert (d.costs == 0).all()
    assert d.card["tried"] > 40
    assert d.card["rejection_rate"] == 1 - 20 / d.card["tried"]


def test_store_and_load(stored, vehicle_demonstrations):
    again = load(stored)
    for name, array in vehicle_demonstrations.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)


def test_first_and_subsample(vehicle_demonstrations):
    part = vehicle_demonstrations.first(3)
    assert len(part) == 3
    assert len(part.actions) == part.offsets[-1] == vehicle_demonstrations.offsets[3]
    some = vehicle_demonstrations.within(200)
    assert len(some.actions) <= 200 < vehicle_demonstrations.offsets[len(some) + 1]
    assert len(vehicle_demonstrations.within(1)) == 1
    assert len(vehicle_demonstrations.subsample(10)["obstacle"]) <= 10


def test_blocks_are_disjoint_parts_that_wrap_round(vehicle_demonstrations):
    """Against the episodes dealt out one by one: a block takes what fits, what is left at the end is no block."""
    lengths = np.diff(vehicle_demonstrations.offsets).tolist()
    blocks, open_block = [], []
    for episode, length in enumerate(lengths):
        if open_block and sum(lengths[e] for e in open_block) + length > 500:
            blocks.append(open_block)
            open_block = []
        open_block.append(episode)
    assert len(blocks) >= 3 and open_block
    for number in range(2 * len(blocks)):
        part, wanted = vehicle_demonstrations.within(500, number), blocks[number % len(blocks)]
        assert part.seeds.tolist() == vehicle_demonstrations.seeds[wanted].tolist()
        check(part)  # offsets, final observations and card fit
        start = vehicle_demonstrations.offsets[wanted[0]]
        np.testing.assert_array_equal(
            part.actions, vehicle_demonstrations.actions[start:][: len(part.actions)]
        )
    # What is smaller than one block is the only block.
    whole = vehicle_demonstrations.within(len(vehicle_demonstrations.actions) + 1, 7)
    assert whole.digest() == vehicle_demonstrations.digest()
    # An episode that has more alone is a block.
    assert [len(vehicle_demonstrations.within(1, k)) for k in range(40)] == [1] * 40
    assert len({int(vehicle_demonstrations.within(1, k).seeds[0]) for k in range(41)}) == 40


def _forge(folder, change):
    """Change arrays and card and make the digest fit, as somebody who means harm would."""
    arrays, card = archive.read(folder / DATA, "demonstrations")
    change(arrays, card)
    archive.write(folder / DATA, "demonstrations", arrays, card)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda a, c: a["actions"].__setitem__((0, 0), np.nan), "actions.*not finite.*row 0"),
        (lambda a, c: a["actions"].__setitem__((3, 1), 9.0), "actions leaves the bounds.*row 3"),
        (lambda a, c: a["costs"].__setitem__(5, 1.0), "not safe"),
        (lambda a, c: a["final.achieved_goal"].__setitem__(2, 0.5), "episode 2 does not end at its goal"),
        (lambda a, c: a["expert"].__setitem__(0, 3), "expert"),
        (lambda a, c: a["offsets"].__setitem__(-1, 7), "offsets"),
        (lambda a, c: a.update(rewards=a["rewards"][:-1].copy()), "rewards"),
        (lambda a, c: a.pop("observations.obstacle"), "observations.obstacle"),
        (lambda a, c: c.update(env="os:system"), "unknown environment"),
        (lambda a, c: c.update(env=["RISE-GroundVehicle-v0"]), "unknown environment"),
        (lambda a, c: c["params"].update(max_speed=99.0), "was recorded with params"),
        (lambda a, c: c.update(episodes=7), "was recorded with episodes 7, here there are 40"),
        (lambda a, c: c.update(transitions=None), "was recorded with transitions None"),
        (lambda a, c: c.update(env_kwargs={"render_mode": "human"}), "env_kwargs"),
        (lambda a, c: a.update(more=a["rewards"]), "unknown: more"),
        (lambda a, c: a.update(seeds=a["seeds"].astype(np.float64)), "seeds are float64"),
        (lambda a, c: a.update(seeds=a["seeds"][:0], offsets=a["offsets"][:1]), "number of episodes"),
    ],
)
def test_forged_sets_are_refused(stored, change, reason):
    _forge(stored, change)
    with pytest.raises(DatasetError, match=reason):
        load(stored)


def test_damaged_and_missing_sets_are_refused(stored, tmp_path):
    body = bytearray((stored / DATA).read_bytes())
    body[len(body) // 2] ^= 4
    (stored / DATA).write_bytes(body)
    with pytest.raises(DatasetError, match="damaged"):
        load(stored)
    with pytest.raises(DatasetError, match=r"nowhere.*does not exist"):
        load(tmp_path / "nowhere")


def test_the_card_for_people_is_not_believed(stored, vehicle_demonstrations):
    card = json.loads((stored / CARD).read_text())
    (stored / CARD).write_text(json.dumps({**card, "expert": "somebody else", "env": "RISE-SafePanda-v0"}))
    assert load(stored).card["expert"] == vehicle_demonstrations.card["expert"] == "cbf"


def test_minari_round_trip(vehicle_demonstrations, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    part = vehicle_demonstrations.first(6)
    minari_io.export(part, "rise/vehicle-v0")
    again = minari_io.load("rise/vehicle-v0", VEHICLE)
    for name, array in part.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)
    with pytest.raises(DatasetError, match="nothing/here-v0"):
        minari_io.load("nothing/here-v0", VEHICLE)
    with pytest.raises(DatasetError, match="observation"):
        minari_io.load("rise/vehicle-v0", "RISE-SafePanda-v0")
    for wrong in ("rise/vehicle-v0", "vehicle", "r/vehicle-v0"):
        with pytest.raises(ValueError, match=wrong):
            minari_io.export(part, wrong)
    assert list(tmp_path.iterdir()) == [tmp_path / "rise"]


@pytest.fixture
def exported(vehicle_demonstrations, tmp_path, monkeypatch):
    """The folder of a Minari dataset ``rise/vehicle-v0``."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    minari_io.export(vehicle_demonstrations.first(2), "rise/vehicle-v0")
    return tmp_path / "rise" / "vehicle-v0" / "data"


def test_a_minari_set_of_something_else_is_named(tmp_path, monkeypatch):
    import minari
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episode = EpisodeBuffer(
        **{"observations": np.zeros((3, 3), np.float32), "actions": np.zeros((2, 1), np.float32)},
        **{"rewards": [0.0, 0.0], "terminations": [False, True], "truncations": [False, False]},
    )
    about = dict.fromkeys(("algorithm_name", "author", "author_email", "code_permalink", "description"), "me")
    about |= dict.fromkeys(("env", "eval_env"), "Pendulum-v1")
    minari.create_dataset_from_buffers("lab/array-v0", [episode], **about)
    with pytest.raises(DatasetError, match=r"'lab/array-v0': observations have no .*: they must be dicts of"):
        minari_io.load("lab/array-v0", VEHICLE)
    with pytest.raises(ValueError, match="'CartPole-v1' describes no task"):
        minari_io.load("lab/array-v0", "CartPole-v1")


def test_a_set_has_episodes():
    for number in (0, -1, 2.0):
        with pytest.raises(ValueError, match="episodes must be a whole number ≥ 1"):
            generate(VEHICLE, "cbf", episodes=number)


@pytest.mark.parametrize(
    ("infos", "reason"),
    [
        # A collector around a noise wrapper records what was read, and the truth beside it.
        (("cost", "clean_observation"), "noise wrapper"),
        ((), "infos have no 'cost'"),
    ],
)
def test_a_minari_set_without_costs_or_of_noisy_readings_is_refused(
    vehicle_demonstrations, tmp_path, monkeypatch, infos, reason
):
    import minari
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    d = vehicle_demonstrations.first(1)
    clean = {key: np.concatenate((d.observations[key], d.final[key])) for key in d.observations}
    n, noisy = len(d.actions), {**clean, "obstacle": clean["obstacle"] + 0.1}
    episode = EpisodeBuffer(
        **{"observations": noisy, "actions": d.actions, "rewards": list(d.rewards)},
        **{"terminations": [False] * (n - 1) + [True], "truncations": [False] * n},
        infos={name: {"cost": np.zeros(n + 1), "clean_observation": clean}[name] for name in infos},
    )
    about = dict.fromkeys(("algorithm_name", "author", "author_email", "code_permalink", "description"), "me")
    about |= dict.fromkeys(("env", "eval_env"), VEHICLE)
    minari.create_dataset_from_buffers("lab/noisy-v0", [episode], **about)
    with pytest.raises(DatasetError, match=rf"'lab/noisy-v0': .*{reason}"):
        minari_io.load("lab/noisy-v0", VEHICLE)


def test_a_changed_number_in_a_minari_set_is_noticed(exported):
    h5py = pytest.importorskip("h5py")
    with h5py.File(exported / "main_data.hdf5", "r+") as file:
        file["episode_0/rewards"][3] += 1e-6
    with pytest.raises(DatasetError, match="SHA-256"):
        minari_io.load("rise/vehicle-v0", VEHICLE)


@pytest.mark.parametrize("without", [(), ("observation_space",), ("action_space", "observation_space")])
def test_an_environment_that_a_minari_set_names_is_never_built(exported, monkeypatch, without):
    """Minari itself builds it where the spaces are missing, and so runs what the file names."""
    (exported / "evil_module.py").write_text("open('run', 'w').close()\nclass Env: pass")
    monkeypatch.syspath_prepend(exported)
    monkeypatch.chdir(exported)
    metadata = json.loads((exported / "metadata.json").read_text())
    spec = json.loads(metadata["env_spec"])
    metadata["env_spec"] = json.dumps({**spec, "entry_point": "evil_module:Env"})
    for name in without:
        del metadata[name]
    (exported / "metadata.json").write_text(json.dumps(metadata))
    if without:
        with pytest.raises(DatasetError, match=f"no {without[-1]}"):
            minari_io.load("rise/vehicle-v0", VEHICLE)
    else:
        minari_io.load("rise/vehicle-v0", VEHICLE)
    assert not (exported / "run").exists()


def test_command_line(tmp_path, capsys):
    out = tmp_path / "set"
    arguments = ["--env", VEHICLE, "--expert", "cbf", "--episodes", "5", "--workers", "1", "--out", str(out)]
    assert main(arguments) == 0
    assert "5 episodes" in capsys.readouterr().out
    assert len(load(out)) == 5
    assert main(arguments) == 2
    assert "holds a demonstration set already" in capsys.readouterr().err
    assert main(["--env", "RISE-GroundVehicl-v0", "--out", str(out)]) == 2
    assert "did you mean 'RISE-GroundVehicle-v0'" in capsys.readouterr().err
    assert main(["--env", VEHICLE, "--seed", "-1", "--out", str(tmp_path / "b")]) == 2
    assert "seed must be in" in capsys.readouterr().err
    assert main(["--env", VEHICLE, "--minari", "no good id", "--out", str(tmp_path / "b")]) == 2
    assert not (tmp_path / "b").exists()


def test_an_interrupted_recording_goes_on(tmp_path):
    """What is recorded is not recorded again, and the set is the same as in one go."""
    whole = generate(VEHICLE, "cbf", 120)

    def interrupt(kept, tried):
        if kept >= 50:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(VEHICLE, "cbf", 120, finished=interrupt, parts=tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert before
    again = generate(VEHICLE, "cbf", 120, parts=tmp_path)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    for name, array in whole.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)


def test_a_recording_whose_worker_is_killed_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    out = tmp_path / "set"
    command = ["--env", VEHICLE, "--expert", "cbf", "--episodes", "60", "--workers", "2", "--out", str(out)]
    monkeypatch.setattr("rise_agents.demonstrations.recording._record", _record_or_die)
    assert main(command) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith(
        "recording from episode 50 on: its worker process ended with SIGKILL (out of memory? fewer workers need less);"
        " what is finished is kept, run the command again to go on\n"
    )
    (piece,) = out.glob(".parts/*/*")
    monkeypatch.undo()
    monkeypatch.setattr("rise_agents.demonstrations.recording.record_part", _only_the_second)
    assert main([*command, "--workers", "1"]) == 0
    assert len(load(out)) == 60 and not piece.exists()


def _record_or_die(tell, output, env, expert, seed, start, count):
    """The first piece is recorded; who has the second one waits for that, and is killed."""
    if start == 0:
        record_part(output, tell, env, expert, seed, start, count)
    while start and not part_path(output.parent, 0).exists():
        time.sleep(0.05)
    if start:
        os.kill(os.getpid(), signal.SIGKILL)


def _only_the_second(output, tell, env, expert, seed, start, count):
    assert start > 0
    record_part(output, tell, env, expert, seed, start, count)


def test_pieces_of_another_recording_are_refused(tmp_path):
    generate(VEHICLE, "cbf", 10, parts=tmp_path)
    with pytest.raises(DatasetError, match=r"0000000.rise.*'cbf'.*'mpc'.*remove"):
        generate(VEHICLE, "mpc", 10, parts=tmp_path)


def test_a_piece_that_somebody_takes_away_is_recorded_again(tmp_path):
    def take(kept, tried):
        (tmp_path / "0000050.rise").unlink(missing_ok=True)

    assert len(generate(VEHICLE, "cbf", 150, workers=2, finished=take, parts=tmp_path)) == 150


def test_forged_pieces_are_refused(tmp_path):
    generate(VEHICLE, "cbf", 10, parts=tmp_path)
    piece = tmp_path / "0000000.rise"
    arrays, facts = archive.read(piece, "candidates")
    for change in (
        {},
        {**arrays, "transitions.actions.": arrays["transitions.actions."] * np.nan},
        {**arrays, "transitions.costs.": arrays["transitions.costs."] + 1},
        {**arrays, "seeds": arrays["seeds"][:3]},
    ):
        archive.write(piece, "candidates", change, facts)
        with pytest.raises(DatasetError):
            generate(VEHICLE, "cbf", 10, parts=tmp_path)
    archive.write(piece, "candidates", arrays, {**facts, "versions": {"numpy": "0.1"}})
    with pytest.raises(DatasetError, match=r"is of another recording, with \{'versions'"):
        generate(VEHICLE, "cbf", 10, parts=tmp_path)


def test_another_recording_in_the_same_folder_begins_anew(tmp_path, capsys, monkeypatch):
    """What was recorded of the first one is left alone until one of them is finished."""
    out, base = tmp_path / "set", ["--env", VEHICLE, "--episodes", "12", "--workers", "1"]
    monkeypatch.setattr("rise_agents.demonstrations.Demonstrations.save", _interrupt)
    assert main([*base, "--expert", "mpc", "--out", str(out)]) == 130
    monkeypatch.undo()
    assert main([*base, "--expert", "cbf", "--out", str(out)]) == 0
    assert load(out).card["expert"] == "cbf"
    assert not (out / ".parts").exists()


def test_a_set_that_is_there_can_still_be_exported(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    out = ["--env", VEHICLE, "--expert", "cbf", "--workers", "1", "--out", str(tmp_path / "set")]
    assert main([*out, "--episodes", "3"]) == 0
    before = (tmp_path / "set" / DATA).stat().st_mtime_ns
    assert main([*out, "--episodes", "3", "--minari", "rise/vehicle-v0"]) == 0
    assert (tmp_path / "set" / DATA).stat().st_mtime_ns == before
    assert len(minari_io.load("rise/vehicle-v0", VEHICLE)) == 3
    assert main([*out, "--episodes", "4", "--minari", "rise/vehicle-v1"]) == 1
    assert "holds a set of --episodes 3" in capsys.readouterr().err


def _interrupt(*_):
    raise KeyboardInterrupt
