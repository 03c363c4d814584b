"""Settings of a Triton2 EVS, its memory, and its registers beyond those of every GigE Vision device.

Registers by address:

    1010 0030               temperature, signed, 1/16 degree C
    1030 0000 - 1030 0020   acquisition and image: mode, start, stop, payload size, width, height, event format
    1030 0024, 1030 0028    messages: selected event, notification: 0 off, 1 without data, 2 with data
    13F3 0000 + 14 k        bias k: value, least, most (signed offsets from the factory's value)
    13F6 0000               rate control: on, 0004 period, us, 0018 events a period, 002C events that are dropped
    1040 1004 - 1040 1038   rows:    on, selector, size, offset, number of ranges
    1040 1050 - 1040 1084   columns: the same
    1040 108C               inverted: masks only where a row range and a column range cross
    1050 0000 - 1050 0038   Precision Time Protocol, if the camera has it: latch, state, servo, then of 64 bits each
                            offset, delay, identities of the clock, its master, the grandmaster

Source: registers that neuromorphic_drivers writes and reads. Of the acquisition registers only start and stop are
known; the others have addresses chosen here, which a GenICam host reads from the description. Bounds of the biases are
those recommended for the IMX636.

The memory of the camera has the features that hosts find in it, power-on values, and rules for writes:

    features() --> Description --> zipped XML, an area of the memory
    triton2_areas()                power-on values of all registers
    triton2_rules()                value written --> value stored, or Refused

The module imports neither numpy nor the event code; see `triton2_control`.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

from firmware_protocol.gige.description import (
    TRANSPORT,
    Description,
    Feature,
    Model,
    identity_features,
    stream_features,
    time_features,
)
from firmware_protocol.gige.gvsp import BLOCK_OCTETS
from firmware_protocol.gige.registers import (
    DeviceIdentity,
    Register,
    Rule,
    between,
    no_value,
    standard_areas,
    standard_rules,
)
from firmware_protocol.prophesee.biases import BiasModel


@dataclass(frozen=True)
class Triton2Settings:
    """Identity and buffers of a camera.

    Attributes
    ----------
    size : (width, height) of the sensor, pixels.
    address : the camera's own IPv4 address, which is in its answer to a discovery.
    serial, user_name : at most 15 ASCII characters.
    start_delay_us
        Silence after AcquisitionStart: a host with the stock socket buffer begins to read some 0.1 s later.
    block_us : age at which a block is closed, unless it is full before.
    reserved_words : True if blocks have the reserved words of the real camera; see `triton2.with_reserved_words`.
    capacity : most events that wait; further ones are dropped and counted.
    biases : effect of the biases on the sensor.
    ptp : True if the camera can follow a master of the Precision Time Protocol; a host switches that on.
    ptp_domain : domain of that protocol.
    pulse_us : length of a pulse at the trigger input.
    """

    size: tuple[int, int] = (1280, 720)
    address: str = "127.0.0.1"
    serial: str = "00000636"
    user_name: str = ""
    start_delay_us: int = 300_000
    block_us: int = 1000
    reserved_words: bool = True
    capacity: int = 1 << 20
    biases: BiasModel = field(default_factory=BiasModel)
    ptp: bool = False
    ptp_domain: int = 0
    pulse_us: int = 100

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


class Ptp(IntEnum):
    """Precision Time Protocol: what LATCH stores of it."""

    LATCH = 0x1050_0000
    STATE = 0x1050_0004
    SERVO = 0x1050_0008
    OFFSET = 0x1050_0010
    DELAY = 0x1050_0018
    CLOCK = 0x1050_0020
    PARENT = 0x1050_0028
    GRANDMASTER = 0x1050_0030


_PTP_OCTETS = 0x38


@dataclass(frozen=True)
class Bias:
    """A bias: its register, its feature's name, and the bounds of its offset."""

    address: int
    feature: str
    least: int
    greatest: int


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


_CELSIUS = 35
_MODEL = Model("TRT009S-E", "Lucid", "5f3d7a10-636e-4d11-8a52-0f3e1c0faf01", "5f3d7a10-636e-4d11-8a52-0f3e1c0faf02")
_BIAS_TIPS = {
    "diff_on": "Threshold of ON events: higher means fewer",
    "diff_off": "Threshold of OFF events: higher means fewer",
    "diff": "Reference level of the comparators; do not change it",
    "refr": "Refractory period: higher means shorter",
    "fo": "Low-pass cut-off: higher means faster",
    "hpf": "High-pass cut-off: higher means that slow changes are suppressed",
}


def features(size: tuple[int, int], *, has_ptp: bool = False) -> list[Feature]:
    """Return all features of a camera whose sensor has `size` = (width, height) pixels."""
    image, control = "ImageFormatControl", "EventControl"
    acquisition, begins = "AcquisitionControl", "Starts the stream; time begins at zero"
    states = {"Off": 0, "On": 1, "OnWithData": NOTIFY_WITH_DATA}
    biases = [
        Feature(bias.feature, control, "integer", bias.address, _BIAS_TIPS[name], limits=(bias.least, bias.greatest))
        for name, bias in BIASES.items()
    ]
    return [
        *identity_features(),
        Feature("Width", image, "integer", Evs.WIDTH, "Columns", False, limits=(0, size[0])),
        Feature("Height", image, "integer", Evs.HEIGHT, "Rows", False, limits=(0, size[1])),
        Feature("EventFormat", image, "enumeration", Evs.EVENT_FORMAT, "Encoding", entries={"EVT3_0": 0}),
        Feature("EventFormatSize", image, "enumeration", Evs.EVENT_FORMAT_SIZE, "Word", False, entries={"Bpe16": 0}),
        *time_features(),
        Feature("AcquisitionMode", acquisition, "enumeration", Evs.MODE, "Mode", entries={"Continuous": 0}),
        Feature("AcquisitionStart", acquisition, "command", ACQUISITION_START, begins),
        Feature("AcquisitionStop", acquisition, "command", ACQUISITION_STOP, "Stops the stream"),
        *biases,
        Feature("ErcEnable", control, "boolean", Erc.ON, "Limits the rate of events", limits=(0, 1)),
        Feature("ErcReferencePeriod", control, "integer", Erc.PERIOD_US, "Period, us", limits=(1, 1 << 20)),
        Feature("ErcEventsPerPeriod", control, "integer", Erc.EVENTS, "Events a period", limits=(0, (1 << 31) - 1)),
        Feature(
            "EventSelector", control, "enumeration", Evs.EVENT_SELECTOR, "Selected event",
            entries={"Line0AnyEdge": 0},
        ),
        Feature("EventNotification", control, "enumeration", Evs.EVENT_NOTIFICATION, "Notification", entries=states),
        Feature("PayloadSize", TRANSPORT, "integer", Evs.PAYLOAD_SIZE, "Most octets of a block", False),
        *stream_features(),
        Feature(
            "DeviceTemperature", "DeviceControl", "integer", TEMPERATURE, "", False, limits=(-4096, 4095), per_unit=16
        ),
        *(_ptp() if has_ptp else ()),
    ]  # fmt: skip


def _ptp() -> list[Feature]:
    """Return the features of the Precision Time Protocol, by the names of GenICam's convention (SFNC 2.7)."""
    group, signed = "PtpControl", (-(1 << 63), (1 << 63) - 1)
    states = {"Initializing": 1, "Faulty": 2, "Disabled": 3, "Listening": 4, "Uncalibrated": 8, "Slave": 9}
    return [
        Feature(
            "PtpEnable", group, "boolean", Register.GVCP_CONFIGURATION, "Follows a master's time", bits=(19, 19),
            limits=(0, 1),
        ),
        Feature("PtpSlaveOnly", group, "boolean", Ptp.SERVO, "Always", False, bits=(1, 1), limits=(0, 1)),
        Feature("PtpDataSetLatch", group, "command", Ptp.LATCH, "Latches the values below"),
        Feature("PtpStatus", group, "enumeration", Ptp.STATE, "Latched state", False, entries=states),
        Feature(
            "PtpServoStatus", group, "enumeration", Ptp.SERVO, "Latched state of the servo", False, bits=(0, 0),
            entries={"Unknown": 0, "Locked": 1},
        ),
        Feature(
            "PtpOffsetFromMaster", group, "integer", Ptp.OFFSET, "Latched offset, ns", False, room=8, limits=signed
        ),
        Feature(
            "PtpMeanPropagationDelay", group, "integer", Ptp.DELAY, "Latched delay, ns", False, room=8, limits=signed
        ),
        Feature("PtpClockID", group, "integer", Ptp.CLOCK, "This clock", False, room=8),
        Feature("PtpParentClockID", group, "integer", Ptp.PARENT, "Latched master", False, room=8),
        Feature("PtpGrandmasterClockID", group, "integer", Ptp.GRANDMASTER, "Latched grandmaster", False, room=8),
    ]  # fmt: skip


def triton2_areas(settings: Triton2Settings) -> dict[int, bytes]:
    """Return the areas of a camera's memory at power-on."""
    has_ptp = settings.ptp
    description = Description(_MODEL, features(settings.size, has_ptp=has_ptp))
    identity = DeviceIdentity(
        "Lucid Vision Labs", _MODEL.name, "1.46.0.0", settings.serial, settings.user_name, settings.address, 0x1C0FAF
    )
    areas = standard_areas(identity, description.location, has_ptp=has_ptp) | _evs_areas(settings.size)
    areas |= {Ptp.LATCH: bytes(_PTP_OCTETS)} if has_ptp else {}
    return areas | {description.address: description.octets}


def _evs_areas(size: tuple[int, int]) -> dict[int, bytes]:
    """Return the areas of the registers beyond those of every device."""
    biases = bytearray(0x14 * len(BIASES))
    for bias in BIASES.values():
        offset = bias.address - 0x13F3_0000
        biases[offset + 4 : offset + 12] = _signed(bias.least) + _signed(bias.greatest)
    rate = bytearray(0x40)
    rate[4:8] = PERIOD_US.to_bytes(4, "big")
    acquisition = bytearray(0x40)
    for register, value in ((Evs.PAYLOAD_SIZE, BLOCK_OCTETS), (Evs.WIDTH, size[0]), (Evs.HEIGHT, size[1])):
        acquisition[register - Evs.MODE : register - Evs.MODE + 4] = value.to_bytes(4, "big")
    return {
        TEMPERATURE: _signed(16 * _CELSIUS),
        Evs.MODE: bytes(acquisition),
        0x13F3_0000: bytes(biases),
        Erc.ON: bytes(rate),
        ROWS.on: bytes(0x100),
    }


def _signed(value: int) -> bytes:
    return value.to_bytes(4, "big", signed=True)


def triton2_rules(settings: Triton2Settings) -> dict[int, Rule]:
    """Return the rules of all registers that a host may write, by address."""
    rules = standard_rules() | evs_rules(settings.size)
    rules |= {Ptp.LATCH: no_value} if settings.ptp else {}
    return rules | dict.fromkeys((ACQUISITION_START, ACQUISITION_STOP), no_value)


def evs_rules(size: tuple[int, int]) -> dict[int, Rule]:
    """Return the rules of the registers beyond those of every device, except start and stop."""
    rules = {bias.address: between(bias.least, bias.greatest) for bias in BIASES.values()}
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
