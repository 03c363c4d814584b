"""The registers that every GigE Vision device has, by address.

    0x0000 version, mode, MAC, address, names       248 octets, which are also the answer to a discovery
    0x0200, 0x0400   where the XML description is   text, 512 octets each
    0x0600 interfaces, 0x0670 link speed
    0x0900 capabilities, heartbeat, time
    0x0A00 control privilege
    0x0B00 message channel
    0x0D00 stream channel
    0x9800 action groups

Source: GigE Vision 2.0 as implemented in the open by Aravis; names of the camera from published captures.
"""

from __future__ import annotations

import ipaddress
import zlib
from enum import IntEnum, IntFlag

from firmware_protocol.gige.settings import GigeSettings

__all__ = ["DISCOVERY_OCTETS", "TICK_HZ", "Capability", "Privilege", "Register", "bootstrap"]

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
    """What the device can do beyond the least, as register CAPABILITY tells."""

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
    """Register PRIVILEGE: who controls the device."""

    EXCLUSIVE = 1 << 0
    CONTROL = 1 << 1


def bootstrap(settings: GigeSettings, xml_location: str) -> bytes:
    """Return the registers from address 0 on, as they are at power-on."""
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
