"""A camera in FunctionFS: the link of a run, fed with events of a file instead of a simulated sensor.

    gadget_camera.py --events FILE --round-us N --record FILE --pids FILE [--model M] [--speed S] [--serial S]

What `evstim run` does beside the link would take minutes on a processor that QEMU translates; it is tested elsewhere.
The events, sorted (n,) EVENT in a .npy file, are played in a loop of N us at their own pace until SIGINT; then one JSON
object is printed. PIDS gets the ids of the two processes when the link is open.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import time
from functools import partial
from pathlib import Path

import numpy as np

from firmware_protocol.davis346 import Davis346, Davis346Settings
from firmware_protocol.event_copies import copy_events
from firmware_protocol.evk4 import Evk4, Evk4Settings
from firmware_protocol.usb.device import Speed
from transports.link.process import LinkSetup, Stop, run_link
from transports.link.ring import EventRing
from transports.usb.functionfs.endpoint import GadgetFactory

AHEAD_US = 50_000
PERIOD_S = 0.005
DRAIN_S = 5.0
START_DELAY_US = 3_000_000  # neuromorphic_drivers must have started all its transfers; the guest is slow


def camera(options: argparse.Namespace) -> partial:
    speed = Speed[options.speed.upper()]
    if options.model == "evk4":
        return partial(Evk4, Evk4Settings(serial=options.serial, speed=speed, start_delay_us=START_DELAY_US))
    return partial(Davis346, Davis346Settings(serial=options.serial, speed=speed, start_delay_us=START_DELAY_US))


class Player:
    """Puts looped events into the link's ring as their time comes."""

    def __init__(self, ring: EventRing, events: np.ndarray, round_us: int) -> None:
        self._ring, self._events, self._round_us = ring, events, round_us
        self._begun_ns = time.monotonic_ns()
        self._next = 0
        self.pushed = 0
        ring.start(self._begun_ns)

    def play(self) -> None:
        until_us = (time.monotonic_ns() - self._begun_ns) // 1000 + AHEAD_US
        while (stretch := self._due(until_us)) is not None:
            self._ring.push(stretch)
            self.pushed += len(stretch)
        self._ring.publish(until_us)

    def _due(self, until_us: int) -> np.ndarray | None:
        """Return the next events of one round that are due; None where there are none."""
        number, place = divmod(self._next, len(self._events))
        end = int(np.searchsorted(self._events["t"], max(0, until_us - number * self._round_us)))
        if end <= place:
            return None
        stretch = copy_events(self._events[place:end])
        stretch["t"] += np.uint64(number * self._round_us)
        self._next += len(stretch)
        return stretch


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("--events", "--record", "--pids"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--round-us", type=int, required=True)
    for name, default in (("--model", "davis346"), ("--speed", "super"), ("--serial", "00000346")):
        parser.add_argument(name, default=default)
    options = parser.parse_args()
    ring = EventRing()
    ours, links = multiprocessing.Pipe()
    setup = LinkSetup("usb_gadget", ring, camera(options), GadgetFactory("evstim", ""), options.record)
    process = multiprocessing.get_context("fork").Process(target=run_link, args=(setup, links))
    process.start()
    links.close()
    stopped = []
    signal.signal(signal.SIGINT, lambda *_: stopped.append(True))
    report = ours.recv()
    player = Player(ring, np.load(options.events), options.round_us)
    options.pids.write_text(f"{os.getpid()} {process.pid}")
    states = []
    while not report.final:
        if stopped:
            ours.send(Stop(DRAIN_S))
            stopped.clear()
            ring.close()
        if not ring.closed:
            player.play()
        if ours.poll(PERIOD_S):
            report = ours.recv()
            if report.state not in states:
                states.append(report.state)
    process.join()
    fates = {"delivered": report.delivered, "dropped": report.dropped, "dropped_in_device": report.dropped_in_device}
    counted = sum(fates.values())
    told = {"pushed": player.pushed, "balanced": counted == player.pushed, "error": report.error, "states": states}
    print(json.dumps({**told, **fates, "camera": str(report.camera)}), flush=True)


if __name__ == "__main__":
    main()
