"""The registers that every GigE Vision device has, and its memory.

Registers by address:

    0x0000 version, mode, MAC, address, names       248 octets, which are also the answer to a discovery
    0x0200, 0x0400   location of the XML description   text, 512 octets each
    0x0600 interfaces, 0x0670 link speed
    0x0900 capabilities, heartbeat, time, state of the Precision Time Protocol
    0x0A00 control privilege
    0x0B00 message channel
    0x0D00 stream channel
    0x9800 action groups

The memory of the device has areas of octets, which a host reads, and registers of four octets, which it writes:

    area       start --- octets ------- end       READREG, READMEM
    rule       at the address of a register       WRITEREG, WRITEMEM: value written -> value stored, or Refused

Source: GigE Vision 2.0 as implemented in the open by Aravis.
"""

from __future__ import annotations

import ipaddress
import zlib
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from firmware_protocol.gige.gvcp import Refused, Status
from firmware_protocol.gige.gvsp import LEAST_PACKET, MOST_PACKET

DISCOVERY_OCTETS = 0xF8
TICK_HZ = 1_000_000_000
ACTION_GROUPS = 1
TEST_PACKET = 1 << 31
PTP_ON = 1 << 19
"""Bit of register GVCP_CONFIGURATION."""
DO_NOT_FRAGMENT = 1 << 30
_VERSION = 2 << 16
_MODE_BIG_ENDIAN_UTF8 = 1 << 31 | 1
_FIXED_ADDRESS = 1
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
    PTP_STATE = 0x096C
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
    PTP = 1 << 19
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


@dataclass(frozen=True)
class DeviceIdentity:
    """Identity of a device, which is in its answer to a discovery.

    Attributes
    ----------
    manufacturer, model, version, serial, user_name, info : at most 31, 31, 31, 15, 15 and 47 ASCII characters.
    address : the device's own IPv4 address.
    mac_prefix : first three octets of its MAC, those of the manufacturer; the others follow from the serial.
    """

    manufacturer: str
    model: str
    version: str
    serial: str
    user_name: str
    address: str
    mac_prefix: int
    info: str = "evstim emulator"


def standard_areas(identity: DeviceIdentity, description: str, *, has_ptp: bool = False) -> dict[int, bytes]:
    """Return the areas of the registers at power-on; `description` is the location of the XML."""
    octets = bytearray(_LENGTH)
    for address, number in _numbers(identity, has_ptp).items():
        octets[address : address + 4] = number.to_bytes(4, "big")
    for address, (text, room) in _texts(identity, description).items():
        octets[address : address + room] = text.encode("ascii").ljust(room, b"\0")
    return {0: bytes(octets), Register.ACTION_GROUP: bytes(16 * ACTION_GROUPS)}


def _numbers(identity: DeviceIdentity, has_ptp: bool) -> dict[int, int]:
    all_capabilities = 0
    for capability in Capability:
        all_capabilities |= capability if has_ptp or capability != Capability.PTP else 0
    return {
        Register.VERSION: _VERSION,
        Register.DEVICE_MODE: _MODE_BIG_ENDIAN_UTF8,
        Register.MAC_HIGH: identity.mac_prefix >> 8,
        Register.MAC_LOW: (identity.mac_prefix & 0xFF) << 24 | zlib.crc32(identity.serial.encode()) & 0xFFFFFF,
        Register.IP_SUPPORTED: _FIXED_ADDRESS,
        Register.IP_CURRENT: _FIXED_ADDRESS,
        Register.ADDRESS: int(ipaddress.IPv4Address(identity.address)),
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


def _texts(identity: DeviceIdentity, description: str) -> dict[int, tuple[str, int]]:
    return {
        Register.MANUFACTURER: (identity.manufacturer, 32),
        Register.MODEL: (identity.model, 32),
        Register.DEVICE_VERSION: (identity.version, 32),
        Register.MANUFACTURER_INFO: (identity.info, 48),
        Register.SERIAL: (identity.serial, 16),
        Register.USER_NAME: (identity.user_name, 16),
        Register.XML_1: (description, 512),
        Register.XML_2: (description, 512),
    }


LONGEST_READ = 536
"""Octets of one READMEM: the answer fits into 576 octets, which every network carries."""

Rule = Callable[[int], int]
"""Rule for writes to a register: returns the value to store, or raises Refused."""


def unchanged(value: int) -> int:
    """Return the value as it was written: the rule of a register that only stores it."""
    return value


def no_value(value: int) -> int:
    """Return zero: the rule of a register that gives an order and stores nothing."""
    return 0


def between(least: int, greatest: int) -> Rule:
    """Return the rule of a register that refuses numbers outside these, signed if `least` is negative."""

    def rule(value: int) -> int:
        number = value - (1 << 32) if least < 0 and value >> 31 else value
        if not least <= number <= greatest:
            raise Refused(Status.INVALID_PARAMETER)
        return value

    return rule


def packet_size(value: int) -> int:
    """Return the value that register PACKET_SIZE stores; raises Refused for a size that no packet has.

    Sizes must be even: neuromorphic_drivers loses the last octet of an odd payload, and then misreads all that follows.
    """
    size = value & 0xFFFF
    if not LEAST_PACKET <= size <= MOST_PACKET or size % 2:
        raise Refused(Status.INVALID_PARAMETER)
    return value & ~TEST_PACKET


_PERSISTENT_ADDRESSES = (0x064C, 0x065C, 0x066C)
_PLAIN = (
    Register.HEARTBEAT_MS, Register.GVCP_CONFIGURATION, Register.PENDING_MS, Register.GVSP_CONFIGURATION,
    Register.PACKET_DELAY, Register.STREAM_ADDRESS, Register.ACTION_DEVICE_KEY, *_PERSISTENT_ADDRESSES,
    Register.MESSAGE_ADDRESS, *(Register.USER_NAME + 4 * k for k in range(4)),
    *(Register.ACTION_GROUP + 16 * k + place for k in range(ACTION_GROUPS) for place in (0, 4)),
)  # fmt: skip


def standard_rules() -> dict[int, Rule]:
    """Return the rules of the registers that a host may write, by address."""
    rules: dict[int, Rule] = dict.fromkeys(_PLAIN, unchanged)
    rules |= dict.fromkeys((Register.STREAM_PORT, Register.MESSAGE_PORT), between(0, 0xFFFF))
    rules |= {Register.MESSAGE_TIMEOUT: between(0, 60_000), Register.MESSAGE_RETRIES: between(0, 100)}
    return rules | {Register.PACKET_SIZE: packet_size, Register.TIME_CONTROL: no_value}


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
