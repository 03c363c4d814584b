"""The flight computer: events from a serial line, attitudes from the CAN bus; accelerations onto the bus.

    python flight_computer.py --serial /tmp/evstim-landing --height 1650 --velocity 0 0 -42

Each SYNC of the bus comes back on the serial line as an edge. Edges overtake events, so the computer then asks for
housekeeping until the camera says that no event waits, and as many have come as it has sent: what the estimator sees
does not depend on how fast the line was. Needs evstim for its receiver alone.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import select
import sys
import termios
import time
import tty
from pathlib import Path
from typing import TextIO

import can
import numpy as np
from divergence import Motion, MotionEstimator, Rays
from frames import ATTITUDE, COMMAND, pack_command, unpack_attitude
from guidance import Guidance, Law
from window import Lens, Window

from evstim import SerialReceiver
from firmware_protocol.packets.telecommands import RequestHousekeeping

_PICTURE_S = 0.04
_MARGIN_PX = 60.0  # for a tilt of 10 degrees
_TURN_S = 0.2
_LEAST_EVENTS = 500
_ATTITUDE_S = 10.0  # wall time that an attitude may come after its edge
_ASK_S = 0.5
_JOINED_S = 0.5  # the served bus lends no frames to a newcomer for a quarter of a second


class FlightComputer:
    """One descent.

    Parameters
    ----------
    guidance : the law, with what navigation knew.
    window : newest events and attitudes.
    estimator : of the motion.
    log : takes a line of JSON for each turn.
    """

    def __init__(self, guidance: Guidance, window: Window, estimator: MotionEstimator, log: TextIO) -> None:
        self._guidance, self._window, self._estimator, self._log = guidance, window, estimator, log

    def turn(self, now_s: float) -> np.ndarray:
        """Return the acceleration wanted from `now_s` on; all events before have come."""
        began = time.perf_counter()
        guidance = self._guidance
        rays = self._window.rays(now_s - guidance.window_s, now_s)
        if len(rays) >= _LEAST_EVENTS:
            spread = 0.01 + 0.5 * abs(guidance.motion.down)
            guidance.take(self._estimator.estimate(rays, guidance.motion, spread), now_s)
        command = guidance.command_m_s2(now_s, _TURN_S)
        self._note(now_s, len(rays), began)
        return command

    def _note(self, now_s: float, events: int, began: float) -> None:
        guidance, seen = self._guidance, self._guidance.motion
        row = {"t_s": now_s, "at_s": seen.at_s, "down_1_s": seen.down, "east_1_s": seen.east, "south_1_s": seen.south}
        row |= {"gain": seen.gain, "events": events, "height_m": guidance.height_m, "lost": guidance.lost(now_s)}
        print(json.dumps(row | {"compute_ms": (time.perf_counter() - began) * 1e3}), file=self._log, flush=True)


class Links:
    """The two links, read in one thread without waiting for either."""

    def __init__(self, port: str, bus: can.BusABC) -> None:
        self._bus = bus
        self._port = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._port, termios.TCSANOW)
        self._receiver = SerialReceiver("ccsds-cobs")
        self._received = 0
        self.edges_us: list[int] = []

    def complete(self, window: Window) -> None:
        """Hear until every event that the camera had when this was called has come; raises EOFError."""
        before, asked_s = self._receiver.housekeeping, 0.0
        while (report := self._receiver.housekeeping) is before or report.events.waiting:
            if time.monotonic() > asked_s + _ASK_S or report is not before:
                os.write(self._port, self._receiver.wrap(RequestHousekeeping()))
                before, asked_s = report, time.monotonic()
            self.hear(window, 0.01)
        while self._received < report.events.sent:
            self.hear(window, 0.01)

    def hear(self, window: Window, timeout_s: float) -> None:
        """Take what has come into the window; raises EOFError when the camera has gone."""
        select.select([self._port], [], [], timeout_s)
        self._hear_serial(window)
        while (message := self._bus.recv(0)) is not None:
            if message.arbitration_id == ATTITUDE:
                q, number = unpack_attitude(bytes(message.data))
                window.add_attitude(number * _PICTURE_S, q)

    def send(self, command: np.ndarray, turn: int) -> None:
        """Send a command."""
        data = pack_command(command, turn)
        self._bus.send(can.Message(arbitration_id=COMMAND, data=data, is_extended_id=False))

    def _hear_serial(self, window: Window) -> None:
        try:
            while data := os.read(self._port, 1 << 16):
                self._receiver.push(data)
        except BlockingIOError:
            pass
        except OSError as error:
            raise EOFError("the camera has gone") from error
        events = self._receiver.take_events()
        self._received += len(events)
        window.add_events(events)
        self.edges_us += self._receiver.take_edges()["t"].tolist()


def fly(links: Links, window: Window, computer: FlightComputer) -> None:
    """Answer SYNC after SYNC until the camera goes away."""
    turn, patience_s = 0, math.inf
    while True:
        links.hear(window, 0.001 if links.edges_us else 0.1)
        if not links.edges_us:
            continue
        now_s = links.edges_us[0] * 1e-6
        patience_s = min(patience_s, time.monotonic() + _ATTITUDE_S)
        late = time.monotonic() > patience_s
        if late or window.attitude_s >= now_s - 1e-6:
            if late:
                print(f"flight computer: no attitude for {now_s:.2f} s, the last one holds", file=sys.stderr)
            links.complete(window)
            turn += 1
            del links.edges_us[0]
            patience_s = math.inf
            links.send(computer.turn(now_s), turn)


def main() -> None:
    """Fly until the camera goes away, and write the log."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serial", required=True)
    parser.add_argument("--can-port", type=int, default=29536)
    parser.add_argument("--height", type=float, required=True)
    parser.add_argument("--velocity", type=float, nargs=3, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=Path, required=True)
    arguments = parser.parse_args()
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # it warns of frames that TCP cut in two
    lens = Lens()
    guidance = Guidance(Law(), arguments.height, np.array(arguments.velocity), lens.size[0] / 2)
    window, port = Window(lens, arguments.seed), arguments.can_port
    with (
        arguments.log.open("w") as log,
        can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port) as bus,
    ):
        computer = FlightComputer(guidance, window, _estimator(lens), log)
        links = Links(arguments.serial, bus)
        time.sleep(_JOINED_S)
        print("ready", flush=True)
        try:
            fly(links, window, computer)
        except (EOFError, KeyboardInterrupt, can.CanError) as end:
            print(f"flight computer: {end}", file=sys.stderr)


def _estimator(lens: Lens) -> MotionEstimator:
    """Return the estimator, compiled."""
    estimator = MotionEstimator(lens.focal_px, (lens.size[0] / 2 + _MARGIN_PX, lens.size[1] / 2 + _MARGIN_PX))
    t = np.linspace(0, 1, 100)
    rays = Rays(t, 0 * t, 0 * t, 0 * t + 1, (-1.0, 1.0, -1.0, 1.0))
    estimator.estimate(rays, Motion(0.0, 0.0, 0.1, 1.0, 0.0, 0), 0.1)
    return estimator


if __name__ == "__main__":
    main()
