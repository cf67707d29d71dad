"""The fault table: every row runs with a handful of trials, and every row can fail."""

from __future__ import annotations

import json
import os
import pickle
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cli import COMMANDS
from benchmarks.faults import (
    checkpoints,
    covered,
    datasets,
    disk_full,
    fuzz,
    hostile,
    kill_checkpoint,
    kill_run,
    measure,
    page,
    processes,
    replay,
    resume_training,
    save_load,
)
from benchmarks.faults.__main__ import main
from benchmarks.faults.measure import Effort, Fault, Findings, Result, Row, Target, Unavailable
from benchmarks.faults.programs import PROGRAMS, name_of
from benchmarks.faults.rows import ROWS
from rise_agents import demonstrations

VEHICLE = "RISE-GroundVehicle-v0"


def silent(share, figures):
    pass


@pytest.fixture
def effort(tmp_path):
    return Effort(0.001, folder=tmp_path, row="row")


def kinds(faults):
    return [fault.kind for fault in faults]


# --- rows and results ------------------------------------------------------------------------------------------


def row(run, **rest):
    return Row("row", "A row", "trials", "faults", run, **rest)


def test_faults_are_counted_by_kind_and_say_how_to_repeat_them():
    def run(effort, tell):
        findings = Findings()
        findings.add(3, [("lost", "a file")])
        findings.add(4, [("lost", "another"), ("late", "2 s")])
        return findings

    result, lines = measure.measure(row(run), Effort(seed=7), silent)
    assert (result.trials, result.faults, result.found, result.met) == (2, 3, "2 lost, 1 late", "no")
    assert lines[0] == "row: lost: a file (again: --rows row --seed 7 --only 3)"


def test_a_row_that_fails_itself_is_not_met():
    def run(effort, tell):
        raise RuntimeError("broken\nin two lines")

    result, lines = measure.measure(row(run), Effort(), silent)
    assert result.met == "no" and "RuntimeError: broken" in lines[0] and "\n" not in lines[0]


def test_what_a_machine_lacks_is_no_fault():
    def run(effort, tell):
        raise Unavailable("no such thing")

    result, lines = measure.measure(row(run), Effort(), silent)
    assert (result.met, result.note, lines) == ("", "not tried: no such thing", [])


@pytest.mark.parametrize(("figure", "share", "met"), [(91.0, 1.0, "yes"), (89.0, 1.0, "no"), (89.0, 0.5, "")])
def test_a_figure_of_its_own_is_judged_in_full_only(figure, share, met):
    made = row(lambda effort, tell: Findings(3, [], figure), target=Target(90.0, "%"), scaled=False)
    result, _ = measure.measure(made, Effort(share), silent)
    assert (result.found, result.target, result.met) == (f"{figure:g} %", "≥ 90 %", met)


def test_shares_round_up():
    assert [Effort(share).count(100, 2) for share in (1.0, 0.02, 0.025, 0.0001)] == [100, 2, 3, 2]
    assert Effort(only=17).numbers(100) == [17]


def test_random_numbers_follow_from_seed_row_and_trial():
    a = Effort(seed=1, row="a")
    draws = [
        e.rng(n).random()
        for e, n in ((a, 0), (a, 0), (a, 1), (replace(a, row="b"), 0), (replace(a, seed=2), 0))
    ]
    assert draws[0] == draws[1] and len(set(draws)) == 4


def test_table_survives_the_csv_and_is_drawn(tmp_path):
    results = [
        Result("fuzz", 10, 0, "0", "0", "yes", 1.5, 0.02, 3),
        Result("coverage", 4, 0, "91.2 %", "≥ 90 %", "", 1.5, 1.0, 3, "a note, with a comma"),
    ]
    measure.write_csv(tmp_path / "faults.csv", results)
    assert measure.read_csv(tmp_path / "faults.csv") == results
    assert "91.2 %" in page.table_text(results) and "coverage: a note" in page.table_text(results)
    text = page.markdown(results, "A machine.")
    assert "| Arguments and settings that make no sense | 10 attempts |" in text and "Seed: 3." in text
    assert "Shares of the full number of trials: 0.02, 1." in text


def test_a_table_of_something_else_is_refused(tmp_path):
    (tmp_path / "faults.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="not a table of faults"):
        measure.read_csv(tmp_path / "faults.csv")


def test_folders_of_trials_are_removed_and_what_went_wrong_is_kept(effort):
    with effort.scratch(3) as place:
        (place / "file").write_text("x")
        effort.keep(place, "3")
        effort.keep(place / "file", "copy")
    assert sorted(str(p.relative_to(effort.folder)) for p in effort.folder.rglob("*") if p.is_file()) == [
        "row-faults/3/file",
        "row-faults/copy",
    ]


# --- the command -----------------------------------------------------------------------------------------------


def fake_rows(monkeypatch, faults):
    findings = Findings()
    findings.add(0, faults)
    fakes = {"fuzz": replace(ROWS["fuzz"], run=lambda effort, tell: findings)}
    monkeypatch.setattr("benchmarks.faults.rows.ROWS", fakes)


@pytest.mark.parametrize(("faults", "code"), [([], 0), ([("late", "2 s")], 1)])
def test_the_command_writes_table_and_page(tmp_path, monkeypatch, capsys, faults, code):
    fake_rows(monkeypatch, faults)
    docs, out = tmp_path / "page.md", tmp_path / "out"
    docs.write_text(f"before\n{page.BLOCK.begin}\n{page.BLOCK.end}\nafter\n")
    assert main(["--quick", "--docs", str(docs), "--out", str(out)]) == code
    said = capsys.readouterr()
    assert "Arguments and settings" in said.out and ("--only 0" in said.err) == bool(faults)
    assert "| 1 attempts |" in docs.read_text() and docs.read_text().endswith("after\n")
    assert sorted(path.name for path in out.iterdir()) == [
        "faults.csv",
        "faults.md",
        "faults.txt",
        "machine.txt",
    ]
    assert main(["--render", "--out", str(out)]) == code  # from what is there


def test_rows_that_are_not_tried_again_stay(tmp_path, monkeypatch):
    """And the exit code speaks of those that were tried."""
    found, fine = Findings(), Findings()
    found.add(0, [Fault("late", "2 s")])
    fine.add(0, [])
    rows = {
        "kill-run": replace(ROWS["kill-run"], run=lambda effort, tell: fine),
        "fuzz": replace(ROWS["fuzz"], run=lambda effort, tell: found),
    }
    monkeypatch.setattr("benchmarks.faults.rows.ROWS", rows)
    codes = [main(["--rows", name, "--out", str(tmp_path)]) for name in ("fuzz", "kill-run")]
    assert codes == [1, 0]
    assert [row.name for row in measure.read_csv(tmp_path / "faults.csv")] == ["kill-run", "fuzz"]
    rows["fuzz"] = replace(ROWS["fuzz"], run=lambda effort, tell: fine)
    assert main(["--rows", "fuzz", "--out", str(tmp_path)]) == 0
    assert [row.met for row in measure.read_csv(tmp_path / "faults.csv")] == ["yes", "yes"]


def test_an_interruption_is_told(tmp_path, monkeypatch):
    def run(effort, tell):
        raise KeyboardInterrupt

    monkeypatch.setattr("benchmarks.faults.rows.ROWS", {"fuzz": replace(ROWS["fuzz"], run=run)})
    assert main(["--out", str(tmp_path)]) == 130


@pytest.mark.parametrize(
    "arguments",
    [
        ["--rows", "fuz"], ["--share", "0"], ["--share", "nan"], ["--quick", "--share", "0.1"], ["--seed", "-1"],
        ["--only", "3"], ["--only", "-1", "--rows", "fuzz"], ["--workers", "0"], ["--docs", "no/such/page.md"],
        ["--render"],
    ],
)  # fmt: skip
def test_bad_arguments(arguments, tmp_path, capsys):
    assert main(["--out", str(tmp_path), *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


# --- killed runs -----------------------------------------------------------------------------------------------

# A stand-in for the benchmark: two jobs and their results, in a second. `broken` does a finished job again.
STAND_IN = """
import os, subprocess, sys, time
from pathlib import Path
out, broken = Path(sys.argv[1]), sys.argv[2]
for job in range(2):
    path = out / "parts" / "env" / f"{job}.parquet"
    if path.exists() and broken != "again":
        continue
    path.parent.mkdir(parents=True, exist_ok=True)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(%s)" % (60 if broken == "orphan" else 0)])
    child.poll() if broken == "orphan" else child.wait()
    time.sleep(0.2)
    path.write_text(f"{job} {os.getpid() if broken == 'again' else ''}")
if broken == "stray":
    (out / ".partial-x").touch()
for name in ("episodes.parquet", "summary.csv", "comparisons.csv"):
    (out / name).write_text(str(os.getpid()) if broken == name else "the same")
sys.exit(broken == "code")
"""


@pytest.mark.parametrize(
    ("broken", "expected"),
    [
        ("", set()),
        ("again", {"finished job done again"}),
        ("summary.csv", {"different result"}),
        ("comparisons.csv", {"different result"}),
        ("stray", {"stray file"}),
        ("code", {"run failed"}),
    ],
)
def test_kill_run_notices(broken, expected, tmp_path, monkeypatch):
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    monkeypatch.setattr(kill_run, "command", lambda out, options=(): [str(script), str(out), ""])
    made = kill_run.reference(tmp_path / "reference")
    monkeypatch.setattr(kill_run, "command", lambda out, options=(): [str(script), str(out), broken])
    monkeypatch.setattr(kill_run, "TARGETS", ("parent",))
    out = tmp_path / "out"
    out.mkdir()
    (out / "parts" / "env").mkdir(parents=True)
    (out / "parts" / "env" / "0.parquet").write_text("0 ")
    killed, faults = kill_run.chain(np.random.default_rng(0), out, made, most=2)
    assert set(killed) <= {"parent"}
    found = set(kinds(faults))
    if broken == "again":
        before = kill_run.finished(out)
        (out / "parts" / "env" / "0.parquet").write_text("anew")
        found = set(kinds(kill_run.changed(before, kill_run.finished(out))))
    assert found == expected


def test_a_finished_job_that_is_gone_is_noticed(tmp_path):
    path = tmp_path / "agents" / "env" / "a.rise"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"weights")
    before = kill_run.finished(tmp_path)
    path.unlink()
    assert kinds(kill_run.changed(before, kill_run.finished(tmp_path))) == ["finished job lost"]


def test_orphans_are_noticed_and_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "PATIENCE", 0.3)
    monkeypatch.setattr(processes.orphans, "__defaults__", (0.3,))
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    process = processes.start([str(script), str(tmp_path), "orphan"], tmp_path / "log")
    while len(processes.members(process.pid)) < 2:
        time.sleep(0.01)
    assert processes.children(process.pid)
    what, faults = kill_run.disturb(process, "parent", 0.05, 0.0)
    assert what == "parent" and kinds(faults) == ["orphan"]
    assert processes.orphans(process.pid, 2.0) == []


def test_a_reference_run_that_fails_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(kill_run, "command", lambda out, options=(): ["-c", "raise SystemExit('no engine')"])
    with pytest.raises(RuntimeError, match="no engine"):
        kill_run.reference(tmp_path)


def test_kill_run_counts_kills(effort, monkeypatch):
    """In folders of the vehicle and of an arm, each beside an undisturbed run of its own."""
    ways = []

    def reference(place, options):
        return kill_run.Reference(float(len(options)), {}, frozenset())

    def chain(rng, out, made, most, options):
        ways.append(options)
        assert made.seconds == len(options)
        return ["parent", "worker"][:most], [Fault("lost", "x")]

    monkeypatch.setattr(kill_run, "reference", reference)
    monkeypatch.setattr(kill_run, "chain", chain)
    findings = kill_run.run(replace(effort, share=0.07), silent)
    assert findings.trials == 7 and len(findings.faults) == 4
    assert "4 of the parent, 3 of the worker" in findings.note
    assert ways == list(kill_run.OPTIONS) and "--envs" in ways[-1] and not ways[0]


@pytest.mark.slow
def test_kill_run(effort):
    assert kill_run.run(replace(effort, share=0.02), silent).faults == []


# --- killed writers --------------------------------------------------------------------------------------------


def test_kill_checkpoint(effort):
    findings = kill_checkpoint.run(effort, silent)
    assert (findings.trials, findings.faults) == (1, [])


def test_kill_checkpoint_notices_a_writer_that_overwrites_in_place(effort):
    # Every file of this one is torn: it never writes the end.
    saver = """
from benchmarks.faults.kill_checkpoint import overwrite
from rise_agents import checkpoint
def save(path, arrays, description):
    checkpoint.save(path.with_name("other"), arrays, description)
    path.write_bytes(path.with_name("other").read_bytes()[:-1])
overwrite(save)
"""
    found = kinds(kill_checkpoint.trial(0, effort, saver))
    assert "unreadable" in found and "stray file" in found


# --- full disks ------------------------------------------------------------------------------------------------


def test_disk_full(effort, monkeypatch):
    monkeypatch.setattr(disk_full, "_try_benchmark", lambda *arguments: None)
    monkeypatch.setattr(disk_full, "WRITERS", {"part": disk_full.write_part})
    findings = disk_full.run(effort, silent)
    assert findings.trials in (2, 4)  # with and without a disk of its own
    assert {fault.kind for _, fault in findings.faults} <= {"error without path"}


def in_place(path, version):
    path.write_bytes(bytes([version]) * 10_000)


def silently(path, version):
    try:
        path.with_name("temporary").write_bytes(bytes(10_000))
    except OSError:
        return


def unclear(path, version):
    if version:
        raise RuntimeError("no")
    path.write_bytes(bytes(10))


@pytest.mark.parametrize(
    ("write", "expected"),
    [
        (in_place, {"old file damaged", "error without path"}),
        (silently, {"stray file", "not told"}),
        (unclear, {"unclear error"}),
    ],
)
def test_disk_full_notices(write, expected, tmp_path):
    target = tmp_path / "place" / "file"
    target.parent.mkdir()
    target.touch()
    if write is silently:
        assert disk_full.files(tmp_path / "place") == {"file": b""}
        write_first = lambda path, version: silently(path, version) if version else None  # noqa: E731
    else:
        write_first = write
    found = disk_full.attempt(write_first, target, 5_000, disk_full.size_limit)
    assert set(kinds(found)) == expected


# --- forged files ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def agents(tmp_path_factory):
    place = tmp_path_factory.mktemp("agents")
    made = []
    for name in ("pcbc", "rise"):
        path = place / f"{name}.rise"
        checkpoints.train(name, VEHICLE).save(path)
        made.append(hostile.take_apart(path.read_bytes()))
    return made


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    return datasets.samples_of(tmp_path_factory.mktemp("sets"))


def test_forged_checkpoints_are_refused(agents, effort):
    found = checkpoints.portion(list(range(3 * len(checkpoints.FORGERS))), effort, agents)
    wrong = {fault for _, faults in found for fault in faults}
    assert len(found) == 3 * len(checkpoints.FORGERS)
    assert not {fault.kind for fault in wrong} - {"accepted"}
    assert all("signed, entry" in fault.details for fault in wrong)


def accepting(path):
    return path.read_bytes()


def unpickling(path):
    try:
        return pickle.loads(path.read_bytes())
    except Exception as error:
        raise checkpoints.CheckpointError(path, "no", "none") from error


def clumsy(path):
    raise KeyError(path)


def importing(path):
    header = hostile.take_apart(path.read_bytes()).header
    __import__(header["description"]["env"].partition(":")[0])


@pytest.mark.parametrize(
    ("load", "forger", "kind"),
    [
        (accepting, "bits flipped", "accepted"),
        (unpickling, "pickle bomb", "executed"),
        (clumsy, "truncated", "other exception"),
        (importing, "signed, environment", "executed"),
    ],
)
def test_forged_checkpoints_are_noticed(load, forger, kind, agents, effort, monkeypatch):
    monkeypatch.setattr(checkpoints, "FORGERS", {forger: checkpoints.FORGERS[forger]})
    found = checkpoints.portion(list(range(40)), effort, agents, load)
    assert kind in {fault.kind for _, faults in found for fault in faults}
    assert list((effort.folder / "row-faults").iterdir())


def test_hangs_and_long_errors_are_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(hostile, "PATIENCE", 0.1)

    def several_lines():
        raise ValueError("a\nb")

    with hostile.Marks(tmp_path) as marks:
        assert hostile.judge(lambda: time.sleep(5), ValueError, marks)[0][0] == "hang"
        assert hostile.judge(several_lines, ValueError, marks)[0][0] == "error of several lines"


def test_what_says_the_same_is_no_forgery(agents):
    good = agents[0]
    assert not checkpoints.differs(good.content, good)
    assert not checkpoints.differs(hostile.archive(good.arrays, good.header), good)
    assert checkpoints.differs(good.content + b"\0", good)
    assert checkpoints.differs(hostile.redescribed(good, env="other"), good)


@pytest.mark.parametrize("kind", ["folder", "fifo"])
def test_what_is_no_file_is_refused(kind, effort):
    assert checkpoints.not_a_file(kind, effort) == []


def test_what_is_no_file_is_noticed(effort, monkeypatch):
    monkeypatch.setattr(checkpoints, "_OPEN", "import sys; open(sys.argv[1]).read()")
    monkeypatch.setattr(hostile, "PATIENCE", 0.5)
    assert kinds(checkpoints.not_a_file("folder", effort)) == ["other exception"]
    assert kinds(checkpoints.not_a_file("fifo", effort)) == ["hang"]


def test_forged_demonstrations_are_refused(sets, effort):
    found = datasets.portion(list(range(2 * len(datasets.FORGERS))), effort, sets)
    wrong = {fault for _, faults in found for fault in faults}
    assert not {fault.kind for fault in wrong} - {"accepted"}
    assert all("env_kwargs" in fault.details or "card" in fault.details for fault in wrong)


def test_forged_demonstrations_are_noticed(sets, effort):
    found = datasets.portion(list(range(len(datasets.FORGERS))), effort, sets, accepting_folder)
    assert all(kinds(faults) == ["accepted"] for _, faults in found)


def accepting_folder(folder):
    return (folder / demonstrations.DATA).read_bytes()


def test_forged_minari_datasets(effort):
    found = dict(datasets.minari_portion([9, 19, 29, 39], effort))
    assert "executed" not in {fault.kind for faults in found.values() for fault in faults}
    assert found[9] == []  # a stored environment is never built


def test_forged_minari_datasets_are_noticed(effort):
    def load(dataset_id):
        store = Path(os.environ["MINARI_DATASETS_PATH"]) / dataset_id / "data" / "metadata.json"
        __import__(json.loads(json.loads(store.read_text())["env_spec"])["entry_point"].partition(":")[0])

    assert "executed" in kinds(dict(datasets.minari_portion([9], effort, load))[9])


def test_folders_without_data(tmp_path):
    for _, folder in datasets.no_data(tmp_path):
        with pytest.raises(demonstrations.DatasetError):
            demonstrations.load(folder)


# --- replay, storage, resumption -------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "history"), replay.ways(VEHICLE))
def test_replay(mode, history):
    seeds = [3, 4]
    alone = replay.digests(VEHICLE, "single", "fresh", seeds)
    assert replay.digests(VEHICLE, mode, history, seeds) == alone and len(set(alone.values())) == 2


def test_replay_notices_a_bit():
    same = {0: "a", 1: "b"}
    found = {("single", "fresh"): same, ("sync", "fresh"): same, ("sync", "used"): {0: "a", 1: "c"}}
    assert replay.compare(VEHICLE, found) == [
        (1, Fault("different episode", f"{VEHICLE}, seed 1, sync, used"))
    ]


def test_save_load_in_two_processes(effort, monkeypatch):
    monkeypatch.setattr(save_load, "BENCHMARKED", (VEHICLE,))
    findings = save_load.run(replace(effort, only=1), silent)  # PC-BC
    assert (findings.trials, findings.faults) == (40, [])


def test_save_load_notices(effort, monkeypatch):
    def each(self, function, tasks, fresh):
        for task in tasks:
            if function is save_load.stored:
                task[2].touch()
            yield task, ["a", "b" if function is save_load.stored else "c"]

    monkeypatch.setattr(Effort, "each", each)
    findings = save_load.run(replace(effort, only=0), silent)
    assert [fault.kind for _, fault in findings.faults] == ["other actions"]


def test_resume_training(tmp_path, effort, monkeypatch):
    made = resume_training.undisturbed("pcbc", VEHICLE, tmp_path)
    killed, faults = resume_training.trial(0, "pcbc", VEHICLE, made, effort)
    assert killed >= 0 and faults == []
    # The weights of another training are told apart.
    other = tmp_path / "other.rise"
    checkpoints.train("pcbc", VEHICLE, updates=7).save(other)
    assert kinds(resume_training.compare(made[0], other)) == ["other weights"]


def test_resume_training_notices_a_training_that_fails(tmp_path, effort, monkeypatch):
    monkeypatch.setattr(resume_training, "_LEARNER", "raise SystemExit('no state')")
    _, faults = resume_training.trial(0, "pcbc", VEHICLE, (tmp_path / "none", 0.1), effort)
    assert faults == [Fault("training failed", f"pcbc on {VEHICLE}, 0 kills: no state")]


# --- arguments -------------------------------------------------------------------------------------------------


def test_fuzz(effort):
    found = fuzz.portion(list(range(120)), effort)
    wrong = [fault for _, faults in found for fault in faults if fault.kind != "slow"]
    assert len(found) == 120 and wrong == []


def test_fuzz_knows_all_command_lines():
    assert {program.module for program in PROGRAMS} == {
        command.module.removesuffix(".__main__") for command in COMMANDS.values()
    }
    for program in PROGRAMS:
        names = {name_of(option) for option in program.options()}
        assert names >= {*program.valid, *program.beside, *program.endless}


def test_fuzz_in_a_process_of_its_own(effort):
    (number, faults, seconds), *rest = list(fuzz.in_processes([0], effort))
    assert number == 0 and seconds > 0 and not rest
    assert not [fault for fault in faults if fault.kind != "slow"]


@pytest.mark.parametrize(
    ("main", "kind"),
    [
        (lambda argv: 0, "wrong exit code"),
        (lambda argv: print("a\nb", file=sys.stderr) or 2, "not one line"),
        (lambda argv: print("a", file=sys.stderr) or print("b") or 2, "output"),
        (lambda argv: {}["x"], "traceback"),
        (lambda argv: time.sleep(1.1) or print("a", file=sys.stderr) or 2, "slow"),
        (lambda argv: time.sleep(20), "started"),
    ],
)
def test_fuzz_notices(main, kind, monkeypatch):
    monkeypatch.setattr(hostile, "PATIENCE", 1.5)
    monkeypatch.setattr(fuzz.Program, "main", lambda self, argv: main(argv))
    assert kind in [found for found, _ in fuzz.in_process(fuzz.PROGRAMS[0], [])]


def test_fuzz_notices_settings_that_break(monkeypatch):
    def broken(name, env, values):
        raise TypeError("no")

    monkeypatch.setattr(fuzz, "make_agent", broken)
    assert kinds(fuzz.configuration(np.random.default_rng(0))) == ["other exception"]


# --- coverage --------------------------------------------------------------------------------------------------


def test_coverage_of_one_file(effort):
    findings = covered.run(replace(effort, workers=1), silent, ["tests/test_cost.py"])
    assert findings.trials == 1 and 0 < findings.figure < 90 and findings.faults == []
    assert "least covered" in findings.note


def test_coverage_notices_a_failed_test_run(effort):
    findings = covered.run(replace(effort, workers=1), silent, ["tests/no_such_test.py"])
    assert [fault.kind for _, fault in findings.faults] == ["failed test run"]
