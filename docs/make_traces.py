"""Write docs/traces/, short captures of two shipped rigs' links, and their decodes: python docs/make_traces.py.

The decode of a capture, NAME.txt, explains each of its lines, or several that are alike.

The instruments and links are those of the rigs `serial-demo` and `can-demo`; the events are a few that are given here,
so that the captures are the same on every machine. The time of a line is that at which the last bit of a frame has
left, on a link that began at 1.02 s and never waits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from emulator.rig.loading import load_rig
from firmware_protocol.can_frames.canopen import NodeState
from firmware_protocol.can_frames.frame import Frame, frame_bits
from firmware_protocol.can_frames.raw_events import Epoch, unpack_clock
from firmware_protocol.events import EDGE, EVENT, Events
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Ping, Verification
from firmware_protocol.receiver.can import CanReceiver
from firmware_protocol.telemetry.reading import decode_block
from transports.can_bus.carriage import sources
from transports.can_bus.kind import CanLink
from transports.serial_line.kind import SerialLink

__all__ = ["EDGES", "EVENTS", "FOLDER", "files"]

FOLDER = Path(__file__).with_name("traces")
SIZE = (346, 260)
START_US = 1_000_000
EVENTS = np.array(
    [
        (START_US + 5, 150, 100, True),
        (START_US + 5, 151, 100, True),
        (START_US + 42, 150, 101, False),
        (START_US + 900, 200, 190, True),
        (START_US + 20_000, 109, 66, False),
    ],
    EVENT,
)
"""Events of the sensor; all inside the region of can-demo."""
EDGES = np.array([(START_US + 10, 2, 0, 1)], EDGE)
"""Edges at the external input."""


def _link(rig: str, kind: type) -> object:
    return next(link for link in load_rig(rig).links if isinstance(link, kind))


def _event_words(events: Events) -> str:
    return "; ".join(f"{t} us x {x} y {y} {'ON' if on else 'OFF'}" for t, x, y, on in events.tolist())


def _instrument(instrument: Instrument) -> Instrument:
    """Offer the events and edges to the instrument."""
    instrument.offer_edges(EDGES)
    instrument.offer(EVENTS)
    instrument.advance(START_US + 20_000)
    return instrument


# The serial line.


def _housekeeping_words(report: Housekeeping) -> str:
    return f"{report.mode.name.lower()}, {report.events.offered} events offered, {report.events.sent} sent"


def _message_words(message: Message) -> str:
    if message.kind in (MessageKind.EVENTS, MessageKind.EDGES):
        block = decode_block(message.payload, message.t_us)
        edges = "; ".join(f"{t} us kind {kind} channel {c} number {seq}" for t, kind, c, seq in block.edges.tolist())
        return _event_words(block.events) or edges
    if message.kind is MessageKind.HOUSEKEEPING:
        return _housekeeping_words(Housekeeping.parse(message.payload))
    if message.kind is MessageKind.VERIFICATION:
        return f"{Verification.parse(message.payload).stage.name.lower()}"
    return "the answer to Ping"


def _serial() -> Iterator[tuple[str, str]]:
    """Yield lines of the capture, and their rows of the decode."""
    parameters = _link("serial-demo", SerialLink)
    assert isinstance(parameters, SerialLink)
    instrument, profile = Instrument(SIZE, parameters.instrument), Profile(parameters.profile)
    computer, sent_us = Profile(parameters.profile), float(START_US + 20_000)
    _instrument(instrument)
    command = computer.wrap_command(Ping())
    for received in profile.command_unwrapper().push(command):
        instrument.command(received)
    yield f"({sent_us / 1e6:.6f}) < {command.hex(' ')}", "| 0x2A0 | 17, 1 | Ping, acknowledgements wanted |"
    while (outgoing := instrument.next_message()) is not None:
        octets = profile.wrap(outgoing.message)
        sent_us += len(octets) * 10 * 1e6 / parameters.baud
        (received,) = computer.unwrapper().push(octets)
        instrument.sent(outgoing)
        message, kind = received.message, outgoing.message.kind
        packet = Profile("ccsds").wrap(message)
        apid, types = int.from_bytes(packet[:2], "big") & 0x7FF, f"{packet[7]}, {packet[8]}"
        row = f"| {apid:#05X} | {types} | {kind.name} at {message.t_us} us: {_message_words(message)} |"
        yield f"({sent_us / 1e6:.6f}) > {octets.hex(' ')}", row.replace("0X", "0x")


# The CAN bus.


class _NoDeliveries:
    """Deliveries that are not recorded."""

    def add_items(self, *_: object) -> None:
        """Ignore the delivery."""


def _isotp_words(receiver: CanReceiver, frame: Frame) -> str:
    words = f"{('single', 'first', 'consecutive')[frame.data[0] >> 4]} frame of ISO-TP"
    report = receiver.housekeeping
    return words if report is None else f"{words}, the last: HOUSEKEEPING, {_housekeeping_words(report)}"


def _frame_words(p: CanLink, receiver: CanReceiver, frame: Frame) -> tuple[str, str]:
    """Return the name of a frame, and its meaning."""
    name = {value: name for name, value in p.identifiers.by_name.items()}[frame.identifier]
    receiver.push(frame)
    events, edges = receiver.take_events(), receiver.take_edges()
    meanings: dict[str, Callable[[], str]] = {
        "heartbeat": lambda: f"{NodeState(frame.data[0]).name.lower()}",
        "sync": lambda: "the trigger",
        "clock": lambda: f"{unpack_clock(frame.data)} us",
        "epoch": lambda: (
            f"{(e := Epoch.parse(frame.data)).ticks} ticks of {e.tick_us} us; {e.sent} events sent, {e.dropped} dropped"
        ),
        "events": lambda: f"number {frame.data[2] & 7}: {_event_words(events)}",
        "edges": lambda: "; ".join(f"{t} us kind {k} channel {c} number {seq}" for t, k, c, seq in edges.tolist()),
        "telemetry": lambda: _isotp_words(receiver, frame),
        "telecommand": lambda: "flow control of ISO-TP",
    }
    return name, meanings[name]()


def _on_the_bus(p: CanLink) -> Iterator[Frame]:
    """Yield the frames: the camera's SYNC and heartbeat, the edge, housekeeping, events."""
    instrument = _instrument(Instrument(SIZE, p.instrument))
    receiver = CanReceiver(p.receiver)
    carried = sources(instrument, _NoDeliveries(), p)  # type: ignore[arg-type]
    yield Frame(p.identifiers.sync, b"")
    yield Frame(p.identifiers.heartbeat, bytes([NodeState.OPERATIONAL]))
    for now_ns in range(0, 1 << 30, 1_000_000):
        found = ((source, source.next_frame(now_ns)) for source in carried)
        source, frame = next(((s, f) for s, f in found if f is not None), (None, None))
        if source is None or frame is None:
            return
        receiver.push(frame, now_ns)
        ended = source.left()
        if ended is not None:
            source.delivered(ended)
        yield frame
        for reply in receiver.take_replies():
            source.receive(reply, now_ns)
            yield reply


def _can() -> Iterator[tuple[str, str]]:
    parameters = _link("can-demo", CanLink)
    assert isinstance(parameters, CanLink)
    receiver, sent_ns = CanReceiver(parameters.receiver), START_US * 1000 + 20_000_000
    for frame in _on_the_bus(parameters):
        sent_ns += parameters.rates.duration_ns(frame_bits(frame))
        name, meaning = _frame_words(parameters, receiver, frame)
        line = f"({sent_ns / 1e9:.6f}) {parameters.channel} {frame.identifier:03X}#{frame.data.hex().upper()}"
        yield line, f"| {frame.identifier:#05x} | {name} | {meaning} |"


# The files.


def _decode(heading: str, lines: list[tuple[str, str]]) -> str:
    """Return the text that explains a capture: a row for each line, or for several that are alike."""
    rows, number = [f"line | time, s | {heading}"], 1
    for row, group in groupby(lines, key=lambda pair: pair[1]):
        times = [line[1 : line.index(")")] for line, _ in group]
        last = number + len(times) - 1
        places = f"{number} to {last} | {times[0]} to {times[-1]}" if len(times) > 1 else f"{number} | {times[0]}"
        rows.append(f"{places} {row}".removesuffix(" |"))
        number = last + 1
    return "\n".join(rows) + "\n"


def files() -> dict[str, str]:
    """Return each file's name and content."""
    serial, can = list(_serial()), list(_can())
    return {
        "serial.hex": "\n".join(line for line, _ in serial) + "\n",
        "serial.txt": _decode("APID | service, subtype | meaning", serial),
        "can.log": "\n".join(line for line, _ in can) + "\n",
        "can.txt": _decode("identifier | frame | meaning", can),
    }


if __name__ == "__main__":
    for name, content in files().items():
        (FOLDER / name).write_text(content, encoding="utf-8")
