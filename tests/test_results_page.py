"""What is published of a run: small, without traces of the machine, and all of it what its episodes say."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hand_made import make_rows

from benchmarks import publish, report, results, results_page
from benchmarks.labels import interval, percent
from benchmarks.tables import ComparisonRow, SummaryRow, read_table, summarise
from rise_agents import make_agent
from rise_agents.agent import config_to_dict
from rise_agents.files import sole_user

PUBLISHED = Path(__file__).parents[1] / "docs" / "results"
ENVS = ("RISE-GroundVehicle-v0", "RISE-SafePanda-v0")
RECORD = {
    "agents": {ENVS[0]: {"rise-seed0": "agents/v/rise-0.rise", "rise-mean-seed0": "agents/v/rise-0.rise"}},
    "command": "python -m benchmarks.run --agents rise pcbc --config /home/someone/mine.toml --out=/tmp/a/run",
    "device": "cpu",
    "failed": [],
    "plan": {"agents": ["rise", "pcbc"], "envs": list(ENVS)},
    "platform": "Linux-1.2.3-of-somebody",
    "python": "3.11.9",
    "rows": ["rise", "pcbc"],
    "settings": {"rise@x": {"beta": 0.1, "unit": "m/s"}},
    "training": {
        "rise": {ENVS[0]: {"learned from": "24 mixture episodes", "training time": "12 s", "beta": 0.07}}
    },
    "versions": {"numpy": "2.0.0"},
}


def episodes(n=30):
    """Both agents, two seeds, under two models; level 0 under the first."""
    rng = np.random.default_rng(0)
    conditions = (("step", 0.0), ("step", 1.0), ("step", 2.0), ("episode", 1.0))
    return pa.concat_tables(
        make_rows(
            n,
            env=env,
            agent=agent,
            noise_model=model,
            noise_level=level,
            train_seed=seed,
            safe=rng.random(n) < rate,
            min_clearance=rng.normal(0.3, 0.3, n),
            episode_return=rng.normal(20, 6, n),
        )
        for env in ENVS
        for agent, rate in (("rise", 0.95), ("pcbc", 0.5))
        for model, level in conditions
        for seed in range(2)
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run folder, and the folder of what is published of it: to be copied, drawing figures takes a while."""
    root = tmp_path_factory.mktemp("made")
    folder = root / "run"
    (folder / "agents" / "v").mkdir(parents=True)
    results.write_rows(folder / "episodes.parquet", episodes())
    (folder / "run.json").write_text(json.dumps(RECORD))
    curve = [{"share": 0.5, "loss": 2.0}, {"share": 1.0, "loss": 0.25}]
    training = {"seconds": 12.5, "device": "cpu", "curve": curve}
    (folder / "agents" / "v" / "rise-0.json").write_text(json.dumps(training))
    publish.publish(folder, root / "results")
    return root


@pytest.fixture
def run(made, tmp_path):
    """A run folder."""
    return Path(shutil.copytree(made / "run", tmp_path / "run"))


@pytest.fixture
def published(made, tmp_path):
    """A folder of published results."""
    return Path(shutil.copytree(made / "results", tmp_path / "results"))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- what is committed -----------------------------------------------------------------------------------------


@pytest.mark.skipif(not (PUBLISHED / "episodes.parquet").exists(), reason="no results are committed yet")
def test_the_committed_results_are_what_their_episodes_say():
    assert results_page.stale(PUBLISHED) == []


@pytest.mark.skipif(not (PUBLISHED / "episodes.parquet").exists(), reason="no results are committed yet")
def test_the_readme_s_table_is_of_the_committed_results():
    rows = {
        (row.env, row.agent): row
        for row in read_table(PUBLISHED / "summary.csv", SummaryRow)
        if (row.noise_model, row.noise_level) == ("step", 1.0)
    }
    agents = ("rise", "pcbc", "cppo", "rise-belief", "rise-belief-shield", "expert-cbf")
    readme = (PUBLISHED.parents[1] / "README.md").read_text()
    found = re.search(r"^\| Noise level 1 \|.*\n\|[-:| ]+\n((?:\|.*\n)+)", readme, re.MULTILINE)
    assert found is not None
    lines = [[cell.strip() for cell in line.split("|")[2:-1]] for line in found[1].splitlines()]
    expected = [
        [
            f"{percent(getattr(row, f'{rate}_rate'))} "
            f"[{interval(getattr(row, f'{rate}_low'), getattr(row, f'{rate}_high'))}]"
            for row in (rows[env, agent] for env in ENVS)
            for rate in ("safety", "reach")
        ]
        for agent in agents
    ]
    assert lines == expected


# --- what is written -------------------------------------------------------------------------------------------


def test_a_run_becomes_a_folder_that_agrees_with_itself(run, published):
    names = {f"{name}{mark}.png" for name in ("comparison", "noise_curve") for mark in ("", "-episode")}
    tables = {"episodes.parquet", "summary.csv", "comparisons.csv"}
    assert set(contents(published)) == names | tables | {"run.json", "summary.md", "README.md"}
    assert results_page.stale(published) == []


def test_blocks_of_a_run_have_tables_of_their_own(run, tmp_path):
    record = json.loads((run / "run.json").read_text())
    asked = {"title": "", "rows": ["rise"], "noise_models": ["step"], "noise_levels": [0, 1, 2], "envs": []}
    other = {"title": "Is it PC-BC?", "rows": ["rise", "pcbc"], "noise_models": ["step", "episode"]}
    record["blocks"] = [asked, {**other, "noise_levels": [0, 1], "envs": [ENVS[0]]}]
    (run / "run.json").write_text(json.dumps(record))
    publish.publish(run, tmp_path / "out")
    assert results_page.stale(tmp_path / "out") == []
    page = (tmp_path / "out" / "README.md").read_text()
    findings, _, rest = page.partition("## Controls")
    controls, _, tables = rest.partition("## What was tried")
    assert "PC-BC" not in findings.replace("pcbc", "") and "PC-BC" not in tables
    lines = [line for line in controls.splitlines() if line.startswith("|")]
    assert lines[0] == "| Agent | level 0 | `episode` 1 | `step` 1 |"
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| RISE", "| PC-BC"]  # of the one environment
    assert "### Is it PC-BC?" in controls and "(others-ground-vehicle.png)" in controls
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {
        *("comparison.png", "noise_curve.png", "others-ground-vehicle.png")
    }
    record["blocks"] = [{**asked, "noise_levels": "all"}]
    (run / "run.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"run\.json is not the record of a run"):
        publish.publish(run, tmp_path / "out")


def test_the_same_run_gives_the_same_files(run, published, tmp_path):
    publish.publish(run, tmp_path / "again")
    assert contents(tmp_path / "again") == contents(published)
    publish.publish(run, published)
    assert contents(tmp_path / "again") == contents(published)


def test_the_report_makes_the_same_tables_again(published, tmp_path, capsys):
    assert report.main([str(published), "--out", str(tmp_path / "x")]) == 0
    for name in ("summary.csv", "comparisons.csv"):
        assert (tmp_path / "x" / name).read_bytes() == (published / name).read_bytes()


def test_episodes_are_those_of_the_run_but_for_the_last_digits(published):
    stored, rows = results.read_rows(published / "episodes.parquet"), episodes()
    for name in results.SCHEMA.names:
        before, after = rows[name].to_numpy(), stored[name].to_numpy()
        if name in ("min_clearance", "episode_return"):
            np.testing.assert_allclose(after, before, rtol=0, atol=2**-13)
        else:
            np.testing.assert_array_equal(after, before)


def test_a_collision_stays_one_when_numbers_are_rounded():
    clearance = np.array([-1e-9, -0.3, 0.0, 1e-9, 0.25, -0.00013])
    got = results.rounded(make_rows(6, min_clearance=clearance))["min_clearance"].to_numpy()
    assert np.array_equal(got < 0, clearance < 0) and not np.signbit(got[2])
    assert got[[0, 4]].tolist() == [-(2**-13), 0.25]
    np.testing.assert_allclose(got, clearance, rtol=0, atol=2**-13)


def test_compact_rows_are_the_same_rows_in_a_few_bytes(tmp_path):
    rng, n = np.random.default_rng(0), 1000
    tables = [
        make_rows(
            n,
            agent=agent,
            train_seed=seed,
            noise_level=level,
            safe=rng.random(n) < 0.95,
            arrived=rng.random(n) < 0.98,
            steps=rng.integers(50, 200, n),
            episode_cost=np.where(rng.random(n) < 0.95, 0.0, rng.integers(1, 20, n)),
            min_clearance=rng.normal(1.0, 0.9, n),
            episode_return=rng.normal(20, 6, n),
        )
        for agent in ("rise", "pcbc")
        for seed in range(5)
        for level in (0.0, 0.5, 1.0, 2.0)
    ]
    rows = results.rounded(pa.concat_tables(tables))
    for name in "ab":
        results.write_compact(tmp_path / name, rows)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert results.read_rows(tmp_path / "a").equals(rows.combine_chunks())
    assert pq.read_table(tmp_path / "a").equals(rows)  # by others too
    assert (tmp_path / "a").stat().st_size < 7.5 * rows.num_rows


def test_the_record_says_nothing_of_the_machine(published):
    record = json.loads((published / "run.json").read_text())
    assert record["command"] == "python -m benchmarks.run --agents rise pcbc --config mine.toml --out=run"
    assert not {"platform", "failed"} & set(record)
    for kept in ("plan", "settings", "versions", "training", "rows", "device", "python"):
        assert record[kept] == RECORD[kept]
    end = {"share": 1.0, "loss": 0.25}
    assert record["trainings"] == {ENVS[0]: {"rise-0": {"seconds": 12.5, "device": "cpu", "end": end}}}


# --- the page --------------------------------------------------------------------------------------------------


def test_the_page_holds_findings_targets_and_rates(published):
    page = (published / "README.md").read_text()
    assert "mine.toml --out=run\n```" in page
    assert (
        "- **Ground vehicle**: 2 rows, 60 episodes per row of 2 training seeds and condition; noise" in page
    )
    assert len(re.findall(r"^- RISE kept .* than PC-BC", page, re.MULTILINE)) == 4
    assert re.search(
        r"^\| `rise` − `pcbc`, `step` 1 \| Ground vehicle \| \d.* \| yes \|$", page, re.MULTILINE
    )
    assert (
        "| `rise` − `cppo`, `step` 1 | Franka Panda | – | – | > 0, all of the interval | not measured |"
        in page
    )
    titles = ["### Ground vehicle: one constant error per episode (`episode`)"]
    titles += ["### Franka Panda: fresh noise at every step (`step`)"]
    assert all(title in page for title in titles)
    (line,) = re.findall(r"Franka Panda: fresh.*\n\n.*\n.*\n(\| RISE .*)", page)
    rows = [row for row in episodes().to_pylist() if (row["env"], row["agent"]) == (ENVS[1], "rise")]
    safe = {
        level: np.mean([r["safe"] for r in rows if (r["noise_model"], r["noise_level"]) == ("step", level)])
        for level in (0.0, 1.0, 2.0)
    }
    cells = [cell.strip() for cell in line.split("|")[2:-1]]
    assert cells[0].startswith(f"{100 * safe[1.0]:.1f} [")
    assert cells[2].startswith(f"{100 * safe[0.0]:.1f} / ") and cells[3].startswith(
        f"{100 * safe[2.0]:.1f} / "
    )


def test_words_that_people_wrote_stay(run, published):
    page = published / "README.md"
    before = page.read_text().replace("## Controls\n", "## Controls\n\nMine.\n")
    begin, end = results_page.BLOCKS["tables"].begin, results_page.BLOCKS["tables"].end
    head, _, rest = before.partition(begin)
    page.write_text(f"{head}{begin}\nold\n{end}{rest.partition(end)[2]}")
    publish.publish(run, published)
    assert page.read_text() == before


def test_figures_of_a_former_run_go(run, published):
    (published / "comparison-drift.png").write_bytes(b"old")
    publish.publish(run, published)
    assert not (published / "comparison-drift.png").exists()


# --- a run that is not finished --------------------------------------------------------------------------------


def unfinished(run, drop, **changes):
    """Take the rows away for which ``drop(row)`` holds."""
    rows = [row for row in episodes().to_pylist() if not drop(row)]
    columns = {name: [row[name] for row in rows] for name in results.SCHEMA.names}
    results.write_rows(run / "episodes.parquet", results.from_columns(columns))
    (run / "run.json").write_text(json.dumps({**RECORD, **changes}))
    return rows


def test_an_unfinished_run_is_published_only_when_asked_for(run, tmp_path, capsys):
    """PC-BC lacks a model, a seed at level 2, and half of its scenarios at level 1 of one seed; RISE all of level 0."""

    def drop(row):
        if row["agent"] == "rise":
            return row["noise_level"] == 0
        if row["noise_level"] == 2:
            return row["train_seed"] == 1
        return row["noise_model"] == "episode" or (
            row["noise_level"] == 1 and row["train_seed"] == 1 and row["scenario"] >= 15
        )

    rows, out = unfinished(run, drop, unfinished=7), tmp_path / "out"
    assert publish.main([str(run), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "is not finished, jobs left: 7" in error and "--partial" in error and error.count("\n") == 1
    assert not out.exists()
    assert publish.main([str(run), "--out", str(out), "--partial"]) == 0
    assert results_page.stale(out) == [] and publish.main([str(out), "--check"]) == 0
    page, summary = (out / "README.md").read_text(), (out / "summary.md").read_text()
    left = "**Not finished:** 7 pieces of work are left, so rows can be missing, or have fewer episodes than others."
    assert page.count(left) == summary.count(left) == 1
    assert "2 rows, 30–60 episodes per row of 1–2 training seeds and condition" in page
    assert json.loads((out / "run.json").read_text())["unfinished"] == 7
    lines = {
        (row.env, row.noise_model, row.noise_level): row
        for row in read_table(out / "comparisons.csv", ComparisonRow)
    }
    assert {key[1:] for key in lines} == {("step", 1.0), ("step", 2.0)}  # elsewhere only one of them is
    for key, line in lines.items():
        safe = {
            (row["agent"], row["train_seed"], row["scenario"]): row["safe"]
            for row in rows
            if (row["env"], row["noise_model"], row["noise_level"]) == key
        }
        # At level 2 PC-BC has one training seed, which is compared with both.
        other = {0: 0, 1: 0} if key[2] == 2 else {0: 0, 1: 1}
        pairs = [
            (safe["rise", seed, n], safe["pcbc", other[seed], n])
            for seed in (0, 1)
            for n in range(30)
            if ("pcbc", other[seed], n) in safe
        ]
        assert len(pairs) == (60 if key[2] == 2 else 45) and (line.seeds, line.scenarios) == (2, 30)
        assert line.safety_diff == pytest.approx(np.mean([a - b for a, b in np.array(pairs, int)]), abs=1e-5)
        assert line.safety_only_a == sum(a and not b for a, b in pairs)
        assert line.safety_low <= line.safety_diff <= line.safety_high
    unfinished(run, lambda row: False, unfinished=0)  # it went on to the end
    publish.publish(run, out)
    assert "Not finished" not in (out / "README.md").read_text()


@pytest.mark.parametrize("asked", [["rise"], ["absent"]], ids=["in one task", "nowhere"])
def test_an_unfinished_run_may_have_other_blocks_first(asked, run, tmp_path, capsys):
    """What was asked for is not there yet, in one task or in both; what was measured beside it is."""
    block = {"title": "", "rows": asked, "noise_models": ["step"], "noise_levels": [0, 1, 2], "envs": []}
    blocks = [block, {**block, "title": "Is it PC-BC?", "rows": ["pcbc"]}]
    gone = ("rise", ENVS[1])
    unfinished(run, lambda row: (row["agent"], row["env"]) == gone, unfinished=2, blocks=blocks)
    out = tmp_path / "out"
    assert publish.main([str(run), "--out", str(out), "--partial"]) == 0
    assert results_page.stale(out) == []
    assert report.main([str(out), "--out", str(tmp_path / "x")]) == 0
    assert capsys.readouterr().out.count("RISE ") == (3 if asked == ["rise"] else 0)
    page = (out / "README.md").read_text()
    assert page.count("Not finished") == 1 and page.count("### Is it PC-BC?") == 1


def test_what_failed_counts_as_left(run, tmp_path):
    """In an older record too, which does not count."""
    failed = [{"job": "train"}, {"job": "evaluate"}]
    unfinished(run, lambda row: row["agent"] == "pcbc", failed=failed)
    with pytest.raises(ValueError, match=r"failed: give the run's command again .* --partial"):
        publish.publish(run, tmp_path / "out")
    publish.publish(run, tmp_path / "out", partial=True)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["unfinished"] == 2 and "failed" not in record
    assert "2 pieces of work are left" in (tmp_path / "out" / "README.md").read_text()


def test_a_run_without_episodes_has_nothing_to_publish(run, tmp_path, capsys):
    (run / "episodes.parquet").unlink()
    (run / "run.json").write_text(json.dumps({**RECORD, "unfinished": 3}))
    assert publish.main([str(run), "--out", str(tmp_path / "out"), "--partial"]) == 2
    assert "has no episodes yet" in capsys.readouterr().err and not (tmp_path / "out").exists()


# --- what does not agree ---------------------------------------------------------------------------------------


def test_a_changed_row_is_noticed(published, capsys):
    rows = results.read_rows(published / "episodes.parquet").to_pydict()
    safe = rows["safe"][0] = not rows["safe"][0]
    rows["reached"][0] = safe and rows["arrived"][0]
    results.write_compact(published / "episodes.parquet", results.from_columns(rows))
    assert results_page.stale(published) == ["summary.csv", "comparisons.csv"]
    before = contents(published)
    assert publish.main([str(published), "--check"]) == 1
    error = capsys.readouterr().err
    assert f"{published}: summary.csv is not what the episodes say" in error and error.count("\n") == 2
    assert contents(published) == before


@pytest.mark.parametrize("block", results_page.BLOCKS)
def test_a_changed_block_is_noticed(published, block, capsys):
    page = published / "README.md"
    begin = results_page.BLOCKS[block].begin
    page.write_text(page.read_text().replace(begin, f"{begin}\n\nAll is well."))
    assert results_page.stale(published) == [f"README.md, block {block}"]


def test_changed_tables_are_noticed(published):
    table = published / "comparisons.csv"
    table.write_text(table.read_text().replace("step", "drift", 1))
    assert results_page.stale(published) == ["comparisons.csv"]


def test_words_outside_of_blocks_are_free(published, capsys):
    page = published / "README.md"
    page.write_text(page.read_text() + "\nMore.\n")
    assert publish.main([str(published), "--check"]) == 0
    assert "are what the episodes say" in capsys.readouterr().out


# --- errors ----------------------------------------------------------------------------------------------------


def test_what_cannot_be_published_ends_in_one_line(run, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()

    def refused(says, *arguments):
        assert publish.main([*map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1 and error.startswith("benchmarks.publish: ")
        assert not (out / "episodes.parquet").exists()

    refused("required: RUN_DIR")
    refused("did you mean '--out'", run, "--uot", out)
    refused("is not a folder", tmp_path / "absent", "--out", out)
    refused("not the folder of a finished run", out, "--out", tmp_path / "other")
    refused("name another folder", run, "--out", run)
    refused("cannot write", run, "--out", "/proc/nowhere")
    refused("cannot be read", out, "--check")
    (out / "README.md").write_text("# Mine\n")
    refused("must hold the lines", run, "--out", out)
    (out / "README.md").unlink()
    with sole_user(run):
        refused("in use by another process", run, "--out", out)
    for changes, says in (
        ({"failed": [{"job": "train"}]}, "failed: give the run's command again"),
        ({"plan": 3}, "not the record of a run"),
        ({"unfinished": "some"}, "not the record of a run"),
        ({"agents": [1]}, "not the record of a run"),
    ):
        (run / "run.json").write_text(json.dumps({**RECORD, **changes}))
        refused(says, run, "--out", out)
    (run / "run.json").write_text(json.dumps(RECORD))
    (run / "agents" / "v" / "rise-0.json").write_text("{}")
    refused("not the record of a training", run, "--out", out)


def test_the_command_explains_itself():
    command = [sys.executable, "-m", "benchmarks.publish", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "examples:" in done.stdout and "--out DIR" in done.stdout and "docs/results" in done.stdout


# --- settings ------------------------------------------------------------------------------------------------------


def test_settings_are_told_where_they_are_not_the_defaults():
    defaults = config_to_dict(make_agent("rise", ENVS[1]).config)
    entry = {"learned from": "24 episodes", "training time": "9 s"}
    training = {
        "rise": {ENVS[1]: {**entry, **defaults, "hidden": [256, 64], "updates": 40_000, "beta": 0.5}},
        "large": {ENVS[1]: {**entry, **defaults}},
        "foreign": {ENVS[1]: {**entry, "gain": 1.5}},
    }
    row = summarise(episodes())[0]
    rows = [replace(row, env=ENVS[1], agent=name) for name in ("rise", "large", "foreign", "expert")]
    text = results_page.settings_tables(rows, {"training": training, "variants": {"large": "rise"}})
    assert "| RISE | 24 episodes | `hidden` 256 × 64, `updates` 40,000, `beta` 0.5 |" in text
    assert "| large | 24 episodes | none |" in text and "| foreign | 24 episodes | `gain` 1.5 |" in text
    assert "9 s" not in text and "xpert" not in text
    assert results_page.settings_tables(rows, {"variants": {}}) == "No agent was trained."
