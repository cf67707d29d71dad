"""Tables of episodes: rates, their intervals, paired comparisons; CSV files."""

import csv
import itertools

import numpy as np
import pyarrow as pa
import pytest
from hand_made import make_rows
from scipy.stats import binomtest, trim_mean

from benchmarks import stats, tables

ENV = "RISE-GroundVehicle-v0"


def outcomes(safe, arrived=True, seeds=None, start=0, **changes):
    """Episodes of one agent with these outcomes, a line per training seed."""
    safe = np.atleast_2d(np.asarray(safe, bool))
    arrived = np.broadcast_to(arrived, safe.shape)
    seeds = range(len(safe)) if seeds is None else seeds
    parts = [
        make_rows(safe.shape[1], start, safe=line, arrived=there, train_seed=seed, **changes)
        for line, there, seed in zip(safe, arrived, seeds, strict=True)
    ]
    return pa.concat_tables(parts)


A = [[1, 1, 1, 1, 1, 0], [1, 1, 1, 1, 0, 0]]
B = [[1, 0, 0, 0, 1, 1], [0, 0, 1, 1, 0, 0]]  # against A: 3 and 2 only A, 1 and 0 only B


def test_summary_of_hand_made_episodes():
    rows = pa.concat_tables([make_rows(6), make_rows(6, train_seed=1)])
    (row,) = tables.summarise(rows)
    # Scenarios 0 and 3 are unsafe, 5 does not arrive: of six, 4 are safe, 5 arrive, 3 do both; twice over.
    assert (row.train_seeds, row.episodes) == (2, 12)
    assert (row.safety_rate, row.reach_rate, row.arrival_rate) == (8 / 12, 6 / 12, 10 / 12)
    assert (row.mean_cost, row.mean_steps) == (2 * 4 / 12, 102.5)
    assert (row.safety_iqm, row.reach_iqm) == (8 / 12, 6 / 12)
    assert row.clearance_iqm == pytest.approx(trim_mean([-0.1] * 4 + [0.1] * 8, 0.25))
    assert row.against == "" and row.safety_diff is None and row.reach_diff_p is None


def test_the_interval_of_one_training_seed_is_wilson_s():
    (row,) = tables.summarise(make_rows(6))
    assert (row.safety_low, row.safety_high) == pytest.approx((0.3000, 0.9032), abs=1e-4)
    assert (row.reach_low, row.reach_high) == pytest.approx((0.1876, 0.8124), abs=1e-4)


def test_equal_training_seeds_add_no_evidence():
    """Five copies of one seed: the scenarios alone vary, as the normal approximation of their number says."""
    rng = np.random.default_rng(0)
    safe = rng.random(400) < 0.8
    (row,) = tables.summarise(outcomes([safe] * 5))
    half = 1.96 * np.sqrt(safe.mean() * (1 - safe.mean()) / 400)
    assert (row.safety_low, row.safety_high) == pytest.approx(
        (safe.mean() - half, safe.mean() + half), abs=0.1 * half
    )


def test_rates_of_all_or_none_have_the_interval_of_the_scenarios():
    (row,) = tables.summarise(outcomes(np.ones((3, 20)), arrived=False))
    assert (row.safety_low, row.safety_high) == tuple(map(float, stats.wilson(20, 20)))
    assert (row.reach_low, row.reach_high) == tuple(map(float, stats.wilson(0, 20)))


def test_the_iqm_of_rates_is_over_training_seeds():
    safe = np.arange(10) < np.array([[0], [5], [6], [7], [10]])
    (row,) = tables.summarise(outcomes(safe))
    assert row.safety_iqm == pytest.approx(0.6)  # of the middle three
    assert row.safety_rate == pytest.approx(0.56)


def test_comparison_of_hand_made_episodes():
    rows = pa.concat_tables([outcomes(A, agent="rise"), outcomes(B, arrived=False, agent="pcbc")])
    summary, (row,) = tables.analyse(rows, ("rise", "pcbc"))
    assert (row.env, row.noise_model, row.noise_level, row.agent, row.other) == (
        ENV,
        "step",
        1,
        "rise",
        "pcbc",
    )
    assert (row.seeds, row.scenarios) == (2, 6)
    assert row.safety_diff == pytest.approx((9 - 5) / 12)
    assert (row.safety_only_a, row.safety_only_b) == (3 + 2, 1)
    assert (row.reach_diff, row.reach_only_a, row.reach_only_b) == (pytest.approx(9 / 12), 9, 0)
    safety, reach = (binomtest(k, n).pvalue for k, n in ((5, 6), (9, 9)))
    assert row.reach_p == pytest.approx(2 * reach) and row.safety_p == pytest.approx(
        safety
    )  # Holm: reach < safety
    assert row.safety_low <= row.safety_diff <= row.safety_high
    first, second = summary
    assert (first.agent, first.against, first.safety_diff) == ("rise", "", None)
    assert second.against == "rise"
    assert (second.safety_diff, second.safety_diff_low, second.safety_diff_high, second.safety_diff_p) == (
        *(-row.safety_diff, -row.safety_high, -row.safety_low, row.safety_p),
    )
    assert (second.reach_diff, second.reach_diff_low, second.reach_diff_high, second.reach_diff_p) == (
        *(-row.reach_diff, -row.reach_high, -row.reach_low, row.reach_p),
    )


def test_pairs_stand_in_order_and_references_second():
    agents = ("expert-mpc", "rise", "expert-cbf", "pcbc", "random")
    rows = pa.concat_tables([outcomes(A[:1], agent=agent) for agent in agents])
    summary, comparisons = tables.analyse(rows, agents)
    assert [(row.agent, row.other) for row in comparisons] == [
        *(("rise", "pcbc"), ("rise", "expert-mpc"), ("rise", "expert-cbf"), ("rise", "random")),
        *(("pcbc", "expert-mpc"), ("pcbc", "expert-cbf"), ("pcbc", "random")),
    ]
    assert {row.agent: row.against for row in summary} == {agent: "rise" for agent in agents} | {"rise": ""}
    assert tables.analyse(outcomes(A[:1], agent="random"))[1] == []


def test_a_row_of_one_seed_is_compared_with_every_seed():
    rows = pa.concat_tables([outcomes(A, agent="rise"), outcomes([[1, 1, 0, 0, 0, 1]], agent="random")])
    (row,) = tables.analyse(rows)[1]
    assert (row.agent, row.seeds, row.safety_only_a, row.safety_only_b) == ("rise", 2, 3 + 2, 1 + 1)
    assert row.safety_diff == pytest.approx((9 - 6) / 12)


def test_seeds_are_matched_by_number():
    rows = pa.concat_tables(
        [outcomes(A, agent="rise"), outcomes([B[1], A[0], A[0]], seeds=(1, 2, 7), agent="pcbc")]
    )
    (row,) = tables.analyse(rows, ("rise",))[1]
    assert (row.seeds, row.safety_only_a, row.safety_only_b) == (1, 2, 0)  # seed 1 of both
    apart = pa.concat_tables([outcomes(A, agent="rise"), outcomes(B, seeds=(5, 6), agent="pcbc")])
    assert tables.analyse(apart)[1] == []


def test_only_scenarios_that_both_met_are_compared():
    other = outcomes([[0, 1, 1, 0], [1, 0, 0, 1]], start=4, agent="pcbc")
    summary, (row,) = tables.analyse(pa.concat_tables([outcomes(A, agent="rise"), other]), ("rise",))
    assert (row.seeds, row.scenarios) == (2, 2)
    # Scenarios 4 and 5: 1 0 against 0 1, and 0 0 against 1 0.
    assert (row.safety_only_a, row.safety_only_b) == (1, 2)
    assert row.safety_diff == -1 / 4
    assert [line.episodes for line in summary] == [12, 8]


def test_an_interval_of_episodes_that_all_agree_is_not_a_point():
    rows = pa.concat_tables([outcomes(A, agent=agent) for agent in ("rise", "pcbc")])
    (row,) = tables.analyse(rows)[1]
    unseen = float(stats.wilson(0, 6)[1])
    assert (row.safety_diff, row.safety_low, row.safety_high, row.safety_p) == (0, -unseen, unseen, 1)


def test_p_values_are_corrected_within_an_environment():
    rng = np.random.default_rng(3)
    parts = [
        outcomes(
            rng.random((2, 40)) < rate, rng.random((2, 40)) < 0.9, env=env, agent=agent, noise_level=level
        )
        for env in ("A-v0", "B-v0")
        for agent, rate in (("rise", 0.9), ("pcbc", 0.7), ("cppo", 0.6))
        for level in (0.0, 1.0)
    ]
    comparisons = tables.analyse(pa.concat_tables(parts))[1]
    for env in ("A-v0", "B-v0"):
        of_env = [row for row in comparisons if row.env == env]
        assert len(of_env) == 6
        raw = [binomtest(r.safety_only_a, r.safety_only_a + r.safety_only_b).pvalue for r in of_env]
        raw += [binomtest(r.reach_only_a, r.reach_only_a + r.reach_only_b).pvalue for r in of_env]
        order = np.argsort(raw)
        expected, worst = np.empty(12), 0.0
        for place, index in enumerate(order):
            worst = max(worst, (12 - place) * raw[index])
            expected[index] = min(1.0, worst)
        assert [r.safety_p for r in of_env] + [r.reach_p for r in of_env] == pytest.approx(expected)


def test_episodes_that_do_not_pair_up_are_refused():
    with pytest.raises(
        ValueError, match=r"scenario 2 of RISE-GroundVehicle-v0 at step 1 has more than one noise_"
    ):
        noise_seed = np.array([0, 1, 7]) + 2**41
        tables.analyse(pa.concat_tables([make_rows(3), make_rows(3, agent="pcbc", noise_seed=noise_seed)]))
    with pytest.raises(ValueError, match="more than one env_seed"):
        tables.analyse(pa.concat_tables([make_rows(3), make_rows(3, train_seed=1, env_seed=5)]))
    with pytest.raises(
        ValueError, match="an episode of rise in RISE-GroundVehicle-v0 at step 1 occurs twice"
    ):
        tables.analyse(pa.concat_tables([make_rows(3), make_rows(3)]))


def test_lines_are_ordered_and_do_not_depend_on_the_order_of_rows():
    parts = [
        make_rows(env=env, agent=agent, noise_model=model, noise_level=level, episode_cost=np.arange(6) / 7)
        for env in ("B-v0", "A-v0")
        for agent in ("pcbc", "zebra", "expert", "rise", "ant")
        for model, level in (("step", 1.0), ("step", 0.0), ("episode", 1.0))
    ]
    rows = pa.concat_tables(parts)
    shuffled = rows.take(np.random.default_rng(0).permutation(rows.num_rows))
    found = tables.analyse(shuffled, agents=("rise", "pcbc", "expert"))
    assert found == tables.analyse(rows, agents=("rise", "pcbc", "expert"))
    summary, comparisons = found
    assert list(dict.fromkeys(r.env for r in summary)) == ["A-v0", "B-v0"]
    assert list(dict.fromkeys(r.agent for r in summary)) == ["rise", "pcbc", "expert", "ant", "zebra"]
    assert [(r.noise_model, r.noise_level) for r in summary[:3]] == [("episode", 1), ("step", 0), ("step", 1)]
    assert len(summary) == 30 and len(comparisons) == 2 * 3 * (6 + 4)
    conditions = [(r.env, r.noise_model, r.noise_level) for r in comparisons]
    assert [key for key, _ in itertools.groupby(conditions)] == sorted(set(conditions))
    assert tables.analyse(rows[:0]) == ([], [])


def test_only_agents_of_a_common_group_are_compared():
    names = ("rise", "pcbc", "cppo", "random")
    rows = pa.concat_tables([outcomes(A, agent=name) for name in names])
    summary, comparisons = tables.analyse(rows, names, [{"rise", "pcbc"}, {"pcbc", "cppo", "random"}])
    assert [(row.agent, row.other) for row in comparisons] == [
        *(("rise", "pcbc"), ("pcbc", "cppo"), ("pcbc", "random"), ("cppo", "random")),
    ]
    assert [row.against for row in summary] == ["", "rise", "", ""]


def test_summary_csv_is_stable_text(tmp_path):
    summary = tables.summarise(make_rows(noise_level=0.5))
    tables.write_table(tmp_path / "summary.csv", tables.SummaryRow, summary)
    assert (tmp_path / "summary.csv").read_bytes().decode() == (
        "env,agent,noise_model,noise_level,train_seeds,episodes,safety_rate,safety_low,safety_high,"
        "reach_rate,reach_low,reach_high,arrival_rate,mean_cost,mean_steps,safety_iqm,reach_iqm,clearance_iqm,"
        "against,safety_diff,safety_diff_low,safety_diff_high,safety_diff_p,"
        "reach_diff,reach_diff_low,reach_diff_high,reach_diff_p\n"
        "RISE-GroundVehicle-v0,rise,step,0.5,1,6,0.666667,0.299993,0.903229,"
        "0.5,0.187616,0.812384,0.833333,0.666667,102.5,0.666667,0.5,0.05,,,,,,,,,\n"
    )


def test_csv_quotes_what_needs_it(tmp_path):
    summary = tables.summarise(make_rows(agent='my, "own"'))
    tables.write_table(tmp_path / "summary.csv", tables.SummaryRow, summary)
    with (tmp_path / "summary.csv").open(newline="") as file:
        assert next(csv.DictReader(file))["agent"] == 'my, "own"'


def test_tables_survive_a_round_trip_to_six_digits(tmp_path):
    rows = pa.concat_tables([outcomes(A, agent="rise"), outcomes(B, agent="pcbc")])
    for kind, lines in zip((tables.SummaryRow, tables.ComparisonRow), tables.analyse(rows), strict=True):
        path = tmp_path / "table.csv"
        tables.write_table(path, kind, lines)
        back = tables.read_table(path, kind)
        tables.write_table(tmp_path / "again.csv", kind, back)
        assert (tmp_path / "again.csv").read_bytes() == path.read_bytes()
        for one, other in zip(lines, back, strict=True):
            for name in kind.__slots__:
                value, read = getattr(one, name), getattr(other, name)
                assert type(value) is type(read)
                assert read == (pytest.approx(value, rel=1e-5) if isinstance(value, float) else value)
    tables.write_table(path, tables.ComparisonRow, [])
    assert tables.read_table(path, tables.ComparisonRow) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "", "is not a table of comparisons"),
        (lambda text: text.replace("scenarios", "scenes"), "is not a table of comparisons"),
        (lambda text: text.replace(",6,", ",six,"), "is damaged"),
        (lambda text: text.rpartition(",")[0], "is damaged"),
        (lambda text: text.strip() + ",1\n", "is damaged"),
    ],
)
def test_foreign_tables_are_refused(tmp_path, change, message):
    path = tmp_path / "comparisons.csv"
    rows = pa.concat_tables([outcomes(A, agent="rise"), outcomes(B, agent="pcbc")])
    tables.write_table(path, tables.ComparisonRow, tables.analyse(rows)[1])
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=message):
        tables.read_table(path, tables.ComparisonRow)
    with pytest.raises(ValueError, match="cannot read"):
        tables.read_table(tmp_path / "absent.csv", tables.ComparisonRow)


@pytest.mark.parametrize(
    "levels, headline", [((0, 0.5, 1, 2), 1), ((0, 0.5), 0.5), ((0.5, 1.5), 0.5), ((2,), 2)]
)
def test_the_headline_level_is_the_papers_or_the_nearest(levels, headline):
    rows = pa.concat_tables([make_rows(noise_level=float(level)) for level in levels])
    assert tables.headline_level(tables.summarise(rows)) == headline


def test_agents_are_compared_where_both_have_been():
    """Of two agents with several seeds the common one, and there the common scenarios."""
    rows = [
        outcomes(A, agent="rise"),
        outcomes([B[0][:4]], agent="pcbc"),
        outcomes([B[1]], agent="pcbc", seeds=[2]),
    ]
    rows.append(outcomes([[1, 1, 0]], agent="expert-cbf", start=6))  # elsewhere: compared with nobody
    summary, (row,) = tables.analyse(pa.concat_tables(rows), ("rise", "pcbc"))
    assert (row.agent, row.other, row.seeds, row.scenarios) == ("rise", "pcbc", 1, 4)
    assert (row.safety_diff, row.safety_only_a, row.safety_only_b) == (3 / 4, 3, 0)
    by_agent = {row.agent: row for row in summary}
    assert (by_agent["pcbc"].train_seeds, by_agent["pcbc"].episodes) == (2, 10)
    assert by_agent["pcbc"].safety_rate == 3 / 10
    assert by_agent["expert-cbf"].safety_low == pytest.approx(float(stats.wilson(2, 3)[0]))
    assert by_agent["expert-cbf"].against == "" and by_agent["pcbc"].against == "rise"
