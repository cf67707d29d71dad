"""The benchmark command: outputs, resuming, independence of workers, errors people meet."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest

from benchmarks import report, results
from benchmarks.executors import run_jobs
from benchmarks.jobs import Job, demonstrations_folder
from benchmarks.pipeline import How, execute
from benchmarks.presets import PRESETS, Block
from benchmarks.protocol import make_plan
from benchmarks.run import main, parser, plan_of, time_limit
from benchmarks.tables import ComparisonRow, read_table
from rise_agents import agent_class
from rise_agents.files import sole_user
from rise_agents.seeds import SPLITS
from rise_envs import ENVS, STAND_INS

VEHICLE = "RISE-GroundVehicle-v0"
SMALL = ["--agents", "rise", "pcbc", "random", "--envs", VEHICLE, "--preset", "smoke", "--expert", "cbf"]
SMALL += ["--episodes", "6", "--noise-levels", "0", "1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    assert main([*SMALL, "--workers", "1", "--out", str(out)]) == 0
    return out


def test_stand_ins_are_evaluated_only_when_asked_for(monkeypatch):
    monkeypatch.setitem(STAND_INS, "RISE-Standin-v0", VEHICLE)
    monkeypatch.setitem(ENVS, "RISE-Standin-v0", ENVS[VEHICLE])
    monkeypatch.setitem(gym.registry, "RISE-Standin-v0", gym.spec(VEHICLE))
    assert plan_of(parser().parse_args([])).envs == (VEHICLE, "RISE-SafePanda-v0")
    plan = plan_of(parser().parse_args(["--envs", "RISE-Standin-v0", "--agents", "expert"]))
    assert plan.rows("RISE-Standin-v0") == [("expert-cbf", 0), ("expert-mpc", 0), ("expert-mixture", 0)]


def test_every_promised_file_is_there(run):
    names = {path.name for path in run.iterdir()}
    assert names >= {
        "episodes.parquet",
        "summary.csv",
        "comparisons.csv",
        "summary.md",
        "comparison.png",
        "report.html",
        "noise_curve.png",
        "run.json",
    }
    assert len(list((run / "videos").glob("*.mp4"))) == 3
    assert len(list((run / "videos").glob("*-frames.png"))) == 3
    traces = [str(path.relative_to(run)) for path in (run / "trajectories").iterdir()]
    assert sorted(json.loads((run / "run.json").read_text())["trajectories"]) == sorted(traces)
    assert len(traces) == 3 * 2  # rows, levels
    assert 'id="player"' in (run / "report.html").read_text()
    assert not list(run.rglob(".partial-*"))


def test_rows_are_paired_test_scenarios(run):
    rows = results.read_rows(run / "episodes.parquet").to_pylist()
    assert len(rows) == 3 * 2 * 6
    assert all(row["env_seed"] >= SPLITS["test"] for row in rows)
    for agent in ("rise", "pcbc", "random"):
        own = [row["env_seed"] for row in rows if row["agent"] == agent and row["noise_level"] == 1]
        assert own == [SPLITS["test"] + n for n in range(6)]


def test_summary_has_the_promised_columns(run):
    with (run / "summary.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert list(lines[0]) == [
        *("env", "agent", "noise_model", "noise_level", "train_seeds", "episodes"),
        *("safety_rate", "safety_low", "safety_high", "reach_rate", "reach_low", "reach_high"),
        *("arrival_rate", "mean_cost", "mean_steps", "safety_iqm", "reach_iqm", "clearance_iqm", "against"),
        *("safety_diff", "safety_diff_low", "safety_diff_high", "safety_diff_p"),
        *("reach_diff", "reach_diff_low", "reach_diff_high", "reach_diff_p"),
    ]
    assert [line["against"] for line in lines] == ["", "", "rise", "rise", "rise", "rise"]
    assert len(lines) == 6
    for line in lines:
        assert 0 <= float(line["safety_low"]) <= float(line["safety_rate"]) <= float(line["safety_high"]) <= 1
        assert (
            float(line["reach_rate"]) <= min(float(line["arrival_rate"]), float(line["safety_rate"])) + 1e-9
        )


def test_every_pair_is_compared_but_references(run):
    rows = read_table(run / "comparisons.csv", ComparisonRow)
    pairs = [("rise", "pcbc"), ("rise", "random"), ("pcbc", "random")]
    assert [(row.agent, row.other) for row in rows] == pairs * 2
    assert {(row.seeds, row.scenarios) for row in rows} == {(1, 6)}


def test_tables_and_figures_come_from_the_episodes_alone(run, tmp_path):
    for name in ("episodes.parquet", "run.json"):
        shutil.copy(run / name, tmp_path)
    assert report.main([str(tmp_path)]) == 0
    for name in ("summary.csv", "comparisons.csv", "summary.md", "comparison.png", "noise_curve.png"):
        assert (tmp_path / name).read_bytes() == (run / name).read_bytes()


def test_run_json_tells_how_to_repeat(run):
    record = json.loads((run / "run.json").read_text())
    assert record["plan"]["noise_levels"] == [0.0, 1.0]
    assert record["demonstrations"][VEHICLE]["expert"] == "cbf"
    assert record["settings"][f"rise@{VEHICLE}"]["updates"] == agent_class("rise").BRIEF["updates"]
    assert "--noise-levels 0 1" in record["command"]
    assert record["rows"] == ["rise", "pcbc", "random"] and set(record["training"]) == {"rise", "pcbc"}


# imageio-ffmpeg leaves its pipes to the garbage collector after reading.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_clips_are_videos_that_move(run):
    for path in (run / "videos").glob("*.mp4"):
        with iio.imopen(path, "r", plugin="FFMPEG") as file:
            frames = file.read()
        assert len(frames) > 20
        assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).max() > 50


def test_again_in_the_same_folder_redoes_nothing(run, capfd):
    tables = {name: (run / name).read_bytes() for name in ("episodes.parquet", "summary.csv", "summary.md")}
    work = [
        path
        for folder in ("agents", "parts", "videos", "trajectories")
        for path in (run / folder).rglob("*.*")
    ]
    before = {path: path.stat().st_mtime_ns for path in work}
    assert main([*SMALL, "--workers", "1", "--out", str(run)]) == 0
    assert {path: path.stat().st_mtime_ns for path in work} == before
    assert {name: (run / name).read_bytes() for name in tables if name != "summary.md"} == {
        name: content for name, content in tables.items() if name != "summary.md"
    }
    assert "done already" in capfd.readouterr().err


MIXED = ["--agents", "pcbc", "quiet", "pcbc-noisy", "expert+true", "--filter", "kalman", "--preset", "smoke"]
MIXED += ["--envs", VEHICLE, "--expert", "cbf", "--episodes", "4", "--noise-model", "step", "episode"]
MIXED += ["--noise-levels", "0", "1", "--workers", "1", "--no-videos"]


def test_rows_of_all_kinds_under_several_noise_models(tmp_path):
    config, out = tmp_path / "mine.toml", tmp_path / "out"
    config.write_text('[variants.quiet]\nagent = "pcbc"\nlabel = "PC-BC, quietly"\nframe = "body"\n')
    assert main([*MIXED, "--config", str(config), "--out", str(out)]) == 0
    rows = results.read_rows(out / "episodes.parquet").to_pylist()
    met = {}
    for row in rows:
        met.setdefault(row["agent"], []).append((row["noise_model"], row["noise_level"]))
    names = ["pcbc", "quiet", "pcbc-noisy"]
    names += [f"{name}+kalman" for name in names]
    assert set(met) == {*names, *(f"expert-{each}+true" for each in ("cbf", "mpc", "mixture"))}
    for conditions in met.values():
        assert sorted(conditions) == 4 * [("episode", 1.0)] + 4 * [("step", 0.0)] + 4 * [("step", 1.0)]

    def outcome(agent, level):
        return [row["episode_return"] for row in rows if (row["agent"], row["noise_level"]) == (agent, level)]

    assert outcome("quiet", 1) == outcome("pcbc", 1)  # body is the default: one training, one behaviour
    assert outcome("pcbc+kalman", 0) == outcome("pcbc", 0) != outcome("pcbc-noisy", 0)
    assert outcome("pcbc+kalman", 1) != outcome("pcbc", 1)
    assert len(list((out / "agents" / VEHICLE).glob("*.rise"))) == 2
    page = (out / "summary.md").read_text()
    for words in (
        "PC-BC, quietly behind a Kalman filter",
        "comparison-episode.png",
        "noise_curve-episode.png",
    ):
        assert words in page
    assert (out / "noise_curve-episode.png").exists() and (out / "comparison.png").exists()
    record = json.loads((out / "run.json").read_text())
    assert record["plan"]["variants"]["quiet"]["label"] == "PC-BC, quietly"
    assert record["plan"]["noise_models"] == ["step", "episode"]
    paths = record["agents"][VEHICLE]
    assert paths["quiet+kalman-seed0"] == paths["pcbc-seed0"] != paths["pcbc-noisy-seed0"]


def test_blocks_of_a_preset_are_measured_and_told_apart(tmp_path, monkeypatch):
    block = Block("Is it the noise?", ("pcbc", "pcbc-noisy", "random"), ("drift:0.3",), (0.0, 1.0), 2)
    preset = replace(PRESETS["smoke"], agents=("pcbc",), noise_levels=(0.0, 1.0), blocks=(block,), episodes=4)
    monkeypatch.setitem(PRESETS, "smoke", preset)
    arguments = ["--preset", "smoke", "--envs", VEHICLE, "--expert", "cbf", "--workers", "1", "--no-videos"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    rows = results.read_rows(tmp_path / "episodes.parquet").to_pylist()
    met = Counter((row["agent"], row["train_seed"], row["noise_model"], row["noise_level"]) for row in rows)
    drift = [("step", 0.0), ("drift:0.3", 1.0)]
    expected = [("pcbc", 0, *condition) for condition in [*drift, ("step", 1.0)]]
    expected += [("pcbc", 1, *c) for c in drift] + [("pcbc-noisy", s, *c) for s in (0, 1) for c in drift]
    assert met == Counter(dict.fromkeys(expected + [("random", 0, *c) for c in drift], 4))
    pairs = {(row.agent, row.other) for row in read_table(tmp_path / "comparisons.csv", ComparisonRow)}
    assert pairs == {("pcbc", "pcbc-noisy"), ("pcbc", "random"), ("pcbc-noisy", "random")}
    page = (tmp_path / "summary.md").read_text()
    findings, _, tables = page.partition("## Tables")
    own, _, block_tables = tables.partition("## Is it the noise?")
    assert "PC-BC, noisy training" not in findings + own and "PC-BC, noisy training" in block_tables
    assert "others-ground-vehicle.png" in findings and (tmp_path / "others-ground-vehicle.png").exists()
    for name in ("episodes.parquet", "run.json"):
        shutil.copy(tmp_path / name, tmp_path / "agents")
    assert report.main([str(tmp_path / "agents")]) == 0  # from what is recorded alone
    for name in ("summary.csv", "comparisons.csv", "summary.md", "others-ground-vehicle.png"):
        assert (tmp_path / "agents" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_workers_do_not_change_the_tables(run, tmp_path):
    assert main([*SMALL, "--workers", "2", "--no-videos", "--out", str(tmp_path)]) == 0
    for name in ("episodes.parquet", "summary.csv", "comparisons.csv"):
        assert (tmp_path / name).read_bytes() == (run / name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--agents", "rize"], "did you mean 'rise'"),
        (["--envs", "RISE-SafePnda-v0"], "did you mean 'RISE-SafePanda-v0'"),
        (["--preset", "quik"], "did you mean 'quick'"),
        (["--expert", "mixtur"], "did you mean 'mixture'"),
        (["--noise-model", "stepp"], "did you mean 'step'"),
        (["--noise-model", "step", "episod"], "did you mean 'episode'"),
        (["--noise-model", "step@positon"], "did you mean 'position'"),
        (["--noise-model", "step@"], "after '@' stands one group"),
        (["--agents", "rise-meen"], "did you mean 'rise-mean'"),
        (["--agents", "pcbc+kalmann"], "did you mean 'kalman'"),
        (["--filter", "kalmann"], "did you mean 'kalman'"),
        (["--config", "no.toml"], "cannot read the config file 'no.toml'"),
        (["--agents", "rise-mean", "--set", "rise-mean.posterior=mode"], "settings of rise-mean: posterior"),
        (["--set", "rise-meen.beta=1"], "did you mean 'rise-mean'"),
        (["--noise-levels", "-1"], "not negative"),
        (["--noise-levels", "nan"], "finite"),
        (["--noise-levels", "lots"], "invalid float"),
        (["--episodes", "0"], "episodes must be"),
        (["--demos", "0"], "demos must be"),
        (["--seeds", "0"], "seeds must be"),
        (["--workers", "0"], "--workers must be"),
        (["--hours", "0"], "--hours must be a number above 0"),
        (["--hours", "nan"], "--hours must be a number above 0"),
        (["--set", "rise.betta=1"], "did you mean 'beta'"),
        (["--set", "rise.beta=-1"], "beta must not be negative"),
        (["--set", "rise.beta=large"], "beta"),
        (["--set", "beta"], "AGENT.FIELD=VALUE"),
        (["--set", "risee.beta=1"], "did you mean 'rise'"),
        (["--noise-level", "1"], "did you mean '--noise-levels'"),
        (["--out", "/proc/nowhere"], "cannot write"),
        (["--device", "cuda:77"], "device"),
        (["--device", "gpu"], "known: cpu, cuda"),
        (["--device", "cpu:-1"], "known: cpu, cuda"),
    ],
)
def test_bad_arguments_end_in_one_line_and_exit_code_2(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not list(tmp_path.rglob("*"))


@pytest.mark.parametrize("arguments", [["--set", "cppo.gama=1"], ["--device", "gpu"]])
def test_bad_arguments_are_told_before_torch_is_imported(arguments):
    code = (
        "import sys; from benchmarks.run import main; code = main(sys.argv[1:]); import benchmarks.pipeline; "
        "print(code, *{'torch', 'stable_baselines3'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert done.stdout == "2\n"


def test_a_plan_adds_the_user_s_choices_to_the_preset():
    plan = make_plan(
        "smoke",
        {"rise": {"beta": 0.2}},
        agents=("rise", "expert"),
        envs=(VEHICLE,),
        noise_models=("step",),
        episodes=5,
    )
    assert plan.episodes == 5
    assert plan.demos == PRESETS["smoke"].demos
    assert plan.config("rise", VEHICLE)["beta"] == 0.2
    assert plan.config("rise", VEHICLE)["updates"] == agent_class("rise").BRIEF["updates"]
    assert [row for row, _ in plan.rows(VEHICLE)] == ["rise", "expert-cbf", "expert-mpc", "expert-mixture"]


def _write(output, progress, text):
    output.write_text(text)


def _break(output, progress):
    raise ValueError("on purpose")


def test_a_failing_job_is_named_and_stops_only_what_needs_it(tmp_path):
    bad, good, after = (tmp_path / name for name in ("bad", "good", "after"))
    jobs = [
        Job("after", _write, {"text": "3"}, after, needs=(bad,)),
        Job("bad", _break, {}, bad),
        Job("good", _write, {"text": "2"}, good),
    ]
    failures = run_jobs(jobs, 2, lambda job, share, figures: None)
    assert {failure.job.name: failure.reason for failure in failures} == {
        "bad": "ValueError: on purpose",
        "after": "a job that it needs failed",
    }
    assert good.read_text() == "2"


def test_a_second_run_in_the_same_folder_is_refused(tmp_path, capsys):
    with sole_user(tmp_path):
        assert main([*SMALL, "--out", str(tmp_path)]) == 1
    assert "in use by another process" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} <= {".lock"}


def test_what_a_killed_run_left_is_swept_and_what_it_finished_is_kept(run, tmp_path):
    """Half of the outputs are there already, and strays in every folder: only the rest is done, to the same tables."""
    shutil.copytree(run, tmp_path / "run")
    out = tmp_path / "run"
    kept = sorted(path for path in (out / "parts").rglob("*.parquet"))
    for path in kept[::2]:
        path.unlink()
    for folder in (out, out / "parts" / VEHICLE, out / "agents" / VEHICLE):
        (folder / ".partial-0123456789abcdef-01234567.parquet").write_bytes(b"half")
    before = {path: path.stat().st_mtime_ns for path in [*kept[1::2], *(out / "agents").rglob("*.rise")]}
    assert main([*SMALL, "--workers", "1", "--no-videos", "--out", str(out)]) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert not list(out.rglob(".partial-*"))
    for name in ("episodes.parquet", "summary.csv", "comparisons.csv"):
        assert (out / name).read_bytes() == (run / name).read_bytes()


def test_failures_end_in_exit_code_1_and_are_recorded(tmp_path, capsys, monkeypatch):
    """A damaged set of demonstrations fails what needs it, in one line each; the rest is done."""
    arguments = [
        *SMALL,
        "--agents",
        "pcbc",
        "random",
        "--no-videos",
        "--workers",
        "1",
        "--out",
        str(tmp_path),
    ]
    folder = demonstrations_folder(plan_of(parser().parse_args(arguments)), VEHICLE, tmp_path)
    folder.mkdir(parents=True)
    (folder / "demonstrations.rise").write_bytes(b"RISEfile and nothing else")
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert "damaged" in error and "Traceback" not in error
    failed = json.loads((tmp_path / "run.json").read_text())["failed"]
    assert f"train pcbc on {VEHICLE}" in [each["job"] for each in failed]
    assert all(not (tmp_path / each["output"]).exists() or "damaged" in each["reason"] for each in failed)
    assert "DatasetError" in (tmp_path / "failures.log").read_text()
    agents = {row["agent"] for row in results.read_rows(tmp_path / "episodes.parquet").to_pylist()}
    assert agents == {"random"}


# --- a time limit ----------------------------------------------------------------------------------------------


def test_a_time_limit_counts_from_the_start():
    now = [100.0]
    time_is_up = time_limit(0.5, 100.0, lambda: now[0])
    assert not time_is_up()
    now[0] += 1799
    assert not time_is_up()
    now[0] += 1
    assert time_is_up()


def _wait(output, progress, pid):
    pid.write_text(str(os.getpid()))
    time.sleep(60)


def test_when_time_is_up_what_runs_is_interrupted_and_nothing_more_starts(tmp_path):
    first, pid, later = tmp_path / "first", tmp_path / "pid", tmp_path / "later"
    jobs = [
        Job("first", _write, {"text": "1"}, first, weight=9),
        Job("long", _wait, {"pid": pid}, tmp_path / "long", weight=5),
        Job("later", _write, {"text": "3"}, later),
    ]
    up = lambda: pid.exists() and bool(pid.read_text())  # noqa: E731
    assert run_jobs(jobs, 1, lambda job, share, figures: None, time_is_up=up) == []
    assert first.exists() and not later.exists() and not (tmp_path / "long").exists()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


def test_with_no_time_nothing_is_started_but_what_there_is_is_shown(run, tmp_path, capsys):
    """Two of six evaluations, a clip and a checkpoint are missing; then the same command without a limit."""
    shutil.copytree(run, tmp_path / "run")
    out, command = tmp_path / "run", [*SMALL, "--workers", "1", "--out", str(tmp_path / "run")]
    parts = [*(out / "parts").rglob("pcbc-*.parquet")]
    lost = [*parts, *(out / "agents").rglob("pcbc-*.rise"), *(out / "videos").glob("*-pcbc-*.mp4")]
    for path in lost:
        path.unlink()
    assert (len(parts), len(lost)) == (2, 4)
    assert main([*command, "--hours", "1e-9"]) == 1
    printed = capsys.readouterr()
    told = "stopped by --hours after 1e-09 h; 4 jobs are left: give the same command again to go on"
    assert f"benchmarks.run: {told}\n" in printed.err and "Stopped after" in printed.out
    assert json.loads((out / "run.json").read_text())["unfinished"] == 4
    assert {row["agent"] for row in results.read_rows(out / "episodes.parquet").to_pylist()} == {
        "rise",
        "random",
    }
    assert not any(path.exists() for path in lost) and not (out / "failures.log").exists()
    assert main(command) == 0
    assert json.loads((out / "run.json").read_text())["unfinished"] == 0
    for name in ("episodes.parquet", "summary.csv", "comparisons.csv"):
        assert (out / name).read_bytes() == (run / name).read_bytes()


def test_a_training_keeps_its_state_when_time_is_up(tmp_path):
    """The clock stops the run as soon as the training has stored it."""
    arguments = [*SMALL, "--agents", "pcbc", "--demos", "4", "--set", "pcbc.updates=100000"]
    plan = plan_of(parser().parse_args(arguments))
    state = lambda: list(tmp_path.glob("agents/*/*.training"))  # noqa: E731
    outcome = execute(plan, tmp_path, How(1, videos=False, every=0.0, time_is_up=lambda: bool(state())))
    assert outcome.stopped and outcome.failures == []
    # The training and two evaluations; the demonstrations are there, their pieces gone.
    assert sorted(job.name.split()[0] for job in outcome.left) == ["evaluate", "evaluate", "train"]
    assert json.loads((tmp_path / "run.json").read_text())["unfinished"] == 3
    assert state() and not (tmp_path / "episodes.parquet").exists()
    # Nor would there be those of an earlier plan, of which run.json no longer speaks.
    (tmp_path / "episodes.parquet").write_bytes(b"")
    execute(plan, tmp_path, How(1, videos=False, time_is_up=lambda: True))
    assert not (tmp_path / "episodes.parquet").exists()
