"""The distance between the kinematic arm and Bullet: its figures, tables and command line."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.fidelity import measure, page
from benchmarks.fidelity.__main__ import main
from rise_agents.rollout import Episodes


def paths(hand_mm: float) -> measure.Paths:
    """Five steps of four episodes, the last of which ends early."""
    hand = np.full((5, 4), hand_mm / 1000)
    hand[3:, 3] = np.nan
    clearance = np.full((5, 4), np.nan)
    clearance[0] = [0.003, -0.003, 0.003, -0.003]
    return measure.Paths(hand, clearance, np.arange(20).reshape(5, 4) == 7)


def episodes(safe: list[bool]) -> Episodes:
    zeros = np.zeros(len(safe))
    return Episodes(
        np.array(safe), np.array([True, True, False, True]), zeros.astype(int), zeros, zeros, zeros
    )


def rows() -> list[page.Row]:
    loops = measure.Loops(
        episodes([True, True, True, False]), episodes([True, True, False, False]), paths(1.5).hand
    )
    return [
        *page.path_rows("random", paths(9.0)),
        *page.path_rows("cbf", paths(2.0)),
        *page.loop_rows("expert-cbf", 1.0, loops),
    ]


def test_figures_and_their_targets() -> None:
    found = {(row.name, row.quantity): row for row in rows()}
    assert found["random", "hand, mean"].value == pytest.approx(9.0)
    assert not found["random", "hand, mean"].met and found["cbf", "hand, mean"].met
    assert found["cbf", "clearance, rms"].value == pytest.approx(3.0)
    assert found["cbf", "clearance, mean"].value == pytest.approx(0.0)
    assert found["cbf", "episodes on the table"].value == 25.0
    assert found["expert-cbf", "Safety, difference"].value == -25.0
    assert not found["expert-cbf", "Safety, difference"].met
    assert found["expert-cbf", "Reach, Bullet"].value == 50.0  # arrived without collision
    assert found["expert-cbf", "same outcome"].value == 75.0


def test_the_page_is_renewed_between_its_markers(tmp_path: Path) -> None:
    file = tmp_path / "page.md"
    file.write_text(f"before\n\n{page.BLOCK.begin}\nold\n{page.BLOCK.end}\nafter\n")
    content = page.markdown(rows(), "picture.png")
    for _ in range(2):
        page.BLOCK.update(file, content)
    text = file.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert "| random, away from the table | 9.0 |" in text
    assert "| expert-cbf, noise 1 | 75.0 / 50.0 | 50.0 / 50.0 | 75.0 |" in text
    file.write_text("no markers")
    with pytest.raises(ValueError, match="must hold"):
        page.BLOCK.update(file, content)


def test_the_command_measures_and_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def untrained(name: str, demos: int, updates: int, tell: Any) -> Any:
        return measure.make_expert("cbf", measure.BULLET)

    monkeypatch.setattr(measure, "trained", untrained)
    docs = tmp_path / "page.md"
    docs.write_text(f"{page.BLOCK.begin}\n{page.BLOCK.end}\n")
    (tmp_path / "images").mkdir()
    assert main(["--quick", "--out", str(tmp_path / "out"), "--docs", str(docs)]) == 0
    table = list(csv.DictReader((tmp_path / "out" / "fidelity.csv").read_text().splitlines()))
    by_name = {(row["name"], row["noise_level"], row["quantity"]): row for row in table}
    assert by_name["cbf", "", "hand, mean"]["met"] == "yes"
    assert float(by_name["expert-mpc", "0", "same outcome"]["value"]) == 100.0
    assert (tmp_path / "out" / "fidelity.png").read_bytes() == (
        tmp_path / "images" / "fidelity.png"
    ).read_bytes()
    assert "| rise, noise 1 |" in docs.read_text() and "| rise, noise 1 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"), [(["--episodes", "1"], "at least 3"), (["--episode", "9"], "--episodes")]
)
def test_bad_arguments(arguments: list[str], message: str, capsys: pytest.CaptureFixture) -> None:
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
