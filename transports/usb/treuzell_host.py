"""Driver of Prophesee's boards on any `UsbHost`: an EVK4, its siblings, boards with a Gen 3.1 or a GenX320.

The order of its registers is that of OpenEB's and neuromorphic_drivers' start and stop. The long initialisation between
the two, which powers the chip, is omitted: the emulated camera needs none.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.events import Events
from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.fx3.decoded import WordFaults
from firmware_protocol.gen31 import device as gen31
from firmware_protocol.gen31 import registers as gen31_registers
from firmware_protocol.genx320 import device as genx320
from firmware_protocol.genx320 import registers as genx320_registers
from firmware_protocol.imx636.evk4 import BOARDS
from firmware_protocol.imx636.registers import GEN41, IMX636, SIZE, V4L2_SENSOR, Address
from firmware_protocol.prophesee.registers import Form
from firmware_protocol.prophesee.treuzell import FAILED, MOST_ANSWER_BYTES, UNKNOWN, Frame, Property
from firmware_protocol.prophesee.usb import ANSWER_ENDPOINT, DATA_ENDPOINT, REQUEST_ENDPOINT
from firmware_protocol.prophesee.v4l2 import NodeSensor
from transports.usb.host import CameraHost, PeerBroken, StreamSettings, UnsuitableDevice, UsbHost

EVK4_IDS = frozenset(board.usb_id for board in (*BOARDS.values(), *gen31.BOARDS.values(), genx320.BOARD))
"""(vendor, product) of an EVK4, of its siblings, and of the boards with a Gen 3.1 or a GenX320."""

_OLDEST_RELEASE = 0x03_0800
_DEVICE = bytes(4)
_Writes = tuple[tuple[int, int], ...]
_FORMATS: Mapping[Form, _Writes] = {
    "evt3": ((Address.FORMAT, 0x0007_0001), (Address.OCTETS, 0x0001_E085)),
    "evt21-legacy": ((Address.FORMAT, 0x0007_0003), (Address.OCTETS, 0x0001_E005)),
}
_START = ((Address.OUTPUT, 0), (Address.TIME, 0x645), (Address.ARRAY, 0xF000_5442))
_STOP = ((Address.ARRAY, 0xF000_5042), (Address.OUTPUT, 2), (Address.TIME, 0x644))
_GENX = genx320_registers.Address
_GENX_FORMATS: Mapping[Form, _Writes] = {
    "evt21": ((_GENX.FORMAT, 2),),
    "evt3": ((_GENX.FORMAT, 1),),
    "evt2": ((_GENX.FORMAT, 0),),
}
_GENX_START = ((_GENX.OUTPUT, 0), (_GENX.TIME, 0x195), (_GENX.ARRAY, 0xC02))
_GENX_STOP = ((_GENX.ARRAY, 0x802), (_GENX.OUTPUT, 2), (_GENX.TIME, 0x194))
_GEN31 = gen31_registers.Address
_GEN31_START = (
    (_GEN31.POWER, 0xC_1107),
    (_GEN31.HOST, 0x300),
    (_GEN31.CLOCK, 1),
    (_GEN31.ARRAY, 0x2B),
    (_GEN31.NOISE, 0xC8),
)
_GEN31_STOP = ((_GEN31.ARRAY, 0x23), (_GEN31.CLOCK, 0), (_GEN31.HOST, 0x100), (_GEN31.POWER, 0x8_1106))


@dataclass(frozen=True)
class _Sensor:
    """The registers that the driver of a sensor writes; `trigger_off`, `trigger_on` are one register each.

    `formats`: registers of each form of the words, the first of which a driver reads unless it is given another.
    `node`: the sensor on V4L2.
    """

    name: str
    formats: Mapping[Form, _Writes] = field(default_factory=lambda: _FORMATS)
    start: _Writes = _START
    stop: _Writes = _STOP
    trigger_off: tuple[int, int] = (Address.TRIGGER, 0xC1FF)
    trigger_on: tuple[int, int] = (Address.TRIGGER, 0xC5FF)
    size: tuple[int, int] = SIZE
    node: NodeSensor | None = None

    @property
    def form(self) -> Form:
        """Form that a driver reads."""
        return next(iter(self.formats))


_CHIPS: Mapping[int, _Sensor] = {
    IMX636.number: _Sensor("an IMX636 or IMX646", node=V4L2_SENSOR),
    GEN41.number: _Sensor("a Gen4.1"),
    genx320_registers.CHIP: _Sensor(
        "a GenX320",
        _GENX_FORMATS,
        _GENX_START,
        _GENX_STOP,
        (_GENX.EVENT_TYPES, 0xC1FF),
        (_GENX.EVENT_TYPES, 0xC5FF),
        genx320_registers.SIZE,
        genx320_registers.V4L2_SENSOR,
    ),
    gen31_registers.CHIP: _Sensor(
        "a Gen 3.1",
        {"evt3": ()},
        _GEN31_START,
        _GEN31_STOP,
        (_GEN31.TRIGGERS, 0),
        (_GEN31.TRIGGERS, 1),
        gen31_registers.SIZE,
    ),
}
"""Sensors by their number, in register 0014, of a Gen 3.1 in 0218."""


@dataclass(frozen=True)
class TreuzellInfo:
    """Identity that a board reports. `size` is (width, height)."""

    serial: str
    release: int
    name: str
    compatible: tuple[str, ...]
    size: tuple[int, int] = SIZE


class TreuzellHost(CameraHost[TreuzellInfo]):
    """Driver of one EVK4, or of a board like it, whose name `model` then is.

    It reads EVT3; of a GenX320 EVT2.1. `host` is closed with the driver, and when it cannot be used. Raises
    UnsuitableDevice for none of these boards, or one that OpenEB refuses, and UsbHostError for any error of the host.
    """

    model = "EVK4"
    faults = WordFaults()  # always none: any bits are a valid word

    def __init__(self, host: UsbHost) -> None:
        self._sensor = _CHIPS[IMX636.number]
        self._decoder: Evt3Decoder | Evt2Decoder | None = None
        super().__init__(host)

    @property
    def node(self) -> NodeSensor | None:
        """The sensor as its driver on V4L2 shows it, if it has one."""
        return self._sensor.node

    def start(self, settings: StreamSettings | None = None) -> None:
        """Start the stream of events; the camera's time begins at zero, so no reset is needed."""
        form = self._sensor.form
        self._decoder, self._edges = Evt3Decoder() if form == "evt3" else Evt2Decoder(form), []
        self.start_words(form, settings)

    def start_words(self, form: Form, settings: StreamSettings | None = None) -> None:
        """Start the stream in words of a form, for `read_words`."""
        settings = settings or StreamSettings()
        self.stop_words()
        self.write_register(*(self._sensor.trigger_on if settings.edges else self._sensor.trigger_off))
        self._host.clear_halt(DATA_ENDPOINT & 15)
        self._reader = self._host.stream(DATA_ENDPOINT & 15, settings.transfer_bytes, settings.transfers)
        for address, value in (*self._sensor.formats[form], *self._sensor.start):
            self.write_register(address, value)

    def _end_stream(self) -> None:
        for address, value in self._sensor.stop:
            self.write_register(address, value)

    def read_register(self, address: int) -> int:
        """Return one 32-bit register of the sensor."""
        answer = self.request(Property.READ_REGISTERS, struct.pack("<III", 0, address, 1))
        if len(answer) != 12 or answer[:8] != struct.pack("<II", 0, address):
            raise PeerBroken(f"register 0x{address:X} was answered with {answer.hex()}")
        return int.from_bytes(answer[8:], "little")

    def write_register(self, address: int, value: int) -> None:
        """Set one 32-bit register of the sensor."""
        self.request(Property.WRITE_REGISTERS, struct.pack("<III", 0, address, value))

    def request(self, property: Property, payload: bytes = b"") -> bytes:
        """Send a request and return the payload of its answer; raises PeerBroken for one that failed."""
        self._host.bulk_out(REQUEST_ENDPOINT, bytes(Frame(property, payload)))
        data = self._host.bulk_in(ANSWER_ENDPOINT & 15, MOST_ANSWER_BYTES)
        try:
            answer = Frame.parse(data)
        except ValueError as error:
            raise PeerBroken(f"{property.name} has an invalid answer: {error}") from error
        if answer.property != property:
            is_known = answer.property == property | FAILED and answer.property != UNKNOWN
            raise PeerBroken(f"{property.name} {'failed' if is_known else 'is not known to the camera'}")
        return answer.payload

    def _identify(self) -> TreuzellInfo:
        identity = self._host.identity
        usb_id = identity.vendor_id, identity.product_id
        if usb_id not in EVK4_IDS:
            raise UnsuitableDevice(f"{usb_id[0]:04x}:{usb_id[1]:04x} is not an EVK4 (04b4:00f5), nor a board like it")
        release = int.from_bytes(self.request(Property.RELEASE), "little")
        if release < _OLDEST_RELEASE:
            raise UnsuitableDevice(f"the camera has release {release:06x}; at least 030800 is needed: update it")
        compatible = self._texts(Property.COMPATIBLE)
        is_gen31 = compatible == gen31.CHIP_NAMES.compatible
        chip = self.read_register(_GEN31.CHIP if is_gen31 else Address.CHIP)
        if chip not in _CHIPS:
            sensors = " or ".join(f"{sensor.name} ({number:08x})" for number, sensor in _CHIPS.items())
            raise UnsuitableDevice(f"the camera has chip {chip:08x}, not {sensors}")
        self._sensor = _CHIPS[chip]
        serial = int.from_bytes(self.request(Property.SERIAL), "little")
        self.model = _model(usb_id, compatible)
        return TreuzellInfo(f"{serial:08X}", release, self._texts(Property.NAME)[0], compatible, self._sensor.size)

    def _texts(self, property: Property) -> tuple[str, ...]:
        texts = self.request(property, _DEVICE)[4:].decode("ascii", "replace")
        return tuple(texts.split("\0")[:-1]) or ("",)

    def _decode(self, data: bytes) -> Events:
        assert self._decoder is not None, "`start` makes it"
        events, edges = self._decoder.decode(data)
        self._edges.append(edges)
        return events


def _model(usb_id: tuple[int, int], compatible: tuple[str, ...]) -> str:
    """Return the names of the boards that these facts fit."""
    if compatible == genx320.CHIP_NAMES.compatible:
        return genx320.BOARD.title
    if compatible == gen31.CHIP_NAMES.compatible:
        with_id = [board for board in gen31.BOARDS.values() if board.usb_id == usb_id]
        return " or ".join(board.title for board in with_id or gen31.BOARDS.values())
    boards = [board for board in BOARDS.values() if board.usb_id == usb_id]
    fitting = [board for board in boards if board.chip.compatible == compatible] or boards
    return " or ".join(board.title for board in fitting)
