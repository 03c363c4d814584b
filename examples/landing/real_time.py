"""The spacecraft in real time: dynamics integrated by the wall clock; no process waits for another.

1. Synchronisation: SYNCs go out, and the flight computer sends the time of each one's edge among the events. The least
   delay of them gives the wall time at which the camera's stream began.
2. Standing: poses at the start; nods of one pixel, from which `latencies` finds the delay from a pose to its light.
3. Flying: every 10 ms the equations go on by 10 ms; pose and attitude leave with their own time, each 0.2 s a SYNC.
   A command holds from the next step after it came until the next one comes.

Poses are not stamped ahead: evstim draws a picture up to a lead and a step before its time, and carries the motion of
the two newest poses on until then (straight line, great circle). With an acceleration a that is wrong by a t^2 / 2: by
6 mm for 1.2 m/s2 and 100 ms. A late machine integrates the missed time, and sends the newest pose alone.

`latency.json` has medians and 95 % of the parts of the loop's delay. Of each command, on CLOCK_MONOTONIC, t the time of
the edge whose SYNC it answers (the end of its window of events):

    turn begins        from t until the estimate begins: SYNC, edge and events on the links, end of the last estimate
    estimate           until the command is decided
    command on bus     until the spacecraft has it
    shown by a pose    until a pose that it changed is sent: the rest of a step of the dynamics
    light              until the first event of that pose's light: from nods of one pixel before the descent, which are
                       steps at known times; median and 95 % of them
    event on the link  until that event is at the computer

`loop` is the whole of it. Apart: the estimator's window, half of which delays the estimate, the time between two
commands, and the lead: the value of the rig beside the one that its steps needed (from the camera's summary.json).
"""

from __future__ import annotations

import json
import os
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from links import Connection
from sensors import COMMAND, EDGE, unpack_command, unpack_edge
from spacecraft import FOOT_M, LEFT_ALONE_S, USUAL, Limits, TouchDown, flies
from vehicle import GRAVITY_M_S2, Height, Lander, Record, State, advance

STEP_S = 0.01
_STEPS_A_TURN = 20
_SYNCS, _SYNC_S, _LONGEST_SYNCHRONISING_S = 20, 0.1, 60.0
_NODS, _NOD_STEPS, _STILL_STEPS = 16, 23, 40
_FOCAL_PX = 299.6
_SILENT_S = 2.0
_MOST_COUNTER = 240
_LATE_NS = 1_000_000_000  # for an edge: a camera that is later does not keep up
_NO_CAMERA = "the descent did not begin: the camera is silent, or more than half a second late"


@dataclass(frozen=True)
class CommandTimes:
    """Instants of one command, ns of CLOCK_MONOTONIC: the SYNC it answers, when it came, when a pose showed it."""

    counter: int
    heard_ns: int
    shown_ns: int


@dataclass
class Times:
    """Times of the spacecraft for `latencies`: start of the stream, nods (stream time, s), commands."""

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


Floats = npt.NDArray[np.float64]

_TIMES_QUIET = 5.0  # a nod's first events: so many times the events of the quiet before it, and
_LEAST_EVENTS = 20  # not fewer than so many in a bin
_LONGEST_S = 0.2  # before the next nod


def latencies(out: Path) -> dict[str, object]:
    """Return the delays for latency.json, from spacecraft.json, computer.jsonl, standing.json of a real-time flight."""
    times = json.loads((out / "spacecraft.json").read_text())
    rows = [json.loads(line) for line in (out / "computer.jsonl").read_text().splitlines()]
    parts = _parts(times, rows)
    events = _event_delays_s(rows, times["origin_ns"])
    light = light_delays_s(json.loads((out / "standing.json").read_text()), times["nods_s"])
    link_s = float(np.median(events)) if len(events) else float("nan")
    fixed_s = float(np.median(light)) + link_s if len(light) else float("nan")
    loop = sum(parts.values()) + fixed_s
    parts_ms = {name: _statistics(values) for name, values in parts.items()}
    parts_ms |= {"light": _statistics(light), "event on the link": _statistics(events), "loop": _statistics(loop)}
    windows = np.array([row["window_s"] for row in rows])
    return {
        "parts_ms": parts_ms,
        "window_s": {"median": _quantile(windows, 50), "p95": _quantile(windows, 95)},
        "period_ms": _statistics(np.diff([row["t_s"] for row in rows])),
        "nods_seen": [len(light), len(times["nods_s"])],
        "lead_us": _lead(out),
        "machine": {"cores": os.cpu_count(), "load_now": os.getloadavg()[0]},
    }


def light_delays_s(standing: dict[str, object], nods_s: list[float]) -> Floats:
    """Return the time from each detected nod to its first events, stream time, s.

    `standing` has counts of events from `from_us` on in bins of `bin_us`.
    """
    counts, bin_us = np.array(standing["counts"], float), float(standing["bin_us"])
    starts_s = (float(standing["from_us"]) + bin_us * np.arange(len(counts))) * 1e-6
    found = []
    for nod_s in nods_s:
        before = counts[(starts_s > nod_s - 0.02) & (starts_s <= nod_s)]
        after = (starts_s > nod_s) & (starts_s < nod_s + _LONGEST_S)
        if len(before):
            many = after & (counts > max(_TIMES_QUIET * float(np.median(before)), _LEAST_EVENTS))
            found += [float(starts_s[many][0]) - nod_s] if many.any() else []
    return np.array(found)


def _parts(times: dict[str, object], rows: list[dict[str, float]]) -> dict[str, Floats]:
    """Return the parts of each command that a pose showed, s."""
    origin_ns, ends = times["origin_ns"], {row["ended_ns"]: row for row in rows if row["counter"]}
    ended_ns = np.array(sorted(ends))
    names = ("turn begins", "estimate", "command on bus", "shown by a pose")
    out = []
    for command in times["commands"]:
        k = int(np.searchsorted(ended_ns, command["heard_ns"])) - 1
        while k >= 0 and ends[ended_ns[k]]["counter"] != command["counter"]:
            k -= 1  # counters restart after 240: the newest row before
        if k < 0:
            continue
        row = ends[ended_ns[k]]
        edge_ns = origin_ns + row["t_s"] * 1e9
        instants = (edge_ns, row["began_ns"], row["ended_ns"], command["heard_ns"], command["shown_ns"])
        out.append(np.diff(instants) * 1e-9)
    table = np.array(out).reshape(-1, len(names))
    return dict(zip(names, table.T, strict=True))


def _event_delays_s(rows: list[dict[str, list[list[int]]]], origin_ns: int) -> Floats:
    """Return the delay of each event, s: that of the oldest and newest of a read, for half of it each."""
    arrivals = np.array([one for row in rows for one in row["arrivals"]], np.int64).reshape(-1, 4)
    at_ns, oldest_us, newest_us, events = arrivals.T
    late = [(at_ns - origin_ns - us * 1000) * 1e-9 for us in (oldest_us, newest_us)]
    return np.repeat(np.concatenate(late), np.tile((events + 1) // 2, 2))


def _lead(out: Path) -> dict[str, object]:
    """Return the lead that is set, and the lead that the steps needed."""
    run = tomllib.loads((out / "landing.toml").read_text())["run"]
    lead: dict[str, object] = {"set": max(run["lead_us"], run["step_us"]), "step": run["step_us"]}
    summary = out / "summary.json"
    text = summary.read_text().strip() if summary.exists() else ""
    if text:
        lateness = json.loads(text.splitlines()[-1])["lateness"]
        lead["needed"] = lateness["lead_needed_us"]
        lead |= {name: lateness[name] for name in ("frames_late", "worst_gap_us", "steps_stretched")}
    return lead


def _statistics(values_s: Floats) -> dict[str, float]:
    return {"median": _quantile(values_s * 1e3, 50), "p95": _quantile(values_s * 1e3, 95), "n": len(values_s)}


def _quantile(values: Floats, percent: float) -> float | None:
    finite = values[np.isfinite(values)]
    return round(float(np.percentile(finite, percent)), 3) if len(finite) else None
