"""The packets as a Wireshark dissector in Lua: tables generated from the description, in a program that reads them.

Filters: `evstim.apid` and the other header fields, `evstim.housekeeping.temperature` for a field of a packet. Values
are in the unit of the label.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import resources
from itertools import accumulate

from firmware_protocol.can_frames.dbc import CanMessage, Signal
from firmware_protocol.ground.description import Packet, Rest
from firmware_protocol.packets.ccsds import PRIMARY_HEADER
from firmware_protocol.packets.pus import ERROR_CONTROL, TC_HEADER, TM_HEADER
from firmware_protocol.wire_layout import Field, Layout

_HEX = frozenset({"apid", "error_control", "crc8", "request_packet_id", "request_sequence_control"})
_TABLES, _FRAMES, _CAN = "--@PACKETS@\n", "--@FRAMES@\n", "--@CAN@\n"


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
        for one in message.signals:
            label = one.name + (f", {one.unit}" if one.unit else "")
            row = [_quoted(f"evstim_can.{message.name}.{one.name}"), _quoted(label), str(_lowest(one)), str(one.bits)]
            more = _signal_more(one)
            yield f"  signal({', '.join(row)}{f', {{{more}}}' if more else ''}),"
        yield "}"


def _lowest(one: Signal) -> int:
    """Return the first bit for the program: of big-endian numbers, the lowest of their first octet."""
    return one.start // 8 * 8 if one.big_endian else one.start


def _signal_more(one: Signal) -> str:
    choices = ", ".join(f"[{value}] = {_quoted(text)}" for value, text in one.values)
    options = {
        "scale": one.factor if one.factor != "1" else "",
        "big": "true" if one.big_endian else "",
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
    fixed = packet.before_rest + ERROR_CONTROL.octets
    abbr = f"evstim.{packet.name.lower()}"
    yield f"packet({packet.type.value}, {packet.apid}, {packet.service}, {packet.subtype}, {{"
    yield f"  name = {_quoted(packet.name)}, before_rest = {packet.before_rest},"
    yield f"  shortest = {least - fixed}, longest = {greatest - fixed},"
    yield "  fields = {"
    yield from _fields("evstim", TC_HEADER if packet.is_command else TM_HEADER, PRIMARY_HEADER.bits)
    yield from _fields(abbr, packet.body, packet.header.bits)
    yield "  },"
    if packet.rest is not None:
        yield from _rest(abbr, packet.rest)
    yield "})"


def _rest(abbr: str, rest: Rest) -> Iterable[str]:
    name = f"{abbr}.{rest.name}"
    yield f"  rest = {{kind = {_quoted(rest.kind)}, abbr = {_quoted(name)}, label = {_quoted(rest.meaning)},"
    if rest.records is not None:
        yield f"    octets = {rest.records.octets}, fields = {{"
        yield from _fields(name, rest.records, 0)
        yield "    },"
    yield "  },"


def _fields(prefix: str, layout: Layout, at: int) -> Iterable[str]:
    places = accumulate((one.bits for one in layout.fields), initial=at)
    for one, place in zip(layout.fields, places, strict=False):
        label = one.name.replace("_", " ") + (f", {one.unit}" if one.unit else "")
        row = [_quoted(f"{prefix}.{one.name}"), _quoted(label), str(place), str(one.bits), _quoted(one.meaning)]
        more = _more(one)
        yield f"    field({', '.join(row)}{f', {{{more}}}' if more else ''}),"


def _more(one: Field) -> str:
    """Return the properties that only some fields have."""
    choices = ", ".join(f"[{value}] = {_quoted(name)}" for value, name in one.choices.items())
    options = {
        "scale": repr(one.scale) if one.scale != 1 else "",
        "signed": "true" if one.signed else "",
        "hex": "true" if one.name in _HEX else "",
        "choices": f"{{{choices}}}" if choices else "",
    }
    return ", ".join(f"{name} = {value}" for name, value in options.items() if value)


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
