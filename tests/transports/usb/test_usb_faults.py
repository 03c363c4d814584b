"""A device on USB with faults, as a host sees it."""

import asyncio
from functools import partial

import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.usb.device import NotReady, SetupPacket, Stall
from transports.faults.faulty_device import FaultyDevice
from transports.faults.line import LostBytes
from transports.faults.script import FaultPlan
from transports.faults.usb import (
    ControlStall,
    EmptyTransfers,
    ShortTransfers,
    SlowControl,
    UsbSilence,
    UsbStall,
    UsbUnplugged,
    WrongVersion,
)
from transports.link.kind import Wiring
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import EventRing
from transports.usb.davis_host import DavisHost
from transports.usb.host import DeviceAbsent, UsbHostError
from transports.usb.kind import UsbipLink
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


def test_what_usb_cannot_have_is_refused(faulty):
    with pytest.raises(ValueError, match="no fault of a USB link"):
        faulty.inject(LostBytes())
    with pytest.raises(ValueError, match="most_bytes must be even"):
        ShortTransfers(most_bytes=3)
    with pytest.raises(ValueError, match="count must be at least 1"):
        UsbStall(count=0)


@pytest.mark.socket
def test_a_camera_that_is_pulled_out_is_lost_and_found_again():
    async def whole():
        clock, ring = FakeClock(10**9), EventRing(1000)
        plan = FaultPlan("usb", (UsbUnplugged(at_s=0.1, for_s=0.2),))
        factory = UsbipFactory(UsbipLink(port=0), Wiring(plan))
        link = Link(LinkSetup("usb", ring, partial(Davis346, Davis346Settings()), factory), clock)
        await link.endpoint.start()
        port = int(link.endpoint.report().address.rpartition(":")[2])
        ring.start(clock.now_ns())
        ring.publish(10**6)

        async def attach():
            return await asyncio.to_thread(UsbipHost.attach, port=port, timeout_s=120)

        async def reach(us):
            clock.advance(us * 1000)
            link.tick()
            await asyncio.sleep(0.01)

        assert link.report().attach_command == f"sudo usbip --tcp-port {port} attach -r 127.0.0.1 -b 1-1"
        host = await attach()
        assert link.endpoint.state.startswith("attached by")
        assert link.report().attach_command == ""
        await reach(110_000)
        assert link.endpoint.state == "unplugged, by a fault"
        assert link.report().attach_command == ""
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


def test_empty_transfers_come_first_and_nothing_is_lost(faulty, device):
    device.chunks.append(b"abcd")
    faulty.inject(EmptyTransfers(count=2))
    transfers = [faulty.read(2, 64) for _ in range(3)]
    for transfer in transfers:
        faulty.sent(transfer)
    assert [transfer.data for transfer in transfers] == [b"", b"", b"abcd"]
    assert device.sent_data == [b"abcd"]
    faulty.advance(1)
    assert [(r.hits, r.ended_us) for r in faulty.records] == [(2, 1)]


def test_what_the_link_loses_of_a_fault_and_of_the_device_is_told_apart(faulty, device):
    device.chunks.append(b"abcd")
    faulty.inject(EmptyTransfers(count=1))
    for transfer in [faulty.read(2, 64) for _ in range(2)]:
        faulty.lost(transfer)
    assert device.lost_data == [b"abcd"]


READ = SetupPacket(0xC0, 0xBF, 6, 0, 4)


def test_vendor_requests_are_refused_as_often_as_asked(faulty):
    faulty.inject(ControlStall(request=0xBF, count=2))
    with pytest.raises(Stall):
        faulty.control(SetupPacket(0xC0, 0x55, 0, 0, 4), b"")
    assert faulty.records[0].hits == 0  # the device itself refused that one
    for _ in range(2):
        with pytest.raises(Stall, match="fault"):
            faulty.control(READ, b"")
    assert faulty.control(READ, b"") == bytes(4)
    assert faulty.control(SetupPacket(0x80, 6, 0x0100, 0, 18), b"")
    faulty.advance(5)
    assert [(r.hits, r.ended_us) for r in faulty.records] == [(2, 5)]


def test_a_slow_request_is_answered_when_its_time_has_come(faulty):
    faulty.inject(SlowControl(delay_ms=10, for_s=1))
    with pytest.raises(NotReady):
        faulty.control(READ, b"")
    faulty.advance(9_999)
    with pytest.raises(NotReady):
        faulty.control(READ, b"")
    faulty.advance(10_000)
    assert faulty.control(READ, b"") == bytes(4)
    with pytest.raises(NotReady):
        faulty.control(READ, b"")
    faulty.advance(1_000_000)
    assert faulty.control(READ, b"") == bytes(4)
    assert faulty.records[0].hits == 2


@pytest.mark.socket
def test_another_camera_comes_back(bench):
    camera = Davis346()
    faulty = FaultyDevice(camera, FaultPlan("usb"))
    bench.start({"1-1": faulty})

    def serial_and_firmware():
        with UsbipHost.attach(port=bench.server.port, timeout_s=120) as host:
            device = DavisHost(host)
            told = host.control_in(SetupPacket(0x80, 6, 0x0100, 0, 18))
            return device.info.serial, host.record.identity.bcd_device, told[12:14]

    assert serial_and_firmware() == ("00000346", 0x0206, b"\x06\x02")
    bench.call(faulty.inject, UsbUnplugged(for_s=0.1, serial="00000999"))
    bench.call(faulty.inject, WrongVersion(firmware=8))
    bench.call(faulty.advance, 100_000)
    assert serial_and_firmware() == ("00000999", 0x0208, b"\x08\x02")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ControlStall(request=256), "request"),
        (lambda: ControlStall(count=0), "count"),
        (lambda: SlowControl(delay_ms=0), "delay_ms"),
        (lambda: UsbUnplugged(serial="é"), "serial"),
    ],
)
def test_bad_keys_are_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()
