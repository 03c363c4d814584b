"""The flight computer: events from a serial line, attitudes or samples from the CAN bus; accelerations onto the bus.

    python flight_computer.py SETTINGS.json        started by fly.py, which writes the settings

Each SYNC of the bus comes back on the serial line as an edge.

In lockstep, edges overtake events. The computer then requests housekeeping until the camera reports that no event
waits, and all sent events have come: the input of the estimator does not depend on the speed of the line. Where the
line is damaged or unplugged the SYNC itself begins the turn, and dead reckoning replaces the lost data.

In real time it answers the newest SYNC with the events that have come, as soon as it is ready; the time of each edge
goes onto the bus, so that the spacecraft can compute the camera's time. The descent begins with the first attitude.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import can
import msgspec
import numpy as np
from divergence import Lens, Motion, MotionEstimator, Rays, Window
from guidance import Guidance
from links import Edge, Links, opened_bus
from navigation import Known
from pilot import DELAY_S, LAW_FAILED, TURN_S, GivenLaw, LawFailed, Pilot
from sensors import COMMAND, EDGE, pack_command, pack_edge

_MARGIN_PX = 60.0  # for a tilt of 10 degrees
_LEAST_EVENTS = 500
_SILENT_S = 1.0
_LATE_S = 0.5  # a camera whose events are older does not keep up, and no descent begins
_EDGE_S = 2.0  # wall time after a SYNC when the camera is queried: it may be slow, or its line dead
_SAMPLES_S = 1.0  # wall time after a SYNC: samples that have not come are lost


@dataclass(frozen=True)
class Settings:
    """Settings of a flight computer."""

    can_port: int  # TCP port of the bus
    serial: str  # path of the serial line
    folder: str  # takes the log, the last events, and the sentence about a law that failed
    seed: int  # of the choice among very many events
    known: Known  # state from navigation at the start
    navigation: str  # a name of pilot.NAVIGATIONS, or "given"
    guidance: str = ""  # FILE.py:NAME of a law in the place of the pilot's
    delay_s: float = DELAY_S  # of a command, with the vehicle's own sensors
    real_time: bool = False
    attitude_s: float = 0.04  # between two numbers of attitudes that are given
    crash_at_s: float | None = None  # stream times at which this program fails, for tests
    hang_at_s: float | None = None

    def pilot(self) -> Pilot | Guidance:
        """Return the pilot of a flight; raises LawFailed where the given law cannot be loaded."""
        if self.navigation != "given":
            law = GivenLaw(self.guidance) if self.guidance else None
            return Pilot(self.known, self.navigation, law, self.delay_s)
        delay_s = DELAY_S if self.real_time else TURN_S  # first estimate; in lockstep a command acts a turn after it
        return Guidance(self.known.position_m[2], np.array(self.known.velocity_m_s), delay_s, self.attitude_s)


class FlightComputer:
    """One descent; the log takes a line of JSON for each turn."""

    def __init__(self, settings: Settings, log: TextIO) -> None:
        lens = Lens()
        self.settings, self._log = settings, log
        self.pilot, self.window = settings.pilot(), Window(lens, settings.seed)
        self._estimator = MotionEstimator(lens.focal_px, (lens.size[0] / 2 + _MARGIN_PX, lens.size[1] / 2 + _MARGIN_PX))
        t = np.linspace(0, 1, 100)
        still = Rays(t, 0 * t, 0 * t, 0 * t + 1, (-1.0, 1.0, -1.0, 1.0))
        self._estimator.estimate(still, Motion(0.0, 0.0, 0.1, 1.0, 0.0, 0), 0.1)  # compiles it

    def turn(self, now_s: float, more: dict[str, object], period_s: float = TURN_S) -> np.ndarray:
        """Return the acceleration wanted from the events until `now_s` and what the bus has brought; `more` is logged.

        `period_s` is the time since the last turn.
        """
        began_ns, pilot, window = time.monotonic_ns(), self.pilot, self.window
        until_s = min(now_s, window.newest_s) if self.settings.real_time else now_s  # in real time events lag
        window_s = pilot.window_s(now_s)
        since_s = max(until_s - window_s, pilot.begins_s)
        if pilot.uses_events and until_s > since_s:
            window.replace_attitudes(pilot.attitudes(since_s))
            rays = window.rays(since_s, until_s)
            if len(rays) >= _LEAST_EVENTS:
                guess = pilot.guess((since_s + until_s) / 2)
                motion = self._estimator.estimate(rays, guess, 0.01 + 0.5 * abs(guess.down))
                pilot.take_motion(motion, now_s, until_s - since_s)
        command = pilot.command_m_s2(now_s, period_s)
        row = {"t_s": now_s, "window_s": window_s} | pilot.row(now_s)
        row |= {"began_ns": began_ns, "ended_ns": time.monotonic_ns()} | more
        print(json.dumps(row), file=self._log, flush=True)
        return command

    def fail(self, now_s: float) -> None:
        """End or stop this program at the stream time that its settings name."""
        crash_at_s, hang_at_s = self.settings.crash_at_s, self.settings.hang_at_s
        if crash_at_s is not None and now_s >= crash_at_s:
            raise RuntimeError(f"the flight computer crashes at {crash_at_s:g} s, as requested")
        while hang_at_s is not None and now_s >= hang_at_s:
            time.sleep(1.0)


def fly_lockstep(links: Links, computer: FlightComputer) -> None:
    """Answer each SYNC, without end."""
    turn, received_s, synced_s = 0, math.inf, math.inf
    while True:
        links.receive(0.001 if links.edges or links.syncs > turn else 0.1)
        edge, now_s = _edge_of(links, turn), turn * TURN_S
        if not links.edges and links.syncs <= turn:
            continue
        received_s = min(received_s, time.monotonic())
        if edge is None:
            if time.monotonic() < received_s + _EDGE_S:
                continue
            links.complete(round(now_s * 1e6))  # a camera that is only slow has sent its edge by then
            edge = _edge_of(links, turn)
        now_s = edge.t_us * 1e-6 if edge else round(now_s * 1e6) * 1e-6
        if not computer.pilot.complete(now_s):
            synced_s = min(synced_s, time.monotonic()) if links.syncs > turn else math.inf
            if time.monotonic() < synced_s + _SAMPLES_S:
                continue
        if edge:
            links.complete()
        turn, received_s, synced_s = turn + 1, math.inf, math.inf
        computer.fail(now_s)
        command = computer.turn(now_s, {"events_lost": links.lost, "edge": edge is not None})
        for frame in computer.pilot.frames():
            links.send(*frame)
        links.send(COMMAND, pack_command(command, turn))


def _edge_of(links: Links, turn: int) -> Edge | None:
    """Return the edge of a turn if it has come; forget those of turns that are over."""
    links.edges = [edge for edge in links.edges if round(edge.t_us * 1e-6 / TURN_S) >= turn]
    first = links.edges[0] if links.edges else None
    return first if first and round(first.t_us * 1e-6 / TURN_S) == turn else None


def fly_real_time(links: Links, computer: FlightComputer) -> None:
    """Answer the newest SYNC, without end; those that came meanwhile are left out.

    When no edge has come for a second the line is dead, and dead reckoning answers.
    """
    guidance, last_s, last_wall_s = computer.pilot, math.nan, math.inf
    while True:
        links.receive(0.002)
        for edge in links.edges:
            if computer.window.newest_s > edge.t_us * 1e-6 - _LATE_S:
                links.send(EDGE, pack_edge(edge.counter, edge.t_us))
        silent_s = time.monotonic() - last_wall_s
        if not links.edges and silent_s < _SILENT_S:
            continue
        received_s = time.monotonic()
        now_s = links.edges[-1].t_us * 1e-6 if links.edges else last_s + silent_s
        counter = links.edges[-1].counter if links.edges else 0
        more = {"counter": counter, "arrivals": links.arrivals, "events_lost": links.lost}
        links.edges, links.arrivals = [], []
        computer.fail(now_s)
        if not guidance.complete(0.0):
            continue  # the vehicle still stands
        if math.isnan(last_s):
            guidance.begin(now_s)
            last_s = now_s - TURN_S
        if now_s > last_s:  # not an edge that dead reckoning has overtaken
            command = computer.turn(now_s, more, now_s - last_s)
            links.send(COMMAND, pack_command(command, counter))
            guidance.took(time.monotonic() - received_s)
            last_s, last_wall_s = now_s, received_s


def main(file: Path) -> int:
    """Fly until the program is ended, or its given law fails; the log is complete at each turn."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))  # the end of a flight
    settings = msgspec.json.decode(file.read_bytes(), type=Settings)
    folder = Path(settings.folder)
    with (folder / "computer.jsonl").open("w") as log, opened_bus(settings.can_port) as bus:
        computer = FlightComputer(settings, log)
        links = Links(settings.serial, bus, computer.window, computer.pilot.take_frame)
        file.with_name("computer.ready").touch()
        try:
            (fly_real_time if settings.real_time else fly_lockstep)(links, computer)
        except (KeyboardInterrupt, can.CanError) as end:
            print(f"flight computer: {end}", file=sys.stderr)
        except LawFailed as failure:
            (folder / LAW_FAILED).write_text(f"guidance {settings.guidance} {failure}")
            return 1
        finally:
            np.savez(folder / "last_events.npz", events=computer.window.events)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
