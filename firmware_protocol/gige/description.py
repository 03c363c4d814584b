"""The GenICam description of a camera: features by name and their registers, as zipped XML in the device's memory.

    feature (Integer, Boolean, Command, Enumeration) --pValue--> register (IntReg, MaskedIntReg) --pPort--> Device
    text (StringReg) ------------------------------------------------------------------------------> Device

Source: GenICam's GenApi schema 1.1, as Aravis and viva-genicam read it.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from firmware_protocol.gige.gvsp import LEAST_PACKET, MOST_PACKET
from firmware_protocol.gige.registers import Register

Kind = Literal["integer", "boolean", "command", "enumeration", "text"]


@dataclass(frozen=True)
class Feature:
    """A feature backed by one register, or by a text in several.

    Attributes
    ----------
    bits : (first, last) bit of the register that it uses, bit 0 the lowest; None: all of them.
    limits : (least, most) value; a negative least means a signed register.
    entries : values of an enumeration by name.
    room : octets of a text, or of a register.
    order : value that a host writes to execute a command.
    per_unit : steps of the register in one unit of the feature, which then is a converter.
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
    per_unit: int = 1


TRANSPORT = "TransportLayerControl"
_ON_OFF = (0, 1)


def identity_features() -> list[Feature]:
    """Return the features of the texts in the answer to a discovery."""
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


def time_features() -> list[Feature]:
    """Return the features that read the device's clock."""
    return [
        Feature("TimestampLatch", "DeviceControl", "command", Register.TIME_CONTROL, "Latches the time", order=2),
        Feature("TimestampLatchValue", "DeviceControl", "integer", Register.TIME_HIGH, "Latched time", False, room=8),
    ]


def stream_features() -> list[Feature]:
    """Return the features of the stream channel and of control."""
    group = TRANSPORT
    return [
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
_MADE = (2026, 1, 1, 0, 0, 0)
_SCHEMA = {
    "StandardNameSpace": "GEV", "SchemaMajorVersion": "1", "SchemaMinorVersion": "1", "SchemaSubMinorVersion": "0",
    "MajorVersion": "1", "MinorVersion": "0", "SubMinorVersion": "0",
}  # fmt: skip
_NAMESPACE = "http://www.genicam.org/GenApi/Version_1_1"


@dataclass(frozen=True)
class Model:
    """Names and GUIDs of a camera model."""

    name: str
    vendor: str
    product_guid: str
    version_guid: str

    def attributes(self) -> dict[str, str]:
        """Return the attributes of the root of its description."""
        names = {"ModelName": self.name, "VendorName": self.vendor, "ToolTip": "An emulated event camera"}
        guids = {"ProductGuid": self.product_guid, "VersionGuid": self.version_guid}
        return {**names, **_SCHEMA, **guids, "xmlns": _NAMESPACE}


class Description:
    """The description of a camera.

    Attributes
    ----------
    xml : its text.
    octets : the zipped file as it is stored at `address`, padded to a multiple of four.
    location : text of the registers XML_1 and XML_2.
    """

    def __init__(self, model: Model, features: Sequence[Feature]) -> None:
        name = f"evstim_{model.name}"
        self.xml = _xml(model, features)
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr(zipfile.ZipInfo(f"{name}.xml", _MADE), self.xml, zipfile.ZIP_DEFLATED)
        zipped = file.getvalue()
        self.address = _ADDRESS
        self.octets = zipped.ljust(-(-len(zipped) // 4) * 4, b"\0")
        self.location = f"Local:{name}.zip;{_ADDRESS:x};{len(zipped):x}"


def _xml(model: Model, features: Sequence[Feature]) -> bytes:
    root = Element("RegisterDescription", model.attributes())
    by_category: dict[str, list[str]] = {}
    for feature in features:
        by_category.setdefault(feature.category, []).append(feature.name)
    by_category.setdefault(TRANSPORT, []).append("TLParamsLocked")
    assert len({feature.name for feature in features}) == len(features)
    _category(root, "Root", list(by_category))
    for category, members in by_category.items():
        _category(root, category, members)
    for feature in features:
        _feature(root, feature)
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
    if feature.per_unit != 1:
        _converter(root, feature)
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


def _converter(root: Element, feature: Feature) -> None:
    """Describe a register in steps, and its value in units for the host."""
    steps = feature.per_unit
    node = _node(root, "Converter", feature.name, FormulaTo=f"FROM * {steps}", FormulaFrom=f"TO / {steps:.1f}")
    SubElement(node, "pValue").text = f"{feature.name}Register"
    _register(root, f"{feature.name}Register", feature)


def _node(root: Element, kind: str, name: str, **children: str) -> Element:
    node = SubElement(root, kind, Name=name)
    for tag, text in children.items():
        SubElement(node, tag).text = text
    return node
