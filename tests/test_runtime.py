"""The control loop on a clock that is told: scheduling, watchdogs, limits, logs, and environments as robots."""

from __future__ import annotations

import gc
import os
import signal
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runtime_parts import LIMITS, PANDA, TASK, VEHICLE, C, Clock, Policy, Readings, Robot, T, make, regular

from rise_agents import make_agent
from rise_agents.rollout import rollout
from rise_agents.runtime import ControlLoop, EnvRobot, Limits, Observed, Reading, Rules, log, streams
from rise_agents.runtime.__main__ import main
from rise_agents.runtime.loop import Mind, Monotonic
from rise_agents.runtime.replay import decide_again
from rise_agents.runtime.replay import main as replay_main
from rise_agents.runtime.streams import NoisyStream, RobotReadings
from rise_agents.runtime.summary import errors, summarise
from rise_envs import ObservationNoise
from rise_envs.task import task_of


def begins(loop):
    return loop.recorder.log().numbers["begin"]


# --- time ------------------------------------------------------------------------------------------------------


def test_deadlines_do_not_drift():
    """Each period begins as late as its own wait ended, however late the others were and however long they took."""
    rng = np.random.default_rng(0)
    late, works = rng.integers(0, 16, 200) / 1024, rng.integers(0, 64, 200) / 1024
    clock = Clock(late)
    work = iter(works)
    loop = make(clock, Policy(lambda: clock.work(next(work)) or (1.0, 0.0)))
    loop.run(200 * T)
    np.testing.assert_array_equal(begins(loop) - T * np.arange(200), late)


def test_a_long_period_costs_those_that_passed_and_no_more():
    clock = Clock()
    works = iter([0.0, 2.5 * T, 0.0, 1.25 * T, *[0.0] * 20])
    loop = make(clock, Policy(lambda: clock.work(next(works)) or (1.0, 0.0)), rules=Rules(stale_after=9.0))
    loop.run(10 * T)
    found = loop.recorder.log()
    np.testing.assert_array_equal(found.period, [0, 1, 3, 4, 5, 6, 7, 8, 9])
    np.testing.assert_array_equal(begins(loop) / T, [0, 1, 3.5, 4, 5.25, 6, 7, 8, 9])
    assert [row for row, event in enumerate(found.events) if "overrun" in event] == [1, 3]
    assert (summarise(found).missed, summarise(found).overruns) == (1, 2)


@pytest.mark.parametrize(("late", "stops"), [(2, False), (3, True)])
def test_overruns_in_a_row_stop(late, stops):
    clock = Clock()
    works = iter([0.0, *[1.25 * T] * late, *[0.0] * 50])
    robot = Robot(clock)
    loop = make(
        clock, Policy(lambda: clock.work(next(works)) or (1.0, 0.0)), robot, rules=Rules(stale_after=9.0)
    )
    loop.run(20 * T)
    stopped = loop.watchdog.stopped
    assert (stopped is not None) == stops
    assert not stops or stopped.kind == "overrun"
    if stops:
        assert len(robot.times("apply")) == 4


def test_garbage_is_collected_afterwards_and_not_meanwhile():
    clock, seen = Clock(), []
    make(clock, Policy(lambda: seen.append(gc.isenabled()) or (1.0, 0.0))).run(3 * T)
    assert seen == [False] * 3 and gc.isenabled()


def test_the_monotonic_clock_never_returns_early():
    clock = Monotonic(spin=1e-4)
    for ahead in (0.0, 1e-5, 2e-3):
        until = clock.now() + ahead
        clock.wait(until)
        assert clock.now() >= until


# --- watchdogs -------------------------------------------------------------------------------------------------


@given(
    phase=st.floats(0.0, 0.999),
    every=st.floats(0.05, 1.0),
    lost=st.integers(3, 40),
    late=st.lists(st.floats(0.0, 0.1), max_size=60),
    delay=st.floats(0.0, 0.5),
)
def test_a_lost_stream_stops_the_robot_within_two_periods(phase, every, lost, late, delay):
    """Whatever the phase, rate and delay of the readings, and although each wait ends up to a tenth late."""
    clock = Clock([T * x for x in late])
    times = regular(clock, count=lost, every=every * T, phase=phase * T)
    robot = Robot(clock)
    loop = make(clock, robot=robot, readings=Readings(clock, times, delay * T))
    loop.run((lost * every + 8) * T)
    last = times[-1] - delay * T
    if loop.watchdog.stopped.kind == "stale" and robot.times("apply"):
        assert robot.stopped_at <= last + 2 * T + 1e-9
    assert loop.watchdog.stopped is not None
    assert all(time < last + 2 * T for time in robot.times("apply"))


def test_readings_that_are_fresh_enough_stop_nothing():
    clock = Clock()
    robot = Robot(clock)
    loop = make(clock, robot=robot, readings=Readings(clock, regular(clock, every=0.9 * T), delay=0.9 * T))
    loop.run(100 * T)
    assert loop.watchdog.stopped is None and len(robot.times("apply")) == 100
    assert robot.told[-1][1] == "stop"  # at the end of the run


def test_nothing_moves_before_the_first_reading():
    clock = Clock()
    robot, policy = Robot(clock), Policy()
    loop = make(clock, policy, robot, Readings(clock, regular(clock, phase=5.5 * T)))
    loop.run(10 * T)
    found = loop.recorder.log()
    assert len(robot.times("apply")) == policy.calls == 4
    assert min(robot.times("apply")) == clock.time - 10 * T + 6 * T
    assert found.events[6] == "go" and np.isnan(found.vectors["reading"][:6]).all()


def bad_once(value, at=4):
    return lambda number: value if number == at else C


TROUBLE = {
    "reading": {"obstacle": bad_once(np.array([np.nan, 0, 0, 0, 1.0]))},
    "reading, infinite": {"obstacle": bad_once(np.array([np.inf, 0, 0, 0, 1.0]))},
    "reading, of another size": {"obstacle": bad_once(np.zeros(7))},
    "action": {"wants": [(1.0, 0.5)] * 3 + [(np.nan, 0.0), (1.0, 0.5)]},
    "action, of another size": {"wants": [(1.0, 0.5)] * 3 + [(1.0, 0.0, 0.0), (1.0, 0.5)]},
    "action, no numbers": {"wants": [(1.0, 0.5)] * 3 + [("a", "b"), (1.0, 0.5)]},
    "policy": {"wants": [(1.0, 0.5)] * 3 + [lambda: 1 / 0, (1.0, 0.5)]},
}


def in_trouble(name, **rules):
    clock, what = Clock(), TROUBLE[name]
    robot, policy = Robot(clock), Policy(*what.get("wants", [(1.0, 0.5)]))
    readings = Readings(clock, regular(clock), obstacle=what.get("obstacle", C))
    loop = make(clock, policy, robot, readings, Rules(**rules))
    return clock, loop, robot, policy


@pytest.mark.parametrize("name", TROUBLE)
def test_what_is_wrong_stops_the_robot_until_it_is_told_to_go_on(name):
    clock, loop, robot, policy = in_trouble(name)
    start = clock.time
    clock.at = [(start + 8.5 * T, loop.restart)]
    loop.run(12 * T)
    kind = name.partition(",")[0]
    found = loop.recorder.log()
    assert found.events[3].startswith(f"stop: {kind}: ") and found.events[9] == "go"
    np.testing.assert_array_equal(robot.times("apply"), start + T * np.array([0, 1, 2, 9, 10, 11]))
    assert set(start + T * np.arange(3, 9)) <= set(robot.times("stop"))
    assert (found.vectors["action"][3:9] == 0).all() and np.isnan(found.vectors["wanted"][3:9]).all()
    assert policy.starts[-3:] == [True, False, False]  # what it remembered is void


@pytest.mark.parametrize("name", TROUBLE)
def test_what_passes_may_end_a_stop_but_no_error_of_the_policy(name):
    clock, loop, robot, _ = in_trouble(name, resume_after=3 * T)
    start = clock.time
    loop.run(12 * T)
    passing = name.startswith("reading")
    expected = [0, 1, 2, 7, 8, 9, 10, 11] if passing else [0, 1, 2]  # good from period 4 on
    np.testing.assert_array_equal(robot.times("apply"), start + T * np.array(expected))


def test_who_lets_a_going_robot_go_on_does_not_undo_a_stop_to_come():
    """Two people press the button, or one twice: the next error of the policy waits for a person all the same."""
    clock, loop, robot, _ = in_trouble("policy")
    start = clock.time
    clock.at = [(start + 1.5 * T, loop.restart)]
    loop.run(12 * T)
    assert loop.watchdog.stopped.kind == "policy"
    np.testing.assert_array_equal(robot.times("apply"), start + T * np.arange(3))


def test_a_state_that_is_not_finite():
    clock = Clock()
    robot = Robot(clock)
    robot.state = np.array([0.0, np.nan, 0.0])
    loop = make(clock, robot=robot)
    loop.run(3 * T)
    assert loop.watchdog.stopped.kind == "state" and not robot.times("apply")


class Odd(Readings):
    """Readings some of which are odd: the fourth, if nothing else is said."""

    def __init__(self, clock, odd):
        super().__init__(clock, regular(clock))
        self.odd, self.odd_ones = odd, (4,)

    def latest(self):
        reading = super().latest()
        return self.odd(reading) if reading.number in self.odd_ones else reading


READING, NUMBERS = "reading: TypeError: latest() must return Reading whose", "an array of numbers"


def no_answer(reading):
    raise OSError("no answer")


@pytest.mark.parametrize(
    ("odd", "says"),
    [
        (lambda reading: replace(reading, stamp=np.nan), "reading: is stamped nan"),
        (lambda reading: replace(reading, stamp=1e9), "reading: is stamped 1000000000.0"),
        (lambda reading: replace(reading, stamp=-1e9), "stale: the last reading is"),
        (lambda reading: None, "stale: no reading any more"),
        (no_answer, "reading: OSError: no answer"),
        (lambda reading: C, "reading: TypeError: latest() must return Reading, got ndarray"),
        (lambda reading: replace(reading, obstacle=C.tolist()), f"{READING} obstacle is {NUMBERS}, got list"),
        (
            lambda reading: replace(reading, obstacle=C.astype("O")),
            f"{READING} obstacle is {NUMBERS}, got object",
        ),
        (lambda reading: replace(reading, goal=[9.0, 0.0]), f"{READING} goal is {NUMBERS}, got list"),
        (lambda reading: replace(reading, stamp=None), f"{READING} stamp is a number, got None"),
    ],
)
def test_streams_that_go_wrong_stop_the_robot_for_good(odd, says):
    clock = Clock()
    robot = Robot(clock)
    loop = make(clock, robot=robot, readings=Odd(clock, odd))
    loop.run(8 * T)
    assert str(loop.watchdog.stopped).startswith(says) and len(robot.times("apply")) == 3
    assert any(says in event for event in loop.recorder.log().events)


@pytest.mark.parametrize(
    ("odd", "says"),
    [
        (lambda reading: replace(reading, obstacle=np.zeros(3)), "reading: has shape (3,), not (5,)"),
        (lambda reading: replace(reading, stamp=reading.stamp + 100.0), "reading: is stamped 164.0"),
        (lambda reading: replace(reading, stamp=reading.stamp - 100.0), "stale: the last reading is 800.00"),
        (no_answer, "reading: OSError: no answer"),
    ],
)
@pytest.mark.parametrize("ends", [1, 5, 99])
def test_why_nothing_moves_from_the_beginning_is_told_once_and_no_reason_not_to_begin(odd, says, ends):
    """The first reading is good, or comes after bad ones, or never."""
    clock = Clock()
    robot, readings = Robot(clock), Odd(clock, odd)
    readings.odd_ones = range(1, ends)
    loop = make(clock, robot=robot, readings=readings)
    loop.run(8 * T)
    found = loop.recorder.log()
    stops = summarise(found).stops
    assert len(stops) == (ends > 1) and len(robot.times("apply")) == max(0, 9 - ends)
    if stops:
        assert stops[0].startswith(f"waiting: no good reading yet ({says}") and stops[0] in found.events[0]
    assert str(loop.watchdog.stopped) == (stops[0] if ends == 99 else "None")


def test_nobody_acts_on_what_has_become_stale_while_it_was_decided():
    clock = Clock()
    robot, works = Robot(clock), iter([0.0, 1.9 * T, *[0.0] * 9])
    loop = make(clock, Policy(lambda: clock.work(next(works)) or (1.0, 0.0)), robot)
    loop.run(8 * T)
    assert loop.watchdog.stopped.kind == "stale" and len(robot.times("apply")) == 1


@pytest.mark.parametrize("fails", ["observe", "apply", "write"])
def test_a_robot_that_fails_ends_the_run_and_is_told_to_stop(fails):
    clock = Clock()
    robot = Robot(clock, fails)
    loop = make(clock, robot=robot)
    loop.run(10 * T)
    assert loop.watchdog.stopped.kind == "robot" and clock.time < 64.0 + 2 * T
    assert robot.told[-1][1] == "stop" and not robot.times("apply")


@pytest.mark.parametrize(
    ("observed", "says"),
    [
        (None, "must return Observed, got NoneType"),
        (np.zeros(3), "must return Observed, got ndarray"),
        (Observed([0.0, 0.0, 0.0], np.zeros(2)), f"must return Observed whose state is {NUMBERS}, got list"),
        (Observed(np.zeros(3), None), f"must return Observed whose goal is {NUMBERS}, got NoneType"),
    ],
)
def test_a_robot_that_returns_something_else_ends_the_run_and_is_told_to_stop(observed, says):
    clock = Clock()
    robot = Robot(clock)
    loop = make(clock, robot=robot)
    clock.at = [(clock.time + 2.5 * T, lambda: setattr(robot, "observe", lambda: observed))]
    loop.run(8 * T)
    assert str(loop.watchdog.stopped) == f"robot: TypeError: observe() {says}"
    assert robot.told[-1][1] == "stop" and len(robot.times("apply")) == 3
    assert loop.recorder.log().events == ["go", "", f"stop: {loop.watchdog.stopped}; end"]


def test_a_robot_that_cannot_be_told_to_stop_ends_the_run_with_a_log():
    clock = Clock()
    robot = Robot(clock)
    loop = make(clock, robot=robot)

    def stop():
        raise OSError("no answer")

    robot.stop = stop
    loop.run(3 * T)
    assert str(loop.watchdog.stopped) == "robot: OSError: no answer" and len(loop.recorder.log()) == 3


def test_an_interruption_stops_the_robot_and_keeps_what_happened():
    def interrupt():
        raise KeyboardInterrupt

    clock = Clock()
    robot = Robot(clock)
    loop = make(clock, Policy(*[(1.0, 0.5)] * 5, interrupt), robot)
    with pytest.raises(KeyboardInterrupt):
        loop.run(100 * T)
    found = loop.recorder.log()
    assert robot.told[-1][1] == "stop" and len(found) == 5 and gc.isenabled()
    assert found.events == ["go", "", "", "", "interrupted"] and not summarise(found).stops


def test_the_planned_end_is_logged_and_no_stop_of_a_watchdog():
    loop = make(Clock())
    loop.run(3 * T)
    found = loop.recorder.log()
    assert found.events == ["go", "", "end"] and not summarise(found).stops


@pytest.mark.parametrize(
    "rules", [{"stale_after": 1.0}, {"stale_after": np.nan}, {"overruns": 0}, {"resume_after": -1.0}]
)
def test_rules_that_make_no_sense(rules):
    with pytest.raises(ValueError, match=next(iter(rules))):
        Rules(**rules)


# --- limits ----------------------------------------------------------------------------------------------------

numbers = st.floats(-1e30, 1e30)


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=20), st.floats(0.01, 100.0))
def test_actions_keep_their_bounds_and_their_rate(wants, rate):
    limits = Limits(LIMITS.low, LIMITS.high, np.array([rate, 2 * rate]))
    last = limits.rest()
    for want in wants:
        action = limits(np.array(want), last, T)
        assert action.dtype == np.float32 and not action.flags.writeable
        assert (action >= LIMITS.low).all() and (action <= LIMITS.high).all()
        assert (np.abs(action - last.astype(np.float64)) <= T * limits.rate * (1 + 1e-6) + 1e-6).all()
        last = action


def test_limits_by_hand():
    limits = Limits(np.array([-1.0, -1.0]), np.array([1.0, 2.0]), np.array([2.0, 2.0]))
    np.testing.assert_array_equal(limits(np.array([9.0, -9.0]), np.zeros(2), 0.25), [0.5, -0.5])
    np.testing.assert_array_equal(limits(np.array([9.0, 9.0]), np.array([0.75, 1.75]), 0.25), [1.0, 2.0])
    np.testing.assert_array_equal(LIMITS.rest(), [0.0, 0.0])
    assert Limits(np.array([0.5]), np.array([1.0])).rest() == [0.5]
    for wrong in ([0.0], [-1.0, 1.0]):
        with pytest.raises(ValueError, match="rate"):
            Limits(LIMITS.low, LIMITS.high, np.array(wrong))


def test_what_is_limited_is_what_the_robot_gets():
    clock = Clock()
    robot = Robot(clock)
    loop = make(clock, Policy((9.0, -9.0)), robot)
    loop.run(4 * T)
    found = loop.recorder.log()
    given_to_it = np.array([action for _, what, action in robot.told if what == "apply"])
    np.testing.assert_array_equal(given_to_it, found.vectors["action"])
    np.testing.assert_array_equal(found.vectors["wanted"], [[9.0, -9.0]] * 4)
    np.testing.assert_array_equal(found.vectors["action"], [[2.5, -1.5]] * 4)


# --- logs ------------------------------------------------------------------------------------------------------


@pytest.fixture
def found():
    """Ten periods, of which one is bad."""
    _, loop, *_ = in_trouble("action")
    loop.run(10 * T)
    loop.recorder.about["env"] = VEHICLE
    return loop.recorder.log()


def test_a_log_survives_the_file(found, tmp_path):
    log.write(tmp_path / "run.parquet", found)
    again = log.read(tmp_path / "run.parquet")
    assert again.about == found.about and again.events == found.events
    for part in ("numbers", "flags", "vectors"):
        for name, column in getattr(found, part).items():
            np.testing.assert_array_equal(getattr(again, part)[name], column)


def test_files_that_are_no_logs(found, tmp_path):
    path = tmp_path / "run.parquet"
    with pytest.raises(ValueError, match="cannot be read"):
        log.read(path)
    log.write(path, found)
    content = path.read_bytes()
    for damaged in (b"", b"garbage", content[:-40], content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"run\.parquet"):
            log.read(path)
    table = pa.table({"period": [1.5]})
    for metadata in (
        None,
        {"schema": "other"},
        {"schema": log.SCHEMA, "about": "[]"},
        {"schema": log.SCHEMA, "about": "{}"},
    ):
        pq.write_table(table.replace_schema_metadata(metadata), path)
        with pytest.raises(ValueError, match="no log of a run"):
            log.read(path)


def hand_made(begin, **columns):
    n = len(begin)
    rest = {"deadline": np.zeros(n), "work": np.full(n, 0.01), "age": np.full(n, 0.02)}
    flags = {name: np.zeros(n, bool) for name in log.FLAGS}
    return log.Log(
        {"period": 0.1},
        columns.get("period", np.arange(n)),
        {"begin": np.array(begin), **rest, "clearance": np.array(columns.get("clearance", [np.nan] * n))},
        flags | {key: np.array(value) for key, value in columns.items() if key in log.FLAGS},
        {"wanted": np.array(columns.get("wanted", np.ones((n, 2))))},
        columns.get("events", [""] * n),
    )


def test_a_summary_by_hand():
    made = hand_made(
        [0.0, 0.1, 0.21, 0.3, 0.4, 0.6],
        period=np.array([0, 1, 2, 3, 4, 6]),
        clearance=[0.5, -0.1, -0.2, 0.3, -0.1, np.nan],
        reached=[False, True, True, False, True, False],
        begins=[True, False, True, False, False, False],
        wanted=[[1, 1]] * 4 + [[np.nan] * 2] * 2,
        events=["go", "", "overrun; stop: stale: old", "", "", ""],
    )
    np.testing.assert_allclose(errors(made), [0, 0.1, 0.1, 0, 1], atol=1e-9)
    s = summarise(made)
    assert (s.periods, s.missed, s.overruns, s.stops) == (6, 1, 1, ("stale: old",))
    assert (s.episodes, s.goals, s.collisions, s.clearance) == (2, 3, 3, -0.2)
    assert s.standing == pytest.approx(1 / 3) and s.age == 0.02


# --- environments as robots ------------------------------------------------------------------------------------


class Told(Clock):
    """Counts seconds of a real run without waiting for them."""


@pytest.fixture(scope="module")
def agent(vehicle_demonstrations):
    return make_agent("rise", VEHICLE, {"updates": 40, "vae_updates": 40}).learn(vehicle_demonstrations)


def controlled(policy, env_id=VEHICLE, periods=60, level=1.0, seed=5, clock=None, rules=None):
    clock, task = clock or Told(), task_of(env_id)
    robot = EnvRobot(env_id, clock, seed)
    stream = NoisyStream(RobotReadings(robot), task, "step", level, seed)
    env = gym.make(env_id)
    limits = Limits(env.action_space.low.astype(float), env.action_space.high.astype(float))
    loop = ControlLoop(Mind(policy, seed), robot, stream, task, limits, task.dt, rules, clock)
    loop.run(periods * task.dt)
    robot.close()
    return loop.recorder.log()


def test_a_run_is_the_episode_that_its_seed_names(agent):
    """State, noisy reading and clearance of every step are those of the environment behind its noise wrapper."""
    found = controlled(agent)
    env = ObservationNoise(gym.make(VEHICLE), "step")
    observation, info = env.reset(seed=5)
    for t in range(60):
        np.testing.assert_array_equal(found.vectors["state"][t], observation["observation"])
        np.testing.assert_array_equal(found.vectors["goal"][t], observation["desired_goal"])
        np.testing.assert_array_equal(found.vectors["reading"][t], observation["obstacle"])
        assert found.numbers["clearance"][t] == info["clearance"]
        observation, _, terminated, truncated, info = env.step(found.vectors["action"][t].astype(np.float32))
        assert not (terminated or truncated)


def test_episodes_follow_each_other():
    found = controlled(Policy((2.5, 0.0)), periods=450, level=0.0)
    first = np.flatnonzero(found.flags["begins"])
    s = summarise(found)
    assert first[0] == 0 and s.episodes == len(first) >= 3 and s.overruns == 0
    ends = first[1:] - 1
    assert all(found.flags["reached"][t] or t - f == 200 for t, f in zip(ends, first[:-1], strict=True))
    env = gym.make(VEHICLE)
    env.reset(seed=5)
    np.testing.assert_array_equal(found.vectors["goal"][first[1]], env.reset()[0]["desired_goal"])


def test_the_arm_as_a_robot():
    found = controlled(Policy((0.5, 0.0, 0.0)), PANDA, periods=5, level=0.0)
    env = gym.make(PANDA)
    observation, _ = env.reset(seed=5)
    for t in range(5):
        np.testing.assert_array_equal(found.vectors["state"][t], observation["observation"])
        observation, *_ = env.step(np.array([0.5, 0.0, 0.0], np.float32))
    env.close()


def test_a_run_can_be_decided_again(agent, vehicle_demonstrations):
    found = controlled(agent)
    assert decide_again(found, agent) == 0.0
    found.about["seed"] = 6
    assert decide_again(found, agent) > 1e-3


def test_a_loop_s_own_log_is_told_and_decided_again(agent, tmp_path, capsys):
    """Without a recorder of one's own, as a robot of one's own is driven."""
    agent.save(tmp_path / "agent.rise")
    log.write(tmp_path / "mine.parquet", controlled(agent))
    assert replay_main([str(tmp_path / "mine.parquet"), "--agent", str(tmp_path / "agent.rise")]) == 0
    told = capsys.readouterr().out
    assert "a policy in RISE-GroundVehicle-v0" in told and "60 run, 0 missed" in told
    assert "differ by 0.0e+00" in told


class Slow:
    """Another policy, some of whose decisions take too long, or are none."""

    def __init__(self, policy, clock, slow=(), spoilt=()):
        self.policy, self.clock, self.slow, self.spoilt, self.calls = policy, clock, slow, spoilt, 0
        self.initial_state, self.evaluate_deterministic = policy.initial_state, policy.evaluate_deterministic

    def predict(self, *arguments):
        wanted, state = self.policy.predict(*arguments)
        self.calls += 1
        if self.calls in self.slow:
            self.clock.work(0.25)
        return (wanted * np.nan if self.calls in self.spoilt else wanted), state


@pytest.mark.parametrize(("name", "first"), [("rise", 1), ("rise", 7), ("rise-belief", 7)])
def test_a_run_with_decisions_that_were_discarded_can_be_decided_again(
    vehicle_demonstrations, agent, name, first
):
    """What nobody acted on has drawn nothing, and nothing of it is remembered; the same of an episode's first one."""
    if name == "rise-belief":
        briefly = {"updates": 10, "belief_updates": 10, "belief_batch_size": 64, "belief_rows": 1_000}
        agent = make_agent(name, VEHICLE, briefly).learn(vehicle_demonstrations)
    clock = Told()
    slow = Slow(agent, clock, slow=(first, 20))
    found = controlled(slow, clock=clock, rules=Rules(resume_after=0.0))
    assert sum("stop: stale" in event for event in found.events) == 2
    assert np.isfinite(found.vectors["wanted"]).all(1).sum() == slow.calls - 2 > 40
    assert decide_again(found, agent) == 0.0


def test_a_decision_that_is_none_changes_nothing_that_is_remembered(agent):
    clock = Told()
    spoilt = Slow(agent, clock, spoilt=(7,))
    mind, seen = Mind(spoilt, 5), {key: np.ones(shape) for key, shape in TASK.shapes.items()}
    wants = [mind.decide(seen, False) for _ in range(7)]
    mind.discard()
    wants[6] = mind.decide(seen, False)
    assert mind.deterministic is False
    again = Mind(agent, 5)
    np.testing.assert_array_equal(wants, [again.decide(seen, False) for _ in range(7)])


def test_noise_is_drawn_once_for_a_reading():
    class Two:
        number = 1

        def latest(self):
            return Reading(C, 0.0, self.number)

    true = Two()
    stream = NoisyStream(true, TASK, "step", 1.0, 3)
    first = stream.latest()
    assert stream.latest() is first and np.abs(first.obstacle - C).max() > 1e-3
    true.number = 2
    assert np.abs(stream.latest().obstacle - first.obstacle).max() > 1e-3
    assert (NoisyStream(true, TASK, "step", 0.0, 3).latest().obstacle == C).all()


def test_noise_is_ready_before_the_first_period(monkeypatch):
    """What is compiled or loaded for a first draw takes longer than a period."""
    drawn = []

    class Noted(streams.NoiseRows):
        def start(self, *arguments):
            drawn.append("start")
            return super().start(*arguments)

    monkeypatch.setattr(streams, "NoiseRows", Noted)
    NoisyStream(RobotReadings(None), TASK, "step", 1.0, 3)
    assert drawn == ["start"]


class Given:
    """A stream of one reading."""

    def __init__(self, reading):
        self.latest = lambda: reading


@pytest.mark.parametrize("env_id", [VEHICLE, PANDA])
def test_a_virtual_obstacle_that_is_read_with_a_radius_below_zero_is_no_failure_of_the_robot(env_id):
    """Noise does that to a reading, and a recorded run is sent as it was read."""
    clock, task = Clock(), task_of(env_id)
    goal, c = np.zeros(task.dim), np.append(np.full(task.widths["obstacle"] - 1, 0.3), -0.5)
    robot = EnvRobot(env_id, clock, follow=Given(Reading(c, clock.now(), 1, goal)))
    for _ in range(2):
        seen = robot.observe()
        robot.stop()
    assert np.isfinite(seen.clearance)
    np.testing.assert_array_equal(seen.goal, goal)
    assert c[-1] == -0.5
    robot.close()


def test_a_vehicle_s_obstacle_can_be_placed():
    """Clearance of a step, of a vehicle at rest from a disc that comes nearer, in closed form."""
    env = gym.make(VEHICLE).unwrapped
    seen, _ = env.reset(seed=0)
    x, y, _ = seen["observation"]
    env.place([9.0, 9.0], [x + 4.0, y, -1.0, 0.0, 1.5])
    seen, *_, info = env.step(np.zeros(2, np.float32))
    assert info["clearance"] == pytest.approx(4.0 - 0.1 - 1.5 - 0.5)
    np.testing.assert_array_equal(seen["desired_goal"], [9.0, 9.0])
    env.place([9.0, 9.0], [x + 1.0, y, 0.0, 0.0, 1.5])
    assert env.step(np.zeros(2, np.float32))[-1]["cost"] == 1.0
    env.place([x, y], [x + 4.0, y, 0.0, 0.0, 1.5])
    assert env.step(np.zeros(2, np.float32))[2]  # at the goal


def test_the_arm_s_sphere_can_be_placed():
    env = gym.make(PANDA).unwrapped
    seen, _ = env.reset(seed=0)
    far = [0.2, 0.5, 0.6, 0.0, 0.0, 0.0, 0.05]
    env.place([0.1, 0.2, 0.3], far)
    at_rest = np.zeros(3, np.float32)
    seen, *_, info = env.step(at_rest)
    assert info["clearance"] > 0.2 and (seen["desired_goal"] == [0.1, 0.2, 0.3]).all()
    env.place([0.1, 0.2, 0.3], [*seen["observation"][:3], 0.0, 0.0, 0.0, 0.05])
    *_, info = env.step(at_rest)
    assert info["cost"] == 1.0 and info["clearance"] < 0
    env.place(seen["observation"][:3], far)
    *_, info = env.step(at_rest)
    assert info["is_success"] and info["cost"] == 0.0
    env.close()


@pytest.mark.parametrize("env_id", [VEHICLE, PANDA])
def test_placements_that_make_no_sense_change_nothing(env_id):
    env = gym.make(env_id).unwrapped
    seen, _ = env.reset(seed=0)
    goal, c = seen["desired_goal"], seen["obstacle"]
    for wrong in (
        (goal[:-1], c),
        (goal, c[:-1]),
        (goal * np.nan, c),
        (goal, np.append(c[:-1], np.inf)),
        (goal, np.append(c[:-1], 0.0)),
        (goal, "sphere"),
    ):
        with pytest.raises(ValueError, match=r"goal|obstacle"):
            env.place(*wrong)
    action = np.zeros(env.action_space.shape, np.float32)
    after = env.step(action)[0]
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(action)[0]["obstacle"], after["obstacle"])
    env.close()


# --- the command -----------------------------------------------------------------------------------------------


def test_the_command_runs_keeps_and_replays(agent, tmp_path, capsys):
    agent.save(tmp_path / "agent.rise")
    path, checkpoint = str(tmp_path / "runs" / "run.parquet"), str(tmp_path / "agent.rise")
    arguments = ["--agent", checkpoint, "--env", VEHICLE, "--seconds", "0.5", "--overruns", "1000"]
    assert main([*arguments, "--log", path, "--stale-after", "1000"]) == 0
    told = capsys.readouterr().out
    assert "timing " in told and "goals reached" in told and path in told
    found = log.read(path)
    assert 1 <= len(found) <= 5 and found.about["env"] == VEHICLE
    assert replay_main([path, "--agent", checkpoint]) == 0
    told = capsys.readouterr().out
    assert "  go" in told and "differ by 0.0e+00" in told


def test_a_run_that_cannot_be_kept_is_told(agent, tmp_path, capsys, monkeypatch):
    def full(path, found):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(log, "write", full)
    agent.save(tmp_path / "agent.rise")
    arguments = ["--agent", str(tmp_path / "agent.rise"), "--env", VEHICLE, "--seconds", "0.2"]
    assert main([*arguments, "--log", str(tmp_path / "run.parquet")]) == 1
    told = capsys.readouterr().err
    assert told.startswith("rise_agents.runtime: ") and "run.parquet" in told and told.count("\n") == 1


def test_a_robot_that_fails_is_told_and_the_run_is_kept(agent, tmp_path, capsys, monkeypatch):
    def broken(self):
        raise OSError("no answer from the drive")

    monkeypatch.setattr(EnvRobot, "observe", broken)
    agent.save(tmp_path / "agent.rise")
    arguments = ["--agent", str(tmp_path / "agent.rise"), "--env", VEHICLE, "--seconds", "0.2"]
    assert main([*arguments, "--log", str(tmp_path / "run.parquet")]) == 1
    told = capsys.readouterr().err
    assert told.startswith("rise_agents.runtime: ") and "no answer from the drive" in told
    assert len(log.read(tmp_path / "run.parquet")) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("first", [False, True])
def test_a_log_is_kept_though_a_signal_comes_while_it_is_written(agent, tmp_path, monkeypatch, number, first):
    """As the second Ctrl-C of somebody in a hurry, or a kill as the run ends."""
    written = log.write
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]

    def write(path, found):
        signal.raise_signal(number)
        written(path, found)

    def observe(self):
        if first:
            signal.raise_signal(number)
        return Observed(np.zeros(3), np.zeros(2))

    def stop(self):
        if first:
            signal.raise_signal(number)
        told.append("stop")

    told = []
    monkeypatch.setattr(log, "write", write)
    monkeypatch.setattr(EnvRobot, "observe", observe)
    monkeypatch.setattr(EnvRobot, "stop", stop)
    agent.save(tmp_path / "agent.rise")
    arguments = ["--agent", str(tmp_path / "agent.rise"), "--env", VEHICLE, "--seconds", "0.2"]
    code = main([*arguments, "--log", str(tmp_path / "run.parquet")])
    assert code == (130 if first else 0) and told[-1] == "stop"
    assert len(log.read(tmp_path / "run.parquet")) == (0 if first else 2)
    assert handlers == [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]


def test_signals_that_come_at_once_end_a_run_quietly(agent, tmp_path, capsys, monkeypatch):
    """Both are there before Python handles the first: nothing is raised where nobody can catch it."""
    both, complaints = (signal.SIGTERM, signal.SIGINT), []

    def observe(self):
        signal.pthread_sigmask(signal.SIG_BLOCK, both)
        for number in both:
            os.kill(os.getpid(), number)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, both)
        return Observed(np.zeros(3), np.zeros(2))

    monkeypatch.setattr(EnvRobot, "observe", observe)
    monkeypatch.setattr(sys, "unraisablehook", complaints.append)
    agent.save(tmp_path / "agent.rise")
    assert main(["--agent", str(tmp_path / "agent.rise"), "--env", VEHICLE, "--seconds", "0.2"]) == 130
    assert not complaints and not capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--env", "RISE-Vehicle-v0"], "did you mean 'RISE-GroundVehicle-v0'"),
        (["--agent", "nowhere.rise"], "does not exist"),
        (["--agent", "nowhere.onnx"], "cannot be read"),
        (["--env", PANDA], "was trained on"),
        (["--seconds", "0"], "--seconds"),
        (["--rate", "nan"], "--rate"),
        (["--noise-model", "stp"], "unknown noise model"),
        (["--noise-level", "-1"], "noise_level"),
        (["--stale-after", "0.5"], "stale_after"),
        (["--rate-limit", "1"], "rate must hold 2 numbers"),
        (["--seed", "-1"], "seed must not be negative"),
        (["--udp", "here"], "PORT or HOST:PORT"),
        (["--log", "x" * 300], "cannot write"),
        (["--log", "a\0b"], "cannot write"),
        (["--log", "/"], "it is a folder"),
        (["--udp", "256.256.256.256:5005"], "cannot listen"),
        (["--uxp", "5005"], "did you mean '--udp'"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(agent, tmp_path, capsys, arguments, says):
    agent.save(tmp_path / "agent.rise")
    given_first = ["--agent", str(tmp_path / "agent.rise"), "--env", VEHICLE]
    assert main([*given_first, *arguments]) == 2
    told = capsys.readouterr().err
    assert told.startswith("rise_agents.runtime: ") and says in told and told.count("\n") == 1


def test_replays_of_what_is_none(tmp_path, capsys, found, agent):
    assert replay_main([str(tmp_path / "run.parquet")]) == 2
    log.write(tmp_path / "run.parquet", found)
    assert replay_main([str(tmp_path / "run.parquet"), "--agent", "nowhere.rise"]) == 2
    del found.about["period"]
    log.write(tmp_path / "run.parquet", found)
    assert replay_main([str(tmp_path / "run.parquet")]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 3 and all(line.startswith("rise_agents.runtime.replay: ") for line in told)


def test_a_policy_can_be_an_exported_file(agent, tmp_path):
    from rise_agents.export import export, sample
    from rise_agents.runtime.policies import load_policy

    export(agent, tmp_path / "agent.onnx", sample(agent, 5, 5))
    ours, theirs = (
        controlled(each, periods=20) for each in (load_policy(str(tmp_path / "agent.onnx"), VEHICLE), agent)
    )
    np.testing.assert_allclose(ours.vectors["action"], theirs.vectors["action"], atol=1e-4)
    with pytest.raises(ValueError, match="is for"):
        load_policy(str(tmp_path / "agent.onnx"), PANDA)


def test_the_run_s_safety_is_the_roll_out_s(agent):
    """On true readings a run of one episode ends as a roll-out of it does."""
    found = controlled(agent, periods=201, level=0.0, seed=7)
    episodes, _ = rollout(agent, VEHICLE, [7], noise_seeds=[7], deterministic=False, slots=1)
    second = np.flatnonzero(found.flags["begins"])[1:2]
    steps = (second[0] if len(second) else len(found)) - 1
    assert steps == episodes.steps[0]
    assert found.numbers["clearance"][1 : steps + 1].min() == episodes.min_clearance[0]
