"""evstim's CAN link on a bus of this machine's kernel, with as many events as the bus takes; no session.

can_load.py CHANNEL EVENTS.npy REPORT.json CAN_LINK

CAN_LINK is a JSON object with keys of the link's table. Stream time waits for the bus, and the program ends when all
events have left.
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
from transports.link.endpoint import LinkFactory
from transports.link.pacing import MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing

_NO_LOSS = ("offered", "delivered")


async def main(channel, events_file, report_file, table):
    events = np.load(events_file)
    clock, ring = MonotonicClock(), EventRing()
    device = partial(Instrument, (346, 260), InstrumentSettings(housekeeping_s=0))
    parameters = CanLink("socketcan", channel, answer_ms=10_000, **json.loads(table))
    factory = LinkFactory(CanEndpoint, parameters)
    link = Link(LinkSetup("can", ring, device, factory), clock)
    await link.endpoint.start()
    begun_ns = clock.now_ns()
    ring.start(FREE_RUNNING)
    ring.push(events)
    ring.publish(int(events["t"][-1]) + 1)
    while not link.idle:
        link.tick()
        await asyncio.sleep(0.0005)
    seconds = (clock.now_ns() - begun_ns) / 1e9
    await link.close()
    report = link.report(final=True)
    lost = {name: n for name, n in vars(report.camera).items() if isinstance(n, int) and name not in _NO_LOSS}
    told = {
        "seconds": seconds,
        "delivered": report.delivered,
        "lost": lost | {"left": report.dropped - report.camera.lost_on_link},
        "counts": dict(report.counts),
    }
    Path(report_file).write_text(json.dumps(told))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
