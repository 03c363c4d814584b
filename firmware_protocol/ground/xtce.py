"""The packets as XTCE 1.2 (CCSDS 660.0-B-2, OMG 20180204), which Yamcs and many archives read.

    CCSDSPacket (abstract)       the primary header
      Telemetry (abstract)       the secondary header of telemetry
        HOUSEKEEPING, ...        selected by APID, service and subtype
    MetaCommands                 one for each telecommand; the ground system fills in count, length and checksum

Parameters of a packet have its name as a prefix. A part of varying length takes its size from the packet's length.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as Xml

from firmware_protocol.ground.description import Packet, Tail
from firmware_protocol.packets.ccsds import ERROR_CONTROL, PRIMARY_HEADER, TM_HEADER
from firmware_protocol.wire_layout import Field, Layout

NAMESPACE = "http://www.omg.org/spec/XTCE/20180204"
_SCHEMA = "https://www.omg.org/spec/XTCE/20180204/SpaceSystem.xsd"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_USUAL_NAMES = {
    "version": "VERSION",
    "type": "TYPE",
    "secondary_header": "SEC_HDR_FLG",
    "apid": "PKT_APID",
    "sequence_flags": "SEQ_FLGS",
    "sequence_count": "SRC_SEQ_CTR",
    "length": "PKT_LEN",
}
"""Names that readers of XTCE expect in the primary header."""


@dataclass(frozen=True)
class _Sets:
    """Sets of definitions of parameters or arguments; `word` is their name in XTCE."""

    word: str
    types: Xml.Element
    names: Xml.Element

    def number(self, name: str, field: Field) -> None:
        """Define a number."""
        self._define(name, field.meaning, _number_type(self.types, f"{name}_type", field, self.word))

    def tail(self, name: str, tail: Tail, before: int) -> None:
        """Define the part of varying length that begins at octet `before`."""
        self._define(name, tail.meaning, _tail_type(self.types, f"{name}_type", tail, before))

    def _define(self, name: str, meaning: str, type_name: str) -> None:
        ref = {f"{self.word.lower()}TypeRef": type_name}
        Xml.SubElement(self.names, self.word, name=name, shortDescription=meaning, attrib=ref)


def xtce_text(packets: Sequence[Packet]) -> str:
    """Return the XML document."""
    attributes = {"xmlns": NAMESPACE, "xmlns:xsi": _XSI, "xsi:schemaLocation": f"{NAMESPACE} {_SCHEMA}"}
    root = Xml.Element("SpaceSystem", name="evstim", attrib=attributes)
    _telemetry(Xml.SubElement(root, "TelemetryMetaData"), [packet for packet in packets if not packet.is_command])
    _commands(Xml.SubElement(root, "CommandMetaData"), [packet for packet in packets if packet.is_command])
    Xml.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(root, encoding="unicode") + "\n"


def _telemetry(parent: Xml.Element, packets: Iterable[Packet]) -> None:
    types, names = Xml.SubElement(parent, "ParameterTypeSet"), Xml.SubElement(parent, "ParameterSet")
    sets, containers = _Sets("Parameter", types, names), Xml.SubElement(parent, "ContainerSet")
    _container(containers, sets, "CCSDSPacket", PRIMARY_HEADER)
    entries = _container(containers, sets, "Telemetry", TM_HEADER)
    _extend(entries, "CCSDSPacket", {"TYPE": "TELEMETRY", "SEC_HDR_FLG": "1"})
    for field in ERROR_CONTROL.fields:
        sets.number(field.name, field)
    for packet in packets:
        _packet(containers, sets, packet)


def _container(parent: Xml.Element, sets: _Sets, name: str, layout: Layout) -> Xml.Element:
    """Define an abstract container of header fields; return it."""
    container = Xml.SubElement(parent, "SequenceContainer", name=name, abstract="true")
    entries = Xml.SubElement(container, "EntryList")
    for field in layout.fields:
        called = _USUAL_NAMES.get(field.name, field.name)
        sets.number(called, field)
        Xml.SubElement(entries, "ParameterRefEntry", parameterRef=called)
    return container


def _packet(parent: Xml.Element, sets: _Sets, packet: Packet) -> None:
    container = Xml.SubElement(parent, "SequenceContainer", name=packet.name, shortDescription=packet.meaning)
    names = [f"{packet.name}_{field.name}" for field in packet.body.fields]
    for name, field in zip(names, packet.body.fields, strict=True):
        sets.number(name, field)
    if packet.tail is not None:
        names.append(f"{packet.name}_{packet.tail.name}")
        sets.tail(names[-1], packet.tail, packet.before_tail)
    entries = Xml.SubElement(container, "EntryList")
    for name in (*names, *(field.name for field in ERROR_CONTROL.fields)):
        Xml.SubElement(entries, "ParameterRefEntry", parameterRef=name)
    identifying = {"PKT_APID": packet.apid, "service": packet.service, "subtype": packet.subtype}
    _extend(container, "Telemetry", {name: str(value) for name, value in identifying.items()})


def _extend(container: Xml.Element, base: str, values: dict[str, str]) -> None:
    criteria = Xml.SubElement(Xml.SubElement(container, "BaseContainer", containerRef=base), "RestrictionCriteria")
    comparisons = Xml.SubElement(criteria, "ComparisonList")
    for name, value in values.items():
        Xml.SubElement(comparisons, "Comparison", parameterRef=name, value=value)


def _number_type(parent: Xml.Element, name: str, field: Field, word: str) -> str:
    """Define the type of a number; return its name."""
    kind = "Enumerated" if field.choices else "Integer" if field.scale == 1 else "Float"
    type_ = Xml.SubElement(parent, f"{kind}{word}Type", name=name)
    if kind == "Integer":
        type_.set("signed", str(field.signed).lower())
    units = Xml.SubElement(type_, "UnitSet")
    if field.unit:
        Xml.SubElement(units, "Unit").text = field.unit
    encoding = Xml.SubElement(type_, "IntegerDataEncoding", sizeInBits=str(field.bits))
    encoding.set("encoding", "twosComplement" if field.signed else "unsigned")
    if kind == "Float":
        type_.set("sizeInBits", "64")
        calibrator = Xml.SubElement(Xml.SubElement(encoding, "DefaultCalibrator"), "PolynomialCalibrator")
        Xml.SubElement(calibrator, "Term", coefficient="0", exponent="0")
        Xml.SubElement(calibrator, "Term", coefficient=repr(field.scale), exponent="1")
    for value, label in field.choices.items():
        choices = type_.find("EnumerationList")
        choices = Xml.SubElement(type_, "EnumerationList") if choices is None else choices
        Xml.SubElement(choices, "Enumeration", value=str(value), label=label)
    if kind == "Integer" and word == "Argument":
        low, high = field.range
        valid = Xml.SubElement(type_, "ValidRangeSet")
        Xml.SubElement(valid, "ValidRange", minInclusive=str(low), maxInclusive=str(high))
    return name


def _tail_type(parent: Xml.Element, name: str, tail: Tail, before: int) -> str:
    """Define the type of the part between octet `before` and the error control; return its name."""
    if tail.kind == "text":
        type_ = Xml.SubElement(parent, "StringParameterType", name=name)
        Xml.SubElement(type_, "UnitSet")
        encoding = Xml.SubElement(type_, "StringDataEncoding", encoding="US-ASCII")
        size = Xml.SubElement(encoding, "Variable", maxSizeInBits=str(8 * tail.longest))
    else:
        type_ = Xml.SubElement(parent, "BinaryParameterType", name=name)
        Xml.SubElement(type_, "UnitSet")
        size = Xml.SubElement(Xml.SubElement(type_, "BinaryDataEncoding"), "SizeInBits")
    dynamic = Xml.SubElement(size, "DynamicValue")
    Xml.SubElement(dynamic, "ParameterInstanceRef", parameterRef="PKT_LEN")
    fixed_octets = before - PRIMARY_HEADER.octets + ERROR_CONTROL.octets
    Xml.SubElement(dynamic, "LinearAdjustment", slope="8", intercept=str(8 * (1 - fixed_octets)))
    return name


def _commands(parent: Xml.Element, packets: Iterable[Packet]) -> None:
    types = Xml.SubElement(parent, "ArgumentTypeSet")
    commands = Xml.SubElement(parent, "MetaCommandSet")
    for packet in packets:
        command = Xml.SubElement(commands, "MetaCommand", name=packet.name, shortDescription=packet.meaning)
        free = [placed for placed in packet.arguments if placed.identifies is None]
        if free:
            sets = _Sets("Argument", types, Xml.SubElement(command, "ArgumentList"))
            for placed in free:
                sets.number(placed.field.name, placed.field)
                # All types are in one set: the name of a type begins with that of its packet.
                name = f"{packet.name}_{sets.types[-1].get('name')}"
                sets.types[-1].set("name", name)
                sets.names[-1].set("argumentTypeRef", name)
        container = Xml.SubElement(command, "CommandContainer", name=f"{packet.name}_packet")
        entries = Xml.SubElement(container, "EntryList")
        for placed in packet.fields:
            if placed in free:
                Xml.SubElement(entries, "ArgumentRefEntry", argumentRef=placed.field.name)
            else:
                _fixed(entries, placed.field, placed.preset)
        for field in ERROR_CONTROL.fields:
            _fixed(entries, field, 0)


def _fixed(entries: Xml.Element, field: Field, value: int) -> None:
    digits = (field.bits + 7) // 8 * 2
    attributes = {"binaryValue": f"{value:0{digits}x}", "sizeInBits": str(field.bits)}
    Xml.SubElement(entries, "FixedValueEntry", name=field.name, attrib=attributes)
