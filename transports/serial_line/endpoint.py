"""Instrument on a serial line: messages out at the baud rate, telecommands in, reconnection when the port returns.

    instrument.next_message -> profile.wrap -> transmitter -> _write -> port
    instrument.command <- unwrapper <- _receive <- port

With the words of a sensor (`network_streams.words`), a few events at a time become words, and nothing is received:

    instrument.next_items -> coder.encode -> transmitter -> _write -> port

Messages in transit are lost with a port that disappears, and are counted; the instrument then counts new events as not
running until the port is back. The tick never waits for the port: blocking calls are made in a thread.

`BaudClock` keeps the baud rate, because a pty accepts bytes as fast as they are written, at any rate setting.

    character   start bit, 5 to 8 data bits, parity bit or none, 1 to 2 stop bits       8N1: 10 bits a byte

A byte occupies the line for the time of its bits, one after the other. Due bytes are counted from an absolute start. So
a late tick sends the bytes that a real port's FIFO would have sent in the meantime, and the rate is exact for any
ticks. A line that had nothing to send starts again: it cannot catch up idle time.

`Transmitter` pulls frames as late as possible, releases their bytes at the baud rate, and never waits.

    source --frames--> [ f f f | part of f ] --bytes that are due--> port.write

A frame is pulled when the line would otherwise be idle before the next tick. Bytes that the port refuses stay here and
are counted as held; the line then stops, like one with hardware flow control.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from firmware_protocol.device.plain_device import own_time
from firmware_protocol.instrument.instrument import Instrument, Outgoing
from firmware_protocol.network_streams.coders import ConnectionCoder, StreamFacts
from firmware_protocol.network_streams.words import WORD_CONNECTION_CODERS, repeat_us
from firmware_protocol.packets.profile import Profile
from transports.faults.faulty_line import FaultyLine
from transports.link.deliveries import Deliveries
from transports.link.endpoint import (
    BUSY_NS,
    HOSTED_NS,
    REST_NS,
    Endpoint,
    EndpointFactory,
    EndpointReport,
    LineUse,
    Reopening,
)
from transports.link.kind import Wiring
from transports.serial_line.kind import SerialLink
from transports.serial_line.port import Port, open_port, remove_abandoned

_BEHIND_NS = 50_000_000  # limit of the time that a late tick may catch up: the size of a driver's transmit buffer


class BaudClock:
    """Sending time of each byte, at `baud` bits a second and `bits` a byte, even half of one (1.5 stop bits)."""

    def __init__(self, baud: int, bits: float) -> None:
        self._baud2 = 2 * baud
        self._half_bits = round(2 * bits)
        self._start_ns = 0
        self._sent = 0  # bytes since _start_ns
        self._began_ns: int | None = None
        self.carried = 0  # bytes that have left
        self._second = 0
        self._in_second = 0
        self._busiest = 0

    @property
    def bytes_per_s(self) -> float:
        """Capacity of the line."""
        return self._baud2 / self._half_bits

    @property
    def busiest_share(self) -> float:
        """Share of the line's time in the busiest whole second, 0 to 1."""
        return min(1.0, self._busiest / self.bytes_per_s)

    def share(self, now_ns: int) -> float:
        """Share of the line's time used since the first byte, 0 to 1."""
        if self._began_ns is None or now_ns <= self._began_ns:
            return 0.0
        return min(1.0, self.carried / self.bytes_per_s / ((now_ns - self._began_ns) * 1e-9))

    def free_ns(self) -> int:
        """Time at which the line is free for the next byte."""
        return self._start_ns + self.duration_ns(self._sent)

    def duration_ns(self, count: int) -> int:
        """Return the duration of `count` bytes, ns."""
        return count * self._half_bits * 1_000_000_000 // self._baud2

    def due(self, now_ns: int) -> int:
        """Return the number of bytes that may have left by now."""
        if now_ns - self.free_ns() > _BEHIND_NS:
            self.restart(now_ns - _BEHIND_NS)
        return max(0, (now_ns - self._start_ns) * self._baud2 // (self._half_bits * 1_000_000_000) - self._sent)

    def leave(self, count: int, now_ns: int) -> None:
        """Record `count` bytes, which were due, as sent."""
        if self._began_ns is None:
            self._began_ns = self.free_ns()
        self._sent += count
        self.carried += count
        second = now_ns // 1_000_000_000
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += count
        self._busiest = max(self._busiest, self._in_second)

    def restart(self, now_ns: int) -> None:
        """Record that the line was stopped until now: it had nothing to send, or was held."""
        if now_ns > self.free_ns():
            self._start_ns, self._sent = now_ns, 0


_Tag = TypeVar("_Tag")


@dataclass(frozen=True)
class Frame(Generic[_Tag]):
    """Bytes of one message, with the message as `tag`."""

    data: bytes
    tag: _Tag


class Transmitter(Generic[_Tag]):
    """Transmitter of frames through `write`, which returns the number of accepted bytes.

    Parameters
    ----------
    pull : Returns the next frame, or None when there is none.
    left : called with the tag of each frame whose last byte has left.
    ahead_ns : time before the line becomes idle at which the next frame is pulled: a little more than a tick.
    """

    def __init__(
        self,
        clock: BaudClock,
        pull: Callable[[], Frame[_Tag] | None],
        left: Callable[[_Tag], None],
        ahead_ns: int,
    ) -> None:
        self._clock = clock
        self._pull = pull
        self._left = left
        self._ahead_ns = ahead_ns
        self._frames: deque[Frame[_Tag]] = deque()
        self._gone = 0  # bytes of the first frame that have left
        self.waiting = 0  # bytes that have been pulled and not sent
        self.held = 0

    @property
    def begun(self) -> bytes:
        """Sent bytes of the frame that is on the line."""
        return self._frames[0].data[: self._gone] if self._frames else b""

    def pump(self, write: Callable[[bytes], int], now_ns: int) -> None:
        """Send the due bytes, and pull the next frames."""
        while self._fill(now_ns):
            due = self._clock.due(now_ns)
            if not due or not self._send(write, due, now_ns):
                return

    @property
    def is_busy(self) -> bool:
        """True while frames wait for their time on the line."""
        return bool(self._frames)

    def drop(self) -> list[_Tag]:
        """Discard all frames, including the one on the line, and return their tags."""
        tags = [frame.tag for frame in self._frames]
        self._frames.clear()
        self._gone = self.waiting = 0
        return tags

    def _fill(self, now_ns: int) -> bool:
        """Pull until the line has enough for the next time; return True if there is anything to send."""
        while self._clock.free_ns() + self._clock.duration_ns(self.waiting) < now_ns + self._ahead_ns:
            frame = self._pull()
            if frame is None:
                break
            self._frames.append(frame)
            self.waiting += len(frame.data)
        if not self._frames:
            self._clock.restart(now_ns)
        return bool(self._frames)

    def _send(self, write: Callable[[bytes], int], due: int, now_ns: int) -> bool:
        """Write up to `due` bytes; return True if the port accepted them all."""
        data = self._next_bytes(due)
        taken = write(data)
        self._clock.leave(taken, now_ns)
        self.waiting -= taken
        self._gone += taken
        while self._frames and self._gone >= len(self._frames[0].data):
            frame = self._frames.popleft()
            self._gone -= len(frame.data)
            self._left(frame.tag)
        if taken < len(data):
            self.held += 1
            self._clock.restart(now_ns)
            return False
        return True

    def _next_bytes(self, count: int) -> bytes:
        parts, have = [], -self._gone
        for frame in self._frames:
            parts.append(frame.data)
            have += len(frame.data)
            if have >= count:
                break
        return b"".join(parts)[self._gone : self._gone + count]


_AHEAD_NS = 600_000  # a little more than a tick of the link
_RETRY_NS = 500_000_000
_WORDS_S = 0.25e-3  # time of the events of a frame, at one byte an event: about a tick at four
_PULL_NS = 50_000_000
_PULL_LOOKS = 10  # the kernel moves bytes of a pty with a delay, and shows none in between
_CLOSE_S = 0.5
_CLOSE_LOOK_S = 0.005
_CLOSE_LOOKS = 4  # a pty passes bytes on with a delay: for a moment neither side shows them


@dataclass(frozen=True)
class SerialFactory(EndpointFactory[Instrument]):
    """Factory of the endpoint of an instrument on a line, in the packets and framing of its parameters."""

    line: SerialLink
    wiring: Wiring = field(default_factory=Wiring)

    def build(self, device: Instrument, deliveries: Deliveries) -> SerialEndpoint:
        """Return the endpoint; its port is not open yet."""
        return SerialEndpoint(self, device, deliveries)

    def remove_remains(self) -> None:
        """Remove the symbolic link to a pty that no longer exists."""
        if self.line.symlink:
            remove_abandoned(Path(self.line.symlink))


class SerialEndpoint(Endpoint):
    """Endpoint of one instrument on one port."""

    faulty: FaultyLine

    def __init__(self, factory: SerialFactory, instrument: Instrument, deliveries: Deliveries) -> None:
        self._line = factory.line
        self._instrument = instrument
        self._clock = deliveries.clock
        self._profile = Profile(self._line.profile)
        self._commands = self._profile.command_unwrapper()
        self._baud = BaudClock(self._line.baud, self._line.bits)
        self._coder: ConnectionCoder | None = None
        if self._line.sends_words:
            form = self._line.format
            camera = factory.wiring.camera
            period_us = repeat_us(form, self._baud.bytes_per_s)
            facts = StreamFacts(camera.size, camera.model, form=form, repeat_us=period_us)
            self._coder = WORD_CONNECTION_CODERS[form](facts)
            instrument.takes_edges = self._coder.has_edges
        self._most_events = max(1, round(self._baud.bytes_per_s * _WORDS_S))
        self._epoch_us = 0
        self._out: Transmitter[Outgoing] = Transmitter(self._baud, self._next_frame, self._left, _AHEAD_NS)
        self.faulty = FaultyLine(
            factory.wiring.faults, self._line.profile, self._baud.bytes_per_s, deliveries.add_items
        )
        self._counts: Counter[str] = Counter()
        self._port: Port | None = None
        self._has_reader = False
        self._reopening = Reopening(self._clock, _RETRY_NS, lambda: asyncio.to_thread(open_port, self._line))
        self._pulled_ns: int | None = None
        self._empty_looks = 0

    async def start(self) -> None:
        """Open the port; raises OSError, with the remedy, when it cannot be opened."""
        self._instrument.disconnected()
        self._port = await asyncio.to_thread(open_port, self._line)

    def pump(self) -> None:
        """Process received bytes, and send the due bytes."""
        port = self._port
        if self.faulty.gone or self._pulled_ns is not None:
            self._pull_out()
            return
        if port is None:
            self._port = self._reopening.poll()
            self._counts["reconnections"] += self._port is not None
            return
        try:
            self._set_reader(port.has_reader)
            self._receive(port.read())
            if self._has_reader:
                self._out.pump(self._write, self._clock.now_ns())
                self.faulty.flush(port.write)
                self.faulty.settle()
        except OSError:
            self._vanished()

    async def close(self) -> None:
        """Close the port after the other side has read the sent bytes; bytes that have not left are lost."""
        await self._reopening.close()
        if self._has_reader and self._port is not None:
            await _emptied(self._port)
        self._set_reader(False)
        self.faulty.close()
        port, self._port = self._port, None
        if port is not None:
            await asyncio.to_thread(port.close)

    @property
    def inputs(self) -> Sequence[int]:
        """Descriptors that are readable when a request has arrived."""
        if self._port is None or self.faulty.gone or not self._has_reader or self._port.descriptor is None:
            return ()
        return (self._port.descriptor,)

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`; a port without a descriptor is looked at every time."""
        if self._pulled_ns is not None or self._out.is_busy or (self._has_reader and self._instrument.waiting_items):
            return BUSY_NS
        return REST_NS if self._port is None or self._port.descriptor is not None else HOSTED_NS

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end the faults of the rig that are due."""
        self.faulty.advance(stream_us, self._out.begun)

    @property
    def state(self) -> str:
        """State of the port, and of the reader at the other side."""
        if self._port is None:
            return f"{self._line.port} is gone; looking for it"
        if not self._has_reader:
            return f"waiting for a reader of {self._port.address}"
        return f"{self._line.baud} baud on {self._port.address}"

    def report(self) -> EndpointReport:
        """Return the port, evstim's own receiver while no program reads telemetry, the load of the line, and counts."""
        counts = {
            "telecommands": self._commands.counters.packets,
            "damaged_frames": self._instrument.frames_refused,
            "held_back": self._out.held,
            "reconnections": self._counts["reconnections"],
            "false_messages": self.faulty.false,
        }
        use = LineUse(self._baud.carried, self._baud.share(self._clock.now_ns()), self._baud.busiest_share)
        if self._port is None:
            return EndpointReport(use=use, counts=counts)
        has_receiver = self._has_reader or self._coder is not None
        attach = "" if has_receiver else f"evstim listen serial {self._port.address}{self._other_options}"
        return EndpointReport(self._port.address, attach, use, counts)

    @property
    def _other_options(self) -> str:
        """Options of the receiver for a line that differs from the default."""
        line = {name: getattr(self._line, name) for name in ("profile", "baud", "parity", "stop_bits")}
        other = {name.replace("_", "-"): value for name, value in line.items() if value != getattr(SerialLink, name)}
        return "".join(f" --{key} {value}" for key, value in other.items())

    def _write(self, data: bytes) -> int:
        """Pass bytes to the port through the line's faults; the only output."""
        return 0 if self._port is None else self.faulty.write(data, self._port.write)

    def _receive(self, data: bytes) -> None:
        """Process bytes of the other side; the only input."""
        if not data or self._coder is not None:
            return
        for received in self._commands.push(data):
            self._instrument.command(received)
        counters = self._commands.counters
        self._instrument.frames_refused = sum(counters.frames.refused.values()) + sum(counters.refused.values())

    def _next_frame(self) -> Frame[Outgoing] | None:
        if self._coder is not None:
            return self._next_words(self._coder)
        outgoing = self._instrument.next_message()
        return None if outgoing is None else Frame(self._profile.wrap(outgoing.message), outgoing)

    def _next_words(self, coder: ConnectionCoder) -> Frame[Outgoing] | None:
        """Return the next items as words, or in a silence the words of the time that are due."""
        data = b""
        outgoing = self._instrument.next_items(self._most_events)
        epoch_us = outgoing.epoch_us
        if epoch_us != self._epoch_us:
            self._epoch_us = epoch_us
            coder.restart()
        if outgoing.numbers.total:
            data = bytes(coder.encode(own_time(outgoing.events, epoch_us), own_time(outgoing.edges, epoch_us)))
        elif not self._instrument.waiting_items:  # events that a rate limit holds still have to follow
            data = coder.advance(self._instrument.own_us)
        return Frame(data, outgoing) if data else None

    def _left(self, outgoing: Outgoing) -> None:
        self._instrument.sent(outgoing)
        self.faulty.left(outgoing)

    def _set_reader(self, present: bool) -> None:
        """Follow the presence of a reader."""
        if present == self._has_reader:
            return
        self._has_reader = present
        if present:
            self._baud.restart(self._clock.now_ns())
            self._instrument.connected()
        else:
            self.faulty.drop()
            for outgoing in self._out.drop():
                self._instrument.lost(outgoing)
            if self._coder is not None:
                self._coder.restart()
            self._instrument.disconnected()

    def _pull_out(self) -> None:
        """Remove the port, but not the sent bytes that wait in the kernel: they count as on the wire."""
        if self._port is None:
            return
        now_ns = self._clock.now_ns()
        if self._pulled_ns is None:
            self._pulled_ns, self._empty_looks = now_ns + _PULL_NS, 0
        self._empty_looks = 0 if self._port.unsent else self._empty_looks + 1
        if self._empty_looks >= _PULL_LOOKS or now_ns >= self._pulled_ns:
            self._vanished()
            self._pulled_ns = None

    def _vanished(self) -> None:
        self._set_reader(False)
        port, self._port = self._port, None
        if port is not None:
            asyncio.get_running_loop().run_in_executor(None, port.close)
        self._reopening.lost()


async def _emptied(port: Port) -> None:
    """Return when the other side has read all bytes in the port, or after half a second."""
    looks = 0
    with suppress(TimeoutError):
        async with asyncio.timeout(_CLOSE_S):
            while looks < _CLOSE_LOOKS:
                looks = 0 if port.unsent else looks + 1
                await asyncio.sleep(_CLOSE_LOOK_S)
