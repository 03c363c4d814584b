"""Faults of a serial line: their effects on its bytes, and the messages that they destroy.

`ByteStage` is one active fault. It is sans-I/O: the same bytes in any division give the same result.

`ReferenceReceiver` decodes the damaged line as an intact receiver does, and so determines the messages that faults
destroyed. It receives only from the beginning of a fault until whole messages arrive again.

    sender --bytes or frames--> faults --+--> port or bus
           --left--> expected            +--> reader, as at the other side --> came, compared with `expected`

`FaultyLine` is between the endpoint's output and its port:

    endpoint._write --> stage --> stage --> [bytes for which the port had no room] --> port
                                   |
                                   +--> ReferenceReceiver: the messages that an intact receiver gets

While no fault is active bytes pass unchanged and are not decoded. A byte that entered a stage counts as sent by the
camera. If the port has no room for it, it waits here, and later bytes are refused, as by a full port.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from operator import itemgetter, mul

import numpy as np

from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.addresses import Message, Received
from firmware_protocol.packets.profile import Profile, Unwrapper
from transports.faults.kinds import (
    BitFlips,
    Burst,
    Fault,
    HitFault,
    InsertedBytes,
    LostBytes,
    Overrun,
    Places,
    Stall,
    StuckLine,
    Unplugged,
    WrongBaud,
)
from transports.faults.script import FaultPlan, FaultRecord, Faults

__all__ = ["ByteStage", "FaultyLine", "ReferenceReceiver", "byte_stage"]


_NOISE_BYTES = 256
_WEIGHTS = tuple(1 << n for n in range(8))


class ByteStage(ABC):
    """One active fault on a stream of bytes.

    Attributes
    ----------
    hits
        Number of times that it was applied.
    touched
        Number of bytes that it changed, removed or inserted.
    places
        Places of its hits in the bytes of the last call, counted from their first.
    over
        True when it has no further effect.
    holds
        True if no byte can leave.
    gone
        True if it removes the port.
    """

    holds = gone = False

    def __init__(self) -> None:
        self.hits = self.touched = 0
        self.places: list[int] = []
        self.over = False

    @abstractmethod
    def change(self, data: bytes) -> bytes:
        """Return the bytes that arrive in place of `data`."""

    def finish(self) -> bytes:
        """Return the bytes that arrive at the end of the fault."""
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
    """Runs of bytes, each begun at a place that is hit: `_instead` returns the replacement of a run."""

    def __init__(self, fault: HitFault, random: np.random.Generator, skip: int, length: int) -> None:
        super().__init__()
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


class _Noise(_Runs):
    _drawn = b""

    def _instead(self, count: int) -> bytes:
        while len(self._drawn) < count:  # in portions of one size: a generator's bytes depend on the number requested
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
    """UART that samples the bits of another at its own rate: start bit, 8 data bits, stop bit."""

    def __init__(self, fault: WrongBaud) -> None:
        super().__init__()
        self._bits = b""
        # Middle of its n-th bit, in bits of the sender from the falling edge of the start bit.
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
        self._bits += b"\1" * (self._middles[-1] + 1)  # the line is idle at the end
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
    """Return the stage of a fault on a line of `bytes_per_s`.

    Raises ValueError for a fault that a line does not have.
    """
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


_IN_STEP = 2  # consecutive messages: the beginning of the first one may have been damaged before


class ReferenceReceiver:
    """Decoder that determines the messages that survived, in order.

    Attributes
    ----------
    false
        Number of messages that arrived but were not sent, or arrived again.
    """

    def __init__(self) -> None:
        self._expected: deque[Outgoing] = deque()
        self._came: deque[Message] = deque()
        self._in_step = 0
        self.false = 0

    @property
    def in_step(self) -> bool:
        """True when no message is outstanding and messages arrive whole again."""
        return not self._expected and self._in_step >= _IN_STEP

    def came(self, received: Iterable[Received]) -> None:
        """Add the messages that an intact receiver decodes from the arrived bytes."""
        self._came += [each.message for each in received]

    def left(self, outgoing: Outgoing) -> None:
        """Add a message whose last byte has left, damaged or not."""
        self._expected.append(outgoing)

    def settle(self) -> tuple[list[Outgoing], list[Outgoing]]:
        """Return the messages that arrived whole since the last call, and those that are now known to be lost."""
        came: list[Outgoing] = []
        lost: list[Outgoing] = []
        while self._came:
            message = self._came.popleft()
            place = next((n for n, each in enumerate(self._expected) if _same(each.message, message)), None)
            if place is None:
                self.false += 1
                continue
            self._in_step = self._in_step + 1 if place == 0 else 1
            lost += [self._expected.popleft() for _ in range(place)]
            came.append(self._expected.popleft())
        return came, lost

    def give_up(self) -> list[Outgoing]:
        """Return the outstanding messages, which can no longer arrive."""
        lost = list(self._expected)
        self._expected.clear()
        return lost

    def damaged(self) -> None:
        """Record that a fault was active until now."""
        self._in_step = 0


def _same(sent: Message, came: Message) -> bool:
    return sent.kind is came.kind and sent.payload == came.payload


_Write = Callable[[bytes], int]


class FaultyLine:
    """Serial line with fault injection.

    Parameters
    ----------
    profile
        Packets and framing of the messages.
    bytes_per_s
        The line's capacity.
    arrived
        Called with each message that an intact receiver gets.
    """

    def __init__(self, plan: FaultPlan, profile: str, bytes_per_s: float, arrived: Callable[[Outgoing], None]) -> None:
        self._faults: Faults[ByteStage] = Faults(plan, partial(byte_stage, bytes_per_s=bytes_per_s))
        self._profile = profile
        self._arrived = arrived
        self._reference: ReferenceReceiver | None = None
        self._unwrapper: Unwrapper | None = None
        self._rest = b""
        self._sent = 0
        self.false = 0

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """Record of each fault."""
        return self._faults.records

    @property
    def lost(self) -> tuple[int, int]:
        """Number of events and edges that faults destroyed."""
        return self._faults.lost

    @property
    def gone(self) -> bool:
        """True while a fault has removed the port."""
        return any(stage.gone for stage in self._faults.stages)

    @property
    def next_us(self) -> int:
        """See `Faults.next_us`."""
        return self._faults.next_us

    def advance(self, now_us: int, begun: bytes) -> None:
        """Advance stream time; `begun` is the sent part of the current frame on the line."""
        for stage in self._faults.advance(now_us):
            self._arrive(stage.finish())
            if self._reference is not None:
                self._reference.damaged()
        self._watch(begun)

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for a fault that a line does not have."""
        self._faults.inject(fault)

    def write(self, data: bytes, port: _Write) -> int:
        """Send bytes through the faults; return the number of accepted bytes."""
        if not self.flush(port) or any(stage.holds for stage in self._hold(data)):
            return 0
        if self._faults.stages:
            taken = len(data)
            self._arrive(self._changed(data))
            self.flush(port)
        else:
            taken = port(data)
            self._see(data[:taken])
        self._sent += taken
        return taken

    def flush(self, port: _Write) -> bool:
        """Pass the waiting bytes to the port; return True if it accepted all of them."""
        if self._rest:
            self._rest = self._rest[port(self._rest) :]
        return not self._rest

    def left(self, outgoing: Outgoing) -> None:
        """Record that the last byte of a message has left."""
        if self._reference is None:
            self._arrived(outgoing)
        else:
            self._reference.left(outgoing)

    def settle(self) -> None:
        """Determine the fates of the messages that have left."""
        if self._reference is None:
            return
        came, lost = self._reference.settle()
        self._lose(lost)
        for outgoing in came:
            self._arrived(outgoing)
        self.false += self._reference.false
        self._reference.false = 0
        if self._reference.in_step and not self._faults.stages:
            self._reference = None

    def drop(self) -> None:
        """Discard the messages in progress: the line or its receiver is lost."""
        self._rest = b""
        if self._reference is not None:
            self.settle()
        if self._reference is not None:
            self._lose(self._reference.give_up())
            self._reference = None

    def close(self) -> None:
        """End all faults."""
        self.drop()
        self._faults.close()

    def _watch(self, begun: bytes) -> None:
        if self._faults.stages and self._reference is None:
            self._reference, self._unwrapper = ReferenceReceiver(), Profile(self._profile).unwrapper()
            self._see(begun)

    def _hold(self, data: bytes) -> list[ByteStage]:
        holding = [stage for stage in self._faults.stages if stage.holds]
        for stage in holding:
            before = stage.hits
            stage.change(data)
            if stage.hits != before:
                self._faults.applied(stage, [self._sent])
        return holding

    def _changed(self, data: bytes) -> bytes:
        for stage in self._faults.stages:
            before = stage.touched
            data = stage.change(data)
            if stage.touched != before or stage.places:
                self._faults.applied(stage, [self._sent + place for place in stage.places])
        return data

    def _arrive(self, data: bytes) -> None:
        self._rest += data
        self._see(data)

    def _see(self, data: bytes) -> None:
        if self._reference is not None and self._unwrapper is not None:
            self._reference.came(self._unwrapper.push(data))

    def _lose(self, lost: list[Outgoing]) -> None:
        for outgoing in lost:
            self._faults.lose(len(outgoing.events), len(outgoing.edges))
