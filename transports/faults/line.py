"""Faults of a serial line: their tables in a rig, and their effects on its bytes. Sans-I/O.

See `kinds` for the attributes that all faults have. The same bytes in any division give the same result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from operator import itemgetter, mul
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from transports.faults.kinds import DATAGRAMS, SERIAL_LINE, Fault, HitFault, LastingFault, Places, Stage

_NOISE_BYTES = 256
_WEIGHTS = tuple(1 << n for n in range(8))


class ByteStage(Stage, ABC):
    """One active fault on a stream of bytes.

    Attributes
    ----------
    places : places of its hits in the bytes of the last call, counted from their first.
    holds : True if no byte can leave.
    gone : True if it removes the port.
    """

    holds = gone = False

    def __init__(self, fault: Any, random: np.random.Generator, carrier: Any = None) -> None:
        super().__init__(fault, random, carrier)
        self.places: list[int] = []

    @abstractmethod
    def change(self, data: bytes) -> bytes:
        """Return the bytes that arrive in place of `data`."""

    def finish(self) -> bytes:
        """Return the bytes that arrive at the end of the fault."""
        return b""

    def _hit(self, places: list[int], touched: int) -> None:
        self.places = places
        self.count(len(places), touched)


class _Flips(ByteStage):
    def change(self, data: bytes) -> bytes:
        bits = self._where.within(8 * len(data))
        self._hit([bit >> 3 for bit in bits], len({bit >> 3 for bit in bits}))
        self.over = self._where.over
        if not bits:
            return data
        changed = bytearray(data)
        for bit in bits:
            changed[bit >> 3] ^= 1 << (bit & 7)
        return bytes(changed)


@dataclass(frozen=True)
class BitFlips(HitFault, carriers=(SERIAL_LINE, DATAGRAMS), effect=_Flips):
    """Single inverted bits: noise on the line. `rate` is the bit error rate."""


class _Insertions(ByteStage):
    def __init__(self, fault: HitFault, random: np.random.Generator, carrier: Any = None) -> None:
        super().__init__(fault, random, carrier)
        where, self._bytes = random.spawn(2)
        self._where = Places(fault, where)

    def change(self, data: bytes) -> bytes:
        self.places = self.hit_places(len(data))
        parts, begin = [], 0
        for place in self.places:
            parts += [data[begin:place], self._bytes.bytes(1)]
            begin = place
        return b"".join((*parts, data[begin:]))


@dataclass(frozen=True)
class InsertedBytes(HitFault, carriers=(SERIAL_LINE,), effect=_Insertions):
    """Random bytes that the camera did not send, inserted before the bytes that are hit."""


class _Runs(ByteStage):
    """Runs of bytes, each begun at a place that is hit: `_instead` returns the replacement of a run."""

    def __init__(self, fault: HitFault, random: np.random.Generator, skip: int, length: int) -> None:
        super().__init__(fault, random)
        where, self._random = random.spawn(2)
        self._where = Places(fault, where)
        self._skip, self._length = skip, length
        self._unchanged = self._left = 0  # bytes of the current run that still pass, and that are then hit

    def change(self, data: bytes) -> bytes:
        self.places = []
        parts, at = [], 0
        while at < len(data):
            at, part = self._go_on(data, at) if self._unchanged or self._left else self._look(data, at)
            parts.append(part)
        self.over = self._where.over and not self._left
        return b"".join(parts)

    def _look(self, data: bytes, at: int) -> tuple[int, bytes]:
        """Pass bytes up to the next place, and begin a run there."""
        place = self._where.first(len(data) - at)
        if place is None:
            return len(data), data[at:]
        self._unchanged, self._left = self._skip, self._length
        self.places.append(at + place)
        self.hits += 1
        return at + place, data[at : at + place]

    def _go_on(self, data: bytes, at: int) -> tuple[int, bytes]:
        unchanged = data[at : at + self._unchanged]
        self._unchanged -= len(unchanged)
        hit = b"" if self._unchanged else data[at + len(unchanged) : at + len(unchanged) + self._left]
        self._left -= len(hit)
        self.touched += len(hit)
        return at + len(unchanged) + len(hit), unchanged + self._instead(len(hit))

    def _instead(self, count: int) -> bytes:
        return b""


@dataclass(frozen=True)
class LostBytes(HitFault, carriers=(SERIAL_LINE,)):
    """Single bytes that never arrive."""

    def stage(self, random: np.random.Generator, carrier: float) -> Stage:
        """Return the loss of runs of one byte."""
        return _Runs(self, random, 0, 1)


@dataclass(frozen=True)
class Overrun(HitFault, carriers=(SERIAL_LINE,)):
    """The receiver empties its FIFO too late: it keeps the bytes that fit, and loses the others until then.

    Attributes
    ----------
    late_us : time from the byte that is hit until the receiver reads again.
    fifo_bytes : number of bytes that it keeps until then: 16 in a 16550, 1 in a UART without a FIFO.
    """

    late_us: Annotated[float, Meta(gt=0, le=1e7)] = 1000.0
    fifo_bytes: Annotated[int, Meta(ge=1, le=65_536)] = 16

    def stage(self, random: np.random.Generator, carrier: float) -> Stage:
        """Return the loss of the bytes that a line of `carrier` bytes a second brings before the receiver reads."""
        missed = round(self.late_us * 1e-6 * carrier) - self.fifo_bytes
        return _Runs(self, random, self.fifo_bytes, max(0, missed))


class _Noise(_Runs):
    _drawn = b""

    def _instead(self, count: int) -> bytes:
        while len(self._drawn) < count:  # in portions of one size: a generator's bytes depend on the number requested
            self._drawn += self._random.bytes(_NOISE_BYTES)
        noise, self._drawn = self._drawn[:count], self._drawn[count:]
        return noise


@dataclass(frozen=True)
class Burst(HitFault, carriers=(SERIAL_LINE,)):
    """A burst of noise: a run of bytes replaced by random ones.

    Attributes
    ----------
    length : bytes of one burst.
    """

    length: Annotated[int, Meta(ge=1, le=1_000_000)] = 32

    def stage(self, random: np.random.Generator, carrier: float) -> Stage:
        """Return random bytes in place of runs of `length`."""
        return _Noise(self, random, 0, self.length)


class _Stuck(ByteStage):
    def change(self, data: bytes) -> bytes:
        first = self._fault.level == "low" and not self.hits and bool(data)
        self._hit([0] if data and not self.hits else [], len(data))
        return b"\0" if first else b""


@dataclass(frozen=True)
class StuckLine(LastingFault, carriers=(SERIAL_LINE,), effect=_Stuck):
    """The line stays at one level: bytes sent in this time are lost.

    Attributes
    ----------
    level : "low": a break, from which a UART makes one zero byte; "high": a broken wire, on which nothing arrives.
    """

    level: Literal["low", "high"] = "low"


class _Hold(ByteStage):
    holds = True

    def change(self, data: bytes) -> bytes:
        self.hits = 1
        return data


@dataclass(frozen=True)
class Stall(LastingFault, carriers=(SERIAL_LINE,), effect=_Hold):
    """The receiver stops the sender (XOFF, RTS, a full buffer): no byte leaves, and the camera's queue fills."""


class _Absence(_Hold):
    gone = True

    def __init__(self, fault: Fault, random: np.random.Generator, carrier: Any) -> None:
        super().__init__(fault, random, carrier)
        self.hits = 1


@dataclass(frozen=True)
class Unplugged(LastingFault, carriers=(SERIAL_LINE,), effect=_Absence):
    """The port disappears and returns, like an adapter that is unplugged; it is found again within half a second."""

    disconnects: ClassVar[bool] = True


class _Resampled(ByteStage):
    """UART that samples the bits of another at its own rate: start bit, 8 data bits, stop bit."""

    def __init__(self, fault: WrongBaud, random: np.random.Generator, carrier: Any) -> None:
        super().__init__(fault, random, carrier)
        self._bits = b""
        # Middle of its n-th bit, in bits of the sender from the falling edge of the start bit.
        self._middles = [int((n + 0.5) / fault.ratio) for n in range(10)]
        self._data_bits = itemgetter(*self._middles[1:9])

    def change(self, data: bytes) -> bytes:
        self._hit([0] if data and not self.hits else [], len(data))
        sent = np.zeros((len(data), 10), np.uint8)
        sent[:, 1:9] = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").reshape(-1, 8)
        sent[:, 9] = 1
        self._bits += sent.tobytes()
        return self._sample()

    def finish(self) -> bytes:
        self._bits += b"\1" * (self._middles[-1] + 1)  # the line is idle at the end
        return self._sample()

    def _sample(self) -> bytes:
        bits = self._bits
        first = self._middles[0]
        stop = self._middles[-1]
        out = bytearray()
        at = 0
        while (start := bits.find(b"\0", at)) >= 0 and start + stop < len(bits):
            if bits[start + first]:  # too short for a start bit
                at = start + first
                continue
            out.append(sum(map(mul, self._data_bits(bits[start : start + stop + 1]), _WEIGHTS)))
            # A UART looks for the next start bit from the middle of the stop bit on.
            at = start + stop if bits[start + stop] else start + stop + 1
        self._bits = b"" if start < 0 else bits[start:]
        return bytes(out)


@dataclass(frozen=True)
class WrongBaud(LastingFault, carriers=(SERIAL_LINE,), effect=_Resampled):
    """The receiver samples the line at another baud rate: garbage, computed from the bits.

    Attributes
    ----------
    ratio : baud rate of the receiver over that of the sender.
    """

    ratio: Annotated[float, Meta(ge=0.1, le=10)] = 2.0
