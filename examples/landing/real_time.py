"""The spacecraft in real time: dynamics integrated by the wall clock; no process waits for another.

First SYNCs go out, and the flight computer sends the time of each one's edge among the events. The least delay of them
gives the wall time at which the camera's stream began. Then, every 10 ms, the equations go on by 10 ms; pose and
attitude leave with their own time, each 0.2 s a SYNC. A command holds from the next step after it came until the next
one comes. A late machine integrates the missed time, and sends the newest pose alone.

`latency.json` has medians and 95 % of the parts of the loop's delay. Of each command, on CLOCK_MONOTONIC, t the time of
the edge whose SYNC it answers (the end of its window of events):

    turn begins        from t until the estimate begins: SYNC, edge and events on the links, end of the last estimate
    estimate           until the command is decided
    command on bus     until the spacecraft has it
    shown by a pose    until a pose that it changed is sent: the rest of a step of the dynamics
    event on the link  from an event's time until it is at the computer

Apart: the estimator's window, half of which delays the estimate.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from links import Connection
from sensors import COMMAND, EDGE, STEP_S, unpack_command, unpack_edge
from spacecraft import LONGEST_S, Spacecraft
from vehicle import Lander, State

_STEPS_A_TURN = 20
_SYNCS, _SYNC_NS, _LONGEST_SYNCHRONISING_NS = 20, 100_000_000, 60_000_000_000
_STANDING_STEPS = 100  # the camera's change to the start makes events that show no motion
_SILENT_S = 2.0
_LATE_NS = 1_000_000_000  # for an edge: a camera that is later does not keep up
_NO_CAMERA = "the descent did not begin: the camera is silent, or more than half a second late"


class CommandTimes(NamedTuple):
    """Times of one command, ns of CLOCK_MONOTONIC: when it came, when a pose showed it; the SYNC that it answers."""

    counter: int
    received_ns: int
    shown_ns: int


class RealTimeSpacecraft(Spacecraft):
    """One vehicle in real time, its attitude given; `now_ns` is its clock, CLOCK_MONOTONIC.

    `origin_ns` is the instant at which the stream began, `commands` has the times of all commands.
    """

    def __init__(
        self,
        lander: Lander,
        state: State,
        connection: Connection,
        longest_s: float = LONGEST_S,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(lander, state, connection, longest_s=longest_s)
        self._now_ns = now_ns
        self._period_s, self._periods = STEP_S, _STEPS_A_TURN
        self._received: list[tuple[int, int]] = []  # counter and time of commands that no pose has shown yet
        self._received_ns = 0
        self.origin_ns = 0
        self.commands: list[CommandTimes] = []

    def _begins(self) -> bool:
        """Find when the stream began, and show the start to the camera; return whether it is in time."""
        if not self._synchronise():
            self._why.append(self._links.trouble() or _NO_CAMERA)
            return False
        for _ in range(_STANDING_STEPS):
            self._receive(self._due_ns(self._number + 1))
            self._number += 1
            self._links.pose(self.t_s, self.state)
        self._start_s, self._received_ns = self.t_s, self._now_ns()
        self._end_s += self.t_s
        return True

    def _synchronise(self) -> bool:
        """Find when the stream began; False when no edges come."""
        sent: dict[int, int] = {}
        origins: list[int] = []
        end_ns = self._now_ns() + _LONGEST_SYNCHRONISING_NS
        while len(origins) < _SYNCS and self._now_ns() < end_ns and not self._links.trouble():
            counter, sent_ns = self._links.sync(), self._now_ns()
            sent[counter] = sent_ns
            while (left_ns := sent_ns + _SYNC_NS - self._now_ns()) > 0:
                message = self._links.receive(left_ns * 1e-9)
                if message is not None and message.arbitration_id == EDGE:
                    counter, t_us = unpack_edge(bytes(message.data))
                    if counter in sent and self._now_ns() - sent[counter] < _LATE_NS:
                        origins.append(sent[counter] - t_us * 1000)
        if len(origins) < _SYNCS:
            return False
        self.origin_ns = max(origins)  # an edge comes after its SYNC: the least delay is the best
        turns = round((self._now_ns() - self.origin_ns) * 1e-9 / STEP_S / _STEPS_A_TURN)
        self._number = turns * _STEPS_A_TURN
        return True

    def _due_ns(self, number: int) -> int:
        """Return the instant of a step."""
        return self.origin_ns + round(number * STEP_S * 1e9)

    def _advanced(self) -> State:
        """Read commands until the next step is due; return the state at it."""
        self._receive(self._due_ns(self._number + 1))
        return super()._advanced()

    def _receive(self, due_ns: int) -> None:
        """Take commands until an instant, and those that have come already in any case."""
        while True:
            left_ns = due_ns - self._now_ns()
            message = self._links.receive(max(left_ns, 0) * 1e-9)
            is_command = message is not None and message.arbitration_id == COMMAND
            if is_command and not self._links.faults.loses_frame(self.t_s):
                command, counter = unpack_command(bytes(message.data))
                self._commands = [(0.0, command)]
                self._received_ns = self._now_ns()
                self._received.append((counter, self._received_ns))
            elif message is None and left_ns <= 0:
                return

    def _send(self, before: State) -> None:
        """Send pose and attitude, unless a newer one is due already."""
        if self._now_ns() >= self._due_ns(self._number + 1) and self._number % _STEPS_A_TURN:
            return
        super()._send(before)
        now_ns = self._now_ns()
        self.commands += [CommandTimes(counter, received_ns, now_ns) for counter, received_ns in self._received]
        self._received = []

    def _take_answer(self) -> None:
        """Record once that commands no longer come: they are taken as they come."""
        silent_s = (self._now_ns() - self._received_ns) * 1e-9
        trouble = self._links.trouble()
        if not self._why and (trouble or silent_s > _SILENT_S):
            self._goes_alone(trouble or f"the flight computer has sent nothing for {silent_s:.1f} s")


Row = dict[str, Any]
_PARTS = "turn begins", "estimate", "command on bus", "shown by a pose"


def latencies(origin_ns: int, commands: Sequence[CommandTimes], rows: Sequence[Row]) -> dict[str, object]:
    """Return the delays for latency.json, from the times of a flight's spacecraft and the log of its computer.

    The delay of an event is that of the oldest or the newest of its read, for half of them each.
    """
    instants = []
    for command in commands:
        # Counters restart after 240: the newest row before.
        ended = [row for row in rows if row["counter"] == command.counter and row["ended_ns"] < command.received_ns]
        for row in ended[-1:]:
            edge_ns = origin_ns + row["t_s"] * 1e9
            instants.append((edge_ns, row["began_ns"], row["ended_ns"], command.received_ns, command.shown_ns))
    parts_ns = dict(zip(_PARTS, np.diff(np.reshape(instants, (-1, len(_PARTS) + 1))).T, strict=True))
    arrivals = np.array([arrival for row in rows for arrival in row["arrivals"]], np.int64).reshape(-1, 4)
    at_ns, oldest_us, newest_us, events = arrivals.T
    late_ns = [at_ns - origin_ns - us * 1000 for us in (oldest_us, newest_us)]
    parts_ns["event on the link"] = np.repeat(np.concatenate(late_ns), np.tile((events + 1) // 2, 2))
    parts_ms = {name: _statistics(values_ns * 1e-6) for name, values_ns in parts_ns.items()}
    return {"parts_ms": parts_ms, "window_s": _statistics(np.array([row["window_s"] for row in rows]))}


def _statistics(values: np.ndarray) -> dict[str, float | None]:
    low, high = np.percentile(values, [50, 95]).round(3).tolist() if len(values) else (None, None)
    return {"median": low, "p95": high, "n": len(values)}
