"""The pages keep their word: snippets run, links lead somewhere, tables agree with the code, doctests pass."""

from __future__ import annotations

import csv
import doctest
import importlib
import inspect
import re
import runpy
import shlex
from collections import defaultdict
from dataclasses import fields
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.configs import FOLDER, SHIPPED, read
from benchmarks.presets import PRESETS
from benchmarks.replay import parser as replay_parser
from benchmarks.results import SCHEMA
from benchmarks.run import parser, plan_of
from benchmarks.speed.page import BLOCK
from benchmarks.speed.rows import ROWS
from benchmarks.tables import ComparisonRow, SummaryRow
from benchmarks.tune import ranking
from benchmarks.tune.__main__ import parser as tune_parser
from rise_agents import AGENTS, agent_class, readings
from rise_agents.belief.agent import Config as BeliefConfig
from rise_agents.cloning import CloningConfig
from rise_agents.experts import EXPERTS
from rise_agents.filters import FILTERS
from rise_agents.pcbc import Config as PCBCConfig
from rise_agents.rise import Config as RiseConfig
from rise_agents.seeds import SPLITS
from rise_envs import ENVS, NOISE_MODELS, STAND_INS, make_noise
from rise_envs.task import env_class, task_of

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
TASKS = [env_id for env_id in ENVS if env_id not in STAND_INS]  # what is benchmarked
MADE = DOCS / "reference"  # by the build of the site
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PAGES += [page for page in sorted(DOCS.rglob("*.md")) if MADE not in page.parents]
TUTORIALS = [DOCS / "quickstart.md", *sorted((DOCS / "tutorials").glob("*.md"))]  # commands are run, too
PICTURES = {DOCS / "images" / "vehicle.png", DOCS / "images" / "panda.png"}  # drawn from a finished run
PACKAGES = ("rise_envs", "rise_agents", "benchmarks")

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")
_CODE = re.compile(r"`([^`]+)`")

Table = tuple[list[str], list[list[str]]]  # header and rows, each a list of cells


def page_id(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


# --- reading the pages -----------------------------------------------------------------------------------------


def prose(page: Path) -> str:
    """A page without its code blocks."""
    return _FENCE.sub("", page.read_text())


def plain(cell: str) -> str:
    """A table cell as a reader sees it: the words of links, no backticks."""
    return _LINK.sub(r"\1", cell).replace("`", "").strip()


def tables(page: Path) -> list[Table]:
    """All tables of a page, cells as written."""
    blocks = re.findall(r"(?:^\|.*\|\n)+", prose(page) + "\n", re.MULTILINE)
    split = [[[cell.strip() for cell in line[1:-1].split("|")] for line in b.splitlines()] for b in blocks]
    return [(rows[0], rows[2:]) for rows in split]


def table(page: str, *header: str) -> list[list[str]]:
    """The rows, in plain words, of the one table of ``docs/page`` whose header begins with these cells."""
    found = [rows for head, rows in tables(DOCS / page) if tuple(map(plain, head))[: len(header)] == header]
    assert len(found) == 1, f"docs/{page} has {len(found)} tables that begin with the columns {header}"
    return [[plain(cell) for cell in row] for row in found[0]]


def columns_after(page: str, marker: str) -> list[str]:
    """The first column of the first table after the line that begins with ``marker``."""
    text = (DOCS / page).read_text()
    rest = text[text.index(f"\n{marker}") :]
    lines = re.search(r"(?:^\|.*\|\n)+", rest, re.MULTILINE)
    assert lines is not None
    return [plain(line.split("|")[1]) for line in lines[0].splitlines()[2:]]


def anchors(page: Path) -> set[str]:
    """What links to the headings of a page are called."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", plain(h)).lower().replace(" ", "-") for h in headings}


def member(file: Path, name: str) -> Any:
    """``name`` (dots allowed) in the module that ``file`` is."""
    module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    return reduce(getattr, name.split("."), importlib.import_module(module))


# --- snippets, links, doctests ---------------------------------------------------------------------------------


def script(page: Path, folder: Path) -> str:
    """What a reader of a page would run, at the lines of the page, so that tracebacks name them.

    Python as it stands; blocks that are marked ``file=NAME`` are saved in ``folder``; of the commands in tutorials
    those that say where their output goes.
    """
    lines, inside, saved, command = [], "", None, ""
    for line in page.read_text().splitlines():
        fence = re.fullmatch(r"```(\w*)(?: file=(\S+))?", line)
        if inside:
            if fence:
                inside, saved = "", None
            elif saved:
                saved.write_text(saved.read_text() + line + "\n")
        elif fence:
            inside = fence[1] or "text"
            saved = folder / fence[2] if fence[2] else None
            if saved:
                saved.write_text("")
        runs = inside == "python" and not fence and not saved
        lines.append(line if runs else "")
        if inside == "sh" and page in TUTORIALS:
            command += line.removesuffix("\\")
            if line.endswith("\\"):
                continue
            if command.startswith("rise-bench") and "--out" in command:
                lines[-1] = f"assert not __import__('benchmarks.cli').cli.main({shlex.split(command)[1:]})"
            command = ""
    return "\n".join(lines)


@pytest.mark.parametrize("page", [p for p in PAGES if "```python" in p.read_text()], ids=page_id)
def test_snippets_run(page, tmp_path, monkeypatch, own_names):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(DOCS)  # paths on the pages are those of the repository
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    path = tmp_path / f"{page.stem}_page.py"
    path.write_text(script(page, tmp_path))
    runpy.run_path(str(path))


def tutorial_commands() -> list[str]:
    """All commands of the benchmark that tutorials name, whether or not they are run."""
    text = "\n".join(page.read_text() for page in TUTORIALS).replace("\\\n", " ")
    return [line for line in text.splitlines() if line.startswith("rise-bench run")]


@pytest.mark.parametrize("command", tutorial_commands())
def test_commands_of_tutorials_are_accepted(command, monkeypatch, tmp_path, own_names):
    monkeypatch.chdir(tmp_path)
    if "linear.py" in command:
        script(DOCS / "tutorials" / "agent.md", tmp_path)  # saves the file
    plan_of(parser().parse_args(shlex.split(command)[2:]))


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_to_files_and_headings_that_exist(page):
    for words, target in _LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if DOCS / "reference" in file.parents:  # is made, and links to it are checked, by `make docs`
            continue
        assert file.exists() or file in PICTURES, f"{page_id(page)}: [{words}]({target})"
        assert not anchor or anchor in anchors(file), f"{page_id(page)}: no heading {target}"


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_names_that_link_to_a_module_are_in_it(page):
    for words, target in _LINK.findall(prose(page)):
        if target.endswith(".py") and re.fullmatch(r"`[\w.]+`", words):
            assert member((page.parent / target).resolve(), words.strip("`")) is not None


DOCTESTED = [
    file
    for package in PACKAGES
    for file in sorted((ROOT / package).rglob("*.py"))
    if re.search(r"^\s*>>> ", file.read_text(), re.MULTILINE)
]


@pytest.mark.parametrize("file", DOCTESTED, ids=page_id)
def test_doctests(file):
    parts = file.relative_to(ROOT).with_suffix("").parts
    module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
    result = doctest.testmod(module)
    assert result.attempted > 0
    assert result.failed == 0


# --- environments ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def environment_table() -> dict[str, list[str]]:
    """Row name → one cell per environment, in the order of the registry."""
    return {row[0]: row[1:] for row in table("environments.md", "", *ENVS)}


@pytest.mark.parametrize("place", range(len(ENVS)), ids=list(ENVS))
def test_the_table_of_environments_agrees_with_them(environment_table, place):
    env_id, said = list(ENVS)[place], {name: cells[place] for name, cells in environment_table.items()}
    entry, vector_entry, steps = ENVS[env_id]
    task, env = task_of(env_id), env_class(env_id)()
    try:
        assert said["class"] == entry.partition(":")[2]
        assert said["steps per episode"] == str(steps)
        assert said["time step"] == f"{task.dt:g} s"
        assert said["reached within"] == f"{task.goal_radius:g} m"
        low, high = (
            ", ".join(f"{x:g}" for x in bound) for bound in (env.action_space.low, env.action_space.high)
        )
        assert said["action bounds"].replace("−", "-") == f"[{low}] to [{high}]"
        for key, space in env.observation_space.items():
            assert said[key].startswith(f"{space.shape}: ".replace("'", "")), key
        assert (said["batched form"] == "native") == (vector_entry is not None)
        assert said["render_mode"] == (", ".join(env.metadata["render_modes"]) or "none")
    finally:
        env.close()


def test_arguments_of_environments():
    for env_id in ENVS:
        known = inspect.signature(env_class(env_id)).parameters
        said = {name for name, _, note in table("environments.md", "argument", "default")}
        assert set(known) <= said
        assert said - set(known) <= {"n_obstacles"}


# --- noise -----------------------------------------------------------------------------------------------------


def test_the_table_of_noise_models_agrees_with_the_registry():
    rows = table("noise.md", "name", "parameter (default)")
    assert [row[0] for row in rows] == list(NOISE_MODELS)
    for name, parameter, *_ in rows:
        default = re.search(r"\((.+)\)", parameter)
        assert default is not None
        assert make_noise(f"{name}:{default[1]}") == make_noise(name)


def test_the_units_of_noise_are_those_that_environments_publish():
    rows = table("noise.md", "environment", "position (m)")
    assert [row[0] for row in rows] == list(ENVS)
    for env_id, *said in rows:
        task = task_of(env_id)
        position, velocity, radius = task.split(np.array([task.noise_scale]))
        for words, values in zip(said, (position, velocity, radius), strict=True):
            assert np.all(values == float(words))


# --- agents ----------------------------------------------------------------------------------------------------


def test_the_table_of_agents_agrees_with_the_registry():
    rows = table("agents.md", "name", "class", "learns from")
    assert [row[0] for row in rows] == list(AGENTS)
    for name, kind, source, _ in rows:
        assert AGENTS[name].endswith(f":{kind}")
        assert agent_class(name).learns_from in source


def test_the_table_of_experts_agrees_with_the_registry():
    rows = table("agents.md", "environment", "name", "class")
    assert {(env, name): kind for env, name, kind, _ in rows} == {
        key: path.partition(":")[2] for key, path in EXPERTS.items()
    }


def test_the_table_of_filters_agrees_with_the_registry():
    rows = table("agents.md", "name", "class", "method")
    assert {name: kind for name, kind, _ in rows} == {
        name: path.partition(":")[2] for name, path in FILTERS.items()
    }


def test_the_table_of_settings_has_every_field_and_its_default():
    rows = table("agents.md", "setting", "default", "of")
    shared = [field.name for field in fields(CloningConfig)]
    expected = [("rise, pcbc" if f.name in shared else "rise", f.name) for f in fields(RiseConfig)]
    expected += [("pcbc", field.name) for field in fields(PCBCConfig) if field.name not in shared]
    assert [(row[2], row[0]) for row in rows] == expected
    for name, default, of, _ in rows:
        for kind, known in ((RiseConfig, "rise"), (PCBCConfig, "pcbc")):
            assert known not in of.split(", ") or default == str(getattr(kind(), name))


def test_the_table_of_the_belief_s_settings_is_complete():
    rows = table("agents.md", "setting of its own", "default")
    shared = {field.name for field in fields(CloningConfig)}
    own = [
        (f.name, str(getattr(BeliefConfig(), f.name))) for f in fields(BeliefConfig) if f.name not in shared
    ]
    assert [(row[0], row[1]) for row in rows] == own


def test_the_table_of_frames_has_the_sizes_of_their_inputs():
    rows = table("agents.md", "frame", "what is seen")
    assert [row[0] for row in rows] == list(readings.FRAMES)
    for place, env_id in enumerate(TASKS):
        task, env = task_of(env_id), env_class(env_id)()
        batch = {key: np.ones((1, *space.shape)) for key, space in env.observation_space.items()}
        env.close()
        for frame, _, *said in rows:
            robot, reading = readings.inputs(task, frame, batch)
            assert said[place] == f"{robot.shape[1]} + {reading.shape[1]}"


def paper_map() -> list[list[str]]:
    """Rows of all tables of the paper-to-code map, cells as written."""
    found = tables(DOCS / "paper.md")
    return [row for head, rows in found if head == ["paper", "function", "file"] for row in rows]


@pytest.mark.parametrize("row", paper_map(), ids=lambda row: plain(row[0]))
def test_what_the_paper_to_code_map_names_exists(row):
    links = _LINK.findall(row[1])
    assert links
    for words, target in links:
        file = (DOCS / target).resolve()
        assert file.relative_to(ROOT).as_posix() == plain(row[2])
        assert member(file, words.strip("`")) is not None


def test_the_map_holds_every_equation_and_every_line_of_algorithm_1():
    lines: list[int] = []
    for row in paper_map():
        if found := re.match(r"lines? (\d+)(?:–(\d+))?,", row[0]):
            lines += range(int(found[1]), int(found[2] or found[1]) + 1)
    assert lines == list(range(1, 27))
    equations = {int(n) for row in paper_map() for n in re.findall(r"^equation (\d)", row[0])}
    assert equations == {1, 2, 3}


def test_the_map_holds_every_setting_of_rise_and_its_metrics():
    named = {words.strip("`") for row in paper_map() for words, _ in _LINK.findall(row[1])}
    ours = {"average", "posterior"}  # what the paper does not have
    assert {f"Config.{name}" for name in vars(RiseConfig)["__annotations__"] if name not in ours} <= named
    assert {"safety_rate", "reach_rate", "StepNoise", "Scenarios", "Mixture"} <= named


# --- benchmark -------------------------------------------------------------------------------------------------


def number(text: str) -> int:
    return int(text.replace(",", ""))


@pytest.mark.parametrize("preset", PRESETS)
def test_the_table_of_presets_agrees_with_them(preset):
    heads = [f"{name} (default)" if name == "quick" else name for name in PRESETS]
    place = list(PRESETS).index(preset) + 1
    said = {row[0]: row[place] for row in table("benchmark.md", "", *heads)}
    known = PRESETS[preset]
    assert number(said.pop("demonstrations, episodes per environment")) == known.demos
    assert number(said.pop("test scenarios per condition")) == known.episodes
    levels = tuple(float(level) for level in said.pop("noise levels").split(", "))
    assert levels == known.noise_levels
    assert number(said.pop("training seeds")) == known.seeds
    assert number(said.pop("scenarios in a clip")) == known.clips
    for field, words in (("agents", "rows"), ("noise_models", "noise models")):
        assert tuple(said.pop(words).split(", ")) == getattr(known, field)
    assert number(said.pop("blocks beside these")) == len(known.blocks)
    settings = {"tuned.toml": known.tuned, "BRIEF": known.brief, "own": not (known.tuned or known.brief)}
    words = said.pop("settings")
    assert {word: word in words for word in settings} == settings
    assert not said


@pytest.mark.parametrize(
    ("head", "command"),
    [
        ("option", parser()),
        ("option of the search", tune_parser()),
        ("option of the replay", replay_parser()),
    ],
    ids=["run", "tune", "replay"],
)
def test_the_table_of_options_has_every_option_of_the_command(head, command):
    actions = {action.option_strings[-1]: action for action in command._actions if action.option_strings}
    rows = table("benchmark.md", head, "default")
    assert {row[0] for row in rows} == set(actions) - {"--help"}
    for option, default, _ in rows:
        value = actions[option].default
        if isinstance(value, str):
            assert default == value
        elif isinstance(value, list):
            assert default == " ".join(value)
        elif value is not None and not isinstance(value, bool):
            assert default == f"{value:g}" if isinstance(value, float | int) else str(value)


def test_the_table_of_variants_agrees_with_the_shipped_file():
    found = read([SHIPPED])
    rows = table("benchmark.md", "variant", "agent", "differs in")
    assert [row[0] for row in rows] == list(found.variants)
    for name, agent, differs in rows:
        variant, settings = found.variants[name], found.layers[0][name]
        words = [f"{key} {value}" for key, value in settings.items()]
        words += [f"demonstrations by {variant.expert}"] if variant.expert else []
        assert (agent, differs) == (variant.agent, ", ".join(words))


def test_the_config_file_of_the_page_is_one(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", (DOCS / "benchmark.md").read_text(), re.DOTALL)
    path = tmp_path / "mine.toml"
    path.write_text(text)
    found = read([path])
    assert list(found.variants) == list(found.searches) == ["rise-large"] and "rise" in found.layers[0]


def test_the_table_of_limits_is_what_the_trials_say(monkeypatch):
    with (FOLDER / "trials.csv").open() as file:
        trials = list(csv.DictReader(file))
    kinds = ("clean_safety", "clean_reach", "safety", "reach")
    seeds = defaultdict(list)
    for row in trials:
        key = row["env"], row["agent"], int(row["trial"])
        seeds[key].append(ranking.Rates(*(float(row[kind]) for kind in kinds)))
    agents = ("rise", "pcbc", "cppo")
    cells = table("benchmark.md", "may lose, points", "Vehicle: rise", "pcbc", "cppo", "Panda: rise")
    assert len(cells) == 5
    for limit, *scores in cells:
        monkeypatch.setattr(ranking, "SURE", 0.0 if "not only shown" in limit else 1.645)
        found = []
        for env in ("RISE-GroundVehicle-v0", "RISE-SafePanda-v0"):
            last = {
                (agent, trial): ranking.mean(rates)
                for (where, agent, trial), rates in seeds.items()
                if where == env and len(rates) == 3
            }
            best = ranking.best_clean(last.values())
            for agent in agents:
                own = {trial: rates for (name, trial), rates in last.items() if name == agent}
                first = ranking.ranked(own, float(limit.split(",")[0]) / 100, best, episodes=3 * 1_000)[0]
                found.append(f"{100 * own[first].score:.1f}")
        assert scores == found, limit


def test_the_table_of_seeds_agrees_with_the_splits():
    assert {row[0]: int(row[1]) for row in table("benchmark.md", "split", "first seed")} == SPLITS


def test_the_tables_of_columns_agree_with_the_files():
    assert columns_after("benchmark.md", "`episodes.parquet`:") == SCHEMA.names
    assert columns_after("benchmark.md", "`summary.csv` (") == [field.name for field in fields(SummaryRow)]
    assert columns_after("benchmark.md", "`comparisons.csv` (") == [f.name for f in fields(ComparisonRow)]


# --- performance -----------------------------------------------------------------------------------------------


def test_every_row_of_the_speed_table_is_explained():
    assert [row[0] for row in table("performance.md", "name", "ours", "peer")] == list(ROWS)


def test_the_performance_page_can_be_renewed():
    text = (DOCS / "performance.md").read_text()
    assert BLOCK.replaced(text, "new") != text  # it has its one block
