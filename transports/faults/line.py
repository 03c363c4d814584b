"""What faults do to the bytes of a serial line. Sans-I/O; the same bytes in whatever pieces give the same result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from operator import itemgetter, mul

import numpy as np

from transports.faults.hit_places import Places
from transports.faults.kinds import (
    BitFlips,
    Burst,
    Fault,
    HitFault,
    InsertedBytes,
    LostBytes,
    Overrun,
    Stall,
    StuckLine,
    Unplugged,
    WrongBaud,
)

__all__ = ["ByteStage", "byte_stage"]

_NOISE_BYTES = 256
_WEIGHTS = tuple(1 << n for n in range(8))


class ByteStage(ABC):
    """One fault at work on a stream of bytes.

    Attributes
    ----------
    hits
        Times that it struck.
    touched
        Bytes that it changed, took away or put in.
    places
        Where it struck in the bytes given last, counted from their first.
    over
        True when it has nothing more to do.
    holds
        True where it lets no byte leave.
    gone
        True where it takes the port away.
    """

    holds = gone = False

    def __init__(self) -> None:
        self.hits = self.touched = 0
        self.places: list[int] = []
        self.over = False

    @abstractmethod
    def change(self, data: bytes) -> bytes:
        """Return what arrives of `data`."""

    def finish(self) -> bytes:
        """Return what arrives when the fault is over."""
        return b""

    def _strike(self, places: list[int], touched: int) -> None:
        self.places = places
        self.hits += len(places)
        self.touched += touched


class _Flips(ByteStage):
    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)

    def change(self, data: bytes) -> bytes:
        bits = self._where.within(8 * len(data))
        self._strike([bit >> 3 for bit in bits], len({bit >> 3 for bit in bits}))
        self.over = self._where.over
        if not bits:
            return data
        changed = bytearray(data)
        for bit in bits:
            changed[bit >> 3] ^= 1 << (bit & 7)
        return bytes(changed)


class _Insertions(ByteStage):
    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        super().__init__()
        where, self._bytes = random.spawn(2)
        self._where = Places(fault, where)

    def change(self, data: bytes) -> bytes:
        places = self._where.within(len(data))
        self._strike(places, len(places))
        self.over = self._where.over
        parts, begin = [], 0
        for place in places:
            parts += [data[begin:place], self._bytes.bytes(1)]
            begin = place
        return b"".join((*parts, data[begin:]))


class _Runs(ByteStage):
    """Runs of bytes, each begun at a place that is hit: `_run` says what becomes of one."""

    def __init__(self, fault: HitFault, random: np.random.Generator, skip: int, length: int) -> None:
        super().__init__()
        where, self._random = random.spawn(2)
        self._where = Places(fault, where)
        self._skip, self._length = skip, length
        self._kept = self._left = 0  # bytes still to pass, then to hit, of the run under way

    def change(self, data: bytes) -> bytes:
        self.places = []
        parts, at = [], 0
        while at < len(data):
            at, part = self._go_on(data, at) if self._kept or self._left else self._look(data, at)
            parts.append(part)
        self.over = self._where.over and not self._left
        return b"".join(parts)

    def _look(self, data: bytes, at: int) -> tuple[int, bytes]:
        """Pass bytes up to the next place, and begin a run there."""
        place = self._where.first(len(data) - at)
        if place is None:
            return len(data), data[at:]
        self._kept, self._left = self._skip, self._length
        self.places.append(at + place)
        self.hits += 1
        return at + place, data[at : at + place]

    def _go_on(self, data: bytes, at: int) -> tuple[int, bytes]:
        kept = data[at : at + self._kept]
        self._kept -= len(kept)
        hit = b"" if self._kept else data[at + len(kept) : at + len(kept) + self._left]
        self._left -= len(hit)
        self.touched += len(hit)
        return at + len(kept) + len(hit), kept + self._instead(len(hit))

    def _instead(self, count: int) -> bytes:
        return b""


class _Noise(_Runs):
    _drawn = b""

    def _instead(self, count: int) -> bytes:
        while len(self._drawn) < count:  # in portions of one size: a generator's bytes depend on how many are asked for
            self._drawn += self._random.bytes(_NOISE_BYTES)
        noise, self._drawn = self._drawn[:count], self._drawn[count:]
        return noise


class _Stuck(ByteStage):
    def __init__(self, fault: StuckLine) -> None:
        super().__init__()
        self._low = fault.level == "low"

    def change(self, data: bytes) -> bytes:
        first = self._low and not self.hits and bool(data)
        self._strike([0] if data and not self.hits else [], len(data))
        return b"\0" if first else b""


class _Hold(ByteStage):
    holds = True

    def __init__(self, fault: Stall | Unplugged) -> None:
        super().__init__()
        self.gone = isinstance(fault, Unplugged)
        self.hits = int(self.gone)

    def change(self, data: bytes) -> bytes:
        self.hits = 1
        return data


class _Resampled(ByteStage):
    """A UART that samples the bits of another: start bit, 8 data bits, stop bit, each as long as it thinks they are."""

    def __init__(self, fault: WrongBaud) -> None:
        super().__init__()
        self._bits = b""
        # The middle of its n-th bit, in bits of the sender from the falling edge of the start bit.
        self._middles = [int((n + 0.5) / fault.ratio) for n in range(10)]
        self._data_bits = itemgetter(*self._middles[1:9])

    def change(self, data: bytes) -> bytes:
        self._strike([0] if data and not self.hits else [], len(data))
        sent = np.zeros((len(data), 10), np.uint8)
        sent[:, 1:9] = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").reshape(-1, 8)
        sent[:, 9] = 1
        self._bits += sent.tobytes()
        return self._sample()

    def finish(self) -> bytes:
        self._bits += b"\1" * (self._middles[-1] + 1)  # the line idles, at last
        return self._sample()

    def _sample(self) -> bytes:
        bits, at, out = self._bits, 0, bytearray()
        first, stop, read = self._middles[0], self._middles[-1], self._data_bits
        while (start := bits.find(b"\0", at)) >= 0 and start + stop < len(bits):
            if bits[start + first]:  # too short for a start bit
                at = start + first
                continue
            out.append(sum(map(mul, read(bits[start : start + stop + 1]), _WEIGHTS)))
            # A UART looks for the next start bit from the middle of the stop bit on.
            at = start + stop if bits[start + stop] else start + stop + 1
        self._bits = b"" if start < 0 else bits[start:]
        return bytes(out)


def byte_stage(fault: Fault, random: np.random.Generator, bytes_per_s: float) -> ByteStage:
    """Return what this fault does to a line of `bytes_per_s`; raises ValueError for one that a line does not have."""
    match fault:
        case BitFlips():
            return _Flips(fault, random)
        case InsertedBytes():
            return _Insertions(fault, random)
        case LostBytes():
            return _Runs(fault, random, 0, 1)
        case Burst():
            return _Noise(fault, random, 0, fault.length)
        case Overrun():
            missed = round(fault.late_us * 1e-6 * bytes_per_s) - fault.fifo_bytes
            return _Runs(fault, random, fault.fifo_bytes, max(0, missed))
        case StuckLine():
            return _Stuck(fault)
        case WrongBaud():
            return _Resampled(fault)
        case Stall() | Unplugged():
            return _Hold(fault)
    raise ValueError(f"{fault.kind!r} is no fault of a serial line")
