"""Settings of a Triton2 EVS, and its registers beyond those of every GigE Vision device.

Registers by address:

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
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

from firmware_protocol.imx636.biases import BiasModel

__all__ = [
    "ACQUISITION_START",
    "ACQUISITION_STOP",
    "BIASES",
    "COLUMNS",
    "INVERTED",
    "MOST_RANGES",
    "NOTIFY_WITH_DATA",
    "PERIOD_US",
    "ROWS",
    "TEMPERATURE",
    "Bias",
    "Erc",
    "Evs",
    "RangeRegisters",
    "Triton2Settings",
]


@dataclass(frozen=True)
class Triton2Settings:
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


TEMPERATURE = 0x1010_0030
ACQUISITION_START = 0x1030_0004
ACQUISITION_STOP = 0x1030_0008
INVERTED = 0x1040_108C
PERIOD_US = 200
NOTIFY_WITH_DATA = 2
MOST_RANGES = 64


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
