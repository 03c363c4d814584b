"""A serial port in memory with the methods of pyserial's Serial, and an instrument at its other side.

    with FakeSerialPort("ccsds-cobs") as port:
        port.show(events)                  # EVENT array, stream time
        decoder_under_test(port.read(4096))

Telecommands that the program under test writes reach the instrument, and its answers come back. The line is as fast as
the program reads: a `read` returns at once with what there is, whatever the timeout. `damage` flips bits on the way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

from evstim.testing.moments import moments
from firmware_protocol.events import Events
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.profile import Profile

__all__ = ["FakeSerialPort"]


class FakeSerialPort:
    """The computer's side of the line.

    Parameters
    ----------
    profile : packets and framing, as in a rig: "ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss" or "fprime".
    size : (width, height) of the camera's array, pixels.
    settings : of the instrument.

    Attributes
    ----------
    instrument : the camera at the other side, with `counters`.
    damage : what happens to the bytes on their way to the computer; by default nothing.
    timeout, is_open, name : as in pyserial.
    """

    def __init__(
        self,
        profile: str = "ccsds-cobs",
        size: tuple[int, int] = (346, 260),
        settings: InstrumentSettings | None = None,
    ) -> None:
        self.instrument = Instrument(size, settings)
        self.damage: Callable[[bytes], bytes] = bytes
        self.timeout: float | None = 0.0
        self.is_open = True
        self.name = f"memory://{profile}"
        self._profile = Profile(profile)
        self._commands = self._profile.command_unwrapper()
        self._line = bytearray()
        self._t_us = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def show(self, events: Events, until_us: int | None = None) -> None:
        """Give the camera events (n,) EVENT of stream time, sorted, and let time go on to `until_us` (their last)."""
        for part, now_us in moments(events, self._t_us, until_us):
            self._t_us = now_us
            self.instrument.offer(part)
            self.instrument.advance(now_us)
            self._send()

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read."""
        self._check()
        return len(self._line)

    def read(self, size: int = 1) -> bytes:
        """Return at most `size` bytes, fewer where there are no more."""
        self._check()
        data = bytes(self._line[:size])
        del self._line[:size]
        return data

    def write(self, data: bytes) -> int:
        """Send telecommands to the camera; return how many bytes it took."""
        self._check()
        for command in self._commands.push(bytes(data)):
            self.instrument.command(command)
        self._send()
        return len(data)

    def flush(self) -> None:
        """Return when all has been written, which is at once."""
        self._check()

    def reset_input_buffer(self) -> None:
        """Throw away what has come."""
        self._check()
        self._line.clear()

    def close(self) -> None:
        """Hang up: events that come from now on are counted as not running."""
        if self.is_open:
            self.is_open = False
            self.instrument.disconnected()

    def _send(self) -> None:
        """Let everything leave that the instrument has to say."""
        while (outgoing := self.instrument.next_message()) is not None:
            self._line += self.damage(self._profile.wrap(outgoing.message))
            self.instrument.sent(outgoing)

    def _check(self) -> None:
        if not self.is_open:
            raise OSError(f"{self.name} is closed")
