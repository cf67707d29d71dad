"""Which work a plan asks for: what shares a file, what must not, and that rows act as their names say."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import results
from benchmarks.executors import run_jobs
from benchmarks.jobs import (
    Job,
    check_settings,
    checkpoint_path,
    complete_settings,
    demonstrations_folder,
    evaluate,
    evaluation_jobs,
    how_it_acts,
    in_turn,
    recording_jobs,
    train,
    training_jobs,
    video_jobs,
    wanted,
)
from benchmarks.labels import TRUE, split_row
from benchmarks.policies import make_policy
from benchmarks.protocol import Scenarios, make_plan
from rise_agents import load_agent, make_agent, register_agent
from rise_agents.agent import silent
from rise_agents.filters.kalman import KalmanFilter
from rise_agents.pcbc import PCBC
from rise_agents.rollout import rollout

VEHICLE = "RISE-GroundVehicle-v0"


def plan(*agents, settings=None, **chosen):
    chosen = {"envs": (VEHICLE,), "noise_models": ("step",), "episodes": 4, "expert": "cbf", **chosen}
    return make_plan("smoke", settings or {}, agents=agents, **chosen)


def test_rows_that_differ_only_in_acting_share_one_training(tmp_path):
    run = plan("rise", "rise-mean", "rise+kalman", "rise-mean+kalman", settings={"rise-mean": {"average": 3}})
    (job,) = training_jobs(run, tmp_path, "cpu", 15.0)
    assert {checkpoint_path(run, VEHICLE, row, 0, tmp_path) for row, _ in run.rows(VEHICLE)} == {job.output}
    assert not {"posterior", "average"} & set(job.arguments["config"])
    assert how_it_acts(run, VEHICLE, "rise-mean") == {"average": 3, "posterior": "mean"}
    jobs = evaluation_jobs(run, tmp_path)
    assert len({each.output for each in jobs}) == len(jobs) == 4
    assert {each.needs for each in jobs} == {(job.output,)}
    # The same row that acts otherwise is another evaluation of the same checkpoint.
    again = plan("rise", settings={"rise": {"average": 3}})
    (other,), (first, *_) = evaluation_jobs(again, tmp_path), jobs
    assert other.needs == first.needs and other.output != first.output


def test_a_number_is_the_same_however_it_is_written(tmp_path):
    """TOML and ``--set`` tell 1 from 1.0; a field of floats does not, and one of whole numbers stays as it is."""
    one, same = ({"beta": beta, "hidden": [64], "updates": 300} for beta in (1, 1.0))
    paths = {
        checkpoint_path(plan("rise", settings={"rise": each}), VEHICLE, "rise", 0, tmp_path)
        for each in (one, same)
    }
    assert len(paths) == 1
    settings = complete_settings(plan("rise", settings={"rise": one}), VEHICLE, "rise")
    assert type(settings["beta"]) is float and type(settings["updates"]) is int
    assert settings["hidden"] == [64] and type(settings["hidden"][0]) is int


def test_equal_training_shares_a_file_and_other_training_does_not(tmp_path):
    run = plan("rise", "rise-m1", "rise-cbf", "rise-mpc", "pcbc", "pcbc-noisy", "pcbc-body", "pcbc-world")
    paths = {row: checkpoint_path(run, VEHICLE, row, 0, tmp_path) for row, _ in run.rows(VEHICLE)}
    assert paths["rise-cbf"] == paths["rise"]  # cbf demonstrates to all in this run
    assert paths["pcbc-body"] == paths["pcbc"]  # body is the default frame
    assert len(set(paths.values())) == len(paths) - 2
    assert len(training_jobs(run, tmp_path, "cpu", 15.0)) == len(paths) - 2


def test_each_expert_demonstrates_into_its_own_folder(tmp_path):
    run = plan("rise", "rise-mpc", "pcbc")
    folders = [demonstrations_folder(run, VEHICLE, tmp_path, expert) for expert in ("cbf", "mpc")]
    assert folders[0] == demonstrations_folder(run, VEHICLE, tmp_path) != folders[1]
    collected = [job for job in recording_jobs(run, tmp_path) if "collect" in job.name]
    assert [job.output.parent for job in collected] == folders
    assert [job.arguments["expert"] for job in collected] == ["cbf", "mpc"]
    data = {job.name: job.arguments["data"] for job in training_jobs(run, tmp_path, "cpu", 15.0)}
    assert data[f"train rise-mpc on {VEHICLE}"] == folders[1]
    assert data[f"train rise on {VEHICLE}"] == data[f"train pcbc on {VEHICLE}"] == folders[0]


def _mark(output, progress, log):
    with log.open("a") as file:
        file.write(f"{output.name}\n")
    output.touch()


def test_in_turn_each_row_is_whole_before_the_next_begins(tmp_path):
    log = tmp_path / "log"

    def job(name, *needs, weight=1.0):
        paths = tuple(tmp_path / need for need in needs)
        return Job(name, _mark, {"log": log}, tmp_path / name, paths, weight)

    ends = [job("test a", "train a"), job("test b", "train b"), job("test a again", "train a")]
    before = [job("record"), job("spare"), job("train b", "record", weight=9.0), job("train a", "record")]
    turn = in_turn([*before, *ends], ends)
    assert sorted(each.name for each in turn) == sorted(each.name for each in [*before, *ends])
    order = ["record", "train a", "test a", "train b", "test b", "test a again", "spare"]
    assert [each.name for each in turn] == order
    assert run_jobs(turn, 1, lambda job, share, figures: None, longest_first=False) == []
    assert log.read_text().splitlines() == order
    for each in turn:
        each.output.unlink()
    log.unlink()
    assert run_jobs(turn, 1, lambda job, share, figures: None) == []
    assert log.read_text().splitlines()[:3] == ["record", "train b", "train a"]


def test_several_noise_models_share_level_0(tmp_path):
    run = plan("random", noise_models=("step", "episode"), noise_levels=(0.0, 1.0))
    met = [
        (job.arguments["noise_model"], job.arguments["noise_level"]) for job in evaluation_jobs(run, tmp_path)
    ]
    assert met == [("step", 0.0), ("step", 1.0), ("episode", 1.0)]
    alone = plan("random", noise_levels=(0.0, 1.0))  # whose files are the same: nothing is done again
    outputs = [job.output for job in evaluation_jobs(run, tmp_path)]
    assert [job.output for job in evaluation_jobs(alone, tmp_path)] == outputs[:2]


def test_a_row_on_true_readings_is_run_once_and_listed_everywhere(tmp_path):
    run = plan("expert+true", "expert", noise_models=("step", "episode"), noise_levels=(0.0, 1.0))
    jobs = [job for job in evaluation_jobs(run, tmp_path) if job.output.name.startswith("expert-cbf")]
    true = [job for job in jobs if split_row(job.arguments.get("row", "x+true"))[1] == TRUE]
    first, *others = true
    assert len(others) == 2 and all(job.needs == (first.output,) for job in others)
    for job in jobs:
        job.run(job.output, silent, **job.arguments)
    rows = {}
    for job in jobs:
        table = results.read_rows(job.output).to_pydict()
        rows[table["agent"][0], table["noise_model"][0], table["noise_level"][0]] = table
    outcome = [name for name in results.SCHEMA.names if name not in ("agent", "noise_model", "noise_level")]
    clean = rows["expert-cbf", "step", 0.0]
    for condition in (("step", 0.0), ("step", 1.0), ("episode", 1.0)):
        table = rows["expert-cbf+true", *condition]
        assert [table[name] for name in outcome] == [clean[name] for name in outcome]
    assert rows["expert-cbf", "step", 1.0]["steps"] != clean["steps"]
    for job in video_jobs(run, tmp_path):
        assert job.arguments["noise_level"] == (0.0 if "+true" in job.arguments["row"] else 1.0)


@pytest.fixture(scope="module")
def trained(vehicle_demonstrations, tmp_path_factory):
    """A plan of rows that share a checkpoint, the folder, and its path; trained by the job itself."""
    out = tmp_path_factory.mktemp("run")
    run = plan("rise", "rise-mean", "rise+kalman")
    (job,) = training_jobs(run, out, "cpu", 15.0)
    job.arguments["data"].mkdir(parents=True)
    vehicle_demonstrations.save(job.arguments["data"])
    job.output.parent.mkdir(parents=True)
    train(job.output, silent, **{**job.arguments, "config": {**job.arguments["config"], "updates": 50}})
    return run, out, job.output


class Impostor(PCBC):
    """Its checkpoints are those of the agent that it was made from."""

    name = "impostor"

    def save(self, path):
        trained = make_agent("pcbc", VEHICLE)
        trained.__dict__.update(self.__dict__)
        trained.save(path)


def test_a_checkpoint_that_names_another_agent_is_refused(own_names, vehicle_demonstrations, tmp_path):
    """Whoever loads it would measure that one under this one's name."""
    register_agent("impostor", Impostor)
    vehicle_demonstrations.save(tmp_path)
    output = tmp_path / "impostor.rise"
    with pytest.raises(ValueError, match="wrote a checkpoint of 'pcbc': it must write the agent's own name"):
        train(output, silent, VEHICLE, "impostor", 0, {"updates": 1}, tmp_path, "cpu", 15.0)
    assert not output.exists()


def test_rows_act_as_their_names_say(trained):
    _, _, path = trained
    mean = make_policy(VEHICLE, "rise-mean", path, {"posterior": "mean"}, 1.0)
    assert mean.config.posterior == "mean" and load_agent(path).config.posterior == "sample"
    kalman = make_policy(VEHICLE, "rise+kalman", path, {}, 1.5)
    assert isinstance(kalman, KalmanFilter) and kalman.noise_level == 1.5
    expert = make_policy(VEHICLE, "expert-cbf+kalman", None, {}, 1.0)
    assert type(expert.policy).__name__ == "VehicleCBF"


def test_evaluations_measure_the_row_they_name(trained, tmp_path):
    """Against roll-outs that are put together by hand."""
    run, out, path = trained
    seeds = Scenarios(0, 4).seeds()
    jobs = {job.arguments["row"]: job for job in evaluation_jobs(run, out)}
    policies = {
        "rise": load_agent(path),
        "rise-mean": load_agent(path, None, "cpu", {"posterior": "mean"}),
        "rise+kalman": KalmanFilter(load_agent(path), load_agent(path).task, 1.0),
    }
    returns = {}
    for row, policy in policies.items():
        evaluate(tmp_path / row, silent, **jobs[row].arguments)
        table = results.read_rows(tmp_path / row)
        episodes, _ = rollout(policy, VEHICLE, seeds, noise_level=1.0, deterministic=False)
        returns[row] = table["episode_return"].to_numpy()
        np.testing.assert_allclose(returns[row], episodes.episode_return, rtol=1e-6)
        assert set(table["agent"].to_pylist()) == {row}
    assert (returns["rise"] != returns["rise-mean"]).all() and (
        returns["rise"] != returns["rise+kalman"]
    ).all()


def test_settings_out_of_range_name_the_row():
    with pytest.raises(ValueError, match="settings of rise-mean: beta must not be negative"):
        check_settings(plan("rise-mean+kalman", settings={"rise-mean": {"beta": -1.0}}))


def test_clips_are_titled_with_the_row_s_label(tmp_path):
    labels = {
        job.arguments["row"]: job.arguments["label"] for job in video_jobs(plan("pcbc+kalman"), tmp_path)
    }
    assert labels == {"pcbc+kalman": "PC-BC behind a Kalman filter"}


def test_only_what_a_missing_end_needs_is_wanted(tmp_path):
    """Two trainings from one set of two pieces; one of the first's evaluations is missing, none of the second's."""

    def job(name, *needs):
        return Job(name, train, {}, tmp_path / name, tuple(tmp_path / each for each in needs))

    before = [
        job("piece 0"),
        job("piece 1"),
        job("set", "piece 0", "piece 1"),
        job("a", "set"),
        job("b", "set"),
    ]
    ends = [job("a at 0", "a"), job("a at 1", "a"), job("b at 0", "b"), job("again", "b at 0"), job("chance")]

    def names():
        return [each.name for each in wanted([*before, *ends], ends)]

    assert names() == [each.name for each in [*before, *ends]]
    for done in ("a at 0", "b at 0", "again", "chance"):
        (tmp_path / done).touch()
    assert names() == ["piece 0", "piece 1", "set", "a", *(each.name for each in ends)]
    (tmp_path / "set").touch()  # whose pieces may be gone
    assert names() == ["set", "a", *(each.name for each in ends)]
    (tmp_path / "b").touch()  # is done, and stays in the list
    (tmp_path / "a at 1").touch()
    (tmp_path / "again").unlink()  # needs an end, which is there
    assert names() == ["set", "b", *(each.name for each in ends)]
    assert wanted(before, []) == [before[2], before[4]]
