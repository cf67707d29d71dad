"""Any recorded episode can be run again, comes out as it is stored, and can be drawn."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from benchmarks import results
from benchmarks.policies import Random
from benchmarks.publish import publish
from benchmarks.recorded import Run, differences, open_run, recreated
from benchmarks.replay import main, parser, told
from benchmarks.run import main as run_benchmark
from benchmarks.trajectories import OUTCOMES, trace
from benchmarks.videos import Clip, strip
from rise_agents import pretrained

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
ROWS = [
    "rise",
    "pcbc",
    "cppo",
    "rise-belief",
    "rise-mean",
    "pcbc+kalman",
    "expert-cbf",
    "expert-cbf+true",
    "random",
]
BRIEF = ["--preset", "smoke", "--expert", "cbf", "--noise-levels", "0", "1", "--no-videos", "--workers", "1"]


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory):
    out = tmp_path_factory.mktemp("vehicle")
    work = [*BRIEF, "--envs", VEHICLE, "--demos", "8", "--episodes", "6", "--out", str(out)]
    assert run_benchmark(["--agents", *ROWS, *work]) == 0
    return out


@pytest.fixture(scope="module")
def panda(tmp_path_factory):
    """More episodes than run side by side, so that some begin while others are on their way."""
    out = tmp_path_factory.mktemp("panda")
    work = [*BRIEF, "--envs", PANDA, "--demos", "4", "--episodes", "6", "--out", str(out)]
    assert run_benchmark(["--agents", "rise", "pcbc", "expert-cbf", *work]) == 0
    return out


@pytest.mark.parametrize("agent", ROWS)
def test_every_episode_of_every_kind_of_row_comes_out_as_stored(vehicle, agent):
    run, count = open_run(vehicle), 0
    for row in run.select(agent=agent):
        outcomes = run.recreate(row).outcomes
        assert outcomes == {name: row[name] for name in OUTCOMES}
        count += 1
    assert count == 12


@pytest.mark.parametrize("agent", ["rise", "pcbc", "expert-cbf"])
def test_the_arm_s_episodes_come_out_as_stored(panda, agent):
    run = open_run(panda)
    for scenario in (0, 5):
        row = run.find(agent=agent, noise_level=1.0, scenario=scenario)
        assert run.recreate(row).outcomes == {name: row[name] for name in OUTCOMES}


@pytest.mark.parametrize(
    "column", ["steps", "min_clearance", "episode_return", "episode_cost", "safe", "arrived"]
)
def test_another_outcome_is_noticed(column):
    policy, seed = Random(VEHICLE), 2**31
    outcomes = trace(policy, VEHICLE, seed, "step", 1.0).outcomes
    row = {"env": VEHICLE, "agent": "random", "train_seed": 0, "noise_model": "step", "noise_level": 1.0}
    row |= {"scenario": 0, "env_seed": seed, **outcomes}
    assert recreated(policy, row, 2).outcomes == outcomes
    value = outcomes[column]
    row[column] = not value if isinstance(value, bool) else value + 1e-9 + (column == "steps")
    with pytest.raises(
        ValueError, match=f"scenario 0 of random .* comes out differently: {column} .*, stored"
    ):
        recreated(policy, row, 2, versions="numpy 1, now 2")


def test_rounded_rows_are_met_to_their_last_digit():
    found = trace(Random(VEHICLE), VEHICLE, 2**31 + 1)
    near = {
        name: round(value * 2**13) / 2**13 if isinstance(value, float) else value
        for name, value in found.outcomes.items()
    }
    if found.outcomes["min_clearance"] < 0:
        near["min_clearance"] = min(near["min_clearance"], -(2.0**-13))
    assert differences(found, near, rounded=True) == []
    assert differences(found, near) != []
    assert differences(found, near | {"min_clearance": near["min_clearance"] + 2.0**-13}, rounded=True) != []


def test_the_command_says_what_happened_and_draws_it(vehicle, tmp_path, capsys):
    film, frames = tmp_path / "clip.mp4", tmp_path / "frames.png"
    arguments = ["--agent", "expert-cbf", "--scenario", "2", "--out", str(film), str(frames)]
    assert main([str(vehicle), *arguments]) == 0
    said = capsys.readouterr().out
    run = open_run(vehicle)
    row = run.find(agent="expert-cbf", noise_level=1.0, scenario=2)
    assert "Expert (cbf) on Ground vehicle, scenario 2, noise level 1 (fresh noise at every step)" in said
    assert f"{row['steps']} ({row['steps'] / 10:.2f} s)" in said and f"{row['min_clearance']:.4f} m" in said
    assert "equal, to the last digit" in said
    picture = np.asarray(Image.open(frames))
    assert picture.shape[1] > 3 * picture.shape[0]  # four key frames side by side
    about = iio.immeta(film, plugin="FFMPEG")
    assert about["fps"] == 10  # real time
    assert about["duration"] == pytest.approx((row["steps"] + 12) / 10, abs=0.25)


def test_the_arm_is_drawn_in_real_time(panda, tmp_path):
    film = tmp_path / "arm.mp4"
    assert main([str(panda), "--agent", "expert-cbf", "--scenario", "0", "--out", str(film)]) == 0
    assert iio.immeta(film, plugin="FFMPEG")["fps"] == 25


def test_key_frames_show_the_closest_moment():
    frames = [np.full((32, 32, 3), 10 * i, np.uint8) for i in range(20)]
    cells = np.split(strip(Clip(frames, [0.1 * i for i in range(20)], "reached", 8, 0.2)), 4, axis=1)
    assert [int(cell[-1, 8, 0]) for cell in cells] == [0, 80, 130, 190]


def test_episodes_are_listed_by_their_clearance(vehicle, capsys):
    assert main([str(vehicle), "--list", "--agent", "random", "--noise-level", "1", "--limit", "3"]) == 0
    said = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in said if line.strip().startswith("RISE-")]
    stored = sorted(
        open_run(vehicle).select(agent="random", noise_level=1.0), key=lambda row: row["min_clearance"]
    )
    assert [row[5] for row in rows] == [str(row["scenario"]) for row in stored[:3]]
    assert said[-1] == "3 of 6 episodes"
    assert main([str(vehicle), "--list", "--unsafe", "--limit", "1000"]) == 0
    unsafe = [row for row in open_run(vehicle).select() if not row["safe"]]
    said = capsys.readouterr().out
    assert said.count("collision,") == len(unsafe) and said.splitlines()[-1].startswith(f"{len(unsafe)} of ")


def test_what_is_published_says_what_is_missing(vehicle, tmp_path, capsys):
    publish(vehicle, tmp_path)
    assert main([str(tmp_path), "--agent", "random", "--scenario", "1"]) == 0
    assert "what is stored is rounded" in capsys.readouterr().out
    assert main([str(tmp_path), "--agent", "pcbc", "--scenario", "1"]) == 2
    error = capsys.readouterr().err
    assert "is missing" in error and "only in the run folder" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "--agent is missing"),
        (["--agent", "rise"], "--scenario is missing"),
        (["--agent", "ris", "--scenario", "0"], "did you mean 'rise'"),
        (["--agent", "rise", "--scenario", "99"], "no episode with scenario 99: there are 0, 1, 2, 3, 4, 5"),
        (["--agent", "rise", "--scenario", "0", "--seed", "3"], "training seed 3: there are 0"),
        (["--agent", "rise", "--scenario", "0", "--noise-level", "7"], "noise level 7.0: there are 0, 1"),
        (["--agent", "rise", "--scenario", "0", "--noise-model", "drift"], "noise model drift"),
        (["--env", "Nowhere-v0", "--agent", "rise", "--scenario", "0"], "no episode with env Nowhere-v0"),
        (["--agent", "rise", "--scenario", "0", "--out", "a.gif"], "must end in .mp4 or .png"),
        (["--list", "--out", "a.png"], "--out draws one episode: leave out --list"),
        (["--unsafe"], "--unsafe chooses among the episodes of a --list"),
        (["--list", "--limit", "0"], "--limit must be at least 1"),
        (["--lst"], "did you mean '--list'"),
    ],
)
def test_bad_arguments_end_in_one_line(vehicle, arguments, words, capsys):
    assert main([str(vehicle), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("benchmarks.replay: ") and words in error and error.count("\n") == 1


def test_a_folder_that_is_no_run(tmp_path, capsys):
    assert main([str(tmp_path / "nowhere"), "--list"]) == 2
    assert "is not a folder" in capsys.readouterr().err
    assert main([str(tmp_path), "--list"]) == 2
    assert "run.json is missing" in capsys.readouterr().err


def test_an_environment_that_draws_no_pictures_says_so():
    from benchmarks.replay import draw

    kinematic = "RISE-SafePandaKinematic-v0"
    found = trace(Random(kinematic), kinematic, 2**31)
    row = {"env": kinematic, "agent": "random", "scenario": 0, "env_seed": 2**31, "noise_model": "step"}
    with pytest.raises(ValueError, match="draws no pictures"):
        draw(row | {"noise_level": 0.0}, found, [])


def test_an_environment_of_one_s_own_is_replayed_once_it_is_imported(own_names, tmp_path):
    """One that describes no task, either."""
    example = Path(__file__).parents[1] / "docs" / "examples" / "calm_pendulum.py"
    row = {"env": "CalmPendulum-v0", "agent": "random", "train_seed": 0, "noise_model": "step"}
    row |= {"noise_level": 0.0, "scenario": 0, "env_seed": 2**31, "safe": True, "arrived": False}
    run = Run(tmp_path, {}, None, 1, ("step",))
    with pytest.raises(ValueError, match="no environment 'CalmPendulum-v0' is registered: --import"):
        run.policy(row)
    parser().parse_args([str(tmp_path), "--list", "--import", str(example)])
    found = trace(run.policy(row), row["env"], row["env_seed"])
    row |= found.outcomes
    assert recreated(run.policy(row), row, 1).outcomes == found.outcomes
    assert f"{len(found.action)} ({len(found.action) / 30:.2f} s)" in told(
        row, found, False
    )  # 30 pictures a second


def test_weights_of_the_package_must_be_those_that_were_evaluated(vehicle, tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    run, entry = open_run(vehicle), "rise.rise of rise_agents.pretrained, SHA-256 "
    with pytest.raises(ValueError, match="is missing: this package lacks the weights"):
        run._weights(entry + "0" * 64)
    (tmp_path / "rise.rise").write_bytes(b"weights")
    assert run._weights(entry + hashlib.sha256(b"weights").hexdigest()) == tmp_path / "rise.rise"
    with pytest.raises(ValueError, match="other weights than those that the run evaluated"):
        run._weights(entry + "0" * 64)


def test_a_damaged_record_ends_in_one_line(vehicle, tmp_path, capsys):
    shutil.copy(vehicle / "episodes.parquet", tmp_path)
    record = json.loads((vehicle / "run.json").read_text())
    for plan in ({"agents": [], "noise_models": ["step"]}, {**record["plan"], "episodes": "many"}):
        (tmp_path / "run.json").write_text(json.dumps(record | {"plan": plan}))
        assert main([str(tmp_path), "--list"]) == 2
        assert "run.json is not the record of a run" in capsys.readouterr().err
    (tmp_path / "run.json").write_text(json.dumps(record | {"settings": {}}))
    assert main([str(tmp_path), "--agent", "rise", "--scenario", "0"]) == 2
    assert "does not say how rise acted" in capsys.readouterr().err


def test_rows_of_results_are_columns():
    assert set(OUTCOMES) < set(results.SCHEMA.names)


def test_the_command_explains_itself():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.replay", "--help"], capture_output=True, text=True
    )
    assert done.returncode == 0 and "--unsafe" in done.stdout and "examples:" in done.stdout
