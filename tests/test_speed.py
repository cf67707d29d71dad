"""The speed table: what is computed from measurements, against cases made by hand, and that its command runs."""

from __future__ import annotations

import time
import tracemalloc
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

from benchmarks.speed import envs, measure, page, throughput
from benchmarks.speed.__main__ import main
from benchmarks.speed.agents import calls
from benchmarks.speed.measure import Effort, Result, Row, Sides, Target
from benchmarks.speed.rows import ROWS

FAST = ["--quick", "--rows", "vehicle", "memory"]


def silent(share, figures):
    pass


def row(ours, peer=None, target=None, note=str, **rest):
    """A row whose sides hand out the given figures one after the other."""
    made = [None if figures is None else partial(next, iter(figures)) for figures in (ours, peer)]

    @contextmanager
    def sides(effort):
        yield Sides(made[0], made[1], note)

    return Row("row", "A row", "µs", "a peer" if peer else "", target, sides, warm_up=False, **rest)


def test_medians_also_of_the_paired_ratios_and_their_quartiles():
    made = row([1.0, 8.0, 3.0], [2.0, 2.0, 6.0], Target(0.5))
    result = measure.measure(made, Effort(repeats=3), silent)
    assert (result.value, result.peer_value, result.ratio) == (3.0, 2.0, 0.5)
    assert (result.ratio_low, result.ratio_high) == (0.5, 2.25)  # of 0.5, 4 and 0.5
    assert (result.target, result.met, result.repeats) == ("≥ 0.5 ×", "yes", 3)


def test_without_a_peer_the_bound_is_on_the_figure():
    result = measure.measure(row([410.0], target=Target(400, at_least=False)), Effort(repeats=1), silent)
    assert (result.value, result.ratio, result.target, result.met) == (410.0, None, "≤ 400 µs", "no")


def test_a_row_without_target_is_only_reported():
    result = measure.measure(row([4.0], [2.0]), Effort(repeats=1), silent)
    assert (result.ratio, result.target, result.met) == (2.0, "", "")


def test_sides_take_turns_and_who_is_first_alternates():
    order = []
    sides = Sides(lambda: order.append("ours") or 1.0, lambda: order.append("peer") or 2.0)
    measure.take_turns(sides, 3, True, silent)
    assert order == ["ours", "peer", "ours", "peer", "peer", "ours", "ours", "peer"]  # the first two warm up


def test_rate_counts_pieces_until_the_time_is_over(monkeypatch):
    clock = iter([0.0, 0.4, 0.8, 1.2])
    monkeypatch.setattr(measure, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    assert measure.rate(lambda: 6, 1.0) == pytest.approx(18 / 1.2)


def test_table_survives_the_csv(tmp_path):
    results = [
        Result("a", 1.25, "µs", "peer", 2.5, 0.5, 0.4, 0.6, "≤ 0.3 ×", "no", 7, "a note, with a comma"),
        Result("b", None, "bytes", "", note="not measured: no such thing"),
    ]
    measure.write_csv(tmp_path / "speed.csv", results)
    assert measure.read_csv(tmp_path / "speed.csv") == results


def test_points_survive_the_csv(tmp_path):
    points = [throughput.Point("vehicles", 10, 1e6, 9e5, 1.1e6)]
    throughput.write_points(tmp_path / "points.csv", points)
    assert throughput.read_points(tmp_path / "points.csv") == points


def test_other_tables_are_refused(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        measure.read_csv(tmp_path / "speed.csv")
    (tmp_path / "speed.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="not a table of speeds"):
        measure.read_csv(tmp_path / "speed.csv")


def test_quantities_have_three_digits():
    figures = [(14_512_345, "14.5 M"), (98_765, "98,800"), (23.149, "23.1"), (0.01234, "0.0123")]
    assert [page.quantity(value, "s") for value, _ in figures] == [f"{text} s" for _, text in figures]
    assert page.quantity(None, "s") == "–"


def test_block_of_a_page_is_replaced_and_nothing_else():
    text = f"# Title\n\n{page.BLOCK.begin}\nold\n{page.BLOCK.end}\n\nafter\n"
    changed = page.BLOCK.replaced(text, "new")
    assert changed == f"# Title\n\n{page.BLOCK.begin}\n\nnew\n\n{page.BLOCK.end}\n\nafter\n"
    assert page.BLOCK.replaced(changed, "new") == changed


BEGIN, END = page.BLOCK.begin, page.BLOCK.end


@pytest.mark.parametrize("text", ["", BEGIN, END + BEGIN, (BEGIN + END) * 2])
def test_a_page_without_its_one_block_is_refused(text):
    with pytest.raises(ValueError, match="must hold the lines"):
        page.BLOCK.replaced(text, "new")


def test_tensor_bytes_count_each_array_once():
    array, tensor = np.zeros((3, 5)), torch.zeros(7, dtype=torch.int32)
    assert envs.tensor_bytes({"a": array, "b": [array, (tensor, {"c": tensor})], "d": "word"}) == 120 + 28


def test_memory_of_a_batch_is_what_it_holds(monkeypatch):
    """A batch of a known size: 80 bytes held per environment, 800 more in a reset, 160 more in a step."""

    class Batch(gym.vector.VectorEnv):
        def __init__(self, num_envs):
            self.num_envs, self.held = num_envs, np.zeros((num_envs, 10))
            self.action_space = gym.spaces.Box(0, 1, (1,))

        def reset(self, *, seed=None, options=None):
            np.zeros((self.num_envs, 100))

        def step(self, actions):
            np.zeros((self.num_envs, 20))

    monkeypatch.setattr(envs, "make_batch", lambda env_id, num_envs: Batch(num_envs))
    small, large = envs.traced(1_000), envs.traced(11_000)
    assert not tracemalloc.is_tracing()
    per_env = {key: (large[key] - small[key]) / 10_000 for key in small}
    assert per_env == pytest.approx({"held": 80, "step": 240, "reset": 880}, abs=4)


def test_steps_of_a_batch_go_through_one_cycle_of_episodes():
    env = envs.make_batch(envs.VEHICLE, 3)
    assert envs.steps_together(env, envs.VEHICLE)() == 201 * 3  # 200 steps and one of autoreset
    env.close()


def test_every_call_hands_the_state_on():
    given = []

    def predict(observation, state, deterministic):
        given.append((observation, state, deterministic))
        return None, observation

    assert calls(predict, ["a", "b", "c"], True)() == 3
    assert given == [("a", None, True), ("b", "a", True), ("c", "b", True)]


def test_command_measures_and_writes(tmp_path, capsys):
    started = time.time()
    assert main([*FAST, "--out", str(tmp_path)]) == 0  # whether or not a target is met
    results = {result.name: result for result in measure.read_csv(tmp_path / "speed.csv")}
    assert list(results) == ["vehicle", "memory"]
    assert results["vehicle"].value > 0 and results["vehicle"].peer_value > 0
    assert results["memory"].peer_value is None
    assert "Vehicle through make" in capsys.readouterr().out
    assert (tmp_path / "machine.txt").stat().st_mtime >= started - 1


def test_render_renews_a_page_from_the_last_measurement(tmp_path):
    docs, out = tmp_path / "docs", tmp_path / "out"
    out.mkdir()
    docs.mkdir()
    results = [Result("vehicle", 1e5, "steps/s", "CartPole-v1", 2e5, 0.5, 0.45, 0.55, "≥ 0.5 ×", "yes", 7)]
    measure.write_csv(out / "speed.csv", results)
    throughput.write_points(out / "throughput.csv", [throughput.Point("vehicles", 10, 1e6, 9e5, 1.1e6)])
    (out / "machine.txt").write_text("A machine.\n")
    place = docs / "performance.md"
    place.write_text(f"# Speed\n\n{page.BLOCK.begin}\n{page.BLOCK.end}\n")
    assert main(["--render", "--docs", str(place), "--out", str(out)]) == 0
    text = place.read_text()
    assert "A machine." in text and "(images/throughput.png)" in text
    assert (
        "| Vehicle through `make` | 100,000 steps/s | 200,000 steps/s | CartPole-v1 | 0.5 × [0.45–0.55] |"
        in text
    )
    assert (docs / "images" / "throughput.png").read_bytes().startswith(b"\x89PNG")


def test_a_row_that_fails_is_told_and_the_others_go_on(tmp_path, monkeypatch, capsys):
    def broken(effort):
        raise RuntimeError("no luck\nat all")

    @contextmanager
    def missing(effort):
        raise measure.Unavailable("no such device")
        yield

    monkeypatch.setitem(ROWS, "vehicle", replace(ROWS["vehicle"], sides=broken))
    monkeypatch.setitem(ROWS, "panda", replace(ROWS["panda"], sides=missing))
    assert main(["--quick", "--rows", "vehicle", "panda", "memory", "--out", str(tmp_path)]) == 1
    results = measure.read_csv(tmp_path / "speed.csv")
    assert [result.value is None for result in results] == [True, True, False]
    assert results[1].note == "not measured: no such device"
    told = capsys.readouterr().err
    assert "failed: vehicle: RuntimeError: no luck" in told and "panda" not in told.split("failed: ")[1]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--rows", "vehicel"], "did you mean 'vehicle'"),
        (["--repeats", "0"], "at least 1"),
        (["--render", "--out", "nowhere"], "cannot read"),
        (["--row", "vehicle"], "did you mean '--rows'"),
    ],
)
def test_wrong_arguments_are_told(tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert says in capsys.readouterr().err


def test_rows_name_themselves_and_slow_ones_wait_to_be_asked():
    assert all(name == each.name for name, each in ROWS.items())
    assert {name for name, each in ROWS.items() if not each.by_default} == {"bench", "bench-again"}
