"""An instrument on a serial line: messages out at the baud rate, telecommands in, reconnection when the port returns.

    instrument.next_message -> profile.wrap -> transmitter -> _write -> port
    instrument.command <- unwrapper <- _receive <- port

A port that goes away takes what was on its way with it, which is counted as lost; the instrument then counts what comes
as not running until the port is back. The tick never waits for the port: what blocks is done in a thread.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.packets.profile import Profile
from transports.faults.faulty_line import FaultyLine
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, FaultRecord
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory, LineUse
from transports.link.reopening import Reopening
from transports.serial_line.opening import open_port
from transports.serial_line.pacing import BaudClock
from transports.serial_line.parameters import SerialParameters
from transports.serial_line.port import Port
from transports.serial_line.pty_symlink import remove_abandoned
from transports.serial_line.transmitter import Frame, Transmitter

__all__ = ["SerialEndpoint", "SerialFactory"]

_AHEAD_NS = 600_000  # a little more than a tick of the link
_RETRY_NS = 500_000_000
_PULL_NS = 50_000_000
_PULL_LOOKS = 10  # a pty's kernel moves bytes in its own time, and shows none meanwhile
_CLOSE_S = 0.5
_CLOSE_LOOK_S = 0.005
_CLOSE_LOOKS = 4  # a pty hands bytes on in its own time: for a moment they are neither here nor there


@dataclass(frozen=True)
class SerialFactory(EndpointFactory[Instrument]):
    """Puts an instrument on a line, in the packets and framing that it names."""

    line: SerialParameters
    faults: FaultPlan = field(default_factory=FaultPlan)

    def build(self, device: Instrument, deliveries: Deliveries) -> SerialEndpoint:
        """Return the endpoint, its port not yet open."""
        return SerialEndpoint(self, device, deliveries)

    def remove_remains(self) -> None:
        """Remove the symbolic link to a pty that is gone."""
        if self.line.symlink:
            remove_abandoned(Path(self.line.symlink))


class SerialEndpoint(Endpoint):
    """One instrument on one port."""

    def __init__(self, factory: SerialFactory, instrument: Instrument, deliveries: Deliveries) -> None:
        self._line = factory.line
        self._instrument = instrument
        self._deliveries = deliveries
        self._clock = deliveries.clock
        self._profile = Profile(self._line.profile)
        self._commands = self._profile.command_unwrapper()
        self._baud = BaudClock(self._line.baud, self._line.bits)
        self._out: Transmitter[Outgoing] = Transmitter(self._baud, self._next_frame, self._left, _AHEAD_NS)
        self._faulty = FaultyLine(factory.faults, self._line.profile, self._baud.bytes_per_s, self._arrived)
        self._counts: Counter[str] = Counter()
        self._port: Port | None = None
        self._heard = False
        self._reopening = Reopening(self._clock, _RETRY_NS, lambda: asyncio.to_thread(open_port, self._line))
        self._pulled_ns: int | None = None
        self._empty_looks = 0

    async def start(self) -> None:
        """Open the port; raises OSError, with what to do, when it cannot be had."""
        self._instrument.disconnected()
        self._port = await asyncio.to_thread(open_port, self._line)

    def pump(self) -> None:
        """Take what came, and send what is due."""
        port = self._port
        if self._faulty.gone or self._pulled_ns is not None:
            self._pull_out()
            return
        if port is None:
            self._reopen()
            return
        try:
            self._notice(port.heard)
            self._receive(port.read())
            if self._heard:
                self._out.pump(self._write, self._clock.now_ns())
                self._faulty.flush(port.write)
                self._faulty.settle()
        except OSError:
            self._vanished()

    async def close(self) -> None:
        """Close the port once the other side has taken what has left; what has not left is lost."""
        await self._reopening.close()
        if self._heard and self._port is not None:
            await _emptied(self._port)
        self._notice(False)
        self._faulty.close()
        port, self._port = self._port, None
        if port is not None:
            await asyncio.to_thread(port.close)

    def advance_faults(self, stream_us: int) -> None:
        """See `Endpoint.advance_faults`."""
        self._faulty.advance(stream_us, self._out.begun)

    def inject(self, fault: Fault) -> None:
        """See `Endpoint.inject`."""
        self._faulty.inject(fault)

    @property
    def faults(self) -> tuple[FaultRecord, ...]:
        """See `Endpoint.faults`."""
        return self._faulty.records

    @property
    def state(self) -> str:
        """Who is at the other side, or what is waited for."""
        if self._port is None:
            return f"{self._line.port} is gone; looking for it"
        if not self._heard:
            return f"waiting for a reader of {self._port.address}"
        return f"{self._line.baud} baud on {self._port.address}"

    @property
    def address(self) -> str | None:
        """Path or URL of the port; for a pty, of the side that is for the reader."""
        return None if self._port is None else self._port.address

    @property
    def use(self) -> LineUse:
        """How full the line was."""
        return LineUse(self._baud.carried, self._baud.share(self._clock.now_ns()), self._baud.busiest_share)

    @property
    def counts(self) -> Mapping[str, int]:
        """Telecommands, back-pressure, reconnections."""
        unwrapped = self._commands.counters
        return {
            "telecommands": unwrapped.packets,
            "damaged_frames": self._instrument.frames_refused,
            "held_back": self._out.held,
            "reconnections": self._counts["reconnections"],
            "false_messages": self._faulty.false,
        }

    def _write(self, data: bytes) -> int:
        """Give bytes to the port, by way of the line's faults: the one way out."""
        return 0 if self._port is None else self._faulty.write(data, self._port.write)

    def _receive(self, data: bytes) -> None:
        """Take bytes of the other side: the one way in."""
        if not data:
            return
        for received in self._commands.push(data):
            self._instrument.command(received)
        counters = self._commands.counters
        self._instrument.frames_refused = sum(counters.frames.refused.values()) + sum(counters.refused.values())

    def _next_frame(self) -> Frame[Outgoing] | None:
        outgoing = self._instrument.next_message()
        return None if outgoing is None else Frame(self._profile.wrap(outgoing.message), outgoing)

    def _left(self, outgoing: Outgoing) -> None:
        self._instrument.sent(outgoing)
        self._faulty.left(outgoing)

    def _arrived(self, outgoing: Outgoing) -> None:
        self._deliveries.add(outgoing.events, outgoing.epoch_us, outgoing.edges)

    def _notice(self, heard: bool) -> None:
        """Follow whether somebody listens."""
        if heard == self._heard:
            return
        self._heard = heard
        if heard:
            self._baud.restart(self._clock.now_ns())
            self._instrument.connected()
        else:
            self._faulty.drop()
            for outgoing in self._out.drop():
                self._instrument.lost(outgoing)
            self._instrument.disconnected()

    def _pull_out(self) -> None:
        """Let the port vanish, but not what has left and waits in the kernel: that is on the wire."""
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
        self._notice(False)
        port, self._port = self._port, None
        if port is not None:
            asyncio.get_running_loop().run_in_executor(None, port.close)
        self._reopening.lost()

    def _reopen(self) -> None:
        """Try to open the port again, every half second, in a thread."""
        self._port = self._reopening.poll()
        if self._port is not None:
            self._counts["reconnections"] += 1


async def _emptied(port: Port) -> None:
    """Return when the other side has taken what the port was given, or after half a second."""
    looks = 0
    with suppress(TimeoutError):
        async with asyncio.timeout(_CLOSE_S):
            while looks < _CLOSE_LOOKS:
                looks = 0 if port.unsent else looks + 1
                await asyncio.sleep(_CLOSE_LOOK_S)
