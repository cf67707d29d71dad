"""Event files of trainings, read back with TensorBoard's own reader."""

from __future__ import annotations

import json
import warnings
from types import SimpleNamespace

import pytest

from benchmarks import run as benchmark
from benchmarks.jobs import Job, evaluate, train, with_events
from benchmarks.tune import search
from rise_agents import figures
from rise_agents.agent import silent
from rise_agents.resume import Resume

VEHICLE = "RISE-GroundVehicle-v0"


def read(folder):
    """Per tag, (step, value) of everything in a folder."""
    pytest.importorskip("tensorboard")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of TensorBoard's own making
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
        events.Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


@pytest.fixture
def tensorboard():
    pytest.importorskip("tensorboard")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def test_what_is_told_is_written(tmp_path, tensorboard):
    told = []
    with figures.written(tmp_path / "a", Resume(), lambda *what: told.append(what)) as tell:
        tell(0.25, {"loss": 2.0, "kl": 0.5})
        tell(1.0, {"loss": 1.0, "kl": 0.25})
    assert told == [(0.25, {"loss": 2.0, "kl": 0.5}), (1.0, {"loss": 1.0, "kl": 0.25})]
    assert read(tmp_path / "a") == {
        "training/loss": [(250, 2.0), (1000, 1.0)],
        "training/kl": [(250, 0.5), (1000, 0.25)],
    }


def test_steps_that_an_agent_counts_are_the_axis(tmp_path, tensorboard):
    with figures.written(tmp_path / "a", Resume(), silent) as tell:
        tell(0.5, {"steps": 4096, "return": 3.0})
    assert read(tmp_path / "a") == {"training/return": [(4096, 3.0)]}


def test_what_an_interruption_lost_is_there_once(tmp_path, tensorboard):
    """The first attempt got to 0.75, but had stored its state at 0.5 only; so had its curve."""
    first = Resume()
    with figures.written(tmp_path / "a", first, silent) as tell:
        tell = first.noting(tell)
        for share in (0.25, 0.5, 0.75):
            tell(share, {"loss": share})
    second = Resume()
    second.curve = first.curve[:2]
    with figures.written(tmp_path / "a", second, silent) as tell:
        tell = second.noting(tell)
        for share in (0.75, 1.0):
            tell(share, {"loss": 10 * share})
    assert read(tmp_path / "a") == {"training/loss": [(250, 0.25), (500, 0.5), (750, 7.5), (1000, 10.0)]}


def test_without_a_folder_nothing_is_written():
    with figures.written(None, Resume(), silent) as tell:
        assert tell is silent


def test_a_missing_package_is_told_before_any_work(monkeypatch, tmp_path, capsys):
    find_spec = figures.importlib.util.find_spec

    def without(name, *rest):
        return None if name == "tensorboard" else find_spec(name, *rest)

    monkeypatch.setattr(figures.importlib, "util", SimpleNamespace(find_spec=without))
    arguments = [
        "--agents",
        "random",
        "--out",
        str(tmp_path / "run"),
        "--tensorboard",
        str(tmp_path / "events"),
    ]
    assert benchmark.main(arguments) == 2
    error = capsys.readouterr().err
    assert "pip install 'rise-suite[tensorboard]'" in error and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_only_trainings_write(tmp_path):
    jobs = [
        Job("a", train, {"env": VEHICLE}, tmp_path / "rise-seed0-abc.rise"),
        Job("b", evaluate, {"env": VEHICLE}, tmp_path / "b.parquet"),
    ]
    first, second = with_events(jobs, tmp_path / "events")
    assert first.arguments["events"] == tmp_path / "events" / VEHICLE / "rise-seed0-abc"
    assert second == jobs[1]
    assert with_events(jobs, None) == jobs


def test_trainings_of_a_search_write_too(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(search, "run_jobs", lambda jobs, *rest, **how: seen.extend(jobs) or [])
    how = search.How(1, 15.0, (), tensorboard=tmp_path / "events")
    search._run([Job("a", train, {"env": VEHICLE}, tmp_path / "x.rise")], how, "train")
    assert [job.arguments["events"] for job in seen] == [tmp_path / "events" / VEHICLE / "x"]


def test_a_run_writes_the_curve_of_every_training(tmp_path, tensorboard):
    """In worker processes, and the same figures as in the record beside the checkpoint."""
    pytest.importorskip("tensorboard")
    out, events = tmp_path / "run", tmp_path / "events"
    arguments = ["--agents", "rise", "cppo", "--envs", VEHICLE, "--preset", "smoke", "--no-videos"]
    arguments += ["--episodes", "2", "--workers", "2", "--out", str(out), "--tensorboard", str(events)]
    assert benchmark.main(arguments) == 0
    for agent, tags in (("rise", {"loss", "kl"}), ("cppo", {"lambda"})):
        (folder,) = (events / VEHICLE).glob(f"{agent}-seed0-*")
        (record,) = (out / "agents" / VEHICLE).glob(f"{agent}-seed0-*.json")
        curve = json.loads(record.read_text())["curve"]
        found = read(folder)
        assert {f"training/{tag}" for tag in tags} <= set(found)
        for tag, points in found.items():
            values = [
                point[tag.removeprefix("training/")]
                for point in curve
                if tag.removeprefix("training/") in point
            ]
            assert [value for _, value in points] == pytest.approx(values, rel=1e-6)
