"""The packets as a dictionary of F Prime's ground system (JSON, specification 1.0.0).

Each message of whole octets is a telemetry packet whose members are its fields, so the body of a packet is what F
Prime's decoder expects after its own id and time. Blocks of events and edges are left out: F Prime has no fields of
single bits and no parts of varying length. A field of three octets is an array of three.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from firmware_protocol.ground.description import Packet
from firmware_protocol.wire_layout import Field

_Json = dict[str, Any]
_WIDTHS = (8, 16, 32, 64)
_CHANNELS_OF_A_PACKET = 256


def fprime_text(packets: Sequence[Packet], version: str = "") -> str:
    """Return the JSON text."""
    telemetry = [
        packet
        for packet in packets
        if not packet.is_command and packet.body.fields and all(field.bits % 8 == 0 for field in packet.body.fields)
    ]
    commands = [packet for packet in packets if packet.is_command]
    definitions = [type_ for packet in (*telemetry, *commands) for type_ in _types(packet)]
    metadata = {
        "deploymentName": "evstim",
        "projectVersion": version,
        "frameworkVersion": "4.0.0",
        "libraryVersions": [],
        "dictionarySpecVersion": "1.0.0",
    }
    dictionary = {
        "metadata": metadata,
        "typeDefinitions": list({type_["qualifiedName"]: type_ for type_ in definitions}.values()),
        "constants": [],
        "commands": [_command(packet) for packet in commands],
        "parameters": [],
        "events": [],
        "telemetryChannels": [channel for n, packet in enumerate(telemetry, 1) for channel in _channels(n, packet)],
        "records": [],
        "containers": [],
        "telemetryPacketSets": [_packet_set(telemetry)],
    }
    return json.dumps(dictionary, indent=2) + "\n"


def _types(packet: Packet) -> Iterable[_Json]:
    for field in packet.body.fields:
        name = f"evstim.{packet.name}_{field.name}"
        if field.choices:
            yield _enumeration(name, field)
        elif field.bits not in _WIDTHS:
            size = field.bits // 8
            element = _integer("U8")
            yield {
                "kind": "array",
                "qualifiedName": name,
                "size": size,
                "elementType": element,
                "default": [0] * size,
                "annotation": _annotation(field),
            }


def _enumeration(name: str, field: Field) -> _Json:
    constants = [{"name": label, "value": value, "annotation": ""} for value, label in field.choices.items()]
    return {
        "kind": "enum",
        "qualifiedName": name,
        "representationType": _integer(f"U{field.bits}"),
        "enumeratedConstants": constants,
        "default": f"{name}.{constants[0]['name']}",
        "annotation": _annotation(field),
    }


def _integer(name: str) -> _Json:
    return {"name": name, "kind": "integer", "size": int(name[1:]), "signed": name[0] == "I"}


def _type(packet: Packet, field: Field) -> _Json:
    if field.choices or field.bits not in _WIDTHS:
        return {"name": f"evstim.{packet.name}_{field.name}", "kind": "qualifiedIdentifier"}
    return _integer(f"{'I' if field.signed else 'U'}{field.bits}")


def _channels(number: int, packet: Packet) -> Iterable[_Json]:
    for n, field in enumerate(packet.body.fields):
        yield {
            "name": f"evstim.{packet.name}.{field.name}",
            "type": _type(packet, field),
            "id": number * _CHANNELS_OF_A_PACKET + n,
            "telemetryUpdate": "always",
            "annotation": _annotation(field),
        }


def _packet_set(telemetry: Sequence[Packet]) -> _Json:
    members = [
        {
            "name": packet.name,
            "id": number,
            "group": 0,
            "members": [f"evstim.{packet.name}.{field.name}" for field in packet.body.fields],
        }
        for number, packet in enumerate(telemetry, 1)
    ]
    return {"name": "evstim", "members": members, "omitted": []}


def _command(packet: Packet) -> _Json:
    parameters = [
        {
            "name": placed.field.name,
            "type": _type(packet, placed.field),
            "ref": False,
            "annotation": _annotation(placed.field),
        }
        for placed in packet.arguments
        if placed.identifies is None
    ]
    return {
        "name": f"evstim.{packet.name}",
        "commandKind": "async",
        "opcode": packet.service << 8 | packet.subtype,
        "formalParams": parameters,
        "queueFullBehavior": "assert",
        "annotation": packet.meaning,
    }


def _annotation(field: Field) -> str:
    step = f", in steps of {field.scale!r}" if field.scale != 1 else ""
    return field.meaning + (f", {field.unit}" if field.unit else "") + step
