"""What a run found, in words, tables and figures, made from its episodes: ``python -m benchmarks.report``."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pyarrow as pa
from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.labels import (
    agent_label,
    condition_label,
    count,
    env_label,
    interval,
    model_order,
    name_rows,
    noise_label,
    p_value,
    percent,
    points,
    points_interval,
    sample,
    several_seeds,
)
from benchmarks.results import atomic_write_text, read_rows
from benchmarks.sections import Section, compared, sections
from benchmarks.tables import ComparisonRow, SummaryRow, analyse, headline_level, write_table
from rise_agents.cli import Parser, command, prepare_folder
from rise_agents.files import sole_user

EPISODES, RECORD = "episodes.parquet", "run.json"  # what a report is made from, in a run folder
FIGURES = {
    "comparison.png": "Safety Rate and Reach Rate of every agent",
    "noise_curve.png": "Safety Rate and Reach Rate against the noise level",
}
_COLUMNS = (
    "Agent",
    "Noise level",
    "Safety Rate % [95 %]",
    "Reach Rate % [95 %]",
    "Arrived %",
    "Mean cost",
    "Mean steps",
)
_MEANING = """\
**Safety Rate**: episodes without any collision. **Reach Rate**: episodes that reach the goal without any \
collision. **Arrived**: episodes that reach the goal, collisions ignored. **Mean cost**: steps in collision \
per episode. In brackets: 95 % \
"""
_ONE_SEED = "Wilson intervals over all episodes."
_SEVERAL_SEEDS = """\
intervals of a bootstrap that draws training seeds and scenarios anew; Wilson intervals for rows of one \
training seed, and where all or no episodes succeeded.\
"""
_DIFFERENCES = """\
Differences are of the same scenarios and training seeds, in percentage points; in brackets: 95 % intervals \
of a bootstrap that draws {}. p: exact McNemar test on the episodes, of these trained \
policies, Holm-corrected over all comparisons of the task (`comparisons.csv`).\
"""
_SURE = " It can be small where the interval, which allows for training anew, holds 0."
_UNSURE = " It can be large where the interval, which is not corrected, does not hold 0."
_DRAWN = {True: "training seeds and scenarios anew, each for itself", False: "scenarios anew"}
_FEW = {"transitions": "all"}  # what 0 stands for
_EXAMPLES = """\
examples:
  python -m benchmarks.report runs/quick                              make its tables and figures again
  python -m benchmarks.report runs/quick --out tables                 the same, in another folder
  python -m benchmarks.report episodes.parquet --out tables           from the episodes alone
"""


def summary_table_text(summary: Sequence[SummaryRow], env: str) -> str:
    """The results of one environment as a text table, 80 columns wide or as wide as its agents' names need.

    Raises:
        ValueError: no rows of ``env``.
    """
    rows = _rows_of(summary, env)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in _COLUMNS:
        words = name.replace(" %", "\n%", 1).replace("Mean ", "Mean\n").replace("Noise ", "Noise\n")
        table.add_column(words, justify="left" if name == "Agent" else "right", no_wrap=True)
    for index, row in enumerate(rows):
        last_of_level = index + 1 == len(rows) or _condition(rows[index + 1]) != _condition(row)
        table.add_row(*_cells(row, rows), end_section=last_of_level)
    text = io.StringIO()
    Console(file=text, width=200, color_system=None).print(table)
    lines = [_title(rows), *text.getvalue().strip("\n").splitlines()]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def summary_markdown(summary: Sequence[SummaryRow], run: Mapping[str, Any]) -> str:
    """The page ``summary.md``: the findings in words, figures, tables per task, training, how to repeat.

    Args:
        summary: rows of :func:`benchmarks.tables.summarise`.
        run: what is known of the run: ``command`` (how to repeat it); ``training`` (name → facts of its training,
            which may be mappings themselves, such as facts per environment); ``figures`` (relative path →
            caption; pictures are shown, other files linked), by default :data:`FIGURES`; ``blocks``, which rows
            belong together; ``unfinished``: how many jobs were not done.

    Raises:
        ValueError: an empty summary.
    """
    if not summary:
        raise ValueError("no results to report: the summary is empty")
    asked, *others = sections(summary, run.get("blocks", ()))
    blocks = ["# Results", *what_is_left(run), *claims(asked.rows)]
    for path, caption in run.get("figures", FIGURES).items():
        blocks.append(f"{'!' if path.endswith('.png') else ''}[{caption}]({path})")
    blocks += ["## Tables", meaning(summary)]
    for section in (asked, *others):
        blocks += [f"## {section.title}"] * bool(section.title)
        blocks += tables_markdown(section.rows)
    trained = training_markdown(run)
    if trained:
        blocks += ["## How the agents were trained", trained]
    if "command" in run:
        blocks += ["## How to repeat", f"```sh\n{run['command']}\n```"]
    return "\n\n".join(blocks) + "\n"


def what_is_left(run: Mapping[str, Any]) -> list[str]:
    """A sentence for pages of a run that is not finished; none for others."""
    left = run.get("unfinished", 0)
    if not left:
        return []
    pieces = f"{count([left], 'piece')} of work {'is' if left == 1 else 'are'} left"
    return [f"**Not finished:** {pieces}, so rows can be missing, or have fewer episodes than others."]


def meaning(summary: Sequence[SummaryRow]) -> str:
    """What the columns of the tables say, and their intervals, in a paragraph of Markdown."""
    return _MEANING + (_SEVERAL_SEEDS if several_seeds(summary) else _ONE_SEED)


def tables_markdown(summary: Sequence[SummaryRow]) -> list[str]:
    """A heading and a table per task, in Markdown."""
    blocks = []
    for env in dict.fromkeys(row.env for row in summary):
        rows = _rows_of(summary, env)
        blocks += [f"### {_title(rows)}", _markdown_table(rows)]
    return blocks


def training_markdown(run: Mapping[str, Any]) -> str:
    """How the agents of a run were trained, as a list in Markdown; empty where nothing is known."""
    known = run.get("training", {}).items()
    return "\n".join(line for name, facts in known for line in _fact(agent_label(name), facts))


def claims(summary: Sequence[SummaryRow]) -> list[str]:
    """What was found, in words: paragraphs and lists of Markdown, last what the numbers in them mean."""
    return [*findings(summary), *what_differences_are(summary)]


def findings(summary: Sequence[SummaryRow]) -> list[str]:
    """:func:`claims` without what the numbers mean."""
    envs = dict.fromkeys(row.env for row in summary)
    return [block for env in envs for block in _findings(_rows_of(summary, env))]


def what_differences_are(summary: Sequence[SummaryRow]) -> list[str]:
    """A paragraph on the differences in :func:`findings`; none where nobody is compared."""
    if not any(row.against for row in summary):
        return []
    seeds = several_seeds(summary)
    return [_DIFFERENCES.format(_DRAWN[seeds]) + (_SURE if seeds else _UNSURE)]


def _condition(row: SummaryRow) -> tuple[str, float]:
    return row.noise_model, row.noise_level


def _rows_of(summary: Sequence[SummaryRow], env: str) -> list[SummaryRow]:
    """The rows of one env by noise, so that the agents that met the same noise stand together."""
    rows = [row for row in summary if row.env == env]
    if not rows:
        raise ValueError(
            f"no results of {env}; there are some of {', '.join(sorted({r.env for r in summary}))}"
        )
    return sorted(
        rows, key=lambda row: (model_order(row.noise_model), row.noise_level)
    )  # agents keep their order


def _title(rows: Sequence[SummaryRow]) -> str:
    models = " / ".join(noise_label(model) for model in dict.fromkeys(row.noise_model for row in rows))
    return f"{env_label(rows[0].env)}: {models}, {sample(rows, 'row')}"


def _cells(row: SummaryRow, rows: Sequence[SummaryRow]) -> tuple[str, ...]:
    """What a table says of ``row``; it names the noise model only where ``rows`` have several."""
    model = f"{row.noise_model} " if len({r.noise_model for r in rows}) > 1 else ""
    return (
        agent_label(row.agent),
        f"{model}{row.noise_level:g}",
        f"{percent(row.safety_rate)} [{interval(row.safety_low, row.safety_high)}]",
        f"{percent(row.reach_rate)} [{interval(row.reach_low, row.reach_high)}]",
        percent(row.arrival_rate),
        f"{row.mean_cost:.2f}",
        f"{row.mean_steps:.1f}",
    )


def _findings(rows: Sequence[SummaryRow]) -> list[str]:
    """What one env says at the headline level of each noise model: the rates, then the first agent against others."""
    blocks = []
    for model in dict.fromkeys(row.noise_model for row in rows):
        level = headline_level([row for row in rows if row.noise_model == model])
        shown = [row for row in rows if _condition(row) == (model, level)]
        first, *others = (_clause(row) for row in shown)
        agent, safe, reached, episodes = first
        clauses = [
            f"{agent} kept {safe} of {episodes} safe and reached the goal without collision in {reached}"
        ]
        clauses += [f"{agent} {safe} and {reached}" for agent, safe, reached, _ in others]
        start = f"**{env_label(rows[0].env)}.** At {condition_label(model, level)}"
        blocks.append(f"{start} {'; '.join(clauses)}.")
        claims = [f"- {_claim(row)}" for row in shown if row.against]
        blocks += ["\n".join(claims)] if claims else []
    return blocks


def _claim(row: SummaryRow) -> str:
    """How the run's first agent differs from that of ``row``, in a sentence."""
    # The columns hold what the row has more than the first agent; the sentence turns them round.
    safety = _difference(row.safety_diff, row.safety_diff_low, row.safety_diff_high, row.safety_diff_p)
    reach = _difference(row.reach_diff, row.reach_diff_low, row.reach_diff_high, row.reach_diff_p)
    other = f"{'than' if row.safety_diff else 'as'} {agent_label(row.agent)}"
    return (
        f"{agent_label(row.against)} kept {safety[0]} episodes safe {other} {safety[1]}, "
        f"and reached the goal without collision in {reach[0]} {reach[1]}."
    )


def _difference(
    diff: float | None, low: float | None, high: float | None, p: float | None
) -> tuple[str, str]:
    """A difference, seen from the other side, in points; and its interval, with what that says."""
    if diff is None or low is None or high is None or p is None:
        raise ValueError("a row that is compared with another needs all numbers of the comparison")
    amount = f"{points(abs(diff))} points {'fewer' if diff > 0 else 'more'}" if diff else "as many"
    # No p where the interval holds 0: it speaks of these trained policies alone, and would seem to say the contrary.
    verdict = ", no difference that these episodes can show" if low <= 0 <= high else f" ({p_value(p)})"
    return amount, f"{points_interval(0 - high, 0 - low)}{verdict}"


def _clause(row: SummaryRow) -> tuple[str, str, str, str]:
    """Agent, Safety Rate, Reach Rate and number of episodes, ready for a sentence."""
    safe = f"{percent(row.safety_rate)} % ({interval(row.safety_low, row.safety_high)})"
    reached = f"{percent(row.reach_rate)} % ({interval(row.reach_low, row.reach_high)})"
    return agent_label(row.agent), safe, reached, count([row.episodes], "episode")


def _markdown_table(rows: Sequence[SummaryRow]) -> str:
    lines = [_COLUMNS, ("---",) + ("---:",) * (len(_COLUMNS) - 1), *(_cells(row, rows) for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _fact(name: str, value: Any, indent: str = "") -> list[str]:
    """``name: value`` as a list item; a mapping is one line, or a list if it holds mappings."""
    if not isinstance(value, Mapping):
        return [f"{indent}- {name}: {_plain(value)}"]
    if not any(isinstance(inner, Mapping) for inner in value.values()):
        said = {
            key: _FEW.get(key, _plain(inner)) if inner == 0 else _plain(inner) for key, inner in value.items()
        }
        facts = ", ".join(f"{_words(key)} {words}" for key, words in said.items() if words)
        return [f"{indent}- **{name}**: {facts}" if facts else f"{indent}- **{name}**"]
    lines = [f"{indent}- **{name}**"]
    for key, inner in value.items():
        lines += _fact(env_label(_words(key)), inner, indent + "  ")
    return lines


def _words(key: str) -> str:
    return key.replace("_", " ")


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_plain(item) for item in value)}]"
    return str(value)


def publish(rows: pa.Table, run: Mapping[str, Any], out: Path) -> list[SummaryRow]:
    """Write all that is computed from episodes: ``summary.csv``, ``comparisons.csv``, ``summary.md``, figures.

    Figures of the paper's noise model, or else of the first one, have the names in :data:`FIGURES`; those of
    others carry the model in theirs.

    Args:
        rows: episodes, at least one.
        run: what is known of the run, as in :func:`summary_markdown`; ``rows``, the order of the agents;
            ``labels``, how those are called that no registry knows; and ``blocks``, which of them belong together.
        out: folder that exists.

    Returns:
        The lines of ``summary.csv``.

    Raises:
        ValueError: no episodes, or episodes that cannot be compared (:func:`benchmarks.tables.analyse`).
        OSError: a file cannot be written.
    """
    name_rows(run.get("labels", {}))
    blocks = run.get("blocks", ())
    summary, comparisons = analyse(rows, run.get("rows", ()), compared(blocks))
    if not summary:
        raise ValueError("there are no episodes to report")
    write_table(out / "summary.csv", SummaryRow, summary)
    write_table(out / "comparisons.csv", ComparisonRow, comparisons)
    asked, *others = sections(summary, blocks)
    figures = _draw(asked.rows, out) | _draw_others(others, out)
    atomic_write_text(out / "summary.md", summary_markdown(summary, {"figures": figures, **run}))
    return summary


def _draw(summary: Sequence[SummaryRow], out: Path) -> dict[str, str]:
    """The figures of the rows that were asked for; path → caption."""
    from benchmarks import plots  # half a second, which only those who draw need wait for

    figures: dict[str, str] = {}
    models = sorted({row.noise_model for row in summary}, key=model_order)
    for model in models:
        level = headline_level([row for row in summary if row.noise_model == model])
        drawn = (plots.comparison(summary, level, model), plots.noise_curve(summary, model))
        for figure, (name, caption) in zip(drawn, FIGURES.items(), strict=True):
            if model != models[0]:
                mark = re.sub(r"[^A-Za-z0-9.]+", "-", model)
                name, caption = name.replace(".png", f"-{mark}.png"), f"{caption}: {noise_label(model)}"
            plots.save_png(figure, out / name)
            figures[name] = caption
    return figures


def others_figure(env: str) -> str:
    """The file name of the figure of what was measured in a task beside the rows that were asked for."""
    return f"others-{re.sub(r'[^A-Za-z0-9]+', '-', env_label(env)).lower()}.png"


def _draw_others(others: Sequence[Section], out: Path) -> dict[str, str]:
    """A figure per task of what was measured beside these; path → caption."""
    from benchmarks import plots

    figures: dict[str, str] = {}
    for env in dict.fromkeys(row.env for section in others for row in section.rows):
        of_env = [Section(s.title, [row for row in s.rows if row.env == env]) for s in others]
        name = others_figure(env)
        plots.save_png(plots.grouped([section for section in of_env if section.rows]), out / name)
        figures[name] = f"{env_label(env)}: controls, sweeps and other noise"
    return figures


def read_run(folder: Path) -> dict[str, Any]:
    """What ``run.json`` in a folder says for :func:`publish`; nothing where there is none.

    Raises:
        ValueError: it cannot be read as such a record.
    """
    path = folder / RECORD
    if not path.exists():
        return {}
    try:
        record = json.loads(path.read_bytes())
        variants = dict(record["plan"].get("variants", {})).items()
        return {
            "command": str(record["command"]),
            "rows": [str(name) for name in record.get("rows", record["plan"]["agents"])],
            "training": dict(record.get("training", {})),
            "labels": {name: str(each["label"]) for name, each in variants if each["label"]},
            "variants": {name: str(each["agent"]) for name, each in variants},
            "unfinished": int(record.get("unfinished", 0)),
            "blocks": [_block(each) for each in record.get("blocks", ())],
            "agents": {env: dict(paths) for env, paths in dict(record.get("agents", {})).items()},
            "trajectories": [str(name) for name in record.get("trajectories", ())],
            "versions": dict(record.get("versions", {})),
        }
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is not the record of a run ({type(error).__name__}: {error})") from None


def _block(entry: Mapping[str, Any]) -> dict[str, Any]:
    """A block of a run's record, each part of its kind."""
    names = {key: [str(name) for name in entry[key]] for key in ("rows", "noise_models", "envs")}
    return {"title": str(entry["title"]), **names, "noise_levels": [float(x) for x in entry["noise_levels"]]}


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m benchmarks.report",
        description="Make the tables, the figures and the page of a run again, from its episodes.",
        epilog=_EXAMPLES,
    )
    p.add_argument(
        "source",
        type=Path,
        metavar="RUN",
        help=f"run folder, or a file of episodes; {RECORD} beside it adds order, training and command",
    )
    p.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to write to (default: where the episodes are)"
    )
    return p


@command("benchmarks.report")
def main(argv: Sequence[str] | None = None) -> int:
    """Make a report; returns the exit code: 0 done, 1 a file cannot be written, 2 bad arguments or input."""
    arguments = parser().parse_args(argv)
    source: Path = arguments.source
    episodes = source / EPISODES if source.is_dir() else source
    rows, run = read_rows(episodes), read_run(episodes.parent)
    out: Path = arguments.out or episodes.parent
    prepare_folder(out)
    with sole_user(out) if (out / RECORD).exists() else nullcontext():  # a run may be at work there
        summary = publish(rows, run, out)
        from benchmarks.html_report import write_page  # it stands on this file

        write_page(summary, run, episodes.parent, out)
    asked, *_ = sections(summary, run.get("blocks", ()))
    for env in dict.fromkeys(row.env for row in asked.rows):
        print(summary_table_text(asked.rows, env))
    print(f"Written: {out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
