"""The estimate of a cluster's time: schedules that can be worked out by hand, times of the most similar jobs."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import cluster_estimate, job_times
from benchmarks.cluster_estimate import jobs_of, main, simulate
from benchmarks.job_times import Estimate, Time, described
from benchmarks.jobs import Job, evaluate, train
from benchmarks.pages import CLUSTER
from benchmarks.protocol import Scenarios


def job(name: str, *needs: str, weight: float = 1.0) -> Job:
    return Job(name, print, {}, Path(name), tuple(map(Path, needs)), weight)


def seconds(**known: float) -> dict[Path, float]:
    return {Path(name): float(value) for name, value in known.items()}


@pytest.mark.parametrize(
    ("workers", "wall"),
    [
        (1, 3 + 4 + 2 + 6 + 1),
        # worker 1: a 0–3, c 3–5, e 9–10; worker 2: b 0–4, d 4–10 (d needs b); e needs c and b
        (2, 10),
        (3, 10),
    ],
)
def test_a_schedule_is_the_one_that_is_worked_out_by_hand(workers, wall):
    jobs = [job("a"), job("b"), job("c", "a"), job("d", "b"), job("e", "c", "b")]
    cost = simulate(jobs, seconds(a=3, b=4, c=2, d=6, e=1), workers)
    assert (cost.wall, cost.work) == (wall, 16)
    assert cost.efficiency == pytest.approx(16 / (wall * workers))


def test_what_weighs_most_starts_first_however_long_it_takes():
    """Two workers. By weight: b and c first, a after c; a first would leave b to the end."""
    jobs = [job("a", weight=1), job("b", weight=9), job("c", weight=8)]
    times = seconds(a=2, b=5, c=1)
    assert simulate(jobs, times, 2).wall == 5
    assert simulate([job("a", weight=9), job("c", weight=8), job("b", weight=1)], times, 2).wall == 6


def test_more_workers_than_the_longest_chain_can_use_are_paid_in_vain():
    jobs = [job("a"), job("b", "a"), job("c", "b"), job("d")]
    cost = simulate(jobs, seconds(a=1, b=2, c=3, d=4), 100)
    assert cost.wall == 6
    assert cost.efficiency == pytest.approx(10 / 600)


def test_a_job_that_needs_what_nobody_makes_is_named():
    with pytest.raises(ValueError, match=r"^b needs what no job makes"):
        simulate([job("a"), job("b", "z")], seconds(a=1, b=1), 2)


def evaluation(row: str, count: int, env: str = "E") -> Job:
    arguments = {"env": env, "row": row, "seed": 0, "scenarios": Scenarios(0, count), "settings": {}}
    return Job("evaluate", evaluate, arguments, Path("x"))


def training(agent: str, config: dict, env: str = "E") -> Job:
    return Job("train", train, {"env": env, "agent": agent, "config": config}, Path("x"))


def test_the_most_similar_measured_jobs_count_by_their_amount_of_work():
    known = Estimate(
        [
            Time("jobs.evaluate", "E", "rise", "", 100, 10),
            Time("jobs.evaluate", "E", "rise", "", 300, 50),  # together 60 s for 400 episodes
            Time("jobs.evaluate", "E", "rise-belief", "", 100, 30),
            Time("jobs.evaluate", "E", "expert-cbf", "", 100, 70),
            Time("jobs.evaluate", "F", "rise", "", 100, 1),
        ]
    )
    assert known.seconds(evaluation("rise", 1000)) == pytest.approx(150)
    assert known.seconds(evaluation("rise-m4+kalman", 1000)) == pytest.approx(150)  # like rise
    assert known.seconds(evaluation("rise-belief-mean", 1000)) == pytest.approx(300)
    assert known.seconds(evaluation("random", 600)) == pytest.approx(160)  # the mean of E
    assert known.seconds(evaluation("rise", 700, "G")) == pytest.approx(161)  # the mean of all
    assert known.seconds(training("rise", {"updates": 10})) is None


def test_trainings_of_the_same_settings_count_before_others_of_the_agent():
    short, long = {"updates": 100, "vae_updates": 100}, {"updates": 100, "vae_updates": 100, "n_samples": 16}
    known = Estimate([described(training("rise", short), 20.0), described(training("rise", long), 60.0)])
    assert known.seconds(training("rise", long)) == pytest.approx(60)
    # Other settings of three times the updates: the mean of both.
    assert known.seconds(training("rise", {"updates": 400, "vae_updates": 200})) == pytest.approx(120)
    assert described(training("cppo", {"total_steps": 5000, "n_steps": 64})).amount == 5000


def test_times_that_were_written_are_read_and_a_torn_line_is_skipped(tmp_path):
    path, heard = tmp_path / job_times.NAME, []
    watch = job_times.noting(path, lambda job, share, figures: heard.append(share))
    watch(evaluation("rise", 100), 0.5, {"safe": 1.0})
    watch(evaluation("rise", 100), 1.0, {"seconds": 5.0, "core_seconds": 4.0})
    watch(evaluation("rise", 100), 1.0, {})  # it failed, or was there
    watch(evaluation("pcbc", 200), 1.0, {"seconds": 2.0, "core_seconds": 1.0})
    with path.open("a") as file:
        file.write("jobs.evaluate,E,ri")
    assert heard == [0.5, 1.0, 1.0, 1.0]
    lines = job_times.read(path)
    assert lines == [
        Time("jobs.evaluate", "E", "rise", "", 100, 4),
        Time("jobs.evaluate", "E", "pcbc", "", 200, 1),
    ]


def test_a_training_that_had_begun_before_is_no_measurement(tmp_path):
    path = tmp_path / job_times.NAME
    done = Job("train", train, {"env": "E", "agent": "rise", "config": {}}, tmp_path / "a.rise")
    done.output.with_suffix(".json").write_text('{"seconds": 50.0}')
    watch = job_times.noting(path, lambda job, share, figures: None)
    watch(done, 1.0, {"seconds": 20.0, "core_seconds": 20.0})
    assert not path.exists()
    watch(done, 1.0, {"seconds": 51.0, "core_seconds": 50.0})
    assert len(job_times.read(path)) == 1


def test_clips_and_traced_episodes_are_of_two_kinds():
    """Both functions are called record, and count their work in units of their own."""
    kinds = {job_times.kind(each) for each in jobs_of("smoke", videos=True)}
    assert {"videos.record", "explorer.record", "jobs.train", "jobs.evaluate"} < kinds


@pytest.fixture
def measured(tmp_path) -> Path:
    """A run folder in which every job of the smoke preset took a second, for each unit of its work."""
    watch = job_times.noting(tmp_path / job_times.NAME, lambda job, share, figures: None)
    for each in jobs_of("smoke", videos=False):
        if each.run is not train:
            took = described(each).amount
            watch(each, 1.0, {"seconds": took, "core_seconds": took})
    return tmp_path


def test_the_command_renews_the_block_of_a_page(measured, capsys):
    page = measured / "page.md"
    page.write_text(f"before\n{CLUSTER.begin}\nold\n{CLUSTER.end}\nafter\n")
    options = ["--preset", "smoke", "--no-videos", "--nodes", "1", "9", "--cores", "1", "--price", "3600"]
    assert main([str(measured), *options, "--docs", str(page)]) == 0
    told = capsys.readouterr().out
    # Per task 24 candidates, 24 to collect, 3 rows of 16 episodes; the trainings were not measured.
    work = 2 * (24 + 24 + 3 * 16)
    assert (
        f"| 1 | 1 | {work / 3600:.2f} | {work / 3600:.1f} | {work / 3600:.1f} | 100 % | {work:,.2f} |" in told
    )
    assert "`jobs.train`" in told.partition("Not measured, and not counted:")[2].partition("\n")[0]
    assert f"takes {(24 + 24 + 16) / 3600:.2f} h" in told
    assert page.read_text().startswith("before\n") and told.strip() in page.read_text()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--preset", "papre"], "unknown preset 'papre'"),
        (["--nodes", "0"], "--nodes takes whole numbers from 1"),
        (["--cores", "-1"], "--cores takes whole numbers from 1"),
        (["--price", "nan"], "--price must be a number"),
        (["--docs", "nowhere.md"], "cannot read the page 'nowhere.md'"),
    ],
)
def test_bad_arguments_get_one_line(measured, options, reason, capsys):
    assert main([str(measured), *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and reason in error


def test_a_folder_without_times_is_named(tmp_path, capsys):
    assert cluster_estimate.main([str(tmp_path)]) == 2
    assert f"cannot read {tmp_path / job_times.NAME}" in capsys.readouterr().err
