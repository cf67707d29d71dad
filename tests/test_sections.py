"""Which rows stand together, and in which order."""

import pyarrow as pa
from hand_made import make_rows

from benchmarks.sections import sections
from benchmarks.tables import summarise

PANDA = "RISE-SafePanda-v0"


def block(title, rows, models, envs=()):
    """A block at levels 0 and 1, as ``run.json`` has them."""
    return {
        "title": title,
        "rows": rows,
        "noise_models": models,
        "noise_levels": [0.0, 1.0],
        "envs": list(envs),
    }


def summary(*wanted):
    """A row for each (agent, noise model, noise level), in both tasks."""
    conditions = [
        {"agent": agent, "noise_model": model, "noise_level": level} for agent, model, level in wanted
    ]
    rows = [make_rows(**each, **env) for each in conditions for env in ({}, {"env": PANDA})]
    return summarise(pa.concat_tables(rows))


def test_noise_models_come_in_the_order_of_the_block():
    rows = summary(("rise", "episode", 1.0), ("rise", "step", 0.0), ("rise", "step", 1.0))
    (asked,) = sections(rows, [block("", ["rise"], ["step", "episode"])])
    seen = [(row.env, row.noise_model, row.noise_level) for row in asked.rows]
    assert [each[1:] for each in seen] == 2 * [("step", 0.0), ("step", 1.0), ("episode", 1.0)]
    assert [env for env, *_ in seen] == sorted(env for env, *_ in seen)  # task by task


def test_what_has_nothing_to_be_compared_with_yet_is_left_out():
    rows = summary(("rise", "step", 1.0), ("pcbc", "step", 1.0), ("expert", "step", 1.0))
    blocks = [
        block("", ["rise", "pcbc"], ["step"]),
        block("half done", ["rise", "rise-mean"], ["step"]),
        block("one row", ["expert"], ["step"]),
        block("not begun", ["random"], ["step"]),
        block("whole", ["rise", "expert"], ["step"]),
    ]
    assert [section.title for section in sections(rows, blocks)] == ["", "one row", "whole"]
