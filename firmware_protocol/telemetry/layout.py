"""The header of every event block, the constants of the format, and events in the order of a block.

     byte   7     6     5     4     3     2     1     0
          +-----+-----+-----+-----+-----+-----+-----+-----+
       0  |      version = 1      |         mode          |
          +-----------+-----------+-----------------------+
       1  | tick code | polarity  |       0 (reserved)    |
          +-----------+-----------+-----------------------+
     2-3  |  n: events or edges in the block              |
     4-7  |  t_base: low 32 bits of the first time, us    |
     8-9  |  dropped since the last block, saturating     |
   10-12  |  W - 1, 12 bits;  H - 1, 12 bits              |
      13  |  CRC-8/AUTOSAR of bytes 0 to 12               |
          +-----------------------------------------------+

Most significant bit and byte first. docs/packets.md describes the whole format, payloads included.

`firmware_protocol.compiled` describes the compilation of the loops of this folder.

A block has its events sorted by tick and address. An event is one number here, its key: (ticks * N + address) << 1 |
polarity. Sorting keys puts a block in order, and differences of neighbours are the steps that ROWS writes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import Bytes, EdgeKind, Int64s
from firmware_protocol.wire_layout import Field, Layout, choices_of

VERSION = 1
HEADER_BYTES = 14
MAX_COUNT = 65535  # events in a block, and the largest value of `dropped`
MAX_SIDE = 4096
LONGEST_US = (1 << 31) - 1  # from the first to the last time in a block
MAX_K = 27  # Rice parameter; steps stay below 2**31
ESCAPE_ONES = 16  # after this number of ones a Rice code has no value but is followed by an escape
TICKS_US = (1, 10, 100, 1000)

EDGE_LAYOUT = Layout(
    Field("t", 32, "time after t_base", "us"),
    Field("kind", 8, "kind of the edge", choices=choices_of(EdgeKind)),
    Field("channel", 8, "number of the input"),
    Field("seq", 16, "number of the edge at its source"),
)
"""The record of an edge in a block: us since t_base, and as in the EDGE record."""
EDGE_RECORD = EDGE_LAYOUT.dtype


class BlockError(ValueError):
    """The bytes are no event block: the line damaged them, or the sender violates the format."""


class Mode(IntEnum):
    """Coding of a block's payload."""

    FLAT = 0
    ROWS = 1
    BITMAP = 2
    EDGE = 3


class Polarity(IntEnum):
    """Position of the events' polarity in a block."""

    EACH = 0
    ALL_OFF = 2
    ALL_ON = 3


HEADER_LAYOUT = Layout(
    Field("block_version", 4, "version of the block", fixed=VERSION),
    Field("mode", 4, "coding of the payload", choices=choices_of(Mode)),
    Field("tick_code", 2, "unit of time of the payload", choices={n: f"US_{us}" for n, us in enumerate(TICKS_US)}),
    Field("polarity", 2, "position of the events' polarity", choices=choices_of(Polarity)),
    Field("block_reserved", 4, "reserved", fixed=0),
    Field("count", 16, "events or edges in the block"),
    Field("t_base", 32, "low 32 bits of the time of the first one", "us"),
    Field("dropped", 16, "dropped before these since the last block; 65535 is that many or more"),
    Field("width_less_1", 12, "width of the sensor less one", "px"),
    Field("height_less_1", 12, "height of the sensor less one", "px"),
    Field("crc8", 8, "CRC-8 of the octets of the block before it"),
)
"""Layout of the 14 bytes above."""


def _crc8_of(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ (0x2F if byte & 0x80 else 0)
    return byte & 0xFF


_CRC8 = bytes(_crc8_of(byte) for byte in range(256))


def crc8(data: bytes) -> int:
    """Return CRC-8/AUTOSAR: polynomial 0x2F, initial value and final XOR 0xFF, not reflected; 0xDF of "123456789"."""
    crc = 0xFF
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc ^ 0xFF


@dataclass(frozen=True)
class Header:
    """Header of a block; `size` = (width, height), `t_base` the low 32 bits of its first time in us."""

    mode: Mode
    tick_us: int
    polarity: Polarity
    count: int
    t_base: int
    dropped: int
    size: tuple[int, int]

    def pack(self) -> bytes:
        """Return the 14 bytes."""
        data = HEADER_LAYOUT.pack(
            mode=self.mode,
            tick_code=TICKS_US.index(self.tick_us),
            polarity=self.polarity,
            count=self.count,
            t_base=self.t_base,
            dropped=self.dropped,
            width_less_1=self.size[0] - 1,
            height_less_1=self.size[1] - 1,
            crc8=0,
        )[:-1]
        return data + bytes((crc8(data),))

    @classmethod
    def parse(cls, data: bytes) -> Header:
        """Read the header of the block `data`; raises BlockError if it is damaged or is not one of this version."""
        if len(data) < HEADER_BYTES:
            raise BlockError(f"a block has at least {HEADER_BYTES} bytes, this has {len(data)}")
        values = HEADER_LAYOUT.unpack(data[:HEADER_BYTES])
        if crc8(data[: HEADER_BYTES - 1]) != values["crc8"]:
            raise BlockError("the CRC-8 of the header is wrong")
        version, mode, polarity, count = (values[name] for name in ("block_version", "mode", "polarity", "count"))
        if version != VERSION or mode > Mode.EDGE:
            raise BlockError(f"version {version}, mode {mode}: this decoder supports version {VERSION}, modes 0 to 3")
        if values["block_reserved"] or polarity == 1 or (polarity and mode in (Mode.FLAT, Mode.EDGE)):
            raise BlockError(f"reserved bits or polarity are set: 0x{data[1]:02x} in mode {Mode(mode).name}")
        if (not count and mode != Mode.FLAT) or (values["tick_code"] and mode == Mode.EDGE):
            raise BlockError(f"a block of mode {Mode(mode).name} has no count {count} with tick code {data[1] >> 6}")
        return cls(
            mode=Mode(mode),
            tick_us=TICKS_US[values["tick_code"]],
            polarity=Polarity(polarity),
            count=count,
            t_base=values["t_base"],
            dropped=values["dropped"],
            size=(values["width_less_1"] + 1, values["height_less_1"] + 1),
        )


entry = entry_of("firmware_protocol.telemetry")

OUTSIDE, BACKWARDS = -1, -2
"""Return value of `load`, in place of a count, for events that are not valid for this sensor."""

_EVENT_BYTES = 13
_DIGIT_BITS = 11  # of a radix sort, at most
_FEW = 48  # a tick with fewer events is sorted by insertion


class Form(NamedTuple):
    """The sensor and the unit of time: pixels, bits of a column and of a row, us."""

    width: int
    height: int
    bx: int
    by: int
    tick_us: int


def form_of(size: tuple[int, int], tick_us: int) -> Form:
    """Return the form of blocks of a sensor of `size` = (width, height)."""
    return Form(*size, (size[0] - 1).bit_length(), (size[1] - 1).bit_length(), tick_us)


class Scratch(NamedTuple):
    """Room for one block; (max_events + 1,) each but the last two."""

    arrival: Int64s  # keys in the order of arrival
    keys: Int64s  # keys in order
    spare: Int64s
    ticks: Int64s
    steps: Int64s  # steps[i]: from event i - 1 to event i
    starts: Int64s  # of spans: index of the first event
    span_steps: Int64s
    lengths: Int64s  # of spans: pixels - 1
    counts: Int64s  # (2048,) of a radix sort
    bits: Int64s  # (3,) bits not yet written, their number, position in bytes


def new_scratch(max_events: int) -> Scratch:
    """Return room for blocks of up to `max_events` events."""
    arrival, keys, spare, ticks, steps, starts, span_steps, lengths = np.zeros((8, max_events + 1), np.int64)
    counts, bits = np.zeros(1 << _DIGIT_BITS, np.int64), np.zeros(3, np.int64)
    return Scratch(arrival, keys, spare, ticks, steps, starts, span_steps, lengths, counts, bits)


@kernel
def load(events: Bytes, form: Form, limit: int, room: Scratch) -> int:
    """Make keys of the first events, as many as a block may span; return their number, or a fault code."""
    start, last = _time_of(events, 0), 0
    if start < 0:  # 2**63 us and more
        return BACKWARDS
    start -= start % form.tick_us
    pixels = form.width * form.height
    count = min(limit, len(events) // _EVENT_BYTES)
    for i in range(count):
        at = i * _EVENT_BYTES
        since = _time_of(events, at) - start
        x = events[at + 8] | np.int64(events[at + 9]) << 8
        y = events[at + 10] | np.int64(events[at + 11]) << 8
        if x >= form.width or y >= form.height:
            return OUTSIDE
        if since < last:
            return BACKWARDS
        if since > LONGEST_US:
            return i
        last = since
        tick = since if form.tick_us == 1 else since // form.tick_us
        on = np.int64(events[at + 12] != 0)
        room.ticks[i] = tick
        room.arrival[i] = (tick * pixels + y * form.width + x) << 1 | on
    return count


@kernel
def _time_of(events: Bytes, at: int) -> int:
    time = np.int64(0)
    for i in range(8):
        time |= np.int64(events[at + i]) << 8 * i
    return int(time)


@kernel
def sort(count: int, form: Form, room: Scratch) -> None:
    """Sort the first `count` keys, preserving the order of events of one pixel in one tick."""
    keys = room.keys
    for i in range(count):
        keys[i] = room.arrival[i]
    begin = 0
    while begin < count:
        end, sorted_so_far = begin + 1, True
        while end < count and room.ticks[end] == room.ticks[begin]:
            sorted_so_far &= keys[end - 1] >> 1 <= keys[end] >> 1
            end += 1
        if not sorted_so_far:
            if end - begin < _FEW:
                _insert(keys, begin, end)
            else:
                _radix(begin, end, form, room)
        begin = end


@kernel
def _insert(keys: Int64s, begin: int, end: int) -> None:
    for i in range(begin + 1, end):
        key, j = keys[i], i
        while j > begin and keys[j - 1] >> 1 > key >> 1:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key


@kernel
def _radix(begin: int, end: int, form: Form, room: Scratch) -> None:
    """Sort keys of one tick by address, a digit of some bits at a time, the lowest first."""
    keys, counts = room.keys, room.counts
    address_bits = 1
    while form.width * form.height - 1 >> address_bits:
        address_bits += 1
    passes = (address_bits + _DIGIT_BITS - 1) // _DIGIT_BITS
    width = (address_bits + passes - 1) // passes
    mask, first = (1 << width) - 1, room.ticks[begin] * (form.width * form.height)
    for shift in range(0, address_bits, width):
        for digit in range(mask + 1):
            counts[digit] = 0
        for i in range(begin, end):
            counts[((keys[i] >> 1) - first >> shift) & mask] += 1
        place = begin
        for digit in range(mask + 1):
            place, counts[digit] = place + counts[digit], place
        for i in range(begin, end):
            digit = ((keys[i] >> 1) - first >> shift) & mask
            room.spare[counts[digit]] = keys[i]
            counts[digit] += 1
        for i in range(begin, end):
            keys[i] = room.spare[i]
