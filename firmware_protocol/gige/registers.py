"""Settings and registers of a GigE Vision camera.

Registers of every GigE Vision device, by address:

    0x0000 version, mode, MAC, address, names       248 octets, which are also the answer to a discovery
    0x0200, 0x0400   location of the XML description   text, 512 octets each
    0x0600 interfaces, 0x0670 link speed
    0x0900 capabilities, heartbeat, time
    0x0A00 control privilege
    0x0B00 message channel
    0x0D00 stream channel
    0x9800 action groups

Source: GigE Vision 2.0 as implemented in the open by Aravis; names of the camera from published captures.

The memory of the device has areas of octets, which a host reads, and registers of four octets, which it writes:

area       start --- octets ------- end       READREG, READMEM
rule       at the address of a register       WRITEREG, WRITEMEM: value written -> value stored, or Refused

Further registers of the Triton2 EVS, by address:

    1010 0030               temperature, signed, 1/16 degree C
    1030 0000 - 1030 0020   acquisition and image: mode, start, stop, payload size, width, height, event format
    1030 0024, 1030 0028    messages: selected event, notification: 0 off, 1 without data, 2 with data
    13F3 0000 + 14 k        bias k: value, least, most (signed offsets from the factory's value)
    13F6 0000               rate control: on, 0004 period, us, 0018 events a period, 002C events that are dropped
    1040 1004 - 1040 1038   rows:    on, selector, size, offset, number of ranges
    1040 1050 - 1040 1084   columns: the same
    1040 108C               inverted: masks only where a row range and a column range cross

Source: registers that neuromorphic_drivers writes and reads. Of the acquisition registers only start and stop are
known; the others have addresses chosen here, which a GenICam host reads from the description. Bounds of the biases are
those recommended for the IMX636.
"""

from __future__ import annotations

import ipaddress
import zlib
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

from firmware_protocol.gige.gvcp import Refused, Status
from firmware_protocol.imx636.biases import BiasModel

__all__ = [
    "ACQUISITION_START",
    "ACQUISITION_STOP",
    "BIASES",
    "COLUMNS",
    "DISCOVERY_OCTETS",
    "INVERTED",
    "LONGEST_READ",
    "MOST_RANGES",
    "NOTIFY_WITH_DATA",
    "PERIOD_US",
    "ROWS",
    "TEMPERATURE",
    "TICK_HZ",
    "Bias",
    "Capability",
    "Erc",
    "Evs",
    "GigeSettings",
    "Memory",
    "Privilege",
    "RangeRegisters",
    "Register",
    "Rule",
    "between",
    "bootstrap",
    "evs_areas",
    "evs_rules",
    "unchanged",
]


@dataclass(frozen=True)
class GigeSettings:
    """Identity and buffers of a camera.

    Attributes
    ----------
    size
        (width, height) of the sensor, pixels.
    address
        The camera's own IPv4 address, which is in its answer to a discovery.
    serial, user_name
        At most 15 ASCII characters.
    start_delay_us
        Silence after AcquisitionStart: a host with the stock socket buffer begins to read some 0.1 s later.
    block_us
        Age at which a block is closed, unless it is full before.
    capacity
        Most events that wait; further ones are dropped and counted.
    biases
        Effect of the biases on the sensor.
    """

    size: tuple[int, int] = (1280, 720)
    address: str = "127.0.0.1"
    serial: str = "00000636"
    user_name: str = ""
    start_delay_us: int = 300_000
    block_us: int = 1000
    capacity: int = 1 << 20
    biases: BiasModel = field(default_factory=BiasModel)

    def __post_init__(self) -> None:
        ipaddress.IPv4Address(self.address)
        for name in ("serial", "user_name"):
            if len(getattr(self, name)) > 15 or not getattr(self, name).isascii():
                raise ValueError(f"{name} must have at most 15 ASCII characters, got {getattr(self, name)!r}")
        if self.start_delay_us < 0 or self.block_us < 1 or self.capacity < 1:
            raise ValueError("start_delay_us must not be negative, block_us and capacity be at least 1")


DISCOVERY_OCTETS = 0xF8
TICK_HZ = 1_000_000_000
_VERSION = 2 << 16
_MODE_BIG_ENDIAN_UTF8 = 1 << 31 | 1
_FIXED_ADDRESS = 1
_MAC_PREFIX = 0x1C0FAF
_HEARTBEAT_MS = 3000
_LINK_MBIT_S = 1000
_LENGTH = 0x0D40


class Register(IntEnum):
    """Addresses."""

    VERSION = 0x0000
    DEVICE_MODE = 0x0004
    MAC_HIGH = 0x0008
    MAC_LOW = 0x000C
    IP_SUPPORTED = 0x0010
    IP_CURRENT = 0x0014
    ADDRESS = 0x0024
    MASK = 0x0034
    GATEWAY = 0x0044
    MANUFACTURER = 0x0048
    MODEL = 0x0068
    DEVICE_VERSION = 0x0088
    MANUFACTURER_INFO = 0x00A8
    SERIAL = 0x00D8
    USER_NAME = 0x00E8
    XML_1 = 0x0200
    XML_2 = 0x0400
    INTERFACES = 0x0600
    LINK_SPEED = 0x0670
    MESSAGE_CHANNELS = 0x0900
    STREAM_CHANNELS = 0x0904
    ACTION_SIGNALS = 0x0908
    ACTION_DEVICE_KEY = 0x090C
    ACTIVE_LINKS = 0x0910
    STREAM_CAPABILITY = 0x092C
    CAPABILITY = 0x0934
    HEARTBEAT_MS = 0x0938
    TICK_HIGH = 0x093C
    TICK_LOW = 0x0940
    TIME_CONTROL = 0x0944
    TIME_HIGH = 0x0948
    TIME_LOW = 0x094C
    GVCP_CONFIGURATION = 0x0954
    PENDING_MS = 0x0958
    GVSP_CONFIGURATION = 0x0960
    PRIVILEGE = 0x0A00
    PRIMARY_PORT = 0x0A04
    PRIMARY_ADDRESS = 0x0A14
    MESSAGE_PORT = 0x0B00
    MESSAGE_ADDRESS = 0x0B10
    MESSAGE_TIMEOUT = 0x0B14
    MESSAGE_RETRIES = 0x0B18
    STREAM_PORT = 0x0D00
    PACKET_SIZE = 0x0D04
    PACKET_DELAY = 0x0D08
    STREAM_ADDRESS = 0x0D18
    STREAM_SOURCE_PORT = 0x0D1C
    ACTION_GROUP = 0x9800


class Capability(IntFlag):
    """Optional functions of the device, as in register CAPABILITY."""

    USER_NAME = 1 << 31
    SERIAL = 1 << 30
    HEARTBEAT_OFF = 1 << 29
    LINK_SPEED = 1 << 28
    SCHEDULED_ACTION = 1 << 17
    ACTION = 1 << 6
    EVENTDATA = 1 << 4
    EVENT = 1 << 3
    RESEND = 1 << 2
    WRITEMEM = 1 << 1
    CONCATENATION = 1 << 0


class Privilege(IntFlag):
    """Register PRIVILEGE: the kind of control that a host has."""

    EXCLUSIVE = 1 << 0
    CONTROL = 1 << 1


def bootstrap(settings: GigeSettings, xml_location: str) -> bytes:
    """Return the registers from address 0 on, at power-on."""
    octets = bytearray(_LENGTH)
    for address, number in _numbers(settings).items():
        octets[address : address + 4] = number.to_bytes(4, "big")
    for address, (text, room) in _texts(settings, xml_location).items():
        octets[address : address + room] = text.encode("ascii").ljust(room, b"\0")
    return bytes(octets)


def _numbers(settings: GigeSettings) -> dict[int, int]:
    all_capabilities = 0
    for one in Capability:
        all_capabilities |= one
    return {
        Register.VERSION: _VERSION,
        Register.DEVICE_MODE: _MODE_BIG_ENDIAN_UTF8,
        Register.MAC_HIGH: _MAC_PREFIX >> 8,
        Register.MAC_LOW: (_MAC_PREFIX & 0xFF) << 24 | zlib.crc32(settings.serial.encode()) & 0xFFFFFF,
        Register.IP_SUPPORTED: _FIXED_ADDRESS,
        Register.IP_CURRENT: _FIXED_ADDRESS,
        Register.ADDRESS: int(ipaddress.IPv4Address(settings.address)),
        Register.MASK: 0xFFFFFF00,
        Register.INTERFACES: 1,
        Register.LINK_SPEED: _LINK_MBIT_S,
        Register.MESSAGE_CHANNELS: 1,
        Register.STREAM_CHANNELS: 1,
        Register.ACTION_SIGNALS: 1,
        Register.ACTIVE_LINKS: 1,
        Register.STREAM_CAPABILITY: 1 << 31,
        Register.CAPABILITY: all_capabilities,
        Register.HEARTBEAT_MS: _HEARTBEAT_MS,
        Register.TICK_LOW: TICK_HZ,
        Register.PACKET_SIZE: 1400,
    }


def _texts(settings: GigeSettings, xml_location: str) -> dict[int, tuple[str, int]]:
    return {
        Register.MANUFACTURER: ("Lucid Vision Labs", 32),
        Register.MODEL: ("TRT009S-E", 32),
        Register.DEVICE_VERSION: ("1.46.0.0", 32),
        Register.MANUFACTURER_INFO: ("evstim emulator", 48),
        Register.SERIAL: (settings.serial, 16),
        Register.USER_NAME: (settings.user_name, 16),
        Register.XML_1: (xml_location, 512),
        Register.XML_2: (xml_location, 512),
    }


LONGEST_READ = 536
"""Octets of one READMEM: the answer fits into 576 octets, which every network carries."""

Rule = Callable[[int], int]
"""Rule for writes to a register: returns the value to store, or raises Refused."""


def unchanged(value: int) -> int:
    """Return the value as it was written: the rule of a register that only stores it."""
    return value


def between(least: int, most: int) -> Rule:
    """Return the rule of a register that refuses numbers outside these, signed if `least` is negative."""

    def rule(value: int) -> int:
        number = value - (1 << 32) if least < 0 and value >> 31 else value
        if not least <= number <= most:
            raise Refused(Status.INVALID_PARAMETER)
        return value

    return rule


class Memory:
    """Memory of a device: areas by their first address, and rules by the address of their register."""

    def __init__(self, areas: Mapping[int, bytes], rules: Mapping[int, Rule]) -> None:
        self._starts = sorted(areas)
        self._areas = {start: bytearray(areas[start]) for start in self._starts}
        self._rules = dict(rules)

    def read(self, address: int, count: int) -> bytes:
        """Return `count` octets; raises Refused outside the areas, and unless four divides both numbers."""
        if address % 4 or count % 4:
            raise Refused(Status.BAD_ALIGNMENT)
        area, offset = self._find(address, count)
        return bytes(area[offset : offset + count])

    def get(self, address: int) -> int:
        """Return a register; raises Refused if there is none."""
        return int.from_bytes(self.read(address, 4), "big")

    def set(self, address: int, value: int) -> None:
        """Change a register from inside the device, without its rule."""
        area, offset = self._find(address, 4)
        area[offset : offset + 4] = (value & 0xFFFFFFFF).to_bytes(4, "big")

    def write(self, address: int, value: int) -> None:
        """Write a register for a host; raises Refused if it cannot be written, or not with this value."""
        if address % 4:
            raise Refused(Status.BAD_ALIGNMENT)
        rule = self._rules.get(address)
        if rule is None:
            self._find(address, 4)
            raise Refused(Status.WRITE_PROTECT)
        self.set(address, rule(value))

    def _find(self, address: int, count: int) -> tuple[bytearray, int]:
        place = bisect_right(self._starts, address) - 1
        if place >= 0:
            start = self._starts[place]
            area = self._areas[start]
            if address + count <= start + len(area):
                return area, address - start
        raise Refused(Status.INVALID_ADDRESS)


TEMPERATURE = 0x1010_0030
ACQUISITION_START = 0x1030_0004
ACQUISITION_STOP = 0x1030_0008
INVERTED = 0x1040_108C
PERIOD_US = 200
NOTIFY_WITH_DATA = 2
MOST_RANGES = 64
_CELSIUS = 35


class Evs(IntEnum):
    """Acquisition and image."""

    MODE = 0x1030_0000
    PAYLOAD_SIZE = 0x1030_0010
    WIDTH = 0x1030_0014
    HEIGHT = 0x1030_0018
    EVENT_FORMAT = 0x1030_001C
    EVENT_FORMAT_SIZE = 0x1030_0020
    EVENT_SELECTOR = 0x1030_0024
    EVENT_NOTIFICATION = 0x1030_0028


class Erc(IntEnum):
    """Event rate control."""

    ON = 0x13F6_0000
    PERIOD_US = 0x13F6_0004
    EVENTS = 0x13F6_0018
    DROP_MODE = 0x13F6_002C


@dataclass(frozen=True)
class Bias:
    """A bias: its register, its feature's name, and the bounds of its offset."""

    address: int
    feature: str
    least: int
    most: int


BIASES: Mapping[str, Bias] = {
    "diff_on": Bias(0x13F3_0000, "BiasEventThresholdPositive", -85, 140),
    "diff_off": Bias(0x13F3_0014, "BiasEventThresholdNegative", -35, 190),
    "diff": Bias(0x13F3_0028, "BiasTuningControl", -25, 23),
    "refr": Bias(0x13F3_003C, "BiasRefractoryPeriod", -20, 235),
    "fo": Bias(0x13F3_0050, "BiasLowPassFilterCutoff", -35, 55),
    "hpf": Bias(0x13F3_0064, "BiasHighPassFilterCutoff", 0, 120),
}
"""By Prophesee's names."""


@dataclass(frozen=True)
class RangeRegisters:
    """Addresses by which a host writes ranges of rows or columns, one after another."""

    on: int
    selector: int
    size: int
    offset: int
    count: int


ROWS = RangeRegisters(0x1040_1004, 0x1040_1008, 0x1040_1010, 0x1040_1024, 0x1040_1038)
COLUMNS = RangeRegisters(0x1040_1050, 0x1040_1054, 0x1040_105C, 0x1040_1070, 0x1040_1084)


def evs_areas(size: tuple[int, int], payload_octets: int) -> dict[int, bytes]:
    """Return the areas of these registers at power-on."""
    biases = bytearray(0x14 * len(BIASES))
    for bias in BIASES.values():
        offset = bias.address - 0x13F3_0000
        biases[offset + 4 : offset + 12] = _signed(bias.least) + _signed(bias.most)
    rate = bytearray(0x40)
    rate[4:8] = PERIOD_US.to_bytes(4, "big")
    acquisition = bytearray(0x40)
    for register, value in ((Evs.PAYLOAD_SIZE, payload_octets), (Evs.WIDTH, size[0]), (Evs.HEIGHT, size[1])):
        acquisition[register - Evs.MODE : register - Evs.MODE + 4] = value.to_bytes(4, "big")
    return {
        TEMPERATURE: _signed(16 * _CELSIUS),
        Evs.MODE: bytes(acquisition),
        0x13F3_0000: bytes(biases),
        Erc.ON: bytes(rate),
        ROWS.on: bytes(0x100),
    }


def evs_rules(size: tuple[int, int]) -> dict[int, Rule]:
    """Return the rules of those of these registers that only store a value."""
    rules = {bias.address: between(bias.least, bias.most) for bias in BIASES.values()}
    rules |= {Evs.MODE: between(0, 0), Evs.EVENT_FORMAT: between(0, 0), INVERTED: between(0, 1)}
    rules |= {Erc.ON: between(0, 1), Erc.PERIOD_US: between(1, 1 << 20), Erc.EVENTS: between(0, (1 << 31) - 1)}
    rules |= {
        Erc.DROP_MODE: between(0, 4),
        Evs.EVENT_SELECTOR: between(0, 0),
        Evs.EVENT_NOTIFICATION: between(0, NOTIFY_WITH_DATA),
    }
    for registers, pixels in ((ROWS, size[1]), (COLUMNS, size[0])):
        rules |= {
            registers.on: between(0, 1),
            registers.selector: between(0, MOST_RANGES - 1),
            registers.size: between(0, pixels),
            registers.offset: between(0, pixels),
            registers.count: between(0, MOST_RANGES),
        }
    return rules


def _signed(value: int) -> bytes:
    return value.to_bytes(4, "big", signed=True)
