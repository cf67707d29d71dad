"""Readings and goals from another process, as UDP datagrams that are data and nothing else.

A datagram is, little-endian and without gaps:

====== ======= ===================================================================================================
offset type    content
====== ======= ===================================================================================================
0      4 bytes ``RISE``
4      u8      version of the format: 1
5      u8      D, dimensions of the goal
6      u16     C, numbers of the reading
8      u64     session: any number, another one for each run of a sender
16     u64     sequence number within the session: each datagram has a greater one than those before
24     f64     time stamp (s) on the sender's own monotonic clock
32     D × f64 goal (m)
…      C × f64 reading: position (m), velocity (m/s) and radius (m) of each obstacle
…      u32     CRC-32 of all that comes before
====== ======= ===================================================================================================

Whatever is not exactly this is counted and dropped. It guards against accidents, not against attackers: whoever can
send to the port can say where the obstacle is. Listen on loopback or a network of your own.
"""

from __future__ import annotations

import socket
import struct
import threading
import zlib
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rise_agents.runtime.streams import Reading
from rise_envs.task import Task

MAGIC, VERSION = b"RISE", 1
_HEADER = struct.Struct("<4sBBHQQd")
_CRC = struct.Struct("<I")
LOOPBACK = "127.0.0.1"
DROPPED = ("size", "garbage", "not finite", "duplicate", "out of order", "session", "time")
_REMEMBERED = 1_024  # sequence numbers, to tell what came twice from what came late
_SILENCE = 1.0  # s after which another session may take over
_DRIFT = 2e-4  # of two clocks against each other, at most


@dataclass(frozen=True)
class Packet:
    """A datagram's content; see the table above."""

    session: int
    sequence: int
    stamp: float
    goal: NDArray[np.float64]
    obstacle: NDArray[np.float64]


def pack(packet: Packet) -> bytes:
    """A packet as a datagram."""
    goal, obstacle = (np.asarray(part, "<f8") for part in (packet.goal, packet.obstacle))
    header = _HEADER.pack(
        MAGIC, VERSION, len(goal), len(obstacle), packet.session, packet.sequence, packet.stamp
    )
    body = header + goal.tobytes() + obstacle.tobytes()
    return body + _CRC.pack(zlib.crc32(body))


def size(dim: int, channels: int) -> int:
    """Bytes of a datagram."""
    return _HEADER.size + 8 * (dim + channels) + _CRC.size


def unpack(data: bytes, dim: int, channels: int) -> Packet | str:
    """A datagram as a packet, or which of ``DROPPED`` it is."""
    if len(data) != size(dim, channels):
        return "size"
    magic, version, d, c, session, sequence, stamp = _HEADER.unpack_from(data)
    (crc,) = _CRC.unpack_from(data, len(data) - _CRC.size)
    if (magic, version, d, c) != (MAGIC, VERSION, dim, channels) or crc != zlib.crc32(data[: -_CRC.size]):
        return "garbage"
    numbers = np.frombuffer(data, "<f8", dim + channels, _HEADER.size).astype(np.float64)
    if not (np.isfinite(numbers).all() and np.isfinite(stamp)):
        return "not finite"
    return Packet(session, sequence, stamp, numbers[:dim], numbers[dim:])


class Receiver:
    """Datagrams to readings: what is accepted, and how old it is.

    The sender's clock is another one. Its offset is taken from the fastest packet so far, allowing for clocks that
    drift apart: a packet that was held up on its way counts as old as it is.

    Attributes:
        counts: of datagrams by what became of them: ``accepted``, or one of ``DROPPED``.
    """

    def __init__(self, task: Task) -> None:
        self._dim, self._channels = task.dim, task.widths["obstacle"]
        self.counts: Counter[str] = Counter()
        self._reading: Reading | None = None
        self._session: int | None = None
        self._last = Packet(0, 0, 0.0, np.zeros(0), np.zeros(0))
        self._seen: deque[int] = deque(maxlen=_REMEMBERED)
        self._offset = self._arrival = 0.0
        self._number = 0

    def latest(self) -> Reading | None:
        """The newest accepted reading."""
        return self._reading

    def receive(self, data: bytes, arrival: float) -> str:
        """Take a datagram that came at ``arrival`` (s, the loop's clock); what became of it."""
        packet = unpack(data, self._dim, self._channels)
        fate = packet if isinstance(packet, str) else self._accept(packet, arrival)
        self.counts[fate] += 1
        return fate

    def _accept(self, packet: Packet, arrival: float) -> str:
        if packet.session != self._session:
            if self._session is not None and arrival - self._arrival < _SILENCE:
                return "session"
            self._session = packet.session
            self._seen.clear()
            self._offset = arrival - packet.stamp
        elif packet.sequence <= self._last.sequence:
            return "duplicate" if packet.sequence in self._seen else "out of order"
        elif packet.stamp < self._last.stamp:
            return "time"
        else:
            drifted = self._offset + _DRIFT * (arrival - self._arrival)
            self._offset = min(drifted, arrival - packet.stamp)
        self._last, self._arrival = packet, arrival
        self._seen.append(packet.sequence)
        self._number += 1
        stamp = packet.stamp + self._offset
        self._reading = Reading(packet.obstacle, stamp, self._number, packet.goal)
        return "accepted"


class UdpStream:
    """A socket, and a thread that empties it into a :class:`Receiver` so that arrivals are stamped when they come.

    Args:
        task: gives the sizes.
        address: host and port to listen on; port 0: any free one, see :attr:`address`.
        now: the loop's clock.

    Raises:
        OSError: the address cannot be used.
    """

    def __init__(self, task: Task, address: tuple[str, int], now: Callable[[], float]) -> None:
        self.receiver = Receiver(task)
        self._now = now
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._socket.settimeout(0.1)  # how long closing may take
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        self._open = True
        self._thread = threading.Thread(target=self._listen, name="readings", daemon=True)
        self._thread.start()

    def latest(self) -> Reading | None:
        """The newest accepted reading."""
        return self.receiver.latest()

    def _listen(self) -> None:
        while self._open:
            try:
                data = self._socket.recv(2_048)
            except TimeoutError:
                continue
            except OSError:  # closed, or an error of an earlier datagram that the system reports now
                if not self._open:
                    return
                continue
            self.receiver.receive(data, self._now())

    def close(self) -> None:
        """Stop listening."""
        self._open = False
        self._thread.join()
        self._socket.close()


def address(text: str) -> tuple[str, int]:
    """``HOST:PORT`` or ``PORT``, which is on loopback; raises ``ValueError`` for anything else."""
    host, _, port = text.rpartition(":")
    host = host.strip("[]") or LOOPBACK
    if "\0" in host or not (port.isascii() and port.isdecimal() and int(port) < 65_536):
        raise ValueError(f"an address must be PORT or HOST:PORT, got {text!r}")
    return host, int(port)
