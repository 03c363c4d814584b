"""Events in classic CAN frames that each stand alone: two events in eight bytes, no reassembly, lowest latency.

An events frame, one little-endian 64-bit number:

    bit    0..15    16..18   19..25   26..34  35..43  44     45..53  54..62  63
           t        seq      dt       x0      y0      on0    x1      y1      on1

    t     time of the first event, in ticks, low 16 bits
    seq   counts events frames, modulo 8
    dt    ticks from the first event to the second, 0..126; 127: there is no second event, and its bits are 0

An epoch frame says where the 16 bits of time lie, and how many events there have been:

    u32   bits 0..29 time in ticks, low 30 bits; bits 30..31 tick (0: 1 us, 1: 10 us, 2: 100 us, 3: 1000 us)
    u16   events sent since the start, modulo 65536
    u16   events dropped before they could be sent, modulo 65536

A clock frame says all 64 bits of the time, in us, as a little-endian number; an epoch frame of the same time follows.
Events frames and epoch frames hold low bits of one number, the time in whole ticks, so any two of them agree.

The time of a frame is the one nearest to the time last told, by whichever frame. The sender puts an epoch frame before
each event that lies 2^15 ticks or more from there, and one every few milliseconds in any case; a clock frame once a
second, and where the time jumps by a second or more. A lost events frame
loses its own two events; the receiver finds it by `seq`, and the exact number by the next epoch frame, whose counts
tell also what was dropped. Eight lost in a row escape `seq`, not the counts.

Nine bits each for column and row: sensors of up to 512x512 pixels.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events, empty_events

__all__ = [
    "RAW_LIMIT_PX",
    "TICKS_US",
    "Epoch",
    "EventsFrame",
    "RawError",
    "pack_clock",
    "pack_events",
    "unpack_clock",
    "unpack_events",
    "unwrapped",
]

TICKS_US = (1, 10, 100, 1000)
"""Ticks by their code."""

RAW_LIMIT_PX = 512
"""Columns and rows that nine bits can number."""

_NO_SECOND = 127
_EPOCH = struct.Struct("<IHH")
_CLOCK = struct.Struct("<Q")


class RawError(ValueError):
    """A frame is none of these; the message says why."""


@dataclass(frozen=True)
class Epoch:
    """What an epoch frame says.

    Attributes
    ----------
    ticks
        Low 30 bits of the time, in ticks: unwrap it near the time expected (`unwrapped`).
    tick_us
        Of this time and of the events frames that follow.
    sent, dropped
        Events since the start, modulo 65536.
    """

    ticks: int
    tick_us: int
    sent: int
    dropped: int

    def __bytes__(self) -> bytes:
        code = TICKS_US.index(self.tick_us)
        return _EPOCH.pack((self.ticks & 0x3FFF_FFFF) | code << 30, self.sent & 0xFFFF, self.dropped & 0xFFFF)

    @classmethod
    def parse(cls, data: bytes) -> Epoch:
        """Read the eight bytes; raises RawError on any other length."""
        if len(data) != _EPOCH.size:
            raise RawError(f"an epoch frame has {_EPOCH.size} bytes, not {len(data)}")
        word, sent, dropped = _EPOCH.unpack(data)
        return cls(word & 0x3FFF_FFFF, TICKS_US[word >> 30], sent, dropped)


def pack_clock(t_us: int) -> bytes:
    """Return the data of a clock frame."""
    return _CLOCK.pack(t_us)


def unpack_clock(data: bytes) -> int:
    """Return the time of a clock frame, us; raises RawError on any other length, or a time of 2^63 us or more."""
    if len(data) != _CLOCK.size:
        raise RawError(f"a clock frame has {_CLOCK.size} bytes, not {len(data)}")
    (t_us,) = _CLOCK.unpack(data)
    if t_us >> 63:
        raise RawError(f"a clock frame says {t_us} us, which no camera reaches")
    return int(t_us)


@dataclass(frozen=True)
class EventsFrame:
    """What an events frame says; `events` carry the full time, in us."""

    seq: int
    events: Events


def pack_events(events: Events, tick_us: int, seq: int) -> tuple[list[bytes], npt.NDArray[np.int64]]:
    """Pack events (n,), sorted, into the data of events frames; `seq` is that of the first.

    Returns the data of each frame, and the index of its first event, shape (frames,). Raises RawError where a pixel
    lies beyond nine bits.
    """
    if not len(events):
        return [], np.zeros(0, np.int64)
    if int(events["x"].max()) >= RAW_LIMIT_PX or int(events["y"].max()) >= RAW_LIMIT_PX:
        raise RawError(f"an events frame numbers {RAW_LIMIT_PX} columns and rows; send larger sensors in blocks")
    ticks = events["t"] // np.uint64(tick_us)
    first = _first_of_each(ticks)
    second = np.minimum(first + 1, len(events) - 1)
    paired = np.append(first[1:], len(events)) - first == 2
    pixels = _pixel_bits(events)
    words = ticks[first] & np.uint64(0xFFFF)
    words |= ((np.arange(len(first), dtype=np.uint64) + np.uint64(seq)) & np.uint64(7)) << np.uint64(16)
    dt = np.where(paired, ticks[second] - ticks[first], np.uint64(_NO_SECOND))
    words |= dt << np.uint64(19) | pixels[first] << np.uint64(26)
    words |= np.where(paired, pixels[second], np.uint64(0)) << np.uint64(45)
    raw = words.astype("<u8").tobytes()
    return [raw[i : i + 8] for i in range(0, len(raw), 8)], first


def _first_of_each(ticks: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
    """Return the index of the first event of each frame: in a run of events close enough, every other one."""
    index = np.arange(len(ticks))
    starts_run = np.append(True, ticks[1:] - ticks[:-1] >= _NO_SECOND)
    run_start: npt.NDArray[np.int64] = np.maximum.accumulate(np.where(starts_run, index, 0))
    first: npt.NDArray[np.int64] = index[(index - run_start) % 2 == 0]
    return first


def _pixel_bits(events: Events) -> npt.NDArray[np.uint64]:
    x, y, on = (events[name].astype(np.uint64) for name in ("x", "y", "on"))
    bits: npt.NDArray[np.uint64] = x | y << np.uint64(9) | on << np.uint64(18)
    return bits


def unpack_events(data: bytes, tick_us: int, near_us: int) -> EventsFrame:
    """Read an events frame, its time taken nearest to `near_us`; raises RawError on what no sender makes."""
    if len(data) != 8:
        raise RawError(f"an events frame has 8 bytes, not {len(data)}")
    word = int.from_bytes(data, "little")
    ticks = unwrapped(word & 0xFFFF, 16, near_us // tick_us)
    dt = word >> 19 & 0x7F
    if dt == _NO_SECOND and word >> 45:
        raise RawError("an events frame without a second event has bits for one")
    events = empty_events(1 if dt == _NO_SECOND else 2)
    for record, (at, bits) in zip(events, ((ticks, word >> 26), (ticks + dt, word >> 45)), strict=False):
        record["t"], record["x"], record["y"], record["on"] = at * tick_us, bits & 511, bits >> 9 & 511, bits >> 18 & 1
    return EventsFrame(word >> 16 & 7, events)


def unwrapped(low: int, bits: int, near: int) -> int:
    """Return the number with these low `bits` that is nearest to `near`, and not negative."""
    span = 1 << bits
    value = near + (low - near + (span >> 1)) % span - (span >> 1)
    return value if value >= 0 else value + span
