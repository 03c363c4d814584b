"""The GenICam description of the camera: XML, zipped, in the device's own memory.

    feature (Integer, Boolean, Command, Enumeration) --pValue--> register (IntReg, MaskedIntReg) --pPort--> Device
    text (StringReg) ------------------------------------------------------------------------------> Device

Source: GenICam's GenApi schema 1.1, as Aravis and viva-genicam read it.
"""

from __future__ import annotations

import io
import zipfile
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from firmware_protocol.gige.evs_registers import TEMPERATURE
from firmware_protocol.gige.features import Feature, features

__all__ = ["Description"]

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
        The zipped file as it lies in memory at `address`, padded to a multiple of four.
    location
        What registers XML_1 and XML_2 say.
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
