"""The server's side of the socketcand protocol, CAN over TCP of can-utils' daemon, and a model of the bus. Sans-I/O.

    server                                  client
    < hi >                              ->
                                        <-  < open can0 >
    < ok >                              ->
                                        <-  < rawmode >
    < ok >                              ->
    < frame 1A2 1700000000.123456 0011 >    ->      identifier (3 or 8 digits), seconds.microseconds, data
                                        <-  < send 1A2 2 0 11 >         identifier, length, one number a byte
    < error 20000088 1700000000.123456 >    ->      an error frame: its class, as in linux/can/error.h, and the flag
    < error TEXT >                      ->
                                        <-  < echo >
    < echo >                            ->

Classic frames only. Source: github.com/linux-can/socketcand, doc/protocol.md (2025-05), and python-can's client
(can.interfaces.socketcand 4.6), which needs each answer of the handshake in a segment of its own.

`Wire` models the bus: one frame at a time, the lowest identifier first, each as long as its bits take. Each node offers
frames in order and competes with its first one, as a controller with one transmit buffer does. A frame that has begun
is never interrupted. Errors, acknowledgement and propagation are not modelled.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import BitRates, Frame, FrameError, frame_bits

GREETING = b"< hi >"

_ERROR_FLAG = 0x2000_0000  # CAN_ERR_FLAG of linux/can.h
_MOST_UNREAD = 4096
_COMMAND = re.compile(rb"<([^<>]*)>")


def frame_line(frame: Frame, wall_us: int) -> bytes:
    """Return the line that reports a classic frame, or an error frame, received at `wall_us` since 1970."""
    identifier = f"{frame.identifier:08X}" if frame.extended else f"{frame.identifier:03X}"
    seconds, us = divmod(wall_us, 1_000_000)
    if frame.error:
        return f"< error {frame.identifier | _ERROR_FLAG:08X} {seconds}.{us:06d} >".encode()
    return f"< frame {identifier} {seconds}.{us:06d} {frame.data.hex().upper()} >".encode()


class SocketcandSession:
    """State of one client's connection.

    Attributes
    ----------
    raw : True if the client selected raw mode, which delivers every frame.
    refused : True if the client requested a bus that does not exist here; the server has to close the connection.
    """

    def __init__(self, bus: str) -> None:
        self._bus = bus
        self._unread = b""
        self._opened = False
        self.raw = False
        self.refused = False

    def push(self, data: bytes) -> tuple[bytes, list[Frame]]:
        """Process bytes of the client; return the answer and the frames that it sends."""
        self._unread += data
        answers, frames = [], []
        at = 0
        for command in _COMMAND.finditer(self._unread):
            at = command.end()
            answer, frame = self._command(command[1].decode("ascii", "replace").split())
            answers.append(answer)
            frames += [frame] if frame is not None else []
        self._unread = self._unread[at:][-_MOST_UNREAD:]
        return b"".join(answers), frames

    def _command(self, words: list[str]) -> tuple[bytes, Frame | None]:
        match words:
            case ["echo"]:
                return b"< echo >", None
            case ["open", bus] if not self._opened:
                self._opened = bus == self._bus
                self.refused = not self._opened
                return (b"< ok >" if self._opened else b"< error could not open bus >"), None
            case ["rawmode"] if self._opened:
                self.raw = True
                return b"< ok >", None
            case ["send", identifier, length, *octets] if self._opened:
                frame = _frame(identifier, length, octets)
                return (b"" if frame else b"< error syntax >"), frame
        return b"< error unknown command >", None


def _frame(identifier: str, length: str, octets: list[str]) -> Frame | None:
    try:
        data = bytes(int(octet, 16) for octet in octets)
        if int(length, 16) != len(data):
            return None
        return Frame(int(identifier, 16), data, extended=len(identifier) != 3)
    except (ValueError, FrameError):
        return None


@dataclass(frozen=True)
class Carried:
    """A frame that was sent on the bus: its node, and the times at which its first bit began and its last one ended."""

    frame: Frame
    node: int
    begin_ns: int
    end_ns: int


class Wire:
    """The bus. Its time is that of the caller, never goes back, and moves only by `advance`."""

    def __init__(self, rates: BitRates) -> None:
        self._rates = rates
        self._queues: dict[int, deque[tuple[int, Frame]]] = {}
        self._free_ns = 0
        self._current: Carried | None = None
        self.busy_ns = 0

    def waiting(self, node: int) -> int:
        """Return the number of frames of a node that have not begun."""
        return len(self._queues.get(node, ()))

    @property
    def busy(self) -> bool:
        """True while a frame is on the bus."""
        return self._current is not None

    def offer(self, node: int, frame: Frame, now_ns: int) -> None:
        """Queue a frame of a node, at the latest time given to `advance` or later."""
        self._queues.setdefault(node, deque()).append((now_ns, frame))

    def forget(self, node: int) -> None:
        """Remove a node and the frames that it has not begun to send."""
        self._queues.pop(node, None)

    def advance(self, now_ns: int) -> list[Carried]:
        """Advance time; return the frames whose last bit ended by `now_ns`."""
        done: list[Carried] = []
        while True:
            if self._current is None:
                self._current = self._begin(now_ns)
            if self._current is None or self._current.end_ns > now_ns:
                return done
            done.append(self._current)
            self._free_ns = self._current.end_ns
            self._current = None

    def _begin(self, now_ns: int) -> Carried | None:
        """Decide the arbitration between the nodes' first frames when the bus is next free and a frame waits."""
        heads = {node: queue[0] for node, queue in self._queues.items() if queue}
        if not heads:
            return None
        begin_ns = max(self._free_ns, min(offered for offered, _ in heads.values()))
        if begin_ns > now_ns:
            return None
        node = min((n for n in heads if heads[n][0] <= begin_ns), key=lambda n: (heads[n][1].arbitration, heads[n][0]))
        _, frame = self._queues[node].popleft()
        duration_ns = self._rates.duration_ns(frame_bits(frame))
        self.busy_ns += duration_ns
        return Carried(frame, node, begin_ns, begin_ns + duration_ns)
