"""The registers of the Triton2 EVS beyond those of every GigE Vision device, by address.

    1010 0030               temperature, signed, 1/16 degree C
    1030 0000 - 1030 0020   acquisition and picture: mode, start, stop, payload size, width, height, event format
    1030 0024, 1030 0028    messages: which event is meant, whether it is told: 1 without data, 2 with data
    13F3 0000 + 14 k        bias k: value, least, most (signed offsets from the factory's value)
    13F6 0000               rate control: on, 0004 period, us, 0018 events a period, 002C what is dropped
    1040 1004 - 1040 1038   rows:    on, selector, size, offset, number of ranges
    1040 1050 - 1040 1084   columns: the same
    1040 108C               inverted: masks only where a row range and a column range cross

Source: what neuromorphic_drivers writes and reads. Of the acquisition registers only start and stop are known; the
others have addresses of our own, which a GenICam host learns from the description. Bounds of the biases are those
recommended for the IMX636.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.gige.memory import Rule, between

__all__ = [
    "ACQUISITION_START", "ACQUISITION_STOP", "BIASES", "COLUMNS", "INVERTED", "MOST_RANGES", "PERIOD_US", "ROWS",
    "TEMPERATURE", "TOLD_WITH_DATA", "Bias", "Erc", "Evs", "RangeRegisters", "evs_areas", "evs_rules",
]  # fmt: skip

TEMPERATURE = 0x1010_0030
ACQUISITION_START = 0x1030_0004
ACQUISITION_STOP = 0x1030_0008
INVERTED = 0x1040_108C
PERIOD_US = 200
TOLD_WITH_DATA = 2
MOST_RANGES = 64
_CELSIUS = 35


class Evs(IntEnum):
    """Acquisition and picture."""

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
    """Return the areas of these registers as they are at power-on."""
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
    """Return what may be written to those of these registers that only remember."""
    rules = {bias.address: between(bias.least, bias.most) for bias in BIASES.values()}
    rules |= {Evs.MODE: between(0, 0), Evs.EVENT_FORMAT: between(0, 0), INVERTED: between(0, 1)}
    rules |= {Erc.ON: between(0, 1), Erc.PERIOD_US: between(1, 1 << 20), Erc.EVENTS: between(0, (1 << 31) - 1)}
    rules |= {
        Erc.DROP_MODE: between(0, 4),
        Evs.EVENT_SELECTOR: between(0, 0),
        Evs.EVENT_NOTIFICATION: between(0, TOLD_WITH_DATA),
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
