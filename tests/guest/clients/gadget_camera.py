"""A camera in FunctionFS: the link of a run, fed with events of a file instead of a simulated sensor.

    gadget_camera.py --events FILE --round-us N --record FILE --pids FILE
                     [--model M] [--speed S] [--serial S] [--streams]

What `evstim run` does beside the link would take minutes on a processor that QEMU translates; it is tested elsewhere.
The events, sorted (n,) EVENT in a .npy file, are played in a loop of N us at their own pace until SIGINT; then one JSON
object is printed. PIDS gets the ids of the two processes when the link is open. With --streams, frames, inertial
samples (see `looped_streams`) and pulses at the external input are played beside them.
"""

import argparse
import json
import multiprocessing
import os
import signal
import time
from functools import partial
from pathlib import Path

import numpy as np
from looped_streams import SIZE, frames, samples

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.recordings.part import Facts
from firmware_protocol.usb.descriptors import Speed
from transports.link.edges import EdgeTiming, PeriodicEdges
from transports.link.endpoint import LinkFactory
from transports.link.feed import Timing
from transports.link.loop import Stop, run_link
from transports.link.process import LinkSetup
from transports.link.rings import EventRing, ReadingRing
from transports.usb.functionfs.endpoint import GadgetEndpoint
from transports.usb.kind import UsbGadgetLink

AHEAD_US = 50_000
PERIOD_S = 0.005
DRAIN_S = 5.0
START_DELAY_US = 3_000_000  # neuromorphic_drivers must have started all its transfers; the guest is slow
PULSE_PERIOD_US = 10_000
MOST_READINGS = 4096
IMU_UNIT = 2


def camera(options):
    speed = Speed[options.speed.upper()]
    if options.model == "evk4":
        return partial(Evk4, Evk4Settings(serial=options.serial, speed=speed, start_delay_us=START_DELAY_US))
    settings = Davis346Settings(
        serial=options.serial,
        speed=speed,
        start_delay_us=START_DELAY_US,
        frames=options.streams,
        imu_unit=IMU_UNIT if options.streams else 0,
    )
    return partial(Davis346, settings)


class Loop:
    """Puts records, (n,) sorted by `t` below `round_us`, into a ring again and again, as their time comes."""

    def __init__(self, ring, records, round_us):
        self._ring, self._records, self._round_us = ring, records, round_us
        self._next = 0
        self.pushed = 0

    def play(self, until_us):
        while (stretch := self._due(until_us)) is not None:
            self._ring.push(stretch)
            self.pushed += len(stretch)

    def _due(self, until_us):
        """Return the next records of one round that are due; None where there are none."""
        number, place = divmod(self._next, len(self._records))
        end = int(np.searchsorted(self._records["t"], max(0, until_us - number * self._round_us)))
        if end <= place:
            return None
        stretch = self._records[place:end].copy()
        stretch["t"] += np.uint64(number * self._round_us)
        self._next += len(stretch)
        return stretch


class Player:
    """Plays events, and with `streams` frames and samples, at their own pace.

    Attributes
    ----------
    ring, readings
        Where they go.
    """

    def __init__(self, options):
        self.ring = EventRing()
        self.events = Loop(self.ring, np.load(options.events), options.round_us)
        told = {ReadingKind.FRAMES: frames, ReadingKind.IMU: samples} if options.streams else {}
        played = {kind: make(options.round_us) for kind, make in told.items()}
        self.readings = tuple(ReadingRing(kind, records.dtype, MOST_READINGS) for kind, records in played.items())
        rings = zip(self.readings, played.values(), strict=True)
        self._loops = [Loop(ring, records, options.round_us) for ring, records in rings]

    def start(self):
        self._begun_ns = time.monotonic_ns()
        self.ring.start(self._begun_ns)

    def play(self):
        until_us = (time.monotonic_ns() - self._begun_ns) // 1000 + AHEAD_US
        for loop in (self.events, *self._loops):
            loop.play(until_us)
        self.ring.publish(until_us)


def link_of(options, player):
    edges = PeriodicEdges(PULSE_PERIOD_US, EdgeTiming()) if options.streams else None
    return LinkSetup(
        "usb_gadget",
        player.ring,
        camera(options),
        LinkFactory(GadgetEndpoint, UsbGadgetLink()),
        options.record,
        Facts(SIZE, imu_unit=IMU_UNIT),
        timing=Timing(edges),
        readings=player.readings,
    )


def main():
    parser = argparse.ArgumentParser()
    for name in ("--events", "--record", "--pids"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--round-us", type=int, required=True)
    for name, default in (("--model", "davis346"), ("--speed", "super"), ("--serial", "00000346")):
        parser.add_argument(name, default=default)
    parser.add_argument("--streams", action="store_true")
    options = parser.parse_args()
    player = Player(options)
    ours, links = multiprocessing.Pipe()
    setup = link_of(options, player)
    process = multiprocessing.get_context("fork").Process(target=run_link, args=(setup, links))
    process.start()
    links.close()
    stopped = []
    signal.signal(signal.SIGINT, lambda *_: stopped.append(True))
    report = ours.recv()
    player.start()
    options.pids.write_text(f"{os.getpid()} {process.pid}")
    states = []
    while not report.final:
        if stopped:
            ours.send(Stop(DRAIN_S))
            stopped.clear()
            player.ring.close()
        if not player.ring.closed:
            player.play()
        if ours.poll(PERIOD_S):
            report = ours.recv()
            if report.state not in states:
                states.append(report.state)
    process.join()
    fates = {"delivered": report.delivered, "dropped": report.dropped, "dropped_in_device": report.dropped_in_device}
    counted = sum(fates.values())
    told = {
        "pushed": player.events.pushed,
        "balanced": counted == player.events.pushed,
        "error": report.error,
        "states": states,
    }
    print(json.dumps({**told, **fates, "camera": str(report.camera)}), flush=True)


if __name__ == "__main__":
    main()
