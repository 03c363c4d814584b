"""The fakes of camera and ports against the real decoders: events arrive, commands act, faults fail as real ones."""

import errno

import can
import numpy as np
import pytest
import usb.core

from evstim.testing.fake_usb import FakeCamera
from evstim.testing.fakes import FakeCanBus, FakeSerialPort
from firmware_protocol.can_frames.canopen import NmtCommand, NmtOrder
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Ping, Stop
from firmware_protocol.receiver.can import CanReceiver
from firmware_protocol.receiver.instrument import SerialReceiver
from tests.made_events import scattered
from transports.can_bus.bus import from_message
from transports.can_bus.kind import CanLink
from transports.usb.davis_host import DavisHost
from transports.usb.host import StreamSettings
from transports.usb.pyusb_host import PyusbHost

SIZE = (346, 260)
PATIENT = InstrumentSettings(queue_ms=60_000)


def stream(count, gap_us=5, seed=1):
    return scattered(np.cumsum(np.random.default_rng(seed).integers(1, 2 * gap_us, count)), SIZE, seed)


def read_all(host, count):
    parts = []
    while sum(map(len, parts)) < count:
        events = host.read(120.0)
        assert events is not None
        parts.append(events)
    return np.concatenate(parts)


def test_a_driver_on_pyusb_reads_every_event():
    sent = stream(5000)
    with FakeCamera() as camera:
        host = DavisHost(PyusbHost(camera.device))
        host.start(StreamSettings(transfers=4, reset_timestamps=False))
        camera.show(sent)
        got = read_all(host, len(sent))
        host.close()
        assert camera.model.counters.accounted == camera.model.counters.offered == len(sent)
    assert np.array_equal(got[["x", "y", "on"]], sent[["x", "y", "on"]])


def test_events_before_a_driver_has_started_it_are_counted():
    with FakeCamera() as camera:
        camera.show(stream(10))
        assert camera.model.counters.not_running == 10


def test_pyusb_finds_it_and_a_pulled_cable_is_enodev():
    with FakeCamera() as camera:
        device = usb.core.find(idVendor=0x152A, idProduct=0x841A, backend=camera.bus)
        device.set_configuration(1)
        with pytest.raises(usb.core.USBTimeoutError):
            device.read(0x82, 512, timeout=1)
        with pytest.raises(usb.core.USBError) as stall:
            device.ctrl_transfer(0xC0, 0x55, 0, 0, 4)
        assert stall.value.errno == errno.EPIPE
        camera.bus.break_with(errno.ENODEV)
        with pytest.raises(usb.core.USBError) as gone:
            device.ctrl_transfer(0xC0, 0xBF, 6, 1, 4)
        assert gone.value.errno == errno.ENODEV


@pytest.mark.parametrize("profile", ["ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss", "fprime"])
def test_a_receiver_on_the_serial_port_reads_every_event(profile):
    sent, receiver = stream(3000), SerialReceiver(profile)
    with FakeSerialPort(profile, SIZE, PATIENT) as port:
        port.show(sent)
        while port.in_waiting:
            receiver.push(port.read(100))
        assert port.instrument.counters.delivered == len(sent)
    assert np.array_equal(receiver.take_events(), sent)


def test_telecommands_on_the_serial_port_are_obeyed_and_answered():
    profile, receiver = Profile("ccsds-cobs"), SerialReceiver("ccsds-cobs")
    with FakeSerialPort(settings=PATIENT) as port:
        port.read(10_000)
        port.write(profile.wrap_command(Ping()) + profile.wrap_command(Stop()))
        receiver.push(port.read(10_000))
        assert len(receiver.take_reports()) >= 2
        port.show(stream(10))
        assert port.instrument.counters.not_running == 10
    with pytest.raises(OSError, match="closed"):
        port.read(1)


def test_damage_on_the_line_is_told_by_the_receiver_and_gives_no_false_event():
    sent, receiver = stream(3000), SerialReceiver("ccsds-cobs")
    with FakeSerialPort(settings=PATIENT) as port:
        port.damage = lambda data: data[:20] + bytes([data[20] ^ 4]) + data[21:]
        port.show(sent)
        receiver.push(port.read(1_000_000))
    assert len(receiver.take_events()) == 0
    assert sum(receiver.counts.values()) > 0


@pytest.mark.parametrize("carriage", ["raw", "cfp"])
def test_a_receiver_on_the_can_bus_reads_every_event(carriage):
    p = CanLink(carriage=carriage, instrument=PATIENT, share=1.0)
    sent, receiver = stream(500, gap_us=400), CanReceiver(p.receiver)
    with FakeCanBus(p, SIZE) as bus:
        bus.show(sent)
        while bus.instrument.counters.delivered < len(sent) or bus.in_waiting:
            message = bus.recv(1.0)
            receiver.push(from_message(message), round(message.timestamp * 1e9))
        assert bus.instrument.counters.delivered == len(sent)
    assert np.array_equal(receiver.take_events(), sent)


def test_nmt_on_the_can_bus_stops_the_camera():
    p = CanLink(instrument=PATIENT)
    with FakeCanBus(p, SIZE) as bus:
        order = bytes(NmtOrder(NmtCommand.STOP, p.node))
        bus.send(can.Message(arbitration_id=p.identifiers.nmt, data=order, is_extended_id=False))
        bus.show(stream(10))
        assert bus.instrument.counters.not_running == 10
