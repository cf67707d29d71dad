"""Whether tables meet the targets, on hand-made lines."""

import pytest

from benchmarks.tables import ComparisonRow, SummaryRow
from benchmarks.targets import (
    ABOVE,
    AT_LEAST,
    NOT_BELOW,
    PANDA,
    SURELY_ABOVE,
    TARGETS,
    VEHICLE,
    Figure,
    Target,
    acceptance,
    measured,
    met,
)


def rates(safety, reach, agent="rise", model="step", level=1.0, env=VEHICLE):
    """A line of the summary; intervals of ±1 point."""
    ends = [end for rate in (safety, reach) for end in (rate, rate - 0.01, rate + 0.01)]
    return SummaryRow(env, agent, model, level, 5, 5000, *ends, 1.0, 0.1, 80.0, safety, reach, 0.2)


def pair(safety, reach, agent="rise", other="pcbc", model="step", level=1.0, env=VEHICLE):
    """A line of the comparisons from (diff, low, high) of each rate."""
    return ComparisonRow(env, model, level, agent, other, 5, 1000, *safety, 9, 5, 0.5, *reach, 9, 5, 0.5)


@pytest.mark.parametrize(
    ("rule", "figure", "bound", "holds"),
    [
        (AT_LEAST, (0.98, 0.90, 0.99), 0.98, True),
        (AT_LEAST, (0.9799, 0.97, 0.99), 0.98, False),
        (AT_LEAST, (-0.01, -0.03, 0.0), -0.01, True),
        (ABOVE, (0.001, -0.1, 0.1), 0.0, True),
        (ABOVE, (0.0, -0.1, 0.1), 0.0, False),
        (SURELY_ABOVE, (0.02, 0.001, 0.04), 0.0, True),
        (SURELY_ABOVE, (0.02, 0.0, 0.04), 0.0, False),
        (NOT_BELOW, (-0.01, -0.02, 0.0), 0.0, True),
        (NOT_BELOW, (-0.01, -0.02, -0.001), 0.0, False),
        (NOT_BELOW, (0.01, 0.005, 0.02), 0.0, True),
    ],
)
def test_rules(rule, figure, bound, holds):
    assert rule.holds(Figure(*figure), bound) is holds


def test_a_difference_is_found_whichever_agent_comes_first():
    target = Target("rise-belief", "step", 1.0, VEHICLE, (0, 0), SURELY_ABOVE, "pcbc")
    expected = {"safety": Figure(0.03, 0.01, 0.05), "reach": Figure(-0.02, -0.04, 0.0)}
    forward = pair((0.03, 0.01, 0.05), (-0.02, -0.04, 0.0), "rise-belief", "pcbc")
    backward = pair((-0.03, -0.05, -0.01), (0.02, 0.0, 0.04), "pcbc", "rise-belief")
    for row in (forward, backward):
        assert measured(target, [], [row]) == expected
    assert met(target, expected) == {"safety": True, "reach": False}


def test_only_the_very_condition_counts():
    target = Target("rise", "episode", 1.0, VEHICLE, (96, 93))
    others = [
        *(rates(1, 1, "pcbc", "episode"), rates(1, 1, model="step")),
        *(rates(1, 1, model="episode", level=2.0), rates(1, 1, model="episode", env=PANDA)),
    ]
    assert measured(target, others, []) is None
    assert measured(target, [*others, rates(0.97, 0.92, model="episode")], []) == {
        "safety": Figure(0.97, pytest.approx(0.96), pytest.approx(0.98)),
        "reach": Figure(0.92, pytest.approx(0.91), pytest.approx(0.93)),
    }


def test_level_0_is_the_same_under_all_models():
    target = Target("rise", "", 0.0, VEHICLE, (-1, -1), AT_LEAST, "pcbc")
    rows = [pair((0.5, 0.4, 0.6), (0.5, 0.4, 0.6)), pair((0, 0, 0), (0, 0, 0), model="drift", level=0.0)]
    assert measured(target, [], rows) == {"safety": Figure(0, 0, 0), "reach": Figure(0, 0, 0)}


def test_the_table_says_what_is_met_and_what_was_not_measured():
    targets = (
        Target("rise", "step", 1.0, VEHICLE, (99.5, 98)),
        Target("pcbc", "step", 1.0, VEHICLE, (90, 90)),
        Target("rise", "", 0.0, VEHICLE, (-1, -1), AT_LEAST, "pcbc"),
        Target("cppo", "step", 1.0, PANDA, (90, 90)),
        Target("rise", "step", 1.0, VEHICLE, (0, 0), SURELY_ABOVE, "pcbc"),
    )
    summary = [rates(0.995, 0.985), rates(0.95, 0.89, "pcbc")]
    comparisons = [
        pair((-0.02, -0.03, -0.01), (-0.011, -0.02, 0.0), level=0.0),
        pair((0.045, 0.04, 0.05), (0.095, 0.09, 0.1)),
    ]
    lines = acceptance(summary, comparisons, targets).splitlines()
    assert lines[0].startswith("2 of 4 targets are met on both rates; 1 not measured.")
    assert lines[4:] == [
        "| `rise`, `step` 1 | Ground vehicle | 99.5 [98.5–100.5] | 98.5 [97.5–99.5] | ≥ 99.5 / 98 | yes |",
        "| `pcbc`, `step` 1 | Ground vehicle | 95.0 [94.0–96.0] | 89.0 [88.0–90.0] | ≥ 90 | only Safety Rate |",
        "| `rise` − `pcbc`, level 0 | Ground vehicle | −2.0 [−3.0, −1.0] | −1.1 [−2.0, 0.0] | ≥ −1 | no |",
        "| `cppo`, `step` 1 | Franka Panda | – | – | ≥ 90 | not measured |",
        "| `rise` − `pcbc`, `step` 1 | Ground vehicle | 4.5 [4.0, 5.0] | 9.5 [9.0, 10.0] "
        "| > 0, all of the interval | yes |",
    ]


def test_no_target_is_set_twice():
    assert len({(target.title, target.env) for target in TARGETS}) == len(TARGETS)
