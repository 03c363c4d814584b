"""The camera's features by name, as a GenICam host sees them, and the registers behind them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from firmware_protocol.gige.bootstrap import Register
from firmware_protocol.gige.evs_registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    BIASES,
    TOLD_WITH_DATA,
    Erc,
    Evs,
)
from firmware_protocol.gige.gvsp import LEAST_PACKET, MOST_PACKET

__all__ = ["Feature", "features"]

Kind = Literal["integer", "boolean", "command", "enumeration", "text"]


@dataclass(frozen=True)
class Feature:
    """A feature that stands for one register, or for a text in several.

    Attributes
    ----------
    bits
        (first, last) bit of the register that it takes, bit 0 the lowest; None: all of them.
    limits
        (least, most) value; a negative least means a signed register.
    entries
        Values of an enumeration by name.
    room
        Octets of a text, or of a register.
    order
        What is written to carry out a command.
    """

    name: str
    category: str
    kind: Kind
    address: int
    tip: str
    writable: bool = True
    bits: tuple[int, int] | None = None
    limits: tuple[int, int] | None = None
    step: int = 1
    entries: Mapping[str, int] = field(default_factory=dict)
    room: int = 4
    order: int = 1


_ON_OFF = (0, 1)
_BIAS_TIPS = {
    "diff_on": "Threshold of ON events: higher means fewer",
    "diff_off": "Threshold of OFF events: higher means fewer",
    "diff": "Reference level of the comparators; leave it",
    "refr": "Refractory period: higher means shorter",
    "fo": "Low-pass cut-off: higher means faster",
    "hpf": "High-pass cut-off: higher means that slow changes are left out",
}


def features(size: tuple[int, int]) -> list[Feature]:
    """Return all features of a camera whose sensor has `size` = (width, height) pixels."""
    return [*_identity(), *_picture(size), *_acquisition(), *_biases(), *_rate_control(), *_messages(), *_transport()]


def _identity() -> list[Feature]:
    texts = (
        ("DeviceVendorName", Register.MANUFACTURER, 32, False),
        ("DeviceModelName", Register.MODEL, 32, False),
        ("DeviceVersion", Register.DEVICE_VERSION, 32, False),
        ("DeviceManufacturerInfo", Register.MANUFACTURER_INFO, 48, False),
        ("DeviceSerialNumber", Register.SERIAL, 16, False),
        ("DeviceUserID", Register.USER_NAME, 16, True),
    )
    return [
        Feature(name, "DeviceControl", "text", address, "Identity", writable, room=room)
        for name, address, room, writable in texts
    ]


def _picture(size: tuple[int, int]) -> list[Feature]:
    return [
        Feature("Width", "ImageFormatControl", "integer", Evs.WIDTH, "Columns", False, limits=(0, size[0])),
        Feature("Height", "ImageFormatControl", "integer", Evs.HEIGHT, "Rows", False, limits=(0, size[1])),
        Feature(
            "EventFormat", "ImageFormatControl", "enumeration", Evs.EVENT_FORMAT, "Encoding", entries={"EVT3_0": 0}
        ),
        Feature(
            "EventFormatSize", "ImageFormatControl", "enumeration", Evs.EVENT_FORMAT_SIZE, "Word", False,
            entries={"Bpe16": 0},
        ),
    ]  # fmt: skip


def _acquisition() -> list[Feature]:
    group = "AcquisitionControl"
    return [
        Feature("TimestampLatch", "DeviceControl", "command", Register.TIME_CONTROL, "Takes the time", order=2),
        Feature("TimestampLatchValue", "DeviceControl", "integer", Register.TIME_HIGH, "Time taken, ns", False, room=8),
        Feature("AcquisitionMode", group, "enumeration", Evs.MODE, "Mode", entries={"Continuous": 0}),
        Feature("AcquisitionStart", group, "command", ACQUISITION_START, "Starts the stream; time begins at zero"),
        Feature("AcquisitionStop", group, "command", ACQUISITION_STOP, "Stops the stream"),
    ]


def _biases() -> list[Feature]:
    return [
        Feature(one.feature, "EventControl", "integer", one.address, _BIAS_TIPS[name], limits=(one.least, one.most))
        for name, one in BIASES.items()
    ]


def _rate_control() -> list[Feature]:
    group = "EventControl"
    return [
        Feature("ErcEnable", group, "boolean", Erc.ON, "Limits the rate of events", limits=_ON_OFF),
        Feature("ErcReferencePeriod", group, "integer", Erc.PERIOD_US, "Period, us", limits=(1, 1 << 20)),
        Feature("ErcEventsPerPeriod", group, "integer", Erc.EVENTS, "Events a period", limits=(0, (1 << 31) - 1)),
    ]


def _messages() -> list[Feature]:
    group = "EventControl"
    states = {"Off": 0, "On": 1, "OnWithData": TOLD_WITH_DATA}
    return [
        Feature(
            "EventSelector", group, "enumeration", Evs.EVENT_SELECTOR, "Event that is meant",
            entries={"Line0AnyEdge": 0},
        ),
        Feature("EventNotification", group, "enumeration", Evs.EVENT_NOTIFICATION, "Is told", entries=states),
    ]  # fmt: skip


def _transport() -> list[Feature]:
    group = "TransportLayerControl"
    return [
        Feature("PayloadSize", group, "integer", Evs.PAYLOAD_SIZE, "Most octets of a block", False),
        Feature(
            "GevSCPSPacketSize", group, "integer", Register.PACKET_SIZE, "Octets of a packet with its headers",
            bits=(0, 15), limits=(LEAST_PACKET, MOST_PACKET), step=2,
        ),
        Feature(
            "GevSCPSDoNotFragment", group, "boolean", Register.PACKET_SIZE, "Packets are not cut", bits=(30, 30),
            limits=_ON_OFF,
        ),
        Feature(
            "GevSCPSFireTestPacket", group, "command", Register.PACKET_SIZE, "Sends a test packet", bits=(31, 31),
        ),
        Feature("GevSCPD", group, "integer", Register.PACKET_DELAY, "Pause between packets, ns", limits=(0, 1 << 30)),
        Feature("GevSCDA", group, "integer", Register.STREAM_ADDRESS, "Address of the receiver"),
        Feature("GevSCPHostPort", group, "integer", Register.STREAM_PORT, "Port of the receiver", limits=(0, 0xFFFF)),
        Feature("GevHeartbeatTimeout", group, "integer", Register.HEARTBEAT_MS, "Heartbeat, ms"),
        Feature("GevCCP", group, "integer", Register.PRIVILEGE, "Control"),
    ]  # fmt: skip
