"""A run that is not paced goes on while a fault keeps the camera silent: the FIFO overflows, as in real time."""

import asyncio
import time

import numpy as np
import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from tests.made_events import events_at
from transports.faults.script import FaultPlan
from transports.faults.usb import FifoOverflow, UsbSilence
from transports.link.kind import Wiring
from transports.link.pacing import MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.usb.cameras import driver_of
from transports.usb.kind import UsbipLink
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.endpoint import UsbipFactory

pytestmark = pytest.mark.socket

EVENTS, SECOND_US = 400_000, 1_000_000


def a_second_of_events():
    return events_at(np.arange(EVENTS) * SECOND_US // EVENTS, x=np.arange(EVENTS) % 346)


async def reports_of(camera, fault):
    """Return the link's last report, of a host that reads all it is given."""
    ring = EventRing(1 << 19)
    factory = UsbipFactory(UsbipLink(port=0), Wiring(FaultPlan("usb", (fault,))))
    link = Link(LinkSetup("usb", ring, lambda: camera, factory), MonotonicClock())
    await link.endpoint.start()
    port, done = int(link.endpoint.report().address.rpartition(":")[2]), asyncio.Event()

    def read_all():
        with UsbipHost.attach(port=port, timeout_s=120) as host:
            driver = driver_of(host)
            driver.start()
            while not done.is_set():
                driver.read(0.05)

    reading = asyncio.create_task(asyncio.to_thread(read_all))
    ends_s = time.monotonic() + 300
    while not (link.idle and ring.origin_ns is not None) and time.monotonic() < ends_s:
        link.tick()
        if ring.origin_ns is None and camera.streaming:
            ring.push(a_second_of_events())
            ring.start(FREE_RUNNING)
            ring.publish(2 * SECOND_US)
        await asyncio.sleep(0.001)
    done.set()
    await reading
    report = link.report()
    await link.close()
    return report


CAMERAS = {
    "davis346": lambda: Davis346(Davis346Settings(start_delay_us=0)),
    "dvxplorer": lambda: Dvxplorer(DvxplorerSettings(start_delay_us=0)),
    "evk4": lambda: Evk4(Evk4Settings(serial="1", start_delay_us=0)),
}


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("overflow", [True, False])
def test_it_ends_and_the_fifo_overflows(model, overflow):
    camera = CAMERAS[model]()
    endpoint = camera.data_endpoint
    fault = FifoOverflow(at_s=0.2) if overflow else UsbSilence(at_s=0.2, for_s=0.5, endpoint=endpoint)
    report = asyncio.run(reports_of(camera, fault))
    (record,) = report.faults
    dropped = report.camera.dropped_fifo
    assert dropped > 0
    assert report.delivered == EVENTS - dropped - report.camera.not_running
    if overflow:
        assert dropped <= EVENTS // 1000 + 1  # it ends a millisecond after the first
    else:
        assert 700_000 <= record.ended_us <= 702_000
