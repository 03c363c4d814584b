"""The spacecraft in real time: dynamics integrated by the wall clock; no process waits for another.

1. Synchronisation: SYNCs go out, and the flight computer sends the time of each one's edge among the events. The least
   delay of them gives the wall time at which the camera's stream began.
2. Standing: poses at the start; nods of one pixel, from which latency.py finds the delay from a pose to its light.
3. Flying: every 10 ms the equations go on by 10 ms; pose and attitude leave with their own time, each 0.2 s a SYNC.
   A command holds from the next step after it came until the next one comes.

Poses are not stamped ahead: evstim draws a picture up to a lead and a step before its time, and carries the motion of
the two newest poses on until then (straight line, great circle). With an acceleration a that is wrong by a t^2 / 2: by
6 mm for 1.2 m/s2 and 100 ms. A late machine integrates the missed time, and sends the newest pose alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from connection import Connection
from frames import COMMAND, EDGE, unpack_command, unpack_edge
from spacecraft import FOOT_M, LEFT_ALONE_S, USUAL, Limits, TouchDown, flies
from vehicle import GRAVITY_M_S2, Lander, State, advance

__all__ = ["STEP_S", "CommandTimes", "RealTimeSpacecraft", "Times"]

STEP_S = 0.01
_STEPS_A_TURN = 20
_SYNCS, _SYNC_S, _LONGEST_SYNCHRONISING_S = 20, 0.1, 60.0
_NODS, _NOD_STEPS, _STILL_STEPS = 16, 23, 40
_FOCAL_PX = 299.6
_SILENT_S = 2.0
_MOST_COUNTER = 240
_LATE_NS = 1_000_000_000  # for an edge: a camera that is later does not keep up
_NO_CAMERA = "the descent did not begin: the camera is silent, or more than half a second late"

Height = Callable[[float, float], float]
Record = Callable[[float, State], None]


@dataclass(frozen=True)
class CommandTimes:
    """Instants of one command, ns of CLOCK_MONOTONIC: the SYNC it answers, when it came, when a pose showed it."""

    counter: int
    heard_ns: int
    shown_ns: int


@dataclass
class Times:
    """Times of the spacecraft for latency.py: start of the stream, nods (stream time, s), commands."""

    origin_ns: int = 0
    start_s: float = 0.0
    nods_s: list[float] = field(default_factory=list)
    commands: list[CommandTimes] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """Return all as JSON can hold it."""
        return asdict(self)


class RealTimeSpacecraft:
    """One vehicle in real time.

    Parameters
    ----------
    lander, state : parameters and start.
    connection : to camera and flight computer.
    limits : the longest flight.
    now_ns : the clock, CLOCK_MONOTONIC.
    """

    def __init__(
        self,
        lander: Lander,
        state: State,
        connection: Connection,
        limits: Limits = USUAL,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._limits = limits
        self._lander, self.state, self._connection, self._now_ns = lander, state, connection, now_ns
        self._full_kg = state.mass_kg
        self._number = self._syncs = 0
        self._command = np.array([0.0, 0.0, GRAVITY_M_S2])
        self._received: list[tuple[int, int]] = []  # counter and time of commands that no pose has shown yet
        self._received_ns = 0
        self._why: list[str] = []
        self._end_s = 0.0
        self.times = Times()

    @property
    def t_s(self) -> float:
        """Stream time of the state."""
        return self._number * STEP_S

    def land(self, ground_m: Height, record: Record) -> TouchDown:
        """Fly to the ground, whose height depends on the place; `record` gets stream time and state of each turn."""
        if not self._synchronise():
            self._why.append(self._connection.trouble() or _NO_CAMERA)
            return self._end(touched=False)
        self._stand()
        self.times.start_s, self._received_ns = self.t_s, self._now_ns()
        self._end_s = self.t_s + self._limits.longest_s
        for due in self._steps():
            state = advance(self._lander, self.state, self._command, STEP_S)
            if not flies(state):
                self._why.append(f"the dynamics gave no numbers at {self.t_s:.2f} s")
                break
            self.state = state
            x, y, z = state.position_m.tolist()
            if z - ground_m(x, y) <= FOOT_M:
                return self._end(touched=True)
            self._send_pose(due)
            if self._number % _STEPS_A_TURN == 0:
                self._sync()
                record(self.t_s, state)
                self._watch()
            if self.t_s > self._end_s:
                self._why.append(f"still flying after {self.t_s - self.times.start_s:.0f} s")
                break
        return self._end(touched=False)

    def _end(self, *, touched: bool) -> TouchDown:
        return TouchDown(
            self.t_s - self.times.start_s, self.state, touched, self._full_kg - self.state.mass_kg, tuple(self._why)
        )

    def _synchronise(self) -> bool:
        """Find when the stream began; False when no edges come."""
        sent: dict[int, int] = {}
        origins: list[int] = []
        end_ns = self._now_ns() + round(_LONGEST_SYNCHRONISING_S * 1e9)
        while len(origins) < _SYNCS and self._now_ns() < end_ns and not self._connection.trouble():
            counter = self._sync()
            sent[counter] = self._now_ns()
            until_ns = sent[counter] + round(_SYNC_S * 1e9)
            while (left_ns := until_ns - self._now_ns()) > 0:
                message = self._connection.receive(left_ns * 1e-9)
                if message is not None and message.arbitration_id == EDGE:
                    known, t_us = unpack_edge(bytes(message.data))
                    if known in sent and self._now_ns() - sent[known] < _LATE_NS:
                        origins.append(sent[known] - t_us * 1000)
        if len(origins) < _SYNCS:
            return False
        self.times.origin_ns = max(origins)  # an edge comes after its SYNC: the least delay is the best
        self._number = round((self._now_ns() - self.times.origin_ns) * 1e-9 / STEP_S)
        return True

    def _stand(self) -> None:
        """Stand still, then nod: a step of one pixel to the side, and back with the next."""
        there = self.state
        shift_m = np.array([there.position_m[2] / _FOCAL_PX, 0.0, 0.0])
        for k, _ in enumerate(self._steps()):
            nods = min(k // _NOD_STEPS, _NODS)  # the first stretch is still
            if 0 < k <= _NODS * _NOD_STEPS and k % _NOD_STEPS == 0:
                self.times.nods_s.append(self.t_s)
            self.state = replace(there, position_m=there.position_m + shift_m * (nods % 2))
            self._connection.pose(self.t_s, self.state)
            if k == (_NODS + 1) * _NOD_STEPS + _STILL_STEPS:
                break
        self.state = there

    def _steps(self) -> Iterator[bool]:
        """Advance by one step at its time, and read commands meanwhile; yield True for the newest step due."""
        while True:
            self._number += 1
            due_ns = self.times.origin_ns + round(self.t_s * 1e9)
            self._receive(due_ns)
            yield self._now_ns() < due_ns + round(STEP_S * 1e9)

    def _receive(self, due_ns: int) -> None:
        """Take commands until an instant, and those that have come already in any case."""
        while True:
            left_ns = due_ns - self._now_ns()
            message = self._connection.receive(max(left_ns, 0) * 1e-9)
            if message is not None and message.arbitration_id == COMMAND and not self._connection.loses(self.t_s):
                self._command, counter = unpack_command(bytes(message.data))
                self._received_ns = self._now_ns()
                self._received.append((counter, self._received_ns))
            elif message is None and left_ns <= 0:
                return

    def _send_pose(self, newest: bool) -> None:
        """Send pose and attitude, unless a newer one is due already."""
        if not newest and self._number % _STEPS_A_TURN:
            return
        self._connection.pose(self.t_s, self.state)
        self._connection.attitude(self.t_s, self.state, self._number)
        now_ns = self._now_ns()
        self.times.commands += [CommandTimes(counter, received_ns, now_ns) for counter, received_ns in self._received]
        self._received = []

    def _sync(self) -> int:
        self._syncs = self._syncs % _MOST_COUNTER + 1
        self._connection.sync(bytes([self._syncs]))
        return self._syncs

    def _watch(self) -> None:
        """Record once that commands no longer come; the last one holds."""
        silent_s = (self._now_ns() - self._received_ns) * 1e-9
        trouble = self._connection.trouble()
        if not self._why and (trouble or silent_s > _SILENT_S):
            cause = trouble or f"the flight computer has sent nothing for {silent_s:.1f} s"
            self._why.append(f"{cause}, at {self.t_s - self.times.start_s:.1f} s and {self.state.position_m[2]:.1f} m")
            self._end_s = min(self.t_s + LEFT_ALONE_S, self._end_s)
