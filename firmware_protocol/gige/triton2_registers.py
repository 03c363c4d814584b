"""Power-on values of all registers of the Triton2 EVS, and the rules for writes to them."""

from __future__ import annotations

from firmware_protocol.gige.control import ACTION_GROUPS
from firmware_protocol.gige.description import Description
from firmware_protocol.gige.gvcp import Refused, Status
from firmware_protocol.gige.gvsp import BLOCK_OCTETS, LEAST_PACKET, MOST_PACKET
from firmware_protocol.gige.registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    GigeSettings,
    Register,
    Rule,
    between,
    bootstrap,
    evs_areas,
    evs_rules,
    unchanged,
)

__all__ = [
    "DO_NOT_FRAGMENT",
    "TEST_PACKET",
    "action_areas",
    "packet_size",
    "standard_rules",
    "triton2_areas",
    "triton2_rules",
]


TEST_PACKET = 1 << 31
DO_NOT_FRAGMENT = 1 << 30
_PERSISTENT_ADDRESSES = (0x064C, 0x065C, 0x066C)
_PLAIN = (
    Register.HEARTBEAT_MS, Register.GVCP_CONFIGURATION, Register.PENDING_MS, Register.GVSP_CONFIGURATION,
    Register.PACKET_DELAY, Register.STREAM_ADDRESS, Register.ACTION_DEVICE_KEY, *_PERSISTENT_ADDRESSES,
    Register.MESSAGE_ADDRESS,
)  # fmt: skip


def standard_rules() -> dict[int, Rule]:
    """Return the rules of the registers that every GigE Vision device has, by address."""
    rules: dict[int, Rule] = dict.fromkeys(_PLAIN, unchanged)
    rules |= {Register.USER_NAME + 4 * k: unchanged for k in range(4)}
    rules |= {Register.ACTION_GROUP + 16 * k + place: unchanged for k in range(ACTION_GROUPS) for place in (0, 4)}
    rules |= dict.fromkeys((Register.STREAM_PORT, Register.MESSAGE_PORT), between(0, 0xFFFF))
    rules |= {Register.MESSAGE_TIMEOUT: between(0, 60_000), Register.MESSAGE_RETRIES: between(0, 100)}
    return rules


def action_areas() -> dict[int, bytes]:
    """Return the area of the keys and masks of action groups."""
    return {Register.ACTION_GROUP: bytes(16 * ACTION_GROUPS)}


def packet_size(value: int) -> int:
    """Return the value that register PACKET_SIZE stores; raises Refused for a size that no packet has.

    Sizes must be even: neuromorphic_drivers loses the last octet of an odd payload, and then misreads all that follows.
    """
    size = value & 0xFFFF
    if not LEAST_PACKET <= size <= MOST_PACKET or size % 2:
        raise Refused(Status.INVALID_PARAMETER)
    return value & ~TEST_PACKET


def triton2_areas(settings: GigeSettings) -> dict[int, bytes]:
    """Return the areas of a camera's memory."""
    description = Description(settings.size)
    areas = {0: bootstrap(settings, description.location), description.address: description.octets}
    return areas | evs_areas(settings.size, BLOCK_OCTETS) | action_areas()


def triton2_rules(size: tuple[int, int]) -> dict[int, Rule]:
    """Return the rules; registers that give an order store zero."""
    rules = {**standard_rules(), **evs_rules(size), Register.PACKET_SIZE: packet_size}
    return rules | dict.fromkeys((ACQUISITION_START, ACQUISITION_STOP, Register.TIME_CONTROL), _nothing)


def _nothing(_: int) -> int:
    return 0
