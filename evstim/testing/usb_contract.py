"""The contract of a USB cable as tests: a host receives the same data and answers over every cable.

The USB/IP server, the bus in memory behind pyusb (`fake_usb`) and the loopback keep it, so that a program tested with
one of them finds the same camera at the others. Subclass and let pytest collect the class:

    class TestMyCable(UsbContract):
        def plug(self, device, timeout_s):
            bus = FakeUsbBus(device, self.camera.settings.descriptors())
            return Plugged(PyusbHost.find(0x152A, self.camera.product, bus, timeout_s), bus.call)

The camera is a DAVIS346; `camera = DVXPLORER` in the class selects another, likewise DVXPLORER_MICRO and DAVIS240C.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from firmware_protocol.davis346.device import Davis240c, Davis240cSettings, Davis346, Davis346Settings
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.micro import DvxplorerMicro, DvxplorerMicroSettings
from firmware_protocol.events import Events
from firmware_protocol.fx3.camera import Fx3Camera, Fx3Settings
from firmware_protocol.usb.device import SetupPacket, UsbDevice
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import ControlStall, ShortTransfers, SlowControl, UsbStall
from transports.usb.davis_host import Davis240cHost, DavisHost
from transports.usb.dvxplorer_host import DvxplorerHost, MicroHost
from transports.usb.fx3_host import Fx3Host
from transports.usb.host import StallError, StreamSettings, TransferTimeout, UsbHost

_T = TypeVar("_T")

_PATIENCE_S = 120.0
_IMPATIENCE_S = 0.3
_ATTEMPTS = 200
_EVENTS = 5000  # from microsecond 1: a DVXplorer Micro sends none with the time of its start
_SIZE = 240, 180  # of the smallest camera
_DEVICE_DESCRIPTOR = SetupPacket(0x80, 6, 0x0100, 0, 18)
_LOGIC_VERSION = SetupPacket(0xC0, 0xBF, 6, 0, 4)
_UNKNOWN = SetupPacket(0xC0, 0x55, 0, 0, 4)
_DELAY = 9, 1  # module and address of the early packet delay of 1 ms, in cycles of the USB clock


@dataclass(frozen=True)
class ContractCamera:
    """A camera that a contract is tested with.

    Attributes
    ----------
    settings : its settings; its serial number is 00000042.
    device : its model.
    driver : its driver.
    chip_id : register 6.1.
    """

    settings: Fx3Settings
    device: Callable[[Any], Fx3Camera]
    driver: type[Fx3Host]
    chip_id: int

    @property
    def product(self) -> int:
        """Product number of USB."""
        return self.settings.product_id


_SERIAL = "00000042"
DAVIS346 = ContractCamera(Davis346Settings(serial=_SERIAL, start_delay_us=0), Davis346, DavisHost, 5)
DAVIS240C = ContractCamera(Davis240cSettings(serial=_SERIAL, start_delay_us=0), Davis240c, Davis240cHost, 2)
DVXPLORER = ContractCamera(DvxplorerSettings(serial=_SERIAL, start_delay_us=0), Dvxplorer, DvxplorerHost, 20)
_MICRO = DvxplorerMicroSettings(serial=_SERIAL, start_delay_us=0, bcd_device=0x0409, has_frames=False)
DVXPLORER_MICRO = ContractCamera(_MICRO, DvxplorerMicro, MicroHost, 20)


@dataclass(frozen=True)
class Plugged:
    """A device at a host.

    Attributes
    ----------
    host : the host's side.
    call : do something to the device as its owner, and let what follows reach the host: call(function, *arguments).
    """

    host: UsbHost
    call: Callable[..., object]


class UsbContract:
    """Behaviour of every cable between a camera and its host; `camera`: the camera at one end."""

    camera: ClassVar[ContractCamera] = DAVIS346

    def plug(self, device: UsbDevice, timeout_s: float) -> Plugged:
        """Return `device`, a camera with `self.camera.settings`, at a host whose control requests may take `timeout_s`.

        The device may be plugged in again when the host was closed.
        """
        raise NotImplementedError("a contract of a cable needs the cable")

    @pytest.fixture
    def model(self) -> Fx3Camera:
        """Return the camera."""
        return self.camera.device(self.camera.settings)

    @pytest.fixture
    def faulty(self, model: Fx3Camera) -> FaultyDevice:
        """Return the camera behind faults, none of which is at work yet."""
        return FaultyDevice(model, FaultPlan("usb"))

    def test_its_identity_is_read(self, model: Fx3Camera) -> None:
        """Identity, descriptors and strings are the camera's own."""
        with closing(self.plug(model, _PATIENCE_S).host) as host:
            identity = host.identity
            of_camera = (0x152A, self.camera.product, self.camera.settings.bcd_device)
            assert (identity.vendor_id, identity.product_id, identity.bcd_device) == of_camera
            assert host.control_in(_DEVICE_DESCRIPTOR) == bytes(model.settings.descriptors().device)
            serial = host.control_in(SetupPacket(0x80, 6, 0x0303, 0x0409, 255))
            assert serial[2:].decode("utf-16-le") == _SERIAL

    def test_an_answer_is_cut_to_the_length_of_the_request(self, model: Fx3Camera) -> None:
        """WLength bounds the data stage."""
        with closing(self.plug(model, _PATIENCE_S).host) as host:
            assert host.control_in(SetupPacket(0x80, 6, 0x0100, 0, 8)) == host.control_in(_DEVICE_DESCRIPTOR)[:8]

    def test_a_refused_request_harms_nothing(self, model: Fx3Camera) -> None:
        """A STALL of endpoint 0 is over with the next request; nothing of a bad write is written."""
        with closing(self.plug(model, _PATIENCE_S).host) as host:
            with pytest.raises(StallError):
                host.control_in(_UNKNOWN)
            with pytest.raises(StallError):
                host.control_out(SetupPacket(0x40, 0xC2, 2, 0, 6), bytes((1, 3, 0, 0, 0, 1)))
            assert host.control_in(SetupPacket(0xC0, 0xBF, 1, 3, 4)) == bytes(4)
            assert host.control_in(_LOGIC_VERSION) == bytes((0, 0, 0, 18))

    def test_registers_keep_what_is_written(self, model: Fx3Camera) -> None:
        """One at a time, and several with one request."""
        with closing(self.plug(model, _PATIENCE_S).host) as host:
            host.configure()
            assert host.control_out(SetupPacket(0x40, 0xBF, *_DELAY, 4), bytes((0, 0, 1, 2))) == 4
            entries = bytes((4, 5, 0, 0, 0, 7, 4, 1, 0, 0, 0, 1))
            assert host.control_out(SetupPacket(0x40, 0xC2, 2, 0, 12), entries) == 12
            keys = (_DELAY, (4, 5), (4, 1))
            read = [host.control_in(SetupPacket(0xC0, 0xBF, *register, 4))[-2:] for register in keys]
            assert read == [b"\1\2", b"\0\7", b"\0\1"]

    def test_every_event_arrives_in_order(self, model: Fx3Camera) -> None:
        """None is lost where nothing forces it, and each counts as delivered."""
        plugged, sent = self.plug(model, _PATIENCE_S), event_stream(_EVENTS, 1, _SIZE)
        camera = self.camera.driver(plugged.host)
        camera.start(StreamSettings(transfer_bytes=2048, transfers=4, reset_timestamps=False))
        plugged.call(_show, model, sent)
        received = _read(camera, len(sent))
        last_transfers = camera.stop()
        camera.close()
        assert np.array_equal(received, sent)
        assert not len(last_transfers)
        assert model.counters.delivered == len(sent) == model.counters.accounted

    def test_a_read_of_nothing_ends_and_requests_do_not_wait_for_it(self, model: Fx3Camera) -> None:
        """Transfers that wait for data hold up no control request."""
        with closing(self.plug(model, _PATIENCE_S).host) as host:
            host.configure()
            stream = host.stream(2, 512, 2)
            assert stream.read(0.0) is None
            assert host.control_in(_LOGIC_VERSION)[-1] == 18
            assert stream.close() == []

    def test_a_host_that_goes_leaves_a_camera_without_power(self, model: Fx3Camera) -> None:
        """Registers are as at power-on for the next host, and events between the two were not running."""
        first = self.plug(model, _PATIENCE_S)
        first.host.configure()
        first.host.control_out(SetupPacket(0x40, 0xBF, *_DELAY, 4), bytes((0, 0, 0, 99)))
        first.host.close()
        second = self.plug(model, _PATIENCE_S)
        second.call(_show, model, event_stream(10, size=_SIZE))
        with closing(second.host) as host:
            cycles = int.from_bytes(host.control_in(SetupPacket(0xC0, 0xBF, *_DELAY, 4)), "big")
            assert cycles == 1000 * self.camera.settings.system.usb_clock_mhz
        assert model.counters.not_running == 10

    def test_a_halt_lasts_until_it_is_cleared(self, faulty: FaultyDevice) -> None:
        """A halted endpoint fails reads; requests go on."""
        plugged = self.plug(faulty, _PATIENCE_S)
        with closing(plugged.host) as host:
            host.configure()
            plugged.call(faulty.inject, UsbStall())
            stream = host.stream(2, 512, 1)
            with pytest.raises(StallError):
                stream.read(_PATIENCE_S)
            stream.close()
            assert host.control_in(_LOGIC_VERSION)[-1] == 18
            host.clear_halt(2)
            plugged.call(faulty.advance, 1)
            stream = host.stream(2, 512, 1)
            assert stream.read(0.0) is None
            stream.close()
        assert faulty.records[0].hits == 1

    def test_a_request_can_be_refused_once(self, faulty: FaultyDevice) -> None:
        """The next one is answered."""
        plugged = self.plug(faulty, _PATIENCE_S)
        with closing(plugged.host) as host:
            plugged.call(faulty.inject, ControlStall())
            with pytest.raises(StallError):
                host.control_in(_LOGIC_VERSION)
            assert host.control_in(_LOGIC_VERSION)[-1] == 18

    def test_a_late_answer_is_a_timeout_and_not_that_of_the_next_request(self, faulty: FaultyDevice) -> None:
        """A host that gives up sends a new request."""
        plugged = _in_time(lambda: self.plug(faulty, _IMPATIENCE_S))
        with closing(plugged.host) as host:
            plugged.call(faulty.inject, SlowControl(for_s=1.0))
            with pytest.raises(TransferTimeout):
                host.control_in(_LOGIC_VERSION)
            plugged.call(faulty.advance, 1_000_000)
            assert _in_time(lambda: host.control_in(SetupPacket(0xC0, 0xBF, 6, 1, 4)))[-1] == self.camera.chip_id

    def test_transfers_of_any_length_carry_the_same_events(self, model: Fx3Camera, faulty: FaultyDevice) -> None:
        """A decoder must not count on full buffers."""
        plugged, sent = self.plug(faulty, _PATIENCE_S), event_stream(100, 1, _SIZE)
        plugged.call(faulty.inject, ShortTransfers(for_s=10.0, most_bytes=6))
        camera = self.camera.driver(plugged.host)
        camera.start(StreamSettings(transfer_bytes=512, transfers=4, reset_timestamps=False))
        plugged.call(_show, model, sent)
        received = _read(camera, len(sent))
        camera.close()
        assert np.array_equal(received, sent)
        assert model.counters.delivered == len(sent)


def _in_time(action: Callable[[], _T]) -> _T:
    """Return what an action gives; it is repeated where a busy machine kept an impatient host waiting."""
    for _ in range(_ATTEMPTS):
        with suppress(TransferTimeout):
            return action()
    raise TransferTimeout(f"not done in {_ATTEMPTS} attempts of {_IMPATIENCE_S} s")


def _show(model: Fx3Camera, events: Events) -> None:
    model.offer(events)
    model.advance(int(events["t"][-1]))


def _read(camera: Fx3Host, count: int) -> Events:
    parts: list[Events] = []
    while sum(map(len, parts)) < count:
        events = camera.read(_PATIENCE_S)
        assert events is not None, f"{sum(map(len, parts))} of {count} events came"
        parts.append(events)
    return np.concatenate(parts)
