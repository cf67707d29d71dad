"""What Weights & Biases is told of a run; the library itself is played by a stand-in."""

import json
import sys
from types import SimpleNamespace

import pyarrow as pa
import pytest
from hand_made import make_rows

from benchmarks import results, upload

VEHICLE = "RISE-GroundVehicle-v0"
CHECKPOINT = f"agents/{VEHICLE}/rise-seed0-abc.rise"
CURVES = {
    "rise-seed0-abc": [{"share": 0.5, "loss": 2.0}, {"share": 1.0, "loss": 1.0}],
    "cppo-seed0-def": [{"share": 0.1, "steps": 4_096.0, "return": 3.0}],
}


@pytest.fixture
def run(tmp_path):
    """A run folder: two rows of one training, one of another; seed 1 is not trained yet."""
    (tmp_path / "agents" / VEHICLE).mkdir(parents=True)
    for name, curve in CURVES.items():
        record = {"seconds": 1.0, "device": "cpu", "curve": curve}
        (tmp_path / "agents" / VEHICLE / f"{name}.json").write_text(json.dumps(record))
    agents = {
        "rise-seed0": CHECKPOINT,
        "rise+kalman-seed0": CHECKPOINT,
        "rise-seed1": CHECKPOINT.replace("seed0", "seed1"),
        "cppo-seed0": f"agents/{VEHICLE}/cppo-seed0-def.rise",
    }
    record = {
        "command": "python -m benchmarks.run",
        "plan": {"agents": ["rise", "cppo"]},
        "training": {"rise": {VEHICLE: {"learned from": "24 mixture episodes", "beta": 0.07}}},
        "agents": {VEHICLE: agents},
    }
    (tmp_path / "run.json").write_text(json.dumps(record))
    rows = [
        make_rows(6),
        make_rows(6, noise_level=0.5, safe=True),
        make_rows(6, agent="rise+kalman", safe=False),
    ]
    results.write_rows(tmp_path / "episodes.parquet", pa.concat_tables(rows))
    return tmp_path


class Library:
    """Stands in for the module ``wandb``."""

    def __init__(self, refuses=False):
        self.runs, self.refuses, self.configured = [], refuses, "online"

    def Settings(self, **how):  # their name
        return how

    def init(self, **how):
        if self.refuses:
            raise ConnectionError("no route\nto it")
        run = SimpleNamespace(how=how, logged=[], summary={}, ended=False)
        run.log = lambda figures, step: run.logged.append((step, figures))
        run.finish = lambda: setattr(run, "ended", True)
        mode = how["mode"] or self.configured
        run.offline, run.disabled = mode == "offline", mode == "disabled"
        self.runs.append(run)
        return run


@pytest.fixture
def library(monkeypatch):
    library = Library()
    monkeypatch.setitem(sys.modules, "wandb", library)
    monkeypatch.setattr(upload.importlib.util, "find_spec", lambda name: object())
    return library


def test_every_training_has_its_settings_curve_and_rates(run, library, capsys):
    assert upload.main([str(run), "--project", "mine"]) == 0
    assert capsys.readouterr().out == "2 trainings in project mine\n"
    rise, cppo = library.runs
    assert rise.how["id"] == f"rise-seed0-abc-{VEHICLE}" and rise.how["name"] == "rise, seed 0"
    assert (rise.how["project"], rise.how["mode"], rise.how["resume"]) == ("mine", None, "allow")
    told = {"env": VEHICLE, "agent": "rise", "seed": 0, "learned from": "24 mixture episodes", "beta": 0.07}
    assert rise.how["config"] == told
    assert rise.logged == [(500, {"loss": 2.0}), (1_000, {"loss": 1.0})]  # thousandths: it takes no steps
    assert rise.summary == pytest.approx(
        {
            "rise/step/1/safety_rate": 4
            / 6,  # of hand-made rows one in three is unsafe, the last one not arrived
            "rise/step/1/reach_rate": 3 / 6,
            "rise/step/0.5/safety_rate": 1.0,
            "rise/step/0.5/reach_rate": 5 / 6,
            "rise+kalman/step/1/safety_rate": 0.0,
            "rise+kalman/step/1/reach_rate": 0.0,
        }
    )
    assert [step for step, _ in cppo.logged] == [4_096] and cppo.summary == {}
    assert rise.ended and cppo.ended


def test_offline_it_writes_into_the_run_folder(run, library, capsys):
    assert upload.main([str(run), "--project", "mine", "--offline"]) == 0
    assert {(r.how["mode"], r.how["dir"]) for r in library.runs} == {("offline", str(run))}
    assert "wandb sync sends it" in capsys.readouterr().out


def test_its_own_word_for_offline_holds(run, library, capsys):
    """``WANDB_MODE=offline``, or ``wandb offline``, which the library reads where no mode is given."""
    library.configured = "offline"
    assert upload.main([str(run), "--project", "mine"]) == 0
    assert "wandb sync sends it" in capsys.readouterr().out


def test_what_is_disabled_is_in_no_project(run, library, capsys):
    library.configured = "disabled"
    assert upload.main([str(run), "--project", "mine"]) == 0
    assert capsys.readouterr().out.startswith("2 trainings in no project: WANDB_MODE")


def test_what_cannot_be_uploaded_is_one_line(run, tmp_path, library, monkeypatch, capsys):
    def refused(says, *arguments, code=2):
        assert upload.main([str(argument) for argument in arguments]) == code
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1

    refused("not the folder of a run", tmp_path / "no", "--project", "x")
    refused("--project", run)
    library.refuses = True
    refused("no route to it; with --offline", run, "--project", "x", code=1)
    monkeypatch.setattr(upload.importlib.util, "find_spec", lambda name: None)
    refused("rise-suite[wandb]", run, "--project", "x")
    (run / "agents" / VEHICLE / "rise-seed0-abc.json").write_text("{}")
    refused("not the record of a training", run, "--project", "x")
    for path in (run / "agents" / VEHICLE).glob("*.json"):
        path.unlink()
    refused("no training that has ended", run, "--project", "x")
