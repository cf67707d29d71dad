"""Published episodes in place of running them again: what is the same is taken, all else is run."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hand_made import make_rows

from benchmarks import publish, published, results
from benchmarks.jobs import (
    checkpoint_path,
    complete_settings,
    evaluation_jobs,
    training_jobs,
    video_jobs,
    wanted,
)
from benchmarks.labels import split_row
from benchmarks.presets import Block
from benchmarks.protocol import make_plan
from benchmarks.run import main
from rise_agents import checkpoint, pretrained
from rise_agents.pretrained.__main__ import main as ship

VEHICLE = "RISE-GroundVehicle-v0"
COMMON = ["--envs", VEHICLE, "--preset", "smoke", "--expert", "cbf", "--demos", "6", "--episodes", "5"]
COMMON += ["--set", "pcbc.updates=20", "--noise-levels", "0", "1", "--workers", "1", "--no-videos"]
ROWS = ("pcbc", "pcbc+kalman", "expert+true")
FOLLOWS = ("episodes.parquet", "summary.csv", "comparisons.csv", "comparison.png", "noise_curve.png")


def files(folder: Path, pattern: str) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob(pattern))


# --- real runs -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def docs(tmp_path_factory):
    """The published results of a run of all ``ROWS``."""
    root = tmp_path_factory.mktemp("made")
    assert main([*COMMON, "--agents", *ROWS, "--out", str(root / "run")]) == 0
    publish.publish(root / "run", root / "docs")
    return root / "docs"


def test_what_is_all_there_is_published_again_byte_for_byte(docs, tmp_path, capfd):
    out, command = tmp_path / "run", [*COMMON, "--agents", *ROWS, "--published", str(docs)]
    assert main([*command, "--out", str(out)]) == 0
    # cbf, mpc and mixture are experts: 5 rows, 2 levels, 5 scenarios.
    assert f"taken from {docs}: 50 episodes of 5 rows\n" in capfd.readouterr().err
    assert files(out, "*.rise") == [] and not (out / "demonstrations").exists()
    publish.publish(out, tmp_path / "docs")
    for name in FOLLOWS:
        assert (tmp_path / "docs" / name).read_bytes() == (docs / name).read_bytes(), name
    before, after = (json.loads((folder / "run.json").read_text()) for folder in (docs, tmp_path / "docs"))
    for name in ("agents", "demonstrations", "settings", "training", "trainings", "rows", "versions"):
        assert after[name] == before[name] != {}
    assert before["taken_from"] == []
    assert [each["command"] for each in after["taken_from"]] == [before["command"]]
    # Once more: nothing is left to take, and the record says the same.
    record = json.loads((out / "run.json").read_text())
    assert main([*command, "--out", str(out)]) == 0
    assert "nothing that is not here already" in capfd.readouterr().err
    assert json.loads((out / "run.json").read_text()) == record


def test_only_what_is_new_is_run(docs, tmp_path):
    out = tmp_path / "run"
    agents = ["random", "expert+true", "pcbc"]
    assert main([*COMMON, "--agents", *agents, "--published", str(docs), "--out", str(out)]) == 0
    assert files(out, "*.rise") == [] and not (out / "demonstrations").exists()
    rows, before = (results.read_rows(folder / "episodes.parquet") for folder in (out, docs))
    taken = rows.filter(pc.not_equal(rows["agent"], "random"))
    assert taken.equals(before.filter(pc.not_equal(before["agent"], "pcbc+kalman")))
    assert rows.num_rows - taken.num_rows == 2 * 5
    assert json.loads((out / "run.json").read_text())["rows"][0] == "random"


def test_an_evaluation_that_lacks_a_scenario_is_run(docs, tmp_path, capfd):
    folder, out = Path(shutil.copytree(docs, tmp_path / "docs")), tmp_path / "run"
    whole = results.read_rows(docs / "episodes.parquet")
    lost = np.array(whole["agent"].to_pylist()) == "expert-cbf+true"
    lost &= (whole["scenario"].to_numpy() == 3) & (whole["noise_level"].to_numpy() == 0)
    results.write_compact(folder / "episodes.parquet", whole.filter(pa.array(~lost)))
    assert main([*COMMON, "--agents", *ROWS, "--published", str(folder), "--out", str(out)]) == 0
    assert f"taken from {folder}: 45 episodes of 5 rows\n" in capfd.readouterr().err
    assert files(out, "*.rise") == []
    rows = results.read_rows(out / "episodes.parquet")
    assert not rows.equals(whole) and results.rounded(rows).equals(whole)


def test_weights_of_the_package_are_the_same_if_their_files_are(docs, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "weights")
    assert ship([str(docs.parent / "run"), "--agents", "pcbc", "--into", str(tmp_path / "weights")]) == 0
    command = ["--pretrained", "--agents", "pcbc", "--envs", VEHICLE, "--preset", "smoke", "--no-videos"]
    command += ["--workers", "1", "--episodes", "5", "--noise-levels", "1"]
    assert main([*command, "--published", str(docs), "--out", str(tmp_path / "run")]) == 0
    assert "nothing: it has none of these evaluations" in capfd.readouterr().err  # there it was trained
    publish.publish(tmp_path / "run", tmp_path / "docs")
    command += ["--published", str(tmp_path / "docs")]
    assert main([*command, "--out", str(tmp_path / "again")]) == 0
    assert "5 episodes of 1 row\n" in capfd.readouterr().err
    weights = next((tmp_path / "weights").glob("*.rise"))
    weights.write_bytes(next((docs.parent / "run").rglob("pcbc-*.rise")).read_bytes()[:-1])
    assert main([*command, "--out", str(tmp_path / "other")]) == 2  # damaged: as without --published


def test_a_folder_that_is_none_is_told_in_one_line_before_any_work(docs, tmp_path, capsys):
    folder = tmp_path / "docs"

    def refused(says, folder=folder, out=tmp_path / "run"):
        arguments = [*COMMON, "--agents", "random", "--published", str(folder), "--out", str(out)]
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert says in error and error.startswith("benchmarks.run: ") and error.count("\n") == 1
        assert not (tmp_path / "run").exists()

    refused("is no folder of published results (run.json: No such file")
    refused("no folder of published results", tmp_path / "x\ny")
    refused("no folder of published results", tmp_path / ("x" * 300))
    refused("benchmarks.publish makes one from a run folder", docs.parent / "run")
    shutil.copytree(docs, folder)
    refused("--out is the folder of published results itself", out=folder)
    record = json.loads((docs / "run.json").read_text())
    broken = [3, {}, {**record, "agents": [1]}, {**record, "versions": None}, {**record, "taken_from": 1}]
    broken += [{**record, "settings": {"a": 1}}, {**record, "trainings": {VEHICLE: {"x": {"seconds": "1"}}}}]
    for content in broken:
        (folder / "run.json").write_text(json.dumps(content))
        refused("is no folder of published results (run.json")
    (folder / "run.json").write_text("{")
    refused("is no folder of published results (run.json")
    shutil.copy(docs / "run.json", folder)
    (folder / "episodes.parquet").write_bytes((docs / "episodes.parquet").read_bytes()[:-50])
    refused("cannot be read as results")
    (folder / "episodes.parquet").unlink()
    refused("cannot be read: No such file")


# --- what is the same ------------------------------------------------------------------------------------------


def plan(*agents, settings=None, **chosen):
    chosen = {
        "envs": (VEHICLE,),
        "noise_models": ("step",),
        "noise_levels": (0.0, 1.0),
        "episodes": 4,
        **chosen,
    }
    return make_plan("smoke", settings or {}, agents=agents, **{"expert": "cbf", **chosen})


def pretend(run, folder, **changes):
    """Published results of a plan that nobody has run."""
    tables, rows = [], run.rows(VEHICLE)
    for row, seed in rows:
        for model, level in run.conditions(VEHICLE, row, seed):
            for part in run.chunks(VEHICLE):
                seeds = part.seeds()
                names = {"agent": row, "train_seed": seed, "noise_model": model, "noise_level": level}
                tables.append(make_rows(part.count, part.start, env_seed=seeds, noise_seed=seeds, **names))
    trained = [(row, seed) for row, seed in rows if run.agent_of(row)]
    paths = {f"{row}-seed{seed}": checkpoint_path(run, VEHICLE, row, seed, folder) for row, seed in trained}
    end = {"seconds": 1.5, "device": "cpu", "end": {"share": 1.0}}
    record = {
        "command": "run",
        "agents": {VEHICLE: {name: str(path.relative_to(folder)) for name, path in paths.items()}},
        "settings": {
            f"{split_row(row)[0]}@{VEHICLE}": complete_settings(run, VEHICLE, split_row(row)[0])
            for row, _ in trained
        },
        "trainings": {VEHICLE: {path.stem: end for path in paths.values()}},
        "demonstrations": {VEHICLE: {"env": VEHICLE, "expert": "cbf", "episodes": 24, "seed": 0}},
        "versions": checkpoint.versions(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    results.write_rows(folder / "episodes.parquet", pa.concat_tables(tables[::-1]))  # in whatever order
    (folder / "run.json").write_text(json.dumps(record | changes))
    return published.read(folder)


def found(source, run, out):
    """(row, training seed, noise model, level) of what can be taken."""
    return [
        tuple(match.who[name] for name in ("row", "seed", "noise_model", "noise_level"))
        for match in published.matches(source, run, out, evaluation_jobs(run, out))
    ]


def test_the_same_plan_is_found_whole_and_each_part_holds_its_own_episodes(tmp_path):
    run = plan("rise", "rise-mean+kalman", "random", "expert+true", seeds=2, episodes=1_003)
    source, out = pretend(run, tmp_path / "docs"), tmp_path / "run"
    jobs = evaluation_jobs(run, out)
    matches = published.matches(source, run, out, jobs)
    assert [match.job for match in matches] == jobs
    assert source.rows.num_rows == sum(match.rows.num_rows for match in matches)
    assert published.take(source, matches) == f"taken from {source.folder}: 16,048 episodes of 6 rows"
    for match in matches[::5]:
        rows, part = results.read_rows(match.job.output), match.who["scenarios"]
        assert rows["scenario"].to_pylist() == list(range(part.start, part.start + part.count))
        for name in ("row", "noise_model", "noise_level"):
            assert set(rows["agent" if name == "row" else name].to_pylist()) == {match.who[name]}
    trained = {path for job in jobs for path in job.needs if path.suffix == ".rise"}
    assert len(trained) == 2  # rise-mean shares the trainings of rise
    for path in trained:
        told = json.loads(path.with_suffix(".json").read_text())
        assert told == {"seconds": 1.5, "device": "cpu", "curve": [{"share": 1.0}]}


@pytest.mark.parametrize(
    ("agents", "changes", "expected"),
    [
        (("pcbc", "rise"), {"settings": {"pcbc": {"updates": 301}}}, {"rise"}),
        (("rise", "rise-mean"), {"settings": {"rise-mean": {"average": 3}}}, {"rise"}),  # acts otherwise
        (("rise+kalman", "rise"), {"settings": {"rise": {"average": 3}}}, set()),
        (("pcbc", "random"), {"demos": 25}, {"random"}),
        (("pcbc", "expert"), {"expert": "mpc"}, {"expert-cbf", "expert-mpc", "expert-mixture"}),
        (("pcbc+kalman", "random"), {"noise_models": ("episode",)}, set()),
        (("pcbc", "random"), {"episodes": 5}, set()),  # none of their parts is whole
        (("pcbc",), {"episodes": 3}, {"pcbc"}),
    ],
)
def test_what_is_not_the_very_same_is_not_taken(agents, changes, expected, tmp_path):
    published_rows = ("pcbc", "pcbc+kalman", "rise", "rise-mean", "rise+kalman", "random", "expert")
    source = pretend(plan(*published_rows), tmp_path / "docs")
    rows = {row for row, *_ in found(source, plan(*agents, **changes), tmp_path / "run")}
    assert rows == expected


def test_more_seeds_and_levels_are_found_as_far_as_they_go(tmp_path):
    source = pretend(plan("pcbc", "expert+true"), tmp_path / "docs")
    more = plan("pcbc", "expert+true", seeds=2, noise_levels=(0.5, 1.0))
    experts = [(f"expert-{name}+true", 0, "step", 1.0) for name in ("cbf", "mpc", "mixture")]
    assert found(source, more, tmp_path / "run") == [("pcbc", 0, "step", 1.0), *experts]


def test_rows_of_other_blocks_are_found_under_their_own_conditions(tmp_path):
    block = Block("", ("pcbc", "rise-mean"), ("step", "episode"), (1.0,), 1)
    run = plan("pcbc", "random", blocks=(block,))
    source, out = pretend(run, tmp_path / "docs"), tmp_path / "run"
    every = found(source, run, out)
    assert [each for each in every if each[0] == "rise-mean"] == [
        ("rise-mean", 0, "step", 1.0),
        ("rise-mean", 0, "episode", 1.0),
    ]
    assert len(every) == len(evaluation_jobs(run, out)) == 3 + 2 + 2


def test_another_version_has_nothing_to_give(tmp_path):
    run = plan("pcbc", "random", "expert")
    source = pretend(run, tmp_path / "docs", versions={**checkpoint.versions(), "rise-suite": "0.0.9"})
    assert found(source, run, tmp_path) == []
    assert "nothing: it is of version 0.0.9, this is 0.1.0" in published.take(source, [])
    assert source.card(VEHICLE, "cbf", 24) is None


@pytest.mark.parametrize("column", ["env_seed", "noise_seed"])
def test_other_seeds_of_a_scenario_are_another_scenario(column, tmp_path):
    run = plan("random")
    source = pretend(run, tmp_path / "docs")
    rows = source.rows.to_pydict()
    rows[column][1] += 1
    results.write_rows(tmp_path / "docs" / "episodes.parquet", results.from_columns(rows))
    assert found(published.read(tmp_path / "docs"), run, tmp_path) == [("random", 0, "step", 1.0)]


def test_a_doubled_episode_is_not_taken(tmp_path):
    run = plan("random")
    source = pretend(run, tmp_path / "docs")
    doubled = pa.concat_tables([source.rows, source.rows[:1]])
    results.write_rows(tmp_path / "docs" / "episodes.parquet", doubled)
    assert found(published.read(tmp_path / "docs"), run, tmp_path) == [("random", 0, "step", 1.0)]


def test_a_training_that_is_needed_is_run_though_a_part_was_taken(tmp_path):
    source, out = pretend(plan("pcbc", "rise"), tmp_path / "docs"), tmp_path / "run"
    more = plan("pcbc", "rise", noise_levels=(0.0, 1.0, 2.0))
    jobs = evaluation_jobs(more, out)
    published.take(source, published.matches(source, more, out, jobs))
    trainings = training_jobs(more, out, "cpu", 15.0)
    assert wanted([*trainings, *jobs], jobs)[:2] == trainings
    # With every episode there, only a clip needs a training: that of the first seed.
    same = plan("pcbc", "rise", seeds=1)
    jobs, clips = evaluation_jobs(same, out), video_jobs(same, out)
    assert wanted([*trainings, *jobs], jobs) == jobs
    assert wanted([*trainings, *jobs, *clips], [*jobs, *clips])[:2] == trainings


def test_a_record_of_a_training_that_was_made_here_stays(tmp_path):
    run = plan("pcbc")
    source, out = pretend(run, tmp_path / "docs"), tmp_path / "run"
    path = checkpoint_path(run, VEHICLE, "pcbc", 0, out)
    path.parent.mkdir(parents=True)
    path.touch()  # trained here; who removed its record has reasons
    published.take(source, published.matches(source, run, out, evaluation_jobs(run, out)))
    assert not path.with_suffix(".json").exists()


def test_the_card_is_that_of_the_very_set(tmp_path):
    source = pretend(plan("pcbc"), tmp_path / "docs")
    assert source.card(VEHICLE, "cbf", 24) == source.record["demonstrations"][VEHICLE]
    for other in (("RISE-SafePanda-v0", "cbf", 24), (VEHICLE, "mpc", 24), (VEHICLE, "cbf", 25)):
        assert source.card(*other) is None


def test_where_results_came_from_is_told_once_the_oldest_first(tmp_path):
    first = pretend(plan("random"), tmp_path / "docs")
    (mine,) = first.origin()
    assert mine["command"] == "run" and mine["versions"] == checkpoint.versions()
    second = replace(first, record={**first.record, "command": "other", "taken_from": first.origin()})
    assert [each["command"] for each in second.origin()] == ["run", "other"]
    again = replace(first, record={**first.record, "command": "other", "taken_from": second.origin()})
    assert again.origin() == second.origin()
