"""The packets as a Wireshark dissector in Lua: tables generated from the description, in a program that reads them.

Filters: `evstim.apid` and the other header fields, `evstim.housekeeping.temperature` for a field of a packet. Values
are in the unit of the label.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import resources
from itertools import accumulate

from firmware_protocol.can_frames.dbc import CanMessage, Signal
from firmware_protocol.ground.description import Packet, Tail
from firmware_protocol.packets.ccsds import ERROR_CONTROL, PRIMARY_HEADER, TC_HEADER, TM_HEADER
from firmware_protocol.wire_layout import Field, Layout

_HEX = frozenset({"apid", "error_control", "crc8", "request_packet_id", "request_sequence_control"})
_TABLES = "--@PACKETS@\n"
_FRAMES = "--@FRAMES@\n"
_CAN = "--@CAN@\n"


def wireshark_text(
    packets: Sequence[Packet], udp_ports: Sequence[int], frames: Sequence[tuple[int, CanMessage]] = ()
) -> str:
    """Return the program, for datagrams from or to these ports, and for CAN frames with these identifiers."""
    program = _program("dissector.lua").replace(_TABLES, "\n".join(_tables(packets, udp_ports)) + "\n")
    can = _program("can_dissector.lua").replace(_FRAMES, "\n".join(_frames(frames)) + "\n") if frames else ""
    return program.replace(_CAN, can)


def _program(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _frames(frames: Sequence[tuple[int, CanMessage]]) -> Iterable[str]:
    for id_, message in frames:
        if message.comment == "ISO-TP":
            continue
        yield f"frames[{id_}] = {{name = {_quoted(message.name)},"
        for signal in message.signals:
            label = signal.name + (f", {signal.unit}" if signal.unit else "")
            first_bit = signal.start // 8 * 8 if signal.big_endian else signal.start  # big-endian: of the first octet
            path = f"evstim_can.{message.name}.{signal.name}"
            row = [_quoted(path), _quoted(label), str(first_bit), str(signal.bits)]
            options = _signal_options(signal)
            yield f"  signal({', '.join(row)}{f', {{{options}}}' if options else ''}),"
        yield "}"


def _signal_options(signal: Signal) -> str:
    choices = ", ".join(f"[{value}] = {_quoted(text)}" for value, text in signal.values)
    options = {
        "scale": signal.factor if signal.factor != "1" else "",
        "big": "true" if signal.big_endian else "",
        "choices": f"{{{choices}}}" if choices else "",
    }
    return ", ".join(f"{name} = {value}" for name, value in options.items() if value)


def _tables(packets: Iterable[Packet], udp_ports: Sequence[int]) -> Iterable[str]:
    yield f"local UDP_PORTS = {{{', '.join(map(str, udp_ports))}}}"
    yield from ("local PRIMARY = {", *_fields("evstim", PRIMARY_HEADER, 0), "}")
    (error_control,) = _fields("evstim", ERROR_CONTROL, 0)
    yield f"local ERROR_CONTROL = {error_control.strip().rstrip(',')}"
    for packet in packets:
        yield from _packet(packet)


def _packet(packet: Packet) -> Iterable[str]:
    least, greatest = packet.lengths
    fixed = packet.before_tail + ERROR_CONTROL.octets
    abbr = f"evstim.{packet.name.lower()}"
    yield f"packet({packet.type.value}, {packet.apid}, {packet.service}, {packet.subtype}, {{"
    yield f"  name = {_quoted(packet.name)}, before_rest = {packet.before_tail},"
    yield f"  shortest = {least - fixed}, longest = {greatest - fixed},"
    yield "  fields = {"
    yield from _fields("evstim", TC_HEADER if packet.is_command else TM_HEADER, PRIMARY_HEADER.bits)
    yield from _fields(abbr, packet.body, packet.header.bits)
    yield "  },"
    if packet.tail is not None:
        yield from _tail(abbr, packet.tail)
    yield "})"


def _tail(abbr: str, tail: Tail) -> Iterable[str]:
    name = f"{abbr}.{tail.name}"
    yield f"  rest = {{kind = {_quoted(tail.kind)}, abbr = {_quoted(name)}, label = {_quoted(tail.meaning)},"
    if tail.records is not None:
        yield f"    octets = {tail.records.octets}, fields = {{"
        yield from _fields(name, tail.records, 0)
        yield "    },"
    yield "  },"


def _fields(prefix: str, layout: Layout, at: int) -> Iterable[str]:
    places = accumulate((field.bits for field in layout.fields), initial=at)
    for field, place in zip(layout.fields, places, strict=False):
        label = field.name.replace("_", " ") + (f", {field.unit}" if field.unit else "")
        row = [_quoted(f"{prefix}.{field.name}"), _quoted(label), str(place), str(field.bits), _quoted(field.meaning)]
        options = _field_options(field)
        yield f"    field({', '.join(row)}{f', {{{options}}}' if options else ''}),"


def _field_options(field: Field) -> str:
    """Return the properties that only some fields have."""
    choices = ", ".join(f"[{value}] = {_quoted(name)}" for value, name in field.choices.items())
    options = {
        "scale": repr(field.scale) if field.scale != 1 else "",
        "signed": "true" if field.signed else "",
        "hex": "true" if field.name in _HEX else "",
        "choices": f"{{{choices}}}" if choices else "",
    }
    return ", ".join(f"{name} = {value}" for name, value in options.items() if value)


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
