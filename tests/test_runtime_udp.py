"""Readings over UDP: the format by hand, hostile datagrams, loss and delay, over loopback and on a told clock."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runtime_parts import TASK, VEHICLE, C, Clock, Policy, Robot, T, make

from rise_agents.runtime import ControlLoop, log
from rise_agents.runtime.loop import Mind, Monotonic
from rise_agents.runtime.send import VirtualObstacle, main, recorded, send
from rise_agents.runtime.summary import summarise
from rise_agents.runtime.udp import DROPPED, Packet, Receiver, UdpStream, address, pack, size, unpack
from rise_agents.runtime.watchdog import Limits
from rise_envs.task import env_class

GOAL = np.array([9.0, -2.0])


def packet(sequence=1, stamp=0.0, session=7, goal=GOAL, obstacle=C):
    return Packet(session, sequence, stamp, np.asarray(goal), np.asarray(obstacle))


def forged(**changes):
    """A datagram by the table of the format, with a checksum that fits."""
    fields = {"magic": b"RISE", "version": 1, "dim": 2, "channels": 5, "session": 7, "sequence": 1}
    fields |= {"stamp": 2.5, "goal": GOAL, "obstacle": C} | changes
    head = struct.pack("<4sBBHQQd", *(fields[key] for key in list(fields)[:7]))
    body = head + struct.pack("<2d", *fields["goal"]) + struct.pack("<5d", *fields["obstacle"])
    return body + struct.pack("<I", zlib.crc32(body))


# --- the format ------------------------------------------------------------------------------------------------


def test_a_datagram_is_what_the_table_says():
    assert pack(packet(stamp=2.5)) == forged() and len(forged()) == size(2, 5) == 92
    found = unpack(forged(), 2, 5)
    assert (found.session, found.sequence, found.stamp) == (7, 1, 2.5)
    np.testing.assert_array_equal(found.goal, GOAL)
    np.testing.assert_array_equal(found.obstacle, C)


@pytest.mark.parametrize(
    ("data", "fate"),
    [
        (b"", "size"),
        (forged()[:-1], "size"),
        (forged() + b"\0", "size"),
        (b"x" * 92, "garbage"),
        (forged(magic=b"NOPE"), "garbage"),
        (forged(version=2), "garbage"),
        (forged(dim=3), "garbage"),
        (forged(channels=7), "garbage"),
        (forged(stamp=np.nan), "not finite"),
        (forged(goal=[np.inf, 0.0]), "not finite"),
        (forged(obstacle=[0.0, 0.0, 0.0, 0.0, np.nan]), "not finite"),
    ],
)
def test_whatever_is_not_exactly_that_is_dropped(data, fate):
    receiver = Receiver(TASK)
    assert receiver.receive(data, 0.0) == fate and fate in DROPPED
    assert receiver.latest() is None and receiver.counts == {fate: 1}


@given(st.integers(0, 91), st.integers(1, 255))
def test_a_changed_byte_is_noticed(place, change):
    data = bytearray(forged())
    data[place] ^= change
    assert unpack(bytes(data), 2, 5) == "garbage"


@given(st.binary(max_size=200))
def test_random_bytes_are_no_reading(data):
    assert unpack(data, 2, 5) in DROPPED


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("5005", ("127.0.0.1", 5005)),
        (":5005", ("127.0.0.1", 5005)),
        ("10.0.0.1:80", ("10.0.0.1", 80)),
        ("[::1]:9", ("::1", 9)),
    ],
)
def test_addresses(text, expected):
    assert address(text) == expected
    for wrong in ("", "host", "host:", "host:x", "1:65536", "1:-1"):
        with pytest.raises(ValueError, match="must be PORT"):
            address(wrong)


# --- order and age ---------------------------------------------------------------------------------------------


def fates(*steps):
    """What becomes of packets (sequence, stamp, arrival)."""
    receiver = Receiver(TASK)
    return [receiver.receive(pack(packet(n, stamp)), arrival) for n, stamp, arrival in steps], receiver


def test_what_comes_late_or_twice_is_dropped():
    found, receiver = fates(
        *[
            (1, 0.1, 5.1),
            (3, 0.3, 5.3),
            (2, 0.2, 5.31),
            (3, 0.3, 5.32),
            (1, 0.1, 5.33),
            (4, 0.2, 5.4),
            (5, 0.5, 5.5),
        ]
    )
    assert found == ["accepted", "accepted", "out of order", "duplicate", "duplicate", "time", "accepted"]
    assert receiver.latest().number == 3 and receiver.counts["accepted"] == 3


def test_age_is_counted_from_the_fastest_packet():
    """The sender's clock is 100 s behind; one packet takes 10 ms, another 60 ms longer than the fastest."""
    _, receiver = fates((1, 1.0, 101.01))
    assert receiver.latest().stamp == pytest.approx(101.01)
    receiver.receive(pack(packet(2, 1.1)), 101.1)
    assert receiver.latest().stamp == pytest.approx(101.1)
    receiver.receive(pack(packet(3, 1.2)), 101.26)
    assert receiver.latest().stamp == pytest.approx(101.2, abs=1e-4)


def test_clocks_may_drift_apart():
    """For an hour the sender's clock loses 100 millionths: readings do not seem older for it."""
    receiver = Receiver(TASK)
    for n in range(3_600):
        receiver.receive(pack(packet(n, n * (1 - 1e-4))), float(n))
    assert 3_599 - receiver.latest().stamp < 1e-3


def test_another_sender_takes_over_only_when_the_first_is_silent():
    receiver = Receiver(TASK)
    assert receiver.receive(pack(packet(50, 10.0)), 1.0) == "accepted"
    assert receiver.receive(pack(packet(0, 99.0, session=8)), 1.9) == "session"
    assert receiver.receive(pack(packet(0, 99.0, session=8)), 2.1) == "accepted"
    assert receiver.latest().stamp == pytest.approx(2.1)
    assert receiver.receive(pack(packet(51, 10.0)), 2.2) == "session"


# --- a loop and a bad network, on a clock that is told ---------------------------------------------------------


def run(arrivals, periods, **rules):
    """A loop whose receiver gets datagrams at given times (from the start)."""
    clock = Clock()
    receiver, robot = Receiver(TASK), Robot(clock)
    start = clock.time
    for arrival, data in sorted(arrivals, key=lambda pair: pair[0]):
        clock.at.append((start + arrival, lambda data=data: receiver.receive(data, clock.now())))
    policy = Policy()
    loop = make(clock, policy, robot, receiver)
    loop.run(periods * T)
    return loop, robot, receiver, start, policy


def test_loss_delay_and_garbage_stop_nothing_while_readings_come():
    rng = np.random.default_rng(1)
    arrivals = []
    for n in range(400):  # four a period: half of them lost, others late, twice, or followed by garbage
        sent = n * T / 4
        data = pack(packet(n, sent, obstacle=[n, 0, 0, 0, 1.0]))
        if n % 4 and rng.random() < 2 / 3:
            continue
        arrivals.append((sent + 0.5 * T * rng.random(), data))
        arrivals += [(sent + T * rng.random(), extra) for extra in (data, b"garbage", b"x" * 92)]
    loop, robot, receiver, *_ = run(arrivals, 98)
    found = loop.recorder.log()
    assert loop.watchdog.stopped is None and len(robot.times("apply")) >= 97
    assert (
        receiver.counts["size"] > 150
        and receiver.counts["garbage"] > 150
        and receiver.counts["duplicate"] > 50
    )
    seen = found.vectors["reading"][:, 0]
    assert (np.diff(seen[np.isfinite(seen)]) >= 0).all()  # never back to an older one
    np.testing.assert_array_equal(found.vectors["goal"][-1], GOAL)


def test_a_lost_sender_stops_the_robot_within_two_periods():
    for last in (40, 41, 42, 43):
        arrivals = [(n * T / 4, pack(packet(n, n * T / 4))) for n in range(last + 1)]
        loop, robot, _, start, _ = run(arrivals, 30)
        assert loop.watchdog.stopped.kind == "stale"
        assert robot.stopped_at <= start + last * T / 4 + 2 * T


def test_a_network_that_holds_packets_up_stops_the_robot():
    """They keep coming, each in time after the last, but two periods old."""
    arrivals = [(n * T / 4 + (2 * T if n > 40 else 0.0), pack(packet(n, n * T / 4))) for n in range(200)]
    loop, robot, *_ = run(arrivals, 40)
    assert loop.watchdog.stopped.kind == "stale" and len(robot.times("apply")) < 14


def test_the_policy_gets_goals_and_readings_of_the_stream():
    *_, policy = run([(0.0, pack(packet(1)))], 2)
    np.testing.assert_array_equal(policy.seen[0]["desired_goal"], GOAL)
    np.testing.assert_array_equal(policy.seen[0]["obstacle"], C)


# --- loopback --------------------------------------------------------------------------------------------------


def until(condition, seconds=30.0):
    ends = time.monotonic() + seconds
    while not condition() and time.monotonic() < ends:
        time.sleep(0.005)
    assert condition()


def test_over_loopback_every_datagram_is_accounted_for():
    """A sender that loses, delays, repeats, swaps and spoils its datagrams."""
    stream = UdpStream(TASK, ("127.0.0.1", 0), time.monotonic)
    sent = {"accepted": 0, "garbage": 0, "size": 0, "not finite": 0, "duplicate": 0, "out of order": 0}
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:

            def go(data, fate):
                out.sendto(data, stream.address)
                sent[fate] += 1
                until(lambda: sum(stream.receiver.counts.values()) == sum(sent.values()))

            for n in range(60):
                data = pack(packet(n, 0.01 * n, obstacle=[n, 0, 0, 0, 1.0]))
                if n % 10 == 9:  # lost
                    continue
                if n % 10 == 3:  # delayed: the next one overtakes it
                    held = data
                    continue
                go(data, "accepted")
                if n % 10 == 4:
                    go(held, "out of order")
                if n % 10 == 6:
                    go(data, "duplicate")
                    go(data[:50] + bytes([data[50] ^ 1]) + data[51:], "garbage")
                    go(b"hello", "size")
                    go(bytes(1_500), "size")
                    go(pack(packet(n + 1, 0.01 * n, goal=[np.nan, 0])), "not finite")
        assert stream.receiver.counts == sent
        assert stream.latest().obstacle[0] == 58 and stream.latest().number == sent["accepted"] == 48
    finally:
        stream.close()


def test_a_port_in_use_is_told(capsys, tmp_path):
    stream = UdpStream(TASK, ("127.0.0.1", 0), time.monotonic)
    try:
        with pytest.raises(OSError, match="in use"):
            UdpStream(TASK, stream.address, time.monotonic)
    finally:
        stream.close()


def test_the_sending_command_reaches_a_listener(capsys):
    stream = UdpStream(TASK, ("127.0.0.1", 0), time.monotonic)
    try:
        to = f"127.0.0.1:{stream.address[1]}"
        assert main(["--env", VEHICLE, "--to", to, "--seconds", "0.2", "--rate", "50", "--seed", "3"]) == 0
        until(lambda: sum(stream.receiver.counts.values()) == 10)
        assert "10 datagrams" in capsys.readouterr().out
        env = env_class(VEHICLE)()
        np.testing.assert_array_equal(stream.latest().goal, env.reset(seed=3)[0]["desired_goal"])
    finally:
        stream.close()


# --- what is sent ----------------------------------------------------------------------------------------------


def test_a_virtual_obstacle_moves_as_the_environment_s():
    source, env = VirtualObstacle(VEHICLE, 4), env_class(VEHICLE)()
    seen, _ = env.reset(seed=4)
    for _ in range(30):
        time_now = source._step * TASK.dt
        for part in (0.0, 0.5):
            goal, c = source(time_now + part * TASK.dt)
            position, velocity = seen["obstacle"][:2], seen["obstacle"][2:4]
            np.testing.assert_allclose(c[:2], position + part * TASK.dt * velocity, atol=1e-9)
            np.testing.assert_array_equal(c[2:], seen["obstacle"][2:])
            np.testing.assert_array_equal(goal, seen["desired_goal"])
        seen, *_ = env.step(np.zeros(2, np.float32))
        source((source._step + 1) * TASK.dt + 1e-9)


def test_a_recorded_run_is_sent_as_it_was_read():
    begin = np.array([0.5, 0.75, 1.0])
    reading, goal = np.array([np.full(5, np.nan), C, 2 * C]), np.tile(GOAL, (3, 1))
    made = log.Log({}, np.arange(3), {"begin": begin}, {}, {"reading": reading, "goal": goal}, [""] * 3)
    source = recorded(made)
    np.testing.assert_array_equal(source(0.0)[1], C)
    np.testing.assert_array_equal(source(0.25)[1], 2 * C)
    np.testing.assert_array_equal(source(0.2)[1], C)
    assert source(0.3) is None
    with pytest.raises(ValueError, match="no readings"):
        recorded(replace(made, vectors={"reading": reading[:1], "goal": goal[:1]}))


def test_datagrams_leave_at_a_fixed_rate():
    clock, sent = Clock([0.0, 0.01, 0.0]), []
    assert send(lambda now: (GOAL, C), lambda data: sent.append(unpack(data, 2, 5)), 8.0, 1.0, clock) == 8
    assert [p.sequence for p in sent] == list(range(8)) and len({p.session for p in sent}) == 1
    expected = 64.0 + np.arange(8) / 8
    expected[1] += 0.01
    np.testing.assert_array_equal([p.stamp for p in sent], expected)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "name one of --env and --log"),
        (["--env", VEHICLE, "--log", "x"], "name one of"),
        (["--env", "RISE-Panda-v0"], "did you mean"),
        (["--log", "nowhere.parquet"], "cannot be read"),
        (["--env", VEHICLE, "--rate", "0"], "--rate"),
        (["--env", VEHICLE, "--to", "somewhere"], "PORT or HOST:PORT"),
        (["--env", VEHICLE, "--to", "0"], "port of --to"),
        (["--env", VEHICLE, "--seed", "-1"], "seed must not be negative"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(capsys, arguments, says):
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.startswith("rise_agents.runtime.send: ") and says in told and told.count("\n") == 1


# --- real time -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_real_time_on_an_idle_core():
    """For 60 s 99 % of periods within 10 %; then the sender is killed, and the robot stands within two periods."""
    clock, period = Monotonic(), 0.04
    stream = UdpStream(TASK, ("127.0.0.1", 0), clock.now)
    robot = Robot(clock)
    command = [sys.executable, "-m", "rise_agents.runtime.send", "--env", VEHICLE, "--seconds", "62"]
    sender = subprocess.Popen([*command, "--to", f"127.0.0.1:{stream.address[1]}"], stdout=subprocess.PIPE)
    limits = Limits(np.array([0.0, -1.5]), np.array([2.5, 1.5]))
    try:
        until(lambda: stream.latest() is not None, 60.0)
        loop = ControlLoop(Mind(Policy()), robot, stream, TASK, limits, period, clock=clock)
        loop.run(64.0)
    finally:
        sender.kill()
        sender.communicate()
        stream.close()
    found = loop.recorder.log()
    assert loop.watchdog.stopped.kind == "stale"
    assert robot.stopped_at <= stream.latest().stamp + 2 * period
    assert summarise(found).on_time >= 0.99
