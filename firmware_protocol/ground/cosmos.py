"""The packets as a plugin of OpenC3 COSMOS: its target's tlm.txt and cmd.txt, and the interface over UDP.

Commands have their length as a default; the interface's CRC protocol writes the error control and checks that of
telemetry. The part of varying length ends where the error control begins, which COSMOS writes as a size of -16 bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from firmware_protocol.ground.description import Packet, Placed
from firmware_protocol.packets.ccsds import ERROR_CONTROL, PRIMARY_HEADER
from firmware_protocol.wire_layout import Field

_UNITS = {"us": "microseconds", "s": "seconds", "px": "pixels", "1/s": "per_second", "degC": "Celsius"}
_HEX = frozenset({"apid", "error_control", "request_packet_id", "request_sequence_control"})


def cosmos_files(packets: Sequence[Packet], camera_host: str, camera_port: int, packet_port: int) -> Mapping[str, str]:
    """Return the text of each file of the plugin, by its path.

    COSMOS sends telecommands to `camera_host` and `camera_port`, and receives packets on `packet_port`.
    """
    commands = [packet for packet in packets if packet.is_command]
    telemetry = [packet for packet in packets if not packet.is_command]
    return {
        "plugin.txt": _PLUGIN.format(camera_host, camera_port, packet_port),
        "openc3-cosmos-evstim.gemspec": _GEMSPEC,
        "targets/EVSTIM/target.txt": "LANGUAGE python\nIGNORE_PARAMETER ERROR_CONTROL\n",
        f"{_FOLDER}/tlm.txt": "\n".join(line for packet in telemetry for line in _telemetry(packet)) + "\n",
        f"{_FOLDER}/cmd.txt": "\n".join(line for packet in commands for line in _command(packet)) + "\n",
    }


_FOLDER = "targets/EVSTIM/cmd_tlm"
_PLUGIN = """VARIABLE target_name EVSTIM
VARIABLE camera_host {}
VARIABLE camera_port {}
VARIABLE packet_port {}

TARGET EVSTIM <%= target_name %>

INTERFACE <%= target_name %>_INT openc3/interfaces/udp_interface.py <%= camera_host %> <%= camera_port %> \
<%= packet_port %> nil nil 128 10.0 nil
  MAP_TARGET <%= target_name %>
  PROTOCOL READ_WRITE openc3/interfaces/protocols/crc_protocol.py \
ERROR_CONTROL FALSE ERROR -16 16 BIG_ENDIAN 0x1021 0xFFFF FALSE FALSE
"""
_GEMSPEC = """Gem::Specification.new do |spec|
  spec.name = 'openc3-cosmos-evstim'
  spec.version = '0.1.0'
  spec.summary = 'Packets of an evstim instrument'
  spec.authors = ['evstim']
  spec.license = 'Apache-2.0'
  spec.files = Dir['targets/**/*', 'plugin.txt']
end
"""


def _telemetry(packet: Packet) -> Iterable[str]:
    yield f"TELEMETRY EVSTIM {packet.name} BIG_ENDIAN {_quoted(packet.meaning)}"
    for placed in packet.fields:
        field, identifies = placed.field, _identifies(placed)
        head = "APPEND_ID_ITEM" if identifies else "APPEND_ITEM"
        value = f" {placed.identifies}" if identifies else ""
        yield f"  {head} {field.name.upper()} {field.bits} {_type(field)}{value} {_quoted(field.meaning)}"
        yield from _details(field, "READ")
    if packet.tail is not None:
        name, kind = packet.tail.name.upper(), "STRING" if packet.tail.kind == "text" else "BLOCK"
        place = f"{8 * packet.before_tail} -{ERROR_CONTROL.bits}"
        yield f"  ITEM {name} {place} {kind} {_quoted(packet.tail.meaning)}"
    for field in ERROR_CONTROL.fields:
        name = field.name.upper()
        head = f"ITEM {name} -{field.bits}" if packet.tail else f"APPEND_ITEM {name}"
        yield f"  {head} {field.bits} UINT {_quoted(field.meaning)}"
        yield from _details(field, "READ")
    yield ""


def _command(packet: Packet) -> Iterable[str]:
    yield f"COMMAND EVSTIM {packet.name.upper()} BIG_ENDIAN {_quoted(packet.meaning)}"
    for placed in packet.fields:
        field = placed.field
        low, high = (value * field.scale if field.scale != 1 else value for value in field.range)
        preset = packet.lengths[0] - PRIMARY_HEADER.octets - 1 if field.name == "length" else placed.preset
        if placed.identifies is not None:
            low = high = preset
        preset = max(preset, min(field.choices)) if field.choices and placed.identifies is None else preset
        head = "APPEND_ID_PARAMETER" if _identifies(placed) else "APPEND_PARAMETER"
        bounds = f"{low} {high} {max(preset, low)}"
        yield f"  {head} {field.name.upper()} {field.bits} {_type(field)} {bounds} {_quoted(field.meaning)}"
        yield from _details(field, "WRITE")
    for field in ERROR_CONTROL.fields:
        yield f"  APPEND_PARAMETER {field.name.upper()} {field.bits} UINT MIN MAX 0 {_quoted(field.meaning)}"
    yield ""


def _identifies(placed: Placed) -> bool:
    return placed.field.name in ("type", "apid", "service", "subtype")


def _details(field: Field, direction: str) -> Iterable[str]:
    """Yield states, unit and conversion."""
    for value, name in field.choices.items():
        yield f"    STATE {name} {value}"
    if field.unit:
        yield f"    UNITS {_UNITS.get(field.unit, field.unit)} {field.unit}"
    if field.scale != 1:
        yield f"    POLY_{direction}_CONVERSION 0 {field.scale if direction == 'READ' else 1 / field.scale!r}"
    if field.name in _HEX:
        yield "    FORMAT_STRING 0x%04X"


def _type(field: Field) -> str:
    return "INT" if field.signed else "UINT"


def _quoted(text: str) -> str:
    return '"' + text.replace('"', "'") + '"'
