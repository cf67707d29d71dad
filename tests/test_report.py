import re

import pytest

from benchmarks import report
from benchmarks.results import SummaryRow

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


def row(env=VEHICLE, agent="rise", level=1.0, model="step", safe=0.859, reach=0.855, seeds=1, episodes=1000):
    """A row with intervals of ±2 points."""
    rates = (safe, safe - 0.02, min(safe + 0.02, 1.0), reach, reach - 0.02, min(reach + 0.02, 1.0))
    return SummaryRow(env, agent, model, level, seeds, episodes, *rates, 0.976, 1.25, 87.345)


SUMMARY = [
    row(level=0.0, safe=0.979),
    row(),
    row(agent="pcbc", level=0.0),
    row(agent="pcbc", safe=0.813, reach=0.812),
    row(env=PANDA, agent="expert", safe=0.55, reach=0.54),
]
RUN = {"command": "python -m benchmarks.run --agents rise pcbc", "agents": {}}


def test_terminal_table_tells_every_row_and_fits_a_terminal():
    text = report.summary_table_text(SUMMARY, VEHICLE)
    lines = [line.split() for line in text.splitlines()]
    rows = [line for line in lines if line and line[0] in ("RISE", "PC-BC")]
    assert [line[:2] for line in rows] == [["RISE", "0"], ["PC-BC", "0"], ["RISE", "1"], ["PC-BC", "1"]]
    assert " ".join(rows[2]) == "RISE 1 85.9 [83.9–87.9] 85.5 [83.5–87.5] 97.6 1.25 87.3"
    assert text.startswith("Ground vehicle: fresh noise at every step, 1,000 episodes per row\n")
    assert max(map(len, text.splitlines())) <= 80
    assert "\x1b" not in text and "Panda" not in text


def test_terminal_table_names_the_noise_model_where_there_are_several():
    text = report.summary_table_text([row(), row(model="episode")], VEHICLE)
    assert "step 1" in text and "episode 1" in text


def test_terminal_table_of_an_env_without_results():
    with pytest.raises(
        ValueError, match="no results of parking-v0; there are some of RISE-GroundVehicle-v0, RISE-S"
    ):
        report.summary_table_text(SUMMARY, "parking-v0")


def test_page_states_the_findings_in_words():
    page = report.summary_markdown(SUMMARY, RUN)
    assert (
        "**Ground vehicle.** At noise level 1 (fresh noise at every step) RISE kept 85.9 % (83.9–87.9) of 1,000 "
        "episodes safe and reached the goal without collision in 85.5 % (83.5–87.5); "
        "PC-BC 81.3 % (79.3–83.3) and 81.2 % (79.2–83.2).\n"
    ) in page
    assert "**Franka Panda.** At noise level 1 (fresh noise at every step) Expert kept 55.0 %" in page


def test_page_has_a_well_formed_table_per_task_with_every_row():
    page = report.summary_markdown(SUMMARY, RUN)
    tables = re.findall(r"^### (.*)\n\n((?:\|.*\n)+)", page, flags=re.M)
    assert [title.partition(":")[0] for title, _ in tables] == ["Ground vehicle", "Franka Panda"]
    for (_, table), n_rows in zip(tables, (4, 1), strict=True):
        lines = table.splitlines()
        assert len(lines) == n_rows + 2 and {line.count("|") for line in lines} == {8}
    assert "| PC-BC | 1 | 81.3 [79.3–83.3] | 81.2 [79.2–83.2] | 97.6 | 1.25 | 87.3 |" in page


def test_page_shows_figures_and_links_films():
    assert "![Safety Rate and Reach Rate of every agent](comparison.png)" in report.summary_markdown(
        SUMMARY, RUN
    )
    page = report.summary_markdown(SUMMARY, RUN | {"figures": {"v/a.png": "Key frames", "v/a.mp4": "A film"}})
    assert "![Key frames](v/a.png)" in page and "\n[A film](v/a.mp4)" in page and "comparison.png" not in page


def test_page_says_how_agents_were_trained_and_how_to_repeat():
    facts = {
        "rise": {VEHICLE: {"beta": 0.03, "hidden": [128, 128], "n_demos": 2000}, PANDA: {"frame": "hand"}}
    }
    agents = facts | {"pcbc": {"layer_norm": True, "epochs": 3}, "cppo": "not trained here", "expert": {}}
    page = report.summary_markdown(SUMMARY, RUN | {"agents": agents})
    assert (
        "- **RISE**\n"
        "  - **Ground vehicle**: beta 0.03, hidden [128, 128], n demos 2,000\n"
        "  - **Franka Panda**: frame hand\n"
        "- **PC-BC**: layer norm yes, epochs 3\n"
        "- C-PPO: not trained here\n"
        "- **Expert**\n"
    ) in page
    assert page.endswith("```sh\npython -m benchmarks.run --agents rise pcbc\n```\n")


def test_page_of_clean_readings_and_of_several_seeds():
    page = report.summary_markdown([row(level=0.0, seeds=5, episodes=5000)], RUN)
    assert "At noise level 0 (clean readings) RISE kept 85.9 % (83.9–87.9) of 5,000 episodes safe" in page
    assert "5,000 episodes per row of 5 training seeds" in page


def test_an_empty_summary_has_no_page():
    with pytest.raises(ValueError, match="empty"):
        report.summary_markdown([], RUN)
