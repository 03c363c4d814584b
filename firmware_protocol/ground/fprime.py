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


def fprime_text(packets: Sequence[Packet], deployment: str = "evstim", version: str = "") -> str:
    """Return the JSON text."""
    telemetry = [one for one in packets if not one.is_command and _is_whole(one)]
    commands = [one for one in packets if one.is_command]
    types = {one["qualifiedName"]: one for packet in (*telemetry, *commands) for one in _types(packet, deployment)}
    metadata = {
        "deploymentName": deployment,
        "projectVersion": version,
        "frameworkVersion": "4.0.0",
        "libraryVersions": [],
        "dictionarySpecVersion": "1.0.0",
    }
    dictionary = {
        "metadata": metadata,
        "typeDefinitions": list(types.values()),
        "constants": [],
        "commands": [_command(one, deployment) for one in commands],
        "parameters": [],
        "events": [],
        "telemetryChannels": [one for n, each in enumerate(telemetry, 1) for one in _channels(n, each, deployment)],
        "records": [],
        "containers": [],
        "telemetryPacketSets": [_packet_set(telemetry, deployment)],
    }
    return json.dumps(dictionary, indent=2) + "\n"


def _is_whole(packet: Packet) -> bool:
    return bool(packet.body.fields) and all(one.bits % 8 == 0 for one in packet.body.fields)


def _types(packet: Packet, deployment: str) -> Iterable[_Json]:
    for one in packet.body.fields:
        name = f"{deployment}.{packet.name}_{one.name}"
        if one.choices:
            yield _enumeration(name, one)
        elif one.bits not in _WIDTHS:
            size = one.bits // 8
            element = _integer("U8")
            yield {
                "kind": "array",
                "qualifiedName": name,
                "size": size,
                "elementType": element,
                "default": [0] * size,
                "annotation": _annotation(one),
            }


def _enumeration(name: str, one: Field) -> _Json:
    constants = [{"name": label, "value": value, "annotation": ""} for value, label in one.choices.items()]
    return {
        "kind": "enum",
        "qualifiedName": name,
        "representationType": _integer(f"U{one.bits}"),
        "enumeratedConstants": constants,
        "default": f"{name}.{constants[0]['name']}",
        "annotation": _annotation(one),
    }


def _integer(name: str) -> _Json:
    return {"name": name, "kind": "integer", "size": int(name[1:]), "signed": name[0] == "I"}


def _type(packet: Packet, one: Field, deployment: str) -> _Json:
    if one.choices or one.bits not in _WIDTHS:
        return {"name": f"{deployment}.{packet.name}_{one.name}", "kind": "qualifiedIdentifier"}
    return _integer(f"{'I' if one.signed else 'U'}{one.bits}")


def _channels(number: int, packet: Packet, deployment: str) -> Iterable[_Json]:
    for n, one in enumerate(packet.body.fields):
        yield {
            "name": f"{deployment}.{packet.name}.{one.name}",
            "type": _type(packet, one, deployment),
            "id": number * _CHANNELS_OF_A_PACKET + n,
            "telemetryUpdate": "always",
            "annotation": _annotation(one),
        }


def _packet_set(telemetry: Sequence[Packet], deployment: str) -> _Json:
    members = [
        {
            "name": packet.name,
            "id": number,
            "group": 0,
            "members": [f"{deployment}.{packet.name}.{one.name}" for one in packet.body.fields],
        }
        for number, packet in enumerate(telemetry, 1)
    ]
    return {"name": deployment, "members": members, "omitted": []}


def _command(packet: Packet, deployment: str) -> _Json:
    parameters = [
        {
            "name": placed.field.name,
            "type": _type(packet, placed.field, deployment),
            "ref": False,
            "annotation": _annotation(placed.field),
        }
        for placed in packet.arguments
        if placed.identifies is None
    ]
    return {
        "name": f"{deployment}.{packet.name}",
        "commandKind": "async",
        "opcode": packet.service << 8 | packet.subtype,
        "formalParams": parameters,
        "queueFullBehavior": "assert",
        "annotation": packet.meaning,
    }


def _annotation(one: Field) -> str:
    step = f", in steps of {one.scale!r}" if one.scale != 1 else ""
    return one.meaning + (f", {one.unit}" if one.unit else "") + step
