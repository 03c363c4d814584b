"""Driver of a Prophesee EVK4 on any `UsbHost`: identify it, start it, read its events, stop it.

The order of registers is that of OpenEB's and neuromorphic_drivers' start and stop. The long initialisation between the
two, which powers the chip, is omitted: the emulated camera needs none.
"""

from __future__ import annotations

import contextlib
import struct
from dataclasses import dataclass

import numpy as np

from firmware_protocol.davis346.decoder import WordFaults
from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.imx636.evk4 import ANSWER_ENDPOINT, DATA_ENDPOINT, PRODUCT_ID, REQUEST_ENDPOINT, VENDOR_ID
from firmware_protocol.imx636.registers import SIZE, Address
from firmware_protocol.imx636.treuzell import FAILED, MOST_ANSWER_BYTES, UNKNOWN, Frame, Property
from transports.usb.davis_host import StreamSettings
from transports.usb.host import BulkReader, PeerBroken, UnsuitableDevice, UsbHost, UsbHostError

__all__ = ["EVK4_PRODUCT", "EVK4_VENDOR", "Evk4Host", "Evk4Info"]

EVK4_VENDOR, EVK4_PRODUCT = VENDOR_ID, PRODUCT_ID

_CHIP = 0xA040_1806
_OLDEST_RELEASE = 0x03_0800
_DEVICE = bytes(4)
_STOP = ((Address.ARRAY, 0xF000_5042), (Address.OUTPUT, 2), (Address.TIME, 0x644))
_START = ((Address.OUTPUT, 0), (Address.TIME, 0x645), (Address.ARRAY, 0xF000_5442))
_TRIGGER_OFF, _TRIGGER_ON = 0xC1FF, 0xC5FF


@dataclass(frozen=True)
class Evk4Info:
    """Identity that an EVK4 reports. `size` is (width, height)."""

    serial: str
    release: int
    name: str
    compatible: tuple[str, ...]
    size: tuple[int, int] = SIZE


class Evk4Host:
    """Driver of one EVK4.

    Parameters
    ----------
    host
        The device; it is closed with the driver, and when it cannot be used.

    Raises
    ------
    UnsuitableDevice
        Not an EVK4, or one that OpenEB refuses.
    UsbHostError
        Any error of the host.
    """

    model = "EVK4"

    def __init__(self, host: UsbHost) -> None:
        self._host = host
        self._reader: BulkReader | None = None
        self._edges: list[Edges] = []
        self._decoder = Evt3Decoder()
        try:
            host.configure()
            self.info = self._identify()
        except UsbHostError:
            host.close()
            raise

    @property
    def faults(self) -> WordFaults:
        """Always none: any 16 bits are a valid word of EVT3."""
        return WordFaults()

    def start(self, settings: StreamSettings | None = None) -> None:
        """Start the stream of events; the camera's time begins at zero, so no reset is needed."""
        settings = settings or StreamSettings()
        self.stop()
        self._decoder, self._edges = Evt3Decoder(), []
        self.write_register(Address.TRIGGER, _TRIGGER_ON if settings.edges else _TRIGGER_OFF)
        self._host.clear_halt(DATA_ENDPOINT & 15)
        self._reader = self._host.stream(DATA_ENDPOINT & 15, settings.transfer_bytes, settings.transfers)
        for address, value in _START:
            self.write_register(address, value)

    def read(self, timeout_s: float) -> Events | None:
        """Return the events of the next transfer, in device time; None when none arrived in time.

        An idle camera sends times, so a transfer may contain no event.
        """
        if self._reader is None:
            raise RuntimeError("the camera is not started")
        data = self._reader.read(timeout_s)
        return None if data is None else self._decode(data)

    def take_edges(self) -> Edges:
        """Return the edges read since the last call, (n,) EDGE in device time, if the start enabled them."""
        edges, self._edges = self._edges, []
        return np.concatenate([empty_edges(), *edges])

    def stop(self) -> Events:
        """Stop the camera and the stream; return the events that were still in transit."""
        for address, value in _STOP:
            self.write_register(address, value)
        reader, self._reader = self._reader, None
        rest = [self._decode(data) for data in reader.close()] if reader else []
        return np.concatenate([empty_events(), *rest])

    def close(self) -> None:
        """Stop the camera, if it is still there, and close it."""
        with contextlib.suppress(UsbHostError):
            self.stop()
        self._host.close()

    def read_register(self, address: int) -> int:
        """Return one 32-bit register of the sensor."""
        answer = self.request(Property.READ_REGISTERS, struct.pack("<III", 0, address, 1))
        if len(answer) != 12 or answer[:8] != struct.pack("<II", 0, address):
            raise PeerBroken(f"register 0x{address:X} was answered with {answer.hex()}")
        return int.from_bytes(answer[8:], "little")

    def write_register(self, address: int, value: int) -> None:
        """Set one 32-bit register of the sensor."""
        self.request(Property.WRITE_REGISTERS, struct.pack("<III", 0, address, value))

    def request(self, what: Property, payload: bytes = b"") -> bytes:
        """Send a request and return the payload of its answer; raises PeerBroken for one that failed."""
        self._host.bulk_out(REQUEST_ENDPOINT, bytes(Frame(what, payload)))
        data = self._host.bulk_in(ANSWER_ENDPOINT & 15, MOST_ANSWER_BYTES)
        try:
            answer = Frame.parse(data)
        except ValueError as error:
            raise PeerBroken(f"{what.name} has an invalid answer: {error}") from error
        if answer.property != what:
            known = answer.property == what | FAILED and answer.property != UNKNOWN
            raise PeerBroken(f"{what.name} {'failed' if known else 'is not known to the camera'}")
        return answer.payload

    def _identify(self) -> Evk4Info:
        identity = self._host.identity
        if (identity.vendor_id, identity.product_id) != (EVK4_VENDOR, EVK4_PRODUCT):
            raise UnsuitableDevice(f"{identity.vendor_id:04x}:{identity.product_id:04x} is not an EVK4 (04b4:00f5)")
        release = int.from_bytes(self.request(Property.RELEASE), "little")
        if release < _OLDEST_RELEASE:
            raise UnsuitableDevice(f"the camera has release {release:06x}; at least 030800 is needed: update it")
        chip = self.read_register(Address.CHIP)
        if chip != _CHIP:
            raise UnsuitableDevice(f"the camera has chip {chip:08x}, not an IMX636 ({_CHIP:08x})")
        serial = int.from_bytes(self.request(Property.SERIAL), "little")
        name, compatible = self._texts(Property.NAME), self._texts(Property.COMPATIBLE)
        return Evk4Info(f"{serial:08X}", release, name[0], compatible)

    def _texts(self, what: Property) -> tuple[str, ...]:
        texts = self.request(what, _DEVICE)[4:].decode("ascii", "replace")
        return tuple(texts.split("\0")[:-1]) or ("",)

    def _decode(self, data: bytes) -> Events:
        events, edges = self._decoder.decode(data)
        self._edges.append(edges)
        return events
