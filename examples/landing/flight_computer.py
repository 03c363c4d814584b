"""The flight computer: events from a serial line, attitudes from the CAN bus; accelerations onto the bus.

    python flight_computer.py --serial /tmp/evstim-landing --height 1650 --velocity 0 0 -42 --log computer.jsonl

Each SYNC of the bus comes back on the serial line as an edge.

In lockstep, edges overtake events. The computer then requests housekeeping until the camera reports that no event
waits, and all sent events have come: the input of the estimator does not depend on the speed of the line. Where the
line is damaged or unplugged the SYNC itself begins the turn, and dead reckoning replaces the lost data.

In real time (`--real-time`) it answers the newest SYNC with the events that have come, as soon as it is ready; the time
of each edge goes onto the bus, so that the spacecraft can compute the camera's time. The descent begins with the first
attitude.
Only the receiver needs evstim.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import can
import numpy as np
from divergence import Lens, Motion, MotionEstimator, Rays, Window
from guidance import Law, PredictingGuidance
from links import Edge, Links
from navigation import Known
from pilot import LAW_FAILED, NAVIGATIONS, GivenLaw, LawFailed, Pilot, PilotSettings
from sensors import PERIOD_S

_MARGIN_PX = 60.0  # for a tilt of 10 degrees
_TURN_S = 0.2  # in lockstep a command acts a turn after its SYNC
_FIRST_DELAY_S = 0.1  # in real time, until it is known
_PICTURE_S = 0.04
_LEAST_EVENTS = 500
_BIN_US = 1000
_SILENT_S = 1.0
_LATE_S = 0.5  # a camera whose events are older does not keep up, and no descent begins
_EDGE_S = 2.0  # wall time after a SYNC when the camera is queried: it may be slow, or its line dead
_PERIODS = round(_TURN_S / PERIOD_S)
_SETTLED_S = 0.5  # before it, events show the camera's start and not the ground
_SAMPLES_S = 1.0  # wall time after a SYNC: samples that have not come are lost
_JOINED_S = 0.5  # the served bus sends no frames to a new client for a quarter of a second


class FlightComputer:
    """One descent.

    Parameters
    ----------
    guidance : the law, with the state from navigation.
    window : newest events and attitudes.
    estimator : of the motion.
    log : takes a line of JSON for each turn.
    """

    def __init__(self, guidance: PredictingGuidance, window: Window, estimator: MotionEstimator, log: TextIO) -> None:
        self._guidance, self._window, self._estimator, self._log = guidance, window, estimator, log
        self.began_s = -math.inf

    def begin(self, now_s: float) -> None:
        """Begin the descent now: earlier events do not count, and are written for latency.json."""
        self.began_s = now_s
        self._guidance.begin(now_s)
        from_us, counts = self._window.counts(_BIN_US)
        standing = {"from_us": from_us, "bin_us": _BIN_US, "counts": counts.tolist()}
        Path(self._log.name).with_name("standing.json").write_text(json.dumps(standing))

    def complete(self, turn: int, syncs: int, now_s: float) -> bool:
        """Return True when the bus has brought all that belongs to a turn."""
        return syncs > turn or self._window.attitude_s >= now_s - 1e-6

    def frames(self) -> list[tuple[int, bytes]]:
        """Return frames that are sent before a command: none."""
        return []

    def took(self, seconds: float) -> None:
        """Report the time of the last command from its turn until it was sent."""
        self._guidance.took(seconds)

    def turn(self, now_s: float, period_s: float = _TURN_S, more: dict[str, object] | None = None) -> np.ndarray:
        """Return the acceleration wanted from `now_s` on, for `period_s`, from the events received so far."""
        began_ns = time.monotonic_ns()
        guidance = self._guidance
        window_s = guidance.window_s
        until_s = now_s if self.began_s == -math.inf else min(now_s, self._window.newest_s)  # in real time events lag
        rays = self._window.rays(max(until_s - window_s, self.began_s), until_s)
        if len(rays) >= _LEAST_EVENTS:
            spread = 0.01 + 0.5 * abs(guidance.motion.down)
            guidance.take(self._estimator.estimate(rays, guidance.motion, spread), now_s)
        command = guidance.command_m_s2(now_s, period_s)
        self._note(now_s, len(rays), began_ns, {"window_s": window_s} | (more or {}))
        return command

    def _note(self, now_s: float, events: int, began_ns: int, more: dict[str, object]) -> None:
        guidance, seen = self._guidance, self._guidance.motion
        row = {"t_s": now_s, "at_s": seen.at_s, "down_1_s": seen.down, "east_1_s": seen.east, "south_1_s": seen.south}
        row |= {"gain": seen.gain, "events": events, "height_m": guidance.height_m, "lost": guidance.lost(now_s)}
        ended_ns = time.monotonic_ns()
        row |= {"compute_ms": (ended_ns - began_ns) * 1e-6, "began_ns": began_ns, "ended_ns": ended_ns}
        print(json.dumps(row | more), file=self._log, flush=True)


class NavigatingComputer:
    """One descent with the vehicle's own sensors, in lockstep.

    A SYNC follows the samples of its turn, and its edge is at the turn's beginning: events are those until then.

    Parameters
    ----------
    pilot : of the vehicle.
    window : newest events.
    estimator : of the motion.
    log : takes a line of JSON for each turn.
    """

    def __init__(self, pilot: Pilot, window: Window, estimator: MotionEstimator, log: TextIO) -> None:
        self._pilot, self._window, self._estimator, self._log = pilot, window, estimator, log
        self._samples_late_s = math.inf
        self._seen_s = _SETTLED_S

    def complete(self, turn: int, syncs: int, now_s: float) -> bool:
        """Return True when the bus has brought all samples of a turn, or has had time for them."""
        if syncs <= turn:
            self._samples_late_s = math.inf
            return False
        self._samples_late_s = min(self._samples_late_s, time.monotonic() + _SAMPLES_S)
        return self._pilot.filter.newest >= (turn + 1) * _PERIODS - 1 or time.monotonic() > self._samples_late_s

    def frames(self) -> list[tuple[int, bytes]]:
        """Return the estimate, which is sent before a command."""
        return [self._pilot.estimate()]

    def turn(self, now_s: float, period_s: float = _TURN_S, more: dict[str, object] | None = None) -> np.ndarray:
        """Return the acceleration wanted from the events until `now_s` and the samples of the turn since."""
        began_ns, pilot = time.monotonic_ns(), self._pilot
        window_s, seen = pilot.window_s(now_s), None
        since_s = max(now_s - window_s, _SETTLED_S)
        if pilot.uses_events and now_s > since_s:
            self._window.replace_attitudes(pilot.attitudes(since_s))
            rays = self._window.rays(since_s, now_s)
            if len(rays) >= _LEAST_EVENTS:
                guess = pilot.motion((since_s + now_s) / 2)
                seen = self._estimator.estimate(rays, guess, 0.01 + 0.5 * abs(guess.down))
                pilot.take_motion(seen, now_s - since_s)
        command = pilot.command_m_s2(now_s + period_s)
        self._note(
            now_s, seen, {"window_s": window_s, "compute_ms": (time.monotonic_ns() - began_ns) * 1e-6} | (more or {})
        )
        return command

    def _note(self, now_s: float, seen: Motion | None, more: dict[str, object]) -> None:
        now = self._pilot.filter.now
        row: dict[str, object] = {"t_s": now_s, "estimate_s": self._pilot.filter.newest * PERIOD_S}
        self._seen_s = now_s if seen and seen.reliable else self._seen_s
        row |= {"lost": self._pilot.uses_events and now_s - self._seen_s > _SILENT_S}
        if seen and seen.reliable:
            row |= {"at_s": seen.at_s, "down_1_s": seen.down, "east_1_s": seen.east, "south_1_s": seen.south}
            row |= {"gain": seen.gain, "events": seen.events}
        row |= {"position_m": now.position_m.tolist(), "velocity_m_s": now.velocity_m_s.tolist()}
        row |= {"attitude": now.attitude.tolist(), "sigma": np.sqrt(np.diag(now.covariance)).tolist()}
        print(json.dumps(row | more), file=self._log, flush=True)


def fly_lockstep(
    links: Links, window: Window, computer: FlightComputer | NavigatingComputer, fails: Callable[[float], None]
) -> None:
    """Answer each SYNC, without end."""
    turn, received_s = 0, math.inf
    while True:
        links.receive(window, 0.001 if links.edges or links.syncs > turn else 0.1)
        edge, now_us = _edge_of(links, turn), round(turn * _TURN_S * 1e6)
        if not links.edges and links.syncs <= turn:
            continue
        received_s = min(received_s, time.monotonic())
        if edge is None:
            if time.monotonic() < received_s + _EDGE_S:
                continue
            links.complete(window, now_us)  # a camera that is only slow has sent its edge by then
            edge = _edge_of(links, turn)
        now_us = edge.t_us if edge else now_us
        if not computer.complete(turn, links.syncs, now_us * 1e-6):
            continue
        if edge:
            links.complete(window)
        turn, received_s = turn + 1, math.inf
        fails(now_us * 1e-6)
        more = {"events_lost": links.lost, "edge": edge is not None}
        command = computer.turn(now_us * 1e-6, more=more)
        for frame in computer.frames():
            links.send_frame(*frame)
        links.send(command, turn)


def _edge_of(links: Links, turn: int) -> Edge | None:
    """Return the edge of a turn if it has come; forget those of turns that are over."""
    links.edges = [edge for edge in links.edges if round(edge.t_us * 1e-6 / _TURN_S) >= turn]
    first = links.edges[0] if links.edges else None
    return first if first and round(first.t_us * 1e-6 / _TURN_S) == turn else None


def fly_real_time(links: Links, window: Window, computer: FlightComputer, fails: Callable[[float], None]) -> None:
    """Answer the newest SYNC, without end; those that came meanwhile are left out.

    When no edge has come for a second the line is dead, and dead reckoning answers.
    """
    last_s, last_wall_s = math.nan, math.inf
    while True:
        links.receive(window, 0.002)
        for edge in links.edges:
            if window.newest_s > edge.t_us * 1e-6 - _LATE_S:
                links.send_edge(edge)
        silent_s = time.monotonic() - last_wall_s
        if not links.edges and silent_s < _SILENT_S:
            continue
        received_s = time.monotonic()
        now_s = links.edges[-1].t_us * 1e-6 if links.edges else last_s + silent_s
        counter = links.edges[-1].counter if links.edges else 0
        more = {"counter": counter, "arrivals": links.arrivals, "events_lost": links.lost}
        links.edges, links.arrivals = [], []
        fails(now_s)
        if window.attitude_s < 0:
            continue  # the vehicle still stands
        if math.isnan(last_s):
            computer.begin(now_s)
            last_s = now_s - _TURN_S
        if now_s > last_s:  # not an edge that dead reckoning has overtaken
            links.send(computer.turn(now_s, now_s - last_s, more), counter)
            computer.took(time.monotonic() - received_s)
            last_s, last_wall_s = now_s, received_s


def _failing(crash_s: float, hang_s: float) -> Callable[[float], None]:
    """Return a function that ends or stops this program at a stream time, for tests."""

    def fails(now_s: float) -> None:
        if now_s >= crash_s:
            raise RuntimeError(f"the flight computer crashes at {crash_s:g} s, as requested")
        while now_s >= hang_s:
            time.sleep(1.0)

    return fails


def main() -> int:
    """Fly until the program is ended, or its given law fails; the log is complete at each turn."""
    arguments = _arguments()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))  # the end of a flight
    started, sys.stdout = sys.stdout, sys.stderr  # a law that prints must not fill the pipe of "ready"
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # it warns of frames that TCP cut in two
    lens, port = Lens(), arguments.can_port
    window = Window(lens, arguments.seed)
    with (
        arguments.log.open("w") as log,
        can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port) as bus,
    ):
        flying: Callable[..., None] = fly_real_time if arguments.real_time else fly_lockstep
        if arguments.navigation:
            law = GivenLaw(arguments.guidance) if arguments.guidance else None
            settings = PilotSettings(arguments.navigation, lens.size[0] / 2, _TURN_S, arguments.delay_s)
            pilot = Pilot(Known(**json.loads(arguments.known)), settings, law)
            computer: FlightComputer | NavigatingComputer = NavigatingComputer(pilot, window, _estimator(lens), log)
            links = Links(arguments.serial, bus, lambda number: 0.0, pilot.take)
        else:
            known = Law(), arguments.height, np.array(arguments.velocity), lens.size[0] / 2
            guidance = PredictingGuidance(*known, delay_s=_FIRST_DELAY_S if arguments.real_time else _TURN_S)
            computer = FlightComputer(guidance, window, _estimator(lens), log)
            links = Links(arguments.serial, bus, _attitude_time(arguments.attitude_s, window))
        time.sleep(_JOINED_S)
        print("ready", file=started, flush=True)
        try:
            flying(links, window, computer, _failing(arguments.crash_at, arguments.hang_at))
        except (KeyboardInterrupt, can.CanError) as end:
            print(f"flight computer: {end}", file=sys.stderr)
        except LawFailed as failure:
            (arguments.log.parent / LAW_FAILED).write_text(f"guidance {arguments.guidance} {failure}")
            return 1
        finally:
            np.savez(arguments.log.with_name("last_events.npz"), events=window.events)
    return 0


def _attitude_time(step_s: float, window: Window) -> Callable[[int], float]:
    """Return the time of an attitude from its number, which is sent modulo 65 536: the nearest to the last one."""

    def time_of(number: int) -> float:
        return (number + 65536 * round((max(window.attitude_s, 0.0) / step_s - number) / 65536)) * step_s

    return time_of


def _estimator(lens: Lens) -> MotionEstimator:
    """Return the estimator, compiled."""
    estimator = MotionEstimator(lens.focal_px, (lens.size[0] / 2 + _MARGIN_PX, lens.size[1] / 2 + _MARGIN_PX))
    t = np.linspace(0, 1, 100)
    rays = Rays(t, 0 * t, 0 * t, 0 * t + 1, (-1.0, 1.0, -1.0, 1.0))
    estimator.estimate(rays, Motion(0.0, 0.0, 0.1, 1.0, 0.0, 0), 0.1)
    return estimator


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--serial", required=True)
    parser.add_argument("--can-port", type=int, default=29536)
    parser.add_argument("--height", type=float, help="from navigation, m")
    parser.add_argument("--velocity", type=float, nargs=3, help="the same, m/s")
    parser.add_argument("--navigation", choices=NAVIGATIONS, help="with the vehicle's own sensors")
    parser.add_argument("--guidance", help="with --navigation: FILE.py:NAME, the law in the place of the pilot's")
    parser.add_argument("--delay-s", type=float, default=PilotSettings.delay_s, help="with --navigation")
    parser.add_argument("--known", help="with --navigation: the start, JSON of navigation.Known")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument("--attitude-s", type=float, default=_PICTURE_S, help="between two numbers of attitudes")
    parser.add_argument("--crash-at", type=float, default=math.inf, help="stream time, s: for tests")
    parser.add_argument("--hang-at", type=float, default=math.inf, help="stream time, s: for tests")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
