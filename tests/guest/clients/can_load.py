"""evstim's CAN link on a bus of this machine's kernel, with as many events as the bus takes; no session.

can_load.py CHANNEL EVENTS.npy REPORT.json CAN_LINK [SECONDS]

CAN_LINK is a JSON object with keys of the link's table. Without SECONDS stream time waits for the bus, as in a run
without pacing, and the program ends when all events have left. With it stream time is that of the clock: events that
the bus has no time for are dropped, and each SYNC triggers the camera.
"""

import asyncio
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np

from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.link.edges import EdgeRing, EdgeSink, EdgeTiming
from transports.link.endpoint import LinkFactory
from transports.link.feed import Timing
from transports.link.kind import Wiring
from transports.link.pacing import MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing


async def main(channel, events_file, report_file, table, seconds=None):
    events = np.load(events_file)
    clock, ring, edges = MonotonicClock(), EventRing(), EdgeRing()
    device = partial(Instrument, (346, 260), InstrumentSettings(housekeeping_s=0))
    parameters = CanLink("socketcan", channel, answer_ms=10_000, **json.loads(table))
    factory = LinkFactory(CanEndpoint, parameters, Wiring(sink=EdgeSink([edges], ring, EdgeTiming())))
    link = Link(LinkSetup("can", ring, device, factory, timing=Timing(edges=edges)), clock)
    await link.endpoint.start()
    begun_ns = clock.now_ns()
    ring.start(FREE_RUNNING if seconds is None else begun_ns)
    ring.push(events)
    last_us = int(events["t"][-1]) + 1
    ring.publish(last_us if seconds is None else int(float(seconds) * 1e6))
    while not link.idle if seconds is None else clock.now_ns() - begun_ns < float(seconds) * 1e9:
        link.tick()
        await asyncio.sleep(0.0005)
    ended_ns = clock.now_ns()
    await link.close()
    report = link.report(final=True)
    told = {
        "seconds": (ended_ns - begun_ns) / 1e9,
        "delivered": report.delivered,
        "dropped": report.dropped,
        "fates": {name: n for name, n in vars(report.camera).items() if isinstance(n, int)},
        "edges": vars(report.camera.edges),
        "counts": dict(report.counts),
        "busy": report.use.share if hasattr(report.use, "share") else None,
    }
    Path(report_file).write_text(json.dumps(told))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
