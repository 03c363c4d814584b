"""A device on USB with faults, as a host sees it."""

import asyncio
from functools import partial

import pytest

from firmware_protocol.davis346 import Davis346, Davis346Settings
from firmware_protocol.usb.device import SetupPacket
from transports.faults.kinds import LostBytes
from transports.faults.script import FaultPlan
from transports.faults.usb import FaultyDevice, usb_stage
from transports.faults.usb_kinds import USB_FAULTS, ShortTransfers, UsbSilence, UsbStall, UsbUnplugged
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.ring import EventRing
from transports.usb.host import DeviceAbsent, StallError, UsbHostError
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.endpoint import UsbipFactory


@pytest.fixture
def faulty(device):
    return FaultyDevice(device, FaultPlan("usb"))


def test_a_silent_endpoint_keeps_what_it_has(faulty, device):
    device.chunks.append(b"abcd")
    faulty.inject(UsbSilence(for_s=0.1))
    assert faulty.read(2, 64) is None
    assert faulty.read(1, 64) is None
    faulty.advance(100_000)
    assert faulty.read(2, 64).data == b"abcd"
    assert [(r.hits, r.ended_us) for r in faulty.records] == [(1, 100_000)]


def test_short_transfers_come_in_order_and_whole(faulty, device):
    device.chunks.append(b"abcdefgh")
    faulty.inject(ShortTransfers(for_s=0.1, most_bytes=2))
    parts = [faulty.read(2, 64).data for _ in range(2)]
    faulty.advance(100_000)
    assert [*parts, faulty.read(2, 64).data] == [b"ab", b"cd", b"efgh"]


@pytest.mark.parametrize("kind", USB_FAULTS)
def test_every_kind_has_a_stage(kind):
    assert usb_stage(USB_FAULTS[kind](), None) is not None


def test_what_usb_cannot_have_is_refused():
    with pytest.raises(ValueError, match="no fault of a USB link"):
        usb_stage(LostBytes(), None)
    with pytest.raises(ValueError, match="most_bytes must be even"):
        ShortTransfers(most_bytes=3)
    with pytest.raises(ValueError, match="count must be 1"):
        UsbStall(count=0)


@pytest.mark.socket
def test_a_halt_lasts_until_the_host_clears_it(bench, faulty, device):
    control = device.control
    device.control = lambda setup, data: b"" if setup.request == 1 else control(setup, data)
    bench.start({"1-1": faulty})
    with UsbipHost.attach(port=bench.server.port, timeout_s=30) as host:
        device.chunks.append(b"abcd")
        bench.call(faulty.inject, UsbStall(count=2))
        for _ in range(2):
            stream = host.stream(2, 64, 1)
            bench.call(bench.server.pump)
            with pytest.raises(StallError):
                stream.read(30)
            stream.close()
            host.clear_halt(2)
        bench.call(faulty.advance, 1000)
        stream = host.stream(2, 64, 1)
        bench.call(bench.server.pump)
        assert stream.read(30) == b"abcd"
    assert faulty.records[0].hits == 2
    assert faulty.records[0].ended_us == 1000


@pytest.mark.socket
def test_a_camera_that_is_pulled_out_is_lost_and_found_again():
    async def whole():
        clock, ring = FakeClock(10**9), EventRing(1000)
        plan = FaultPlan("usb", (UsbUnplugged(at_s=0.1, for_s=0.2),))
        factory = UsbipFactory("127.0.0.1", 0, "1-1", plan)
        link = Link(LinkSetup("usb", ring, partial(Davis346, Davis346Settings()), factory), clock)
        await link.endpoint.start()
        port = int(link.endpoint.address.rpartition(":")[2])
        ring.start(clock.now_ns())
        ring.publish(10**6)

        async def attach():
            return await asyncio.to_thread(UsbipHost.attach, port=port, timeout_s=30)

        async def reach(us):
            clock.advance(us * 1000)
            link.tick()
            await asyncio.sleep(0.01)

        host = await attach()
        assert link.endpoint.state.startswith("attached by")
        await reach(110_000)
        assert link.endpoint.state == "unplugged, by a fault"
        with pytest.raises(UsbHostError):
            await asyncio.to_thread(host.control_in, SetupPacket(0x80, 6, 0x0100, 0, 18))
        host.close()
        with pytest.raises(DeviceAbsent):
            await attach()
        await reach(200_000)
        host = await attach()
        assert link.endpoint.state.startswith("attached by")
        host.close()
        await link.close()
        return link.report(final=True)

    report = asyncio.run(whole())
    assert [(r.kind, r.began_us, r.ended_us) for r in report.faults] == [("usb_unplugged", 110_000, 310_000)]
