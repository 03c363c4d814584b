"""The GenICam description of the camera: features by name and their registers, as zipped XML in the device's memory.

    feature (Integer, Boolean, Command, Enumeration) --pValue--> register (IntReg, MaskedIntReg) --pPort--> Device
    text (StringReg) ------------------------------------------------------------------------------> Device

Source: GenICam's GenApi schema 1.1, as Aravis and viva-genicam read it.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from firmware_protocol.gige.gvsp import LEAST_PACKET, MOST_PACKET
from firmware_protocol.gige.registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    BIASES,
    NOTIFY_WITH_DATA,
    TEMPERATURE,
    Erc,
    Evs,
    Register,
)

__all__ = ["Description", "Feature", "features"]


Kind = Literal["integer", "boolean", "command", "enumeration", "text"]


@dataclass(frozen=True)
class Feature:
    """A feature backed by one register, or by a text in several.

    Attributes
    ----------
    bits
        (first, last) bit of the register that it uses, bit 0 the lowest; None: all of them.
    limits
        (least, most) value; a negative least means a signed register.
    entries
        Values of an enumeration by name.
    room
        Octets of a text, or of a register.
    order
        Value that a host writes to execute a command.
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
    "diff": "Reference level of the comparators; do not change it",
    "refr": "Refractory period: higher means shorter",
    "fo": "Low-pass cut-off: higher means faster",
    "hpf": "High-pass cut-off: higher means that slow changes are suppressed",
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
        Feature("TimestampLatch", "DeviceControl", "command", Register.TIME_CONTROL, "Latches the time", order=2),
        Feature("TimestampLatchValue", "DeviceControl", "integer", Register.TIME_HIGH, "Latched time", False, room=8),
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
    states = {"Off": 0, "On": 1, "OnWithData": NOTIFY_WITH_DATA}
    return [
        Feature(
            "EventSelector", group, "enumeration", Evs.EVENT_SELECTOR, "Selected event",
            entries={"Line0AnyEdge": 0},
        ),
        Feature("EventNotification", group, "enumeration", Evs.EVENT_NOTIFICATION, "Notification", entries=states),
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
            "GevSCPSDoNotFragment", group, "boolean", Register.PACKET_SIZE, "Packets are not fragmented", bits=(30, 30),
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


_ADDRESS = 0x8000_0000
_NAME = "evstim_TRT009S-E"
_NAMESPACE = "http://www.genicam.org/GenApi/Version_1_1"
_MADE = (2026, 1, 1, 0, 0, 0)
_ROOT = {
    "ModelName": "TRT009S-E", "VendorName": "Lucid", "ToolTip": "An emulated event camera", "StandardNameSpace": "GEV",
    "SchemaMajorVersion": "1", "SchemaMinorVersion": "1", "SchemaSubMinorVersion": "0",
    "MajorVersion": "1", "MinorVersion": "0", "SubMinorVersion": "0",
    "ProductGuid": "5f3d7a10-636e-4d11-8a52-0f3e1c0faf01", "VersionGuid": "5f3d7a10-636e-4d11-8a52-0f3e1c0faf02",
    "xmlns": _NAMESPACE,
}  # fmt: skip


class Description:
    """The description of a camera whose sensor has `size` = (width, height) pixels.

    Attributes
    ----------
    xml
        Its text.
    octets
        The zipped file as it is stored at `address`, padded to a multiple of four.
    location
        Text of the registers XML_1 and XML_2.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.xml = _xml(features(size))
        zipped = _zipped(self.xml)
        self.address = _ADDRESS
        self.octets = zipped.ljust(-(-len(zipped) // 4) * 4, b"\0")
        self.location = f"Local:{_NAME}.zip;{_ADDRESS:x};{len(zipped):x}"


def _zipped(xml: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(f"{_NAME}.xml", _MADE), xml, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def _xml(all_features: list[Feature]) -> bytes:
    root = Element("RegisterDescription", _ROOT)
    names = [feature.name for feature in all_features]
    by_category: dict[str, list[str]] = {}
    for feature in all_features:
        by_category.setdefault(feature.category, []).append(feature.name)
    by_category["DeviceControl"].append("DeviceTemperature")
    by_category["TransportLayerControl"].append("TLParamsLocked")
    _category(root, "Root", list(by_category))
    for category, members in by_category.items():
        _category(root, category, members)
    for feature in all_features:
        _feature(root, feature)
    assert len(set(names)) == len(names)
    _temperature(root)
    locked = _node(root, "Integer", "TLParamsLocked", Value="0", Min="0", Max="1")
    locked.set("NameSpace", "Standard")
    _node(root, "Port", "Device")
    return b'<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root)


def _category(root: Element, name: str, members: list[str]) -> None:
    category = SubElement(root, "Category", Name=name, NameSpace="Standard")
    for member in members:
        SubElement(category, "pFeature").text = member


def _feature(root: Element, feature: Feature) -> None:
    if feature.kind == "text":
        _text(root, feature)
        return
    register = f"{feature.name}Register"
    node = SubElement(root, feature.kind.capitalize(), Name=feature.name)
    SubElement(node, "ToolTip").text = feature.tip
    if feature.kind == "enumeration":
        for name, value in feature.entries.items():
            entry = SubElement(node, "EnumEntry", Name=name)
            SubElement(entry, "Value").text = str(value)
    SubElement(node, "pValue").text = register
    if feature.kind == "command":
        SubElement(node, "CommandValue").text = str(feature.order)
    if feature.kind == "boolean":
        SubElement(node, "OnValue").text, SubElement(node, "OffValue").text = "1", "0"
    if feature.kind == "integer" and feature.limits is not None:
        SubElement(node, "Min").text, SubElement(node, "Max").text = map(str, feature.limits)
        SubElement(node, "Inc").text = str(feature.step)
    _register(root, register, feature)


def _register(root: Element, name: str, feature: Feature) -> None:
    node = SubElement(root, "IntReg" if feature.bits is None else "MaskedIntReg", Name=name)
    access = "WO" if feature.kind == "command" and feature.bits is None else "RW" if feature.writable else "RO"
    _place(node, feature.address, feature.room, access)
    if feature.bits is not None:  # a big-endian register counts its bits from the highest
        SubElement(node, "LSB").text, SubElement(node, "MSB").text = (str(31 - bit) for bit in feature.bits)
    signed = feature.limits is not None and feature.limits[0] < 0
    SubElement(node, "Sign").text = "Signed" if signed else "Unsigned"
    SubElement(node, "Endianess").text = "BigEndian"


def _text(root: Element, feature: Feature) -> None:
    node = SubElement(root, "StringReg", Name=feature.name)
    SubElement(node, "ToolTip").text = feature.tip
    _place(node, feature.address, feature.room, "RW" if feature.writable else "RO")


def _place(node: Element, address: int, length: int, access: str) -> None:
    SubElement(node, "Address").text = f"0x{address:08x}"
    SubElement(node, "Length").text = str(length)
    SubElement(node, "AccessMode").text = access
    SubElement(node, "pPort").text = "Device"
    SubElement(node, "Cachable").text = "NoCache"


def _temperature(root: Element) -> None:
    """Describe the temperature: sixteenths of a degree in the register, degrees for the host."""
    node = _node(root, "Converter", "DeviceTemperature", FormulaTo="FROM * 16", FormulaFrom="TO / 16.0")
    SubElement(node, "pValue").text = "DeviceTemperatureRegister"
    feature = Feature("", "", "integer", TEMPERATURE, "", False, limits=(-4096, 4095))
    _register(root, "DeviceTemperatureRegister", feature)


def _node(root: Element, kind: str, name: str, **children: str) -> Element:
    node = SubElement(root, kind, Name=name)
    for tag, text in children.items():
        SubElement(node, tag).text = text
    return node
