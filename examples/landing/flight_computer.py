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
from itertools import count
from pathlib import Path
from typing import TextIO

import can
import msgspec
import numpy as np
from divergence import Lens, Motion, Rays, Window, estimate
from frames import COMMAND, EDGE, ESTIMATE, pack_command, pack_edge
from guidance import Guidance
from links import Fault, Links, opened_bus
from navigation import Known
from pilot import DELAY_S, LAW_FAILED, TURN_S, GivenLaw, LawFailed, Pilot
from sensors import PICTURE_S, STEP_S

_LENS, _REACH_PX = Lens(), (346 / 2 + 60.0, 260 / 2 + 60.0)  # with a margin for a tilt of 10 degrees
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
    seed: int  # of the choice among very many events
    known: Known  # state from navigation at the start
    navigation: str  # a name of pilot.NAVIGATIONS, or "given"
    guidance: str = ""  # FILE.py:NAME of a law in the place of the pilot's
    real_time: bool = False
    faults: tuple[Fault, ...] = ()


class FlightComputer:
    """One descent; the log takes a line of JSON for each turn. Raises LawFailed where a given law cannot be loaded."""

    def __init__(self, settings: Settings, log: TextIO) -> None:
        self.settings, self._log, self.window = settings, log, Window(_LENS, settings.seed)
        known = settings.known
        if settings.navigation == "given":
            # The delay is a first estimate; in lockstep a command acts a turn after it.
            delay_s, attitude_s = (DELAY_S, STEP_S) if settings.real_time else (TURN_S, PICTURE_S)
            self.pilot = Guidance(known.position_m[2], np.array(known.velocity_m_s), delay_s, attitude_s)
        else:
            law = GivenLaw(settings.guidance) if settings.guidance else None
            self.pilot = Pilot(known, settings.navigation, law)
        t = np.linspace(0, 1, 100)
        still = Rays(t, 0 * t, 0 * t, 0 * t + 1, (-1.0, 1.0, -1.0, 1.0))
        estimate(still, Motion(0.0, 0.0, 0.1, 1.0, 0.0, 0), 0.1, _LENS.focal_px, _REACH_PX)  # compiles it

    def turn(self, now_s: float, more: dict[str, object], period_s: float = TURN_S) -> np.ndarray:
        """Return the acceleration wanted from the events until `now_s` and what the bus has brought; `more` is logged.

        `period_s` is the time since the last turn.
        """
        self._fail(now_s)
        began_ns, pilot, window = time.monotonic_ns(), self.pilot, self.window
        until_s = min(now_s, window.newest_s) if self.settings.real_time else now_s  # in real time events lag
        window_s = pilot.window_s(now_s)
        since_s = max(until_s - window_s, pilot.begins_s)
        if pilot.uses_events and until_s > since_s:
            rays = window.rays(since_s, until_s, pilot.attitudes(since_s))
            if len(rays.t_s) >= _LEAST_EVENTS:
                guess = pilot.guess((since_s + until_s) / 2)
                motion = estimate(rays, guess, 0.01 + 0.5 * abs(guess.down), _LENS.focal_px, _REACH_PX)
                pilot.take_motion(motion, now_s, until_s - since_s)
        command = pilot.command_m_s2(now_s, period_s)
        row = {"t_s": now_s, "window_s": window_s} | pilot.row(now_s)
        row |= {"began_ns": began_ns, "ended_ns": time.monotonic_ns()} | more
        print(json.dumps(row), file=self._log, flush=True)
        return command

    def _fail(self, now_s: float) -> None:
        """Let this program end, or stand still, while a fault of it lasts."""
        for fault in self.settings.faults:
            if fault.kind == "crash" and fault.on(now_s):
                raise RuntimeError(f"the flight computer crashes at {fault.at_s:g} s, as requested")
            while fault.kind == "hang" and fault.on(now_s):
                time.sleep(1.0)


def answer_turn(links: Links, computer: FlightComputer, turn: int) -> None:
    """Wait for the SYNC that ends a turn in lockstep, and for all data until it; send the command."""
    pilot = computer.pilot
    while _edge_us(links, turn) is None and not links.edges and links.syncs <= turn:
        links.receive(0.1)
    links.wait(lambda: _edge_us(links, turn) is not None, _EDGE_S)
    if (edge_us := _edge_us(links, turn)) is None:
        links.complete(round(turn * TURN_S * 1e6))  # a camera that is only slow has sent its edge by then
        edge_us = _edge_us(links, turn)
    now_s = (round(turn * TURN_S * 1e6) if edge_us is None else edge_us) * 1e-6
    while links.syncs <= turn and not pilot.complete(now_s):
        links.receive(0.1)
    links.wait(lambda: pilot.complete(now_s), _SAMPLES_S)
    if edge_us is not None:
        links.complete()
    command = computer.turn(now_s, {"events_lost": links.lost, "edge": edge_us is not None})
    if isinstance(pilot, Pilot):
        links.send(ESTIMATE, pilot.estimate())
    links.send(COMMAND, pack_command(command, turn + 1))


def _edge_us(links: Links, turn: int) -> int | None:
    """Return the time of the edge of a turn if it has come; forget those of turns that are over."""
    links.edges = [edge for edge in links.edges if round(edge[0] * 1e-6 / TURN_S) >= turn]
    return next((t_us for t_us, _ in links.edges if round(t_us * 1e-6 / TURN_S) == turn), None)


def fly_real_time(links: Links, computer: FlightComputer) -> None:
    """Answer the newest SYNC, without end; those that came meanwhile are left out.

    When no edge has come for a second the line is dead, and dead reckoning answers.
    """
    guidance, last_s, last_wall_s = computer.pilot, math.nan, math.inf
    while True:
        links.receive(0.002)
        for t_us, counter in links.edges:
            if computer.window.newest_s > t_us * 1e-6 - _LATE_S:
                links.send(EDGE, pack_edge(counter, t_us))
        silent_s = time.monotonic() - last_wall_s
        if not links.edges and silent_s < _SILENT_S:
            continue
        received_s = time.monotonic()
        t_us, counter = links.edges[-1] if links.edges else ((last_s + silent_s) * 1e6, 0)
        now_s = t_us * 1e-6
        more = {"counter": counter, "arrivals": links.arrivals, "events_lost": links.lost}
        links.edges, links.arrivals = [], []
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
    with file.with_name("computer.jsonl").open("w") as log, opened_bus(settings.can_port) as bus:
        computer = FlightComputer(settings, log)
        links = Links(settings.serial, bus, computer.window, computer.pilot.take_frame)
        file.with_name("computer.ready").touch()
        try:
            if settings.real_time:
                fly_real_time(links, computer)
            for turn in count():
                answer_turn(links, computer, turn)
        except (KeyboardInterrupt, can.CanError) as end:
            print(f"flight computer: {end}", file=sys.stderr)
        except LawFailed as failure:
            file.with_name(LAW_FAILED).write_text(f"guidance {settings.guidance} {failure}")
            return 1
        finally:
            np.savez(file.with_name("last_events.npz"), events=computer.window.events)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
