"""The page of a run: its numbers are those of the tables, it loads nothing, what it carries decodes to the truth."""

from __future__ import annotations

import base64
import csv
import gzip
import json
import re
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects as go
import pytest
from hand_made import make_rows

from benchmarks import charts, explorer, html_report, report, trajectories
from benchmarks.explorer import choose, decoded
from benchmarks.html_report import PAGE, write_page
from benchmarks.labels import percent
from benchmarks.plots import METRICS
from benchmarks.results import write_rows
from benchmarks.tables import SummaryRow, write_table
from benchmarks.trajectories import Trajectory
from rise_envs.task import task_of

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
RUN = {"command": "python -m benchmarks.run --agents rise pcbc", "versions": {"numpy": "2.4"}}


def row(env=VEHICLE, agent="rise", level=1.0, safe=0.859, reach=0.855, model="step"):
    rates = (safe, safe - 0.02, min(safe + 0.02, 1.0), reach, reach - 0.02, min(reach + 0.02, 1.0))
    return SummaryRow(env, agent, model, level, 1, 1000, *rates, 0.976, 1.25, 87.345, safe, reach, 0.2)


SUMMARY = [
    row(level=0.0, safe=0.979),
    row(),
    row(agent="pcbc", level=0.0, safe=0.913),
    row(agent="pcbc", safe=0.813, reach=0.712),
    row(env=PANDA, safe=0.661, reach=0.655),
    row(env=PANDA, agent="pcbc", safe=0.55, reach=0.54),
]


def episode(env: str, steps: int, number: int) -> Trajectory:
    """A smooth made-up one with the shapes of a task."""
    task, rng = task_of(env), np.random.default_rng(number)
    reading = task.widths["obstacle"]

    def walk(rows: int, width: int) -> np.ndarray:
        return rng.normal(size=width) + np.cumsum(rng.normal(0, 0.05, (rows, width)), axis=0)

    whole = {"state": walk(steps + 1, task.state_size), "goal": np.tile(walk(1, task.dim), (steps + 1, 1))}
    whole |= {"true": walk(steps + 1, reading), "reading": 9 * walk(steps + 1, reading)}
    whole |= {"action": walk(steps, task.dim), "clearance": walk(steps + 1, 1)[:, 0]}
    cost = (whole["clearance"][1:] < 0).astype(float)
    return Trajectory(**whole, cost=cost, reward=np.ones(steps), arrived=np.array(True))


@pytest.fixture(scope="module")
def traced(tmp_path_factory):
    """A folder with made-up trajectories of two agents and tasks, and what was stored."""
    folder = tmp_path_factory.mktemp("traced")
    stored, names = {}, []
    for env in (VEHICLE, PANDA):
        for agent in ("rise", "pcbc"):
            episodes = {n: episode(env, 5 + n, 10 * len(names) + n) for n in (3, 0, 8)}
            facts = {"env": env, "row": agent, "noise_model": "step", "noise_level": 1.0, "differing": [5]}
            facts |= {"why": ["critical", "drawn", "drawn"], "low": [-1.0] * 3, "high": [1.0] * 3}
            names.append(f"trajectories/{env}-{agent}.rise")
            trajectories.save(folder / names[-1], episodes, facts)
            stored |= {(env, agent, n): each for n, each in episodes.items()}
    return folder, names, stored


@pytest.fixture(scope="module")
def page(traced):
    folder, names, _ = traced
    run = RUN | {"trajectories": names, "rows": ["rise", "pcbc"]}
    return write_page(SUMMARY, run, folder, folder).read_text()


class Tags(HTMLParser):
    """All tags of a page with their attributes, and the rows of its tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self.inside = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.inside = tag in ("td", "th")
        if tag == "tr":
            self.rows.append([])
        if self.inside:
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        self.inside = self.inside and tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.rows[-1][-1] += data


def payload(page: str, name: str) -> bytes:
    found = re.search(rf'<script type="text/plain" id="{name}">([^<]*)</script>', page)
    assert found is not None
    return gzip.decompress(base64.b64decode(found[1]))


def test_the_numbers_are_those_of_the_table(page, tmp_path):
    write_table(tmp_path / "summary.csv", SummaryRow, SUMMARY)
    rows = {tuple(cells[:2]) + tuple(cells[2:4]) for cells in Tags(page).rows if len(cells) == 7}
    with (tmp_path / "summary.csv").open() as file:
        for line in csv.DictReader(file):
            name = {"rise": "RISE", "pcbc": "PC-BC"}[line["agent"]]
            rates = [
                f"{percent(float(line[f'{key}_rate']))} "
                f"[{percent(float(line[f'{key}_low']))}–{percent(float(line[f'{key}_high']))}]"
                for key in ("safety", "reach")
            ]
            assert (name, f"{float(line['noise_level']):g}", *rates) in rows
    found = (
        "<strong>Ground vehicle.</strong> At noise level 1 (fresh noise at every step) RISE kept 85.9\xa0%"
    )
    assert found in page  # a sign of per cent that begins a line says nothing
    assert "python -m benchmarks.run --agents rise pcbc" in page and "numpy 2.4" in page


def test_charts_have_the_numbers_of_the_table_and_are_such_that_plotly_takes_them(page):
    drawn = json.loads(payload(page, "data"))["charts"]
    ids = {attributes.get("id") for _, attributes in Tags(page).tags}
    assert set(drawn) <= ids
    for chart in drawn.values():
        for data in chart.get("choices", {"": chart.get("data")}).values():
            go.Figure(data=data, layout=chart["layout"])  # raises for what plotly does not know
    (bars,) = drawn[f"bars-{VEHICLE}-safety"]["data"]
    assert bars["y"] == ["RISE", "PC-BC"] and bars["x"] == [85.9, 81.3]
    assert bars["error_x"]["array"] == pytest.approx([2, 2]) and bars["error_x"][
        "arrayminus"
    ] == pytest.approx([2, 2])
    line = drawn[f"lines-{VEHICLE}-safety"]["data"][1]
    assert (line["name"], line["x"], line["y"]) == ("PC-BC", [0, 1], [91.3, 81.3])
    levels = drawn[f"pareto-{VEHICLE}"]["choices"]
    assert list(levels) == ["noise level 1", "noise level 0", "all noise levels"]
    *marks, best = levels["noise level 1"]
    assert [(mark["name"], mark["x"], mark["y"]) for mark in marks] == [
        ("RISE", [85.9], [85.5]),
        ("PC-BC", [81.3], [71.2]),
    ]
    assert (best["x"], best["y"]) == ([85.9], [85.5])
    assert levels["all noise levels"][0]["x"] == [97.9, 85.9]
    assert list(drawn[f"pareto-{PANDA}"]["choices"]) == ["noise level 1"]


def test_the_noise_of_the_paper_comes_first_in_words_charts_and_tables(tmp_path):
    rows = [
        row(agent=agent, model="episode", level=level) for agent in ("rise", "pcbc") for level in (1.0, 2.0)
    ]
    rows += [row(), row(agent="pcbc")]
    text = write_page(rows, RUN, tmp_path, tmp_path).read_text()
    findings, figures, tables = (
        text.split(f'<section id="{name}">')[1] for name in ("findings", "figures", "tables")
    )
    for part in (findings, figures, tables):
        assert part.index("fresh noise at every step") < part.index("one constant error per episode")
    # A table for each, so no row has to say which it is of.
    assert [cells[1] for cells in Tags(tables).rows] == [
        "Noise level",
        "1",
        "1",
        "Noise level",
        "1",
        "1",
        "2",
        "2",
    ]
    (begins,) = re.findall(
        r'<tr class="begins">(.*?)</tr>', tables.partition("one constant error")[2], re.DOTALL
    )
    assert "RISE" in begins and ">2<" in begins


def test_a_run_that_is_not_finished_says_so(tmp_path):
    assert "Not finished" not in write_page(SUMMARY, RUN, tmp_path, tmp_path).read_text()
    text = write_page(SUMMARY, RUN | {"unfinished": 3}, tmp_path, tmp_path).read_text()
    assert text.index("3 pieces of work are left") < text.index("RISE kept")


def test_the_page_loads_nothing(page):
    for tag, attributes in Tags(page).tags:
        for name in ("src", "srcset", "href", "data", "poster", "action", "background"):
            value = attributes.get(name) or ""
            plain_link = tag == "a" and name == "href"
            assert plain_link or not value or value.startswith("data:"), f"<{tag} {name}={value[:60]}>"
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
    ours = "".join(html_report._asset(name) for name in (*html_report._SCRIPTS, "style.css"))
    assert not re.search(
        r"https?:|@import|url\(|\bimport\b|fetch\(|XMLHttpRequest|WebSocket|sendBeacon", ours
    )
    policy = next(
        each["content"]
        for tag, each in Tags(page).tags
        if each.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'; ") and "http" not in policy


def test_what_the_page_carries_decodes_to_the_trajectories(page, traced):
    _, _, stored = traced
    numbers, found = payload(page, "numbers"), 0
    for task in json.loads(payload(page, "data"))["tasks"]:
        for each in task["episodes"]:
            truth = stored[task["env"], task["agents"][each["agent"]]["row"], each["scenario"]]
            assert each["steps"] == len(truth.action) and each["cost"] == truth.cost.sum()
            assert each["least"] == pytest.approx(truth.clearance[1:].min(), abs=1e-4)
            at = each["at"]
            for part in task["parts"]:
                values = decoded(numbers[at:], each["steps"] + 1, part["width"], part["scale"])
                at += values.size * 2
                expected = {
                    "true": truth.true,
                    "reading": truth.reading,
                    "clearance": truth.clearance[:, None],
                }
                expected |= {"position": task_of(task["env"]).pose(truth.state)[0]}
                if part["name"] in expected:
                    np.testing.assert_allclose(values, expected[part["name"]], atol=part["scale"])
                assert part["scale"] < 2e-3
            found += 1
    assert found == len(stored) == 12


def test_numbers_that_jump_from_end_to_end_survive():
    values = np.array([[1.0, -1.0], [-1.0, 1.0], [1.0, 0.5], [0.0, -1.0]])
    scale = 1 / 32767
    np.testing.assert_allclose(decoded(explorer._encoded(values, scale), 4, 2, scale), values, atol=scale)


def test_critical_scenarios_are_those_of_all_agents_in_turn():
    clear = {
        "rise": [0.5, 0.1, 0.4, 0.3, 0.9, 0.8],
        "pcbc": [0.2, 0.6, -0.3, 0.5, 0.7, 0.9],
        "expert-cbf": [9, 9, 9, 9, 9, -9],
    }
    rows = [make_rows(6, agent=name, min_clearance=np.array(values, float)) for name, values in clear.items()]
    # rise: 1, 3, 2, …; pcbc: 2, 0, 3, …; an expert names none. Drawn are the first others.
    assert choose(rows, 3) == {
        1: "critical",
        2: "critical",
        3: "critical",
        0: "drawn",
        4: "drawn",
        5: "drawn",
    }
    assert choose(rows[2:], 1) == {5: "critical", 0: "drawn"}


def test_the_front_is_who_is_beaten_by_nobody():
    points = [(0.9, 0.5), (0.8, 0.7), (0.8, 0.6), (0.5, 0.9), (0.4, 0.9), (0.9, 0.5)]
    assert charts.front(points) == [(0.5, 0.9), (0.8, 0.7), (0.9, 0.5)]


def test_training_curves_are_thinned_and_can_be_chosen():
    points = [{"share": i / 1000, "steps": i, "loss": 1 / (1 + i), "cost_rate": 0.5} for i in range(1000)]
    points.append({"share": 1.0, "loss": float("nan")})  # for which JSON has no word
    chart = charts.training("RISE", {"seed 0": points, "seed 1": points[:3]}, "#0072B2")
    assert chart is not None and list(chart["choices"]) == ["loss", "cost rate"]
    first, second = chart["choices"]["loss"]
    assert (
        np.isfinite(first["y"]).all()
        and len(first["x"]) <= 250
        and first["y"][0] == 1.0
        and len(second["x"]) == 3
    )
    go.Figure(data=chart["choices"]["loss"], layout=chart["layout"])
    assert charts.training("C-PPO", {}, "#000") is None


def test_training_curves_come_from_beside_the_checkpoints(tmp_path):
    (tmp_path / "agents").mkdir()
    record = {
        "seconds": 1.0,
        "device": "cpu",
        "curve": [{"share": 0.5, "loss": 2.0}, {"share": 1.0, "loss": 1.0}],
    }
    (tmp_path / "agents" / "rise-seed0.json").write_text(json.dumps(record))
    run = RUN | {"agents": {VEHICLE: {"rise-seed0": "agents/rise-seed0.rise", "pcbc-seed0": "gone.rise"}}}
    run |= {"training": {"rise": {VEHICLE: {"beta": 0.1}}}}
    text = write_page(SUMMARY, run, tmp_path, tmp_path).read_text()
    drawn = json.loads(payload(text, "data"))["charts"]
    assert [name for name in drawn if name.startswith("training")] == [f"training-{VEHICLE}-rise"]
    assert drawn[f"training-{VEHICLE}-rise"]["choices"]["loss"][0]["y"] == [2.0, 1.0]
    assert "beta 0.1" in text
    agents = run["agents"][VEHICLE] | {"rise-mean-seed0": "agents/rise-seed0.rise"}  # which no training made
    both = [*SUMMARY, row(agent="rise-mean")]
    text = write_page(both, run | {"agents": {VEHICLE: agents}}, tmp_path, tmp_path).read_text()
    assert text.count('id="training-') == 1
    (tmp_path / "agents" / "rise-seed0.json").write_text("[]")
    with pytest.raises(ValueError, match=r"rise-seed0\.json is not the record of a training"):
        write_page(SUMMARY, run, tmp_path, tmp_path)


def test_without_trajectories_the_page_says_so(tmp_path):
    for names in ([], ["gone.rise"]):
        text = write_page(SUMMARY, RUN | {"trajectories": names}, tmp_path, tmp_path).read_text()
        assert "There are none to watch here" in text and "--no-videos" in text
        assert 'id="player"' not in text


@pytest.mark.parametrize(
    ("options", "imports"),
    [
        ("--import a.py 'my b.py' --agents rise --import=c.py", " --import a.py 'my b.py' --import=c.py"),
        ("--agents rise", ""),
        ("--agents 'an open quote", ""),
    ],
)
def test_episodes_are_replayed_from_this_folder_with_the_modules_of_the_run(
    traced, tmp_path, options, imports
):
    folder, names, _ = traced
    run = {"command": f"python -m benchmarks.run {options}", "trajectories": names}
    tags = Tags(write_page(SUMMARY, run, folder, tmp_path).read_text()).tags
    assert [each["data-run"] for _, each in tags if "data-run" in each] == [f"{folder}{imports}"]


def test_an_environment_of_one_s_own_must_be_imported(tmp_path):
    facts = {"env": "Mine-v0", "row": "rise", "noise_model": "step", "noise_level": 1.0, "differing": []}
    facts |= {"why": ["drawn"], "low": [-1.0] * 2, "high": [1.0] * 2}
    trajectories.save(tmp_path / "a.rise", {0: episode(VEHICLE, 5, 0)}, facts)
    with pytest.raises(ValueError, match="no environment 'Mine-v0' is registered: --import the module"):
        write_page(SUMMARY, RUN | {"trajectories": ["a.rise"]}, tmp_path, tmp_path)


def test_names_are_words_and_no_markup(tmp_path):
    hostile = '<img src=x onerror="alert(1)"></script>'
    text = write_page([row(agent=hostile)], {"command": hostile}, tmp_path, tmp_path).read_text()
    assert "<img" not in text.partition("<style>")[2].partition("</style>")[2]
    assert "&lt;img" in text


def test_blocks_have_tables_of_their_own(tmp_path):
    blocks = [
        {"title": "", "rows": ["rise"], "noise_models": ["step"], "noise_levels": [0.0, 1.0], "envs": []},
        {
            "title": "Is it the encoder?",
            "rows": ["pcbc"],
            "noise_models": ["step"],
            "noise_levels": [1.0],
            "envs": [],
        },
    ]
    text = write_page(SUMMARY, RUN | {"blocks": blocks}, tmp_path, tmp_path).read_text()
    assert "<details><summary>Is it the encoder?</summary>" in text
    assert text.index("85.9 [83.9") < text.index("Is it the encoder?") < text.index("81.3 [79.3")


def test_the_same_run_gives_the_same_page(traced, page):
    folder, names, _ = traced
    again = write_page(SUMMARY, RUN | {"trajectories": names, "rows": ["rise", "pcbc"]}, folder, folder)
    assert again.read_text() == page


def test_the_page_is_small_and_says_whose_charts_they_are(page):
    assert len(page) < 3_500_000
    assert "plotly.js" in page and "MIT licence" in page
    assert b"Licensed under the MIT license" in payload(page, "plotly")[:400]


def test_the_report_command_writes_the_page(tmp_path, capsys):
    write_rows(tmp_path / "episodes.parquet", make_rows(6))
    assert report.main([str(tmp_path)]) == 0
    assert "RISE" in (tmp_path / PAGE).read_text()
    assert "Written" in capsys.readouterr().out


def test_damaged_trajectories_end_in_one_line(tmp_path, capsys):
    write_rows(tmp_path / "episodes.parquet", make_rows(6))
    plan = {"agents": ["rise"], "noise_models": ["step"], "variants": {}}
    (tmp_path / "run.json").write_text(json.dumps({"command": "c", "plan": plan, "trajectories": ["a.rise"]}))
    (tmp_path / "a.rise").write_bytes(b"nothing")
    assert report.main([str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "a.rise cannot be read as trajectories" in error and error.count("\n") == 1


def test_every_metric_has_its_chart(page):
    drawn = json.loads(payload(page, "data"))["charts"]
    assert {f"bars-{env}-{metric.key}" for env in (VEHICLE, PANDA) for metric in METRICS} <= set(drawn)
