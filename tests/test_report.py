import json
import re
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from hand_made import make_rows

from benchmarks import labels, report, results, tables
from benchmarks.tables import SummaryRow
from rise_agents.files import sole_user

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


def row(
    env=VEHICLE,
    agent="rise",
    level=1.0,
    model="step",
    safe=0.859,
    reach=0.855,
    seeds=1,
    episodes=1000,
    against=(),
):
    """A row with intervals of ±2 points."""
    rates = (safe, safe - 0.02, min(safe + 0.02, 1.0), reach, reach - 0.02, min(reach + 0.02, 1.0))
    measured = (*rates, 0.976, 1.25, 87.345, safe, reach, 0.2)
    return SummaryRow(env, agent, model, level, seeds, episodes, *measured, *against)


SUMMARY = [
    row(level=0.0, safe=0.979),
    row(),
    row(agent="pcbc", level=0.0),
    row(agent="pcbc", safe=0.813, reach=0.812),
    row(env=PANDA, agent="expert", safe=0.55, reach=0.54),
]
RUN = {"command": "python -m benchmarks.run --agents rise pcbc", "training": {}}


def test_terminal_table_tells_every_row_and_fits_a_terminal():
    text = report.summary_table_text(SUMMARY, VEHICLE)
    lines = [line.split() for line in text.splitlines()]
    rows = [line for line in lines if line and line[0] in ("RISE", "PC-BC")]
    assert [line[:2] for line in rows] == [["RISE", "0"], ["PC-BC", "0"], ["RISE", "1"], ["PC-BC", "1"]]
    assert " ".join(rows[2]) == "RISE 1 85.9 [83.9–87.9] 85.5 [83.5–87.5] 97.6 1.25 87.3"
    assert text.startswith("Ground vehicle: fresh noise at every step, 1,000 episodes per row\n")
    assert max(map(len, text.splitlines())) <= 80
    assert "\x1b" not in text and "Panda" not in text


def test_terminal_table_names_the_noise_model_where_there_are_several():
    text = report.summary_table_text([row(), row(model="episode")], VEHICLE)
    assert "step 1" in text and "episode 1" in text


def test_terminal_table_of_an_env_without_results():
    with pytest.raises(
        ValueError, match="no results of parking-v0; there are some of RISE-GroundVehicle-v0, RISE-S"
    ):
        report.summary_table_text(SUMMARY, "parking-v0")


def test_page_states_the_findings_in_words():
    page = report.summary_markdown(SUMMARY, RUN)
    assert (
        "**Ground vehicle.** At noise level 1 (fresh noise at every step) RISE kept 85.9 % (83.9–87.9) of 1,000 "
        "episodes safe and reached the goal without collision in 85.5 % (83.5–87.5); "
        "PC-BC 81.3 % (79.3–83.3) and 81.2 % (79.2–83.2).\n"
    ) in page
    assert "**Franka Panda.** At noise level 1 (fresh noise at every step) Expert kept 55.0 %" in page


def test_page_has_a_well_formed_table_per_task_with_every_row():
    page = report.summary_markdown(SUMMARY, RUN)
    tables = re.findall(r"^### (.*)\n\n((?:\|.*\n)+)", page, flags=re.M)
    assert [title.partition(":")[0] for title, _ in tables] == ["Ground vehicle", "Franka Panda"]
    for (_, table), n_rows in zip(tables, (4, 1), strict=True):
        lines = table.splitlines()
        assert len(lines) == n_rows + 2 and {line.count("|") for line in lines} == {8}
    assert "| PC-BC | 1 | 81.3 [79.3–83.3] | 81.2 [79.2–83.2] | 97.6 | 1.25 | 87.3 |" in page


def test_page_shows_figures_and_links_films():
    assert "![Safety Rate and Reach Rate of every agent](comparison.png)" in report.summary_markdown(
        SUMMARY, RUN
    )
    page = report.summary_markdown(SUMMARY, RUN | {"figures": {"v/a.png": "Key frames", "v/a.mp4": "A film"}})
    assert "![Key frames](v/a.png)" in page and "\n[A film](v/a.mp4)" in page and "comparison.png" not in page


def test_page_says_how_agents_were_trained_and_how_to_repeat():
    facts = {
        "rise": {
            VEHICLE: {"beta": 0.03, "hidden": [128, 128], "n_demos": 2000, "transitions": 0},
            PANDA: {"frame": "hand", "train_env": "", "average": 0},
        }
    }
    agents = facts | {"pcbc": {"layer_norm": True, "epochs": 3}, "cppo": "not trained here", "expert": {}}
    page = report.summary_markdown(SUMMARY, RUN | {"training": agents})
    assert (
        "- **RISE**\n"
        "  - **Ground vehicle**: beta 0.03, hidden [128, 128], n demos 2,000, transitions all\n"
        "  - **Franka Panda**: frame hand, average 0\n"
        "- **PC-BC**: layer norm yes, epochs 3\n"
        "- C-PPO: not trained here\n"
        "- **Expert**\n"
    ) in page
    assert page.endswith("```sh\npython -m benchmarks.run --agents rise pcbc\n```\n")


def test_page_of_clean_readings_and_of_several_seeds():
    page = report.summary_markdown([row(level=0.0, seeds=5, episodes=5000)], RUN)
    assert "At noise level 0 (clean readings) RISE kept 85.9 % (83.9–87.9) of 5,000 episodes safe" in page
    assert "5,000 episodes per row of 5 training seeds" in page


def test_an_empty_summary_has_no_page():
    with pytest.raises(ValueError, match="empty"):
        report.summary_markdown([], RUN)


# --- claims --------------------------------------------------------------------------------------------------------

BEHIND = ("rise", -0.099, -0.136, -0.061, 1e-9, -0.102, -0.14, -0.064, 0.0123)
AHEAD = ("rise", 0.02, 0.001, 0.039, 0.04, 0.0, -0.0123, 0.0123, 1.0)


def test_page_states_how_the_first_agent_differs_from_every_other():
    summary = [row(), row(agent="pcbc", against=BEHIND), row(agent="expert-cbf", against=AHEAD)]
    page = report.summary_markdown(
        [*summary, row(level=0.0), row(agent="pcbc", level=0.0, against=AHEAD)], RUN
    )
    assert (
        "\n\n- RISE kept 9.9 points more episodes safe than PC-BC [6.1, 13.6] (p < 0.001), and reached the goal "
        "without collision in 10.2 points more [6.4, 14.0] (p = 0.012).\n"
        "- RISE kept 2.0 points fewer episodes safe than Expert (cbf) [−3.9, −0.1] (p = 0.04), and reached the goal "
        "without collision in as many [−1.2, 1.2], no difference that these episodes can show.\n\n"
    ) in page
    assert page.count("RISE kept") == 3  # one rate, two claims: nothing of level 0
    assert "exact McNemar test" in page and "of a bootstrap that draws scenarios anew. p:" in page
    assert "McNemar" not in report.summary_markdown([row()], RUN)


def test_an_interval_that_ends_at_0_holds_it():
    for ends in ((0.0, 0.2), (-0.2, 0.0)):
        against = ("rise", 0.1, *ends, 0.01, 0.1, *ends, 0.01)
        page = report.summary_markdown([row(), row(agent="pcbc", against=against)], RUN)
        assert page.count("no difference that these episodes can show") == 2


def test_each_noise_model_speaks_at_its_own_headline_level_the_paper_s_first():
    summary = [
        *(
            row(),
            row(level=2.0),
            row(agent="pcbc", against=BEHIND),
            row(agent="pcbc", level=2.0, against=BEHIND),
        ),
        *(row(model="drift", level=0.5), row(agent="pcbc", model="drift", level=0.5, against=AHEAD)),
    ]
    page = report.summary_markdown(summary, RUN)
    findings = re.findall(r"At noise level (\S+) \((.*?)\) RISE.*\n\n- RISE kept (\S+) points", page)
    assert findings == [("1", "fresh noise at every step", "9.9"), ("0.5", "a drifting error", "2.0")]


def test_page_names_the_intervals_in_its_brackets():
    one = report.summary_markdown([row(), row(agent="pcbc", against=BEHIND)], RUN)
    assert "In brackets: 95 % Wilson intervals over all episodes." in one
    several = report.summary_markdown([row(seeds=5), row(seeds=5, agent="pcbc", against=BEHIND)], RUN)
    assert (
        "In brackets: 95 % intervals of a bootstrap that draws training seeds and scenarios anew" in several
    )
    assert "of a bootstrap that draws training seeds and scenarios anew, each for itself. p:" in several


@pytest.mark.parametrize(
    ("difference", "text"),
    [(0.099, "9.9"), (-0.003, "−0.3"), (0.0, "0.0"), (-1.0, "−100.0"), (-0.0002, "−0.02")],
)
def test_differences_are_told_in_points(difference, text):
    assert labels.points(difference) == text


@pytest.mark.parametrize(
    ("p", "text"),
    [(0.0, "p < 0.001"), (0.00099, "p < 0.001"), (0.001, "p = 0.001"), (0.4567, "p = 0.46"), (1.0, "p = 1")],
)
def test_p_values_have_two_digits(p, text):
    assert labels.p_value(p) == text


# --- from episodes to pages ------------------------------------------------------------------------------------------

RECORD = {
    "command": RUN["command"],
    "rows": ["rise", "pcbc"],
    "training": {"rise": {VEHICLE: {"beta": 0.03}}},
}
FILES = {"summary.csv", "comparisons.csv", "summary.md", "comparison.png", "noise_curve.png", "report.html"}


def episodes(models=("step",)):
    rng = np.random.default_rng(0)
    return pa.concat_tables(
        [
            make_rows(40, agent=agent, noise_model=model, train_seed=seed, safe=rng.random(40) < rate)
            for agent, rate in (("rise", 0.95), ("pcbc", 0.4))
            for model in models
            for seed in range(2)
        ]
    )


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    results.write_rows(folder / "episodes.parquet", episodes())
    (folder / "run.json").write_text(json.dumps({**RECORD, "plan": {"agents": ["rise", "pcbc"]}}))
    return folder


def test_a_report_is_made_from_a_run_folder_alone(folder, capsys):
    before = {path.name for path in folder.iterdir()}
    assert report.main([str(folder)]) == 0
    assert {path.name for path in folder.iterdir()} - before - {".lock"} == FILES
    printed = capsys.readouterr().out
    assert "RISE" in printed and printed.endswith(f"Written: {folder}\n")
    summary, comparisons = tables.analyse(episodes(), ("rise", "pcbc"))
    tables.write_table(folder / "expected.csv", SummaryRow, summary)
    assert (folder / "expected.csv").read_bytes() == (folder / "summary.csv").read_bytes()
    tables.write_table(folder / "expected.csv", tables.ComparisonRow, comparisons)
    assert (folder / "expected.csv").read_bytes() == (folder / "comparisons.csv").read_bytes()
    page = (folder / "summary.md").read_text()
    assert "- RISE kept" in page and "beta 0.03" in page and RUN["command"] in page


def test_the_same_episodes_give_the_same_files(folder, tmp_path):
    for name in "ab":
        assert report.main([str(folder), "--out", str(tmp_path / name)]) == 0
    assert {path.name for path in (tmp_path / "a").iterdir()} == FILES
    for name in FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert not (folder / "summary.csv").exists()


def test_a_report_is_made_from_a_file_of_episodes(tmp_path):
    results.write_rows(tmp_path / "mine.parquet", episodes())
    assert report.main([str(tmp_path / "mine.parquet"), "--out", str(tmp_path / "tables")]) == 0
    page = (tmp_path / "tables" / "summary.md").read_text()
    assert "- PC-BC kept" in page  # by name, where nobody says which is first
    assert "How to repeat" not in page and "How the agents were trained" not in page


def test_records_of_former_versions_are_read(folder):
    (folder / "run.json").write_text(
        json.dumps({"command": "make bench", "plan": {"agents": ["rise", "pcbc"]}})
    )
    assert report.main([str(folder)]) == 0
    assert "- RISE kept" in (folder / "summary.md").read_text()


def test_variants_are_called_as_the_run_called_them(folder):
    rows = episodes().to_pydict()
    rows["agent"] = ["told-in-run" if name == "pcbc" else name for name in rows["agent"]]
    results.write_rows(folder / "episodes.parquet", results.from_columns(rows))
    variants = {
        "told-in-run": {"agent": "pcbc", "label": "PC-BC, told"},
        "untold": {"agent": "pcbc", "label": ""},
    }
    plan = {"agents": ["rise", "told-in-run"], "variants": variants}
    (folder / "run.json").write_text(json.dumps({"command": "make bench", "plan": plan}))
    assert report.main([str(folder)]) == 0
    page = (folder / "summary.md").read_text()
    assert "than PC-BC, told" in page and "told-in-run" not in page


def test_every_noise_model_has_its_figures(tmp_path):
    report.publish(episodes(("step", "drift", "step+delay:2", "episode:0.5@radius")), RECORD, tmp_path)
    marks = ("", "-drift", "-step-delay-2", "-episode-0.5-radius")
    figures = {f"{name}{mark}.png" for name in ("comparison", "noise_curve") for mark in marks}
    assert {path.name for path in tmp_path.glob("*.png")} == figures
    page = (tmp_path / "summary.md").read_text()
    assert "![Safety Rate and Reach Rate of every agent: a drifting error](comparison-drift.png)" in page
    assert all(f"({name})" in page for name in figures)


@pytest.mark.parametrize(
    ("record", "says"),
    [
        (b"{", "run.json is not the record"),
        (b"[]", "not the record"),
        (b"{}", "not the record"),
        (b'{"command": "", "plan": []}', "not the record"),
        (b'{"command": "", "plan": {"agents": [], "variants": {"x": 1}}}', "not the record"),
        (b"\xff", "not the"),
    ],
)
def test_foreign_records_are_refused_in_one_line(folder, record, says, capsys):
    (folder / "run.json").write_bytes(record)
    assert report.main([str(folder)]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and error.startswith("benchmarks.report: ")
    assert not (folder / "summary.csv").exists()


def test_what_cannot_be_reported_ends_in_one_line(folder, tmp_path, capsys):
    (tmp_path / "text.parquet").write_text("hello")
    results.write_rows(tmp_path / "none.parquet", episodes()[:0])
    results.write_rows(tmp_path / "twice.parquet", pa.concat_tables([episodes(), episodes()]))
    for arguments, says in (
        ([], "required: RUN"),
        ([str(tmp_path / "absent")], "cannot be read"),
        ([str(tmp_path)], "cannot be read"),
        ([str(tmp_path / "text.parquet")], "cannot be read"),
        ([str(tmp_path / "none.parquet")], "no episodes"),
        ([str(tmp_path / "twice.parquet")], "occurs twice"),
        ([str(folder), "--uot", "x"], "did you mean '--out'"),
        ([str(folder), "--out", "/proc/nowhere"], "cannot write"),
    ):
        assert report.main(arguments) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1
    with sole_user(folder):
        assert report.main([str(folder)]) == 2
    assert "in use by another process" in capsys.readouterr().err
    assert not FILES & {path.name for path in (*tmp_path.iterdir(), *folder.iterdir())}


def test_the_command_explains_itself():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.report", "--help"], capture_output=True, text=True, check=True
    )
    assert "examples:" in done.stdout and "--out DIR" in done.stdout
