"""evstim's CAN link on a bus of this machine's kernel, without a session: it sends what a file holds and tells of it.

can_link.py CHANNEL EVENTS.npy REPORT.json CAN_LINK SECONDS [BEGIN]

CAN_LINK is a JSON object with keys of the link's table. With SECONDS 0 stream time waits for the bus, and the program
ends when all events have left; else it runs for so long. It begins when the file BEGIN is there: its imports take half
a minute on a processor that QEMU translates.
"""

import asyncio
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np

from firmware_protocol.can_frames.transport import IsoTpSender
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from transports.can_bus.bus import PythonCanBus
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.link.endpoint import LinkFactory
from transports.link.kind import Wiring
from transports.link.pacing import MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing

_NO_LOSS = ("offered", "delivered")


async def main(channel, events_file, report_file, table, seconds, begin=None):
    while begin and not Path(begin).exists():
        await asyncio.sleep(0.05)
    events, seconds = np.load(events_file), float(seconds)
    clock, ring, syncs = MonotonicClock(), EventRing(), []
    queue = {"queue_ms": 60_000} if seconds else {}
    device = partial(Instrument, (346, 260), InstrumentSettings(housekeeping_s=0, **queue))
    parameters = CanLink("socketcan", channel, answer_ms=10_000, **json.loads(table))
    factory = LinkFactory(CanEndpoint, parameters, Wiring(sink=lambda *mark: syncs.append(mark)))
    link = Link(LinkSetup("can", ring, device, factory), clock)
    sent, packets = (tapped_frames(), tapped_packets()) if seconds else ([], [])
    await link.endpoint.start()
    origin_ns = clock.now_ns()
    ring.start(origin_ns if seconds else FREE_RUNNING)
    ring.push(events)
    ring.publish(int(seconds * 1e6) or int(events["t"][-1]) + 1)
    while clock.now_ns() - origin_ns < seconds * 1e9 if seconds else not link.idle:
        link.tick()
        await asyncio.sleep(0.0005)
    state = link.report().state
    await link.close()
    report = link.report(final=True)
    lost = {name: n for name, n in vars(report.camera).items() if isinstance(n, int) and name not in _NO_LOSS}
    told = {
        "sent": sent,
        "packets": packets,
        "syncs": [seq for _, seq in syncs],
        "sync_us": [(t_ns - origin_ns) / 1000 for t_ns, _ in syncs],
        "state": state,
        "delivered": report.delivered,
        "not_running": report.camera.not_running,
        "lost": lost | {"left": report.dropped - report.camera.lost_on_link},
        "counts": dict(report.counts),
    }
    Path(report_file).write_text(json.dumps(told))


def tapped_frames():
    """Note each frame that the kernel took."""
    sent = []
    take = PythonCanBus.send

    def send(bus, frame, *, urgent=False):
        taken = take(bus, frame, urgent=urgent)
        if taken:
            sent.append(str(frame))
        return taken

    PythonCanBus.send = send
    return sent


def tapped_packets():
    """Note each packet that goes by ISO-TP."""
    packets = []
    start = IsoTpSender.start

    def begin(sender, packet):
        start(sender, packet)
        packets.append(packet.hex())

    IsoTpSender.start = begin
    return packets


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
