"""evstim's CAN link on a bus of this machine's kernel, without a session: it sends what a file holds and tells of it.

python can_link.py CHANNEL CARRIAGE EVENTS.npy REPORT.json SECONDS [BEGIN]

It begins when the file BEGIN is there: its imports take half a minute on a processor that QEMU translates.
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
from transports.link.rings import EventRing


async def main(channel, carriage, events_file, report_file, seconds, begin=None):
    while begin and not Path(begin).exists():
        await asyncio.sleep(0.05)
    events = np.load(events_file)
    clock, ring, syncs = MonotonicClock(), EventRing(), []
    device = partial(Instrument, (346, 260), InstrumentSettings(queue_ms=60_000, housekeeping_s=0))
    parameters = CanLink("socketcan", channel, heartbeat_ms=100, carriage=carriage, answer_ms=10_000)
    factory = LinkFactory(CanEndpoint, parameters, Wiring(sink=lambda *mark: syncs.append(mark)))
    link = Link(LinkSetup("can", ring, device, factory), clock)
    sent, packets = tapped_frames(), tapped_packets()
    await link.endpoint.start()
    origin_ns = clock.now_ns()
    ring.start(origin_ns)
    ring.push(events)
    ring.publish(int(seconds * 1e6))
    while clock.now_ns() - origin_ns < seconds * 1e9:
        link.tick()
        await asyncio.sleep(0.0005)
    state = link.report().state
    await link.close()
    report = link.report(final=True)
    told = {
        "sent": sent,
        "packets": packets,
        "syncs": [seq for _, seq in syncs],
        "sync_us": [(t_ns - origin_ns) / 1000 for t_ns, _ in syncs],
        "state": state,
        "delivered": report.delivered,
        "not_running": report.camera.not_running,
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
    asyncio.run(main(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4], float(sys.argv[5]), *sys.argv[6:]))
