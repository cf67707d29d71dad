"""``report.html``: what a run found, as one page that needs nothing beside it.

Words, tables and numbers are those of :mod:`benchmarks.report`; they are there without JavaScript, too. The charts
are drawn by plotly.js, which comes inside the page: its whole bundle, as the Python package ships it, takes 2 MB
under gzip, and so there is no copy of it in this repository to keep up to date.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markdown_it import MarkdownIt

from benchmarks import charts, explorer, plots, report, results
from benchmarks.charts import Chart
from benchmarks.labels import (
    agent_label,
    condition_label,
    env_label,
    model_order,
    noise_label,
    sample,
    split_row,
)
from benchmarks.plots import METRICS
from benchmarks.results import atomic_write_text
from benchmarks.sections import sections
from benchmarks.tables import SummaryRow, headline_level
from rise_agents import __version__

PAGE = "report.html"
_SCRIPTS = ("data.js", "strokes.js", "scene.js", "explorer.js", "charts.js", "start.js")
_BIBTEX = f"""\
@misc{{rise,
  title  = {{RISE: Robust Imitation through Stochastic Encoding}},
  author = {{Tayal and Tayal and Prakash}},
}}
@software{{rise_suite,
  title   = {{RISE suite: robust safe imitation learning under noisy obstacle readings}},
  version = {{{__version__}}},
}}"""


@dataclass(frozen=True)
class Group:
    """Charts that answer one question.

    Attributes:
        title: of the group.
        note: how to read it.
        charts: by their ids on the page.
    """

    title: str
    note: str
    charts: list[tuple[str, Chart]]


def write_page(summary: Sequence[SummaryRow], run: Mapping[str, Any], folder: Path, out: Path) -> Path:
    """Write ``report.html``.

    Args:
        summary: all rows of the run.
        run: what is known of it, :func:`benchmarks.report.read_run`.
        folder: of the run: where trajectories and records of trainings lie.
        out: folder to write to; the figures of the report are there.

    Returns:
        The page.

    Raises:
        ValueError: an empty summary, or a damaged file of trajectories.
        OSError: it cannot be written.
    """
    asked, *others = sections(summary, run.get("blocks", ()))
    traced = [folder / name for name in run.get("trajectories", ())]
    traced = [path for path in traced if path.exists()]
    packed = explorer.pack(traced, run.get("rows", ()))
    groups = _groups(asked.rows)
    trainings = _trainings(asked.rows, run, folder)
    drawn = [pair for group in groups for pair in group.charts] + trainings
    data = {"tasks": packed.tasks, "charts": dict(drawn)}
    text = _template().render(
        title="Safety and reach under noisy obstacle readings",
        version=__version__,
        style=_asset("style.css"),
        findings=_html(_tied("\n\n".join(_findings(asked.rows, run)))),
        groups=groups,
        pictures=_pictures(out),
        explorer=bool(packed.tasks),
        selection=_selection(packed.tasks),
        replayed=shlex.join([folder.as_posix(), *_imports(run)]),
        meaning=_html(_tied(report.meaning(summary))),
        sections=[
            {"title": section.title, "html": _html("\n\n".join(_tables(section.rows)))}
            for section in (asked, *others)
        ],
        training={"charts": trainings, "facts": _html(report.training_markdown(run))}
        if run.get("training")
        else None,
        repeat=_html(_repeat(run)),
        bibtex=_BIBTEX,
        payload=[
            (
                "data",
                _packed(
                    json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
                ),
            ),
            ("numbers", _packed(bytes(packed.numbers))),
            ("plotly", _packed(_plotly().encode())),
        ],
        script="\n".join(_asset(name) for name in _SCRIPTS),
    )
    atomic_write_text(out / PAGE, text)
    return out / PAGE


def _by_model(summary: Sequence[SummaryRow]) -> dict[str, list[SummaryRow]]:
    """The rows of each noise model, the paper's first."""
    models = sorted({row.noise_model for row in summary}, key=model_order)
    return {model: [row for row in summary if row.noise_model == model] for model in models}


def _by_task(summary: Sequence[SummaryRow]) -> list[list[SummaryRow]]:
    """The rows of each task and noise model, task by task."""
    envs = dict.fromkeys(row.env for row in summary)
    of_env = ([row for row in summary if row.env == env] for env in envs)
    return [rows for each in of_env for rows in _by_model(each).values()]


def _findings(asked: Sequence[SummaryRow], run: Mapping[str, Any]) -> list[str]:
    """Whether the run is finished, and what was found, in Markdown."""
    found = [block for rows in _by_task(asked) for block in report.findings(rows)]
    return [*report.what_is_left(run), *found, *report.what_differences_are(asked)]


def _tables(summary: Sequence[SummaryRow]) -> list[str]:
    """A table per task and noise model, in Markdown."""
    return [block for rows in _by_task(summary) for block in report.tables_markdown(rows)]


def _groups(summary: Sequence[SummaryRow]) -> list[Group]:
    """The charts of the rows that were asked for."""
    found: list[Group] = []
    models = _by_model(summary)
    for model, rows in models.items():
        level, envs = headline_level(rows), list(dict.fromkeys(row.env for row in rows))
        shown = {env: [row for row in rows if (row.env, row.noise_level) == (env, level)] for env in envs}
        of_env = {env: [row for row in rows if row.env == env] for env in envs}
        where, kind = condition_label(model, level), noise_label(model)
        mark = f"{model}-" if model != next(iter(models)) else ""
        bars = [
            (f"{mark}bars-{env}-{m.key}", charts.comparison(shown[env], m))
            for env in envs
            if shown[env]
            for m in METRICS
        ]
        found.append(Group(f"At {where}", f"{sample(rows, 'bar')}, with 95 % intervals.", bars))
        if len({row.noise_level for row in rows}) > 1:
            lines = [
                (f"{mark}lines-{env}-{m.key}", charts.curve(of_env[env], m)) for env in envs for m in METRICS
            ]
            found.append(
                Group(
                    f"Against the noise level: {kind}",
                    f"{sample(rows, 'point')}, with 95 % intervals.",
                    lines,
                )
            )
        both = [(f"{mark}pareto-{env}", charts.pareto(of_env[env])) for env in envs]
        note = "Up and to the right is better. Over all levels: from the lowest noise level of an agent to its highest."
        found.append(Group(f"Safety against reach: {kind}", note, both))
    return found


def _trainings(
    summary: Sequence[SummaryRow], run: Mapping[str, Any], folder: Path
) -> list[tuple[str, Chart]]:
    """A chart per task and agent that was trained, of the records beside the checkpoints."""
    bases = dict.fromkeys(split_row(row.agent)[0] for row in summary)
    found = []
    for env, checkpoints in run.get("agents", {}).items():
        seen = set()  # rows of one training, such as those that act in different ways, have one chart
        for base in bases:
            curves = {}
            for key, path in checkpoints.items():
                row, _, seed = key.rpartition("-seed")
                record = folder / Path(path).with_suffix(".json")
                if split_row(row)[0] == base and path not in seen and record.is_file():
                    seen.add(path)
                    curves[f"seed {seed}"] = results.curve(record)
            chart = charts.training(
                f"{agent_label(base)} on {env_label(env)}", curves, plots.colour(list(bases), base)
            )
            found += [(f"training-{env}-{base}", chart)] if chart else []
    return found


def _selection(tasks: Sequence[Mapping[str, Any]]) -> str:
    """How much can be watched, in words."""
    words = [
        f"{task['label']}: {len(task['scenarios'])} scenarios, {len(task['episodes'])} episodes"
        for task in tasks
    ]
    differing = sum(task["differing"] for task in tasks)
    lost = (
        f" {differing} episodes came out differently here than where they were recorded and are left out."
        if differing
        else ""
    )
    return f"{'; '.join(words)}.{lost}" if tasks else ""


def _imports(run: Mapping[str, Any]) -> list[str]:
    """The ``--import`` options of the command of a run: without them nobody knows its names."""
    try:
        words = shlex.split(run.get("command", ""))
    except ValueError:
        return []
    option, found = "", []
    for word in words:
        option = word if word.startswith("-") else option
        found += [word] * (option.partition("=")[0] == "--import")
    return found


def _repeat(run: Mapping[str, Any]) -> str:
    """Markdown: the command, the versions."""
    if "command" not in run:
        return "How the episodes were made is not known: there is no `run.json` beside them."
    versions = ", ".join(f"{name} {version}" for name, version in run.get("versions", {}).items())
    again = (
        "The same command in the same folder goes on where it was; in a new one it does everything again, with these "
        "versions to the same tables."
    )
    return f"```sh\n{run['command']}\n```\n\n{again}" + (f"\n\nVersions: {versions}." if versions else "")


def _pictures(out: Path) -> list[dict[str, str]]:
    """The figures of the report, for readers without JavaScript."""
    found = []
    for name, caption in report.FIGURES.items():
        if (out / name).is_file():
            content = base64.b64encode((out / name).read_bytes()).decode()
            found.append({"source": f"data:image/png;base64,{content}", "caption": caption})
    return found


def _html(markdown: str) -> str:
    """Markdown as HTML; HTML inside of it is text. Wide tables scroll by themselves."""
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)
    html = re.sub(r"<th(?!ead)", '<th scope="col"', html)
    html = _grouped(html).replace("</table>", "</table></div>")
    return html.replace(
        "<table>", '<div class="scroll" tabindex="0" role="region" aria-label="Table"><table>'
    )


def _grouped(html: str) -> str:
    """Tables whose rows begin a group where their second cell, the noise level, is another than in the row above."""
    above = ""

    def row(match: re.Match[str]) -> str:
        nonlocal above
        begins, above = match[2] != above, match[2]
        mark = ' class="begins"' * begins
        return f"<tr{mark}>{match[1]}{match[2]}"

    return re.sub(r"<tr>(\n<td>.*</td>\n<td[^>]*>)(.*)", row, html)


def _tied(text: str) -> str:
    """``text`` with numbers and their per cent sign on one line."""
    return text.replace(" %", "\N{NO-BREAK SPACE}%")


def _packed(content: bytes) -> str:
    """Bytes as the page carries them; the same bytes give the same text."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _plotly() -> str:
    """The source of plotly.js."""
    from plotly.offline import get_plotlyjs

    return get_plotlyjs()


def _asset(name: str) -> str:
    return (files("benchmarks") / "page" / name).read_text("utf-8")


def _template() -> Any:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_asset("report.html.j2"))
