"""Speed of encoding and decoding events, in one thread: medians of repeats, every event decoded and compared once.

DAVIS words: events of the checkerboard rig's read-out, one million (about 1 Mev/s of stream, so nearly every
microsecond has a timestamp word), in batches of 20 000 as on a busy link, in processor time. `words_encode_streams` has
all that a DAVIS346 sends in its words: a saturated read-out's events (12.5 a microsecond), 25 frames of 346 x 260 a
second, samples of the inertial unit and edges, 1000 a second each. The time to turn readings into words is included.

Words of a DVXplorer: a scanned read-out of 640 x 480 pixels with random events, batches and buffers of the same sizes,
every event compared.

EVT3 words: batches of 20 000 events and buffers of 128 KiB, as on a busy link. There are two streams: a textured
target, where pixels fire one by one at their own microsecond (`streams.target`), and rows, where many pixels of a row
fire at the same time, which vectors encode.

Event blocks: speed, and bits per event on the line. Blocks have 1024 bytes at most; the streams are a sparse sky and a
textured target. As in a link, the events of one step of 1 ms are put in block order before blocks are cut from them;
encoding includes that. Bits are those of the default profile: CCSDS packet with time and CRC-16, in COBS.

The C decoder for firmware is compiled by this machine's own compiler: events a second on one core. The sparse sky is at
1 us, each event counted and summed, and the sum compared, in processor time. Without a C compiler there is no
measurement.
"""

from __future__ import annotations

import functools
import shutil
import statistics
import struct
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from firmware_protocol.c import FOLDER, sources
from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.words import GroupEncoder
from firmware_protocol.events import EVENT, Events, join_events
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry.reading import as_received, decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings
from laboratory.bench.streams import (
    SIZE,
    BenchFailed,
    checkerboard_stream,
    davis_batches,
    scanned_stream,
    stars,
    target,
)
from transports.output_file import TemporaryFolder

_EVENTS = 1_000_000
_BATCH = 20_000
_REPEATS = 9


def words_encode() -> float:
    """Mev/s of the word encoder."""
    return _encoding_rate(lambda: WordEncoder((346, 260)), checkerboard_stream(_EVENTS))


def words_decode() -> float:
    """Mev/s of our own decoder, on 128 KiB transfers."""
    encoder = WordEncoder((346, 260))
    data = encoder.encode(checkerboard_stream(_EVENTS)).words.tobytes()
    transfers = [data[i : i + 131_072] for i in range(0, len(data), 131_072)]

    def decode() -> None:
        decoder = Decoder((346, 260))
        for transfer in transfers:
            decoder.feed(transfer)

    return _EVENTS / _median_s(decode) * 1e-6


def words_encode_streams() -> float:
    """Mev/s of the word encoder with frames, inertial samples and edges among the events."""
    parts = davis_batches(_EVENTS, _BATCH)

    def encode() -> None:
        encoder = WordEncoder((346, 260))
        for part in parts:
            encoder.encode(part.events, 0, part.marks, part.blocks())

    return _EVENTS / _median_s(encode) * 1e-6


def groups_encode() -> float:
    """Mev/s from events to a DVXplorer's words."""
    return _encoding_rate(lambda: GroupEncoder((640, 480)), scanned_stream(_EVENTS))


def _encoding_rate(make: Callable[[], WordEncoder | GroupEncoder], events: Events) -> float:
    """Return Mev/s of a new encoder that gets events in batches."""
    batches = np.array_split(events, len(events) // _BATCH)

    def encode() -> None:
        encoder = make()
        for batch in batches:
            encoder.encode(batch)

    return len(events) / _median_s(encode) * 1e-6


def groups_decode() -> float:
    """Mev/s from a DVXplorer's words to events, on 128 KiB transfers; raises BenchFailed where an event differs."""
    events = scanned_stream(_EVENTS)
    data = GroupEncoder((640, 480)).encode(events).words.tobytes()
    transfers = [data[i : i + _BUFFER] for i in range(0, len(data), _BUFFER)]

    def decode() -> list[Events]:
        decoder = GroupDecoder()
        return [decoder.feed(transfer).events for transfer in transfers]

    if not np.array_equal(join_events(decode()), events):
        raise BenchFailed("the words of a DVXplorer came back as other events")
    return _EVENTS / _median_s(decode) * 1e-6


def _median_s(work: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Return the median time of the work by a clock; the first time, which may compile, is left out."""
    times = []
    for _ in range(_REPEATS + 1):
        start_s = clock()
        work()
        times.append(clock() - start_s)
    return statistics.median(times[1:])


_BUFFER = 131_072

_WIDTH, _HEIGHT = 1280, 720

Stream = Literal["target", "rows"]


@dataclass(frozen=True)
class Evt3Encoding:
    """Mev/s from events to words."""

    stream: Stream

    def __call__(self) -> float:
        """Measure."""
        batches = _evt3_batches(self.stream)
        return sum(map(len, batches)) / _median_s(lambda: _encoded_evt3(batches), time.perf_counter) * 1e-6


@dataclass(frozen=True)
class Evt3Decoding:
    """Mev/s from words to events."""

    stream: Stream

    def __call__(self) -> float:
        """Measure, and compare every event."""
        events, data = join_events(_evt3_batches(self.stream)), _encoded_evt3(_evt3_batches(self.stream))
        buffers = [data[k : k + _BUFFER] for k in range(0, len(data), _BUFFER)]
        if not np.array_equal(join_events(_decoded_evt3(buffers)), events):
            raise BenchFailed(f"{len(events)} events were encoded as EVT3 words, and the decoded events differ")
        return len(events) / _median_s(lambda: _decoded_evt3(buffers), time.perf_counter) * 1e-6


@dataclass(frozen=True)
class Evt3Bytes:
    """Bytes an event."""

    stream: Stream

    def __call__(self) -> float:
        """Measure."""
        batches = _evt3_batches(self.stream)
        return len(_encoded_evt3(batches)) / sum(map(len, batches))


@functools.cache
def _evt3_batches(stream: Stream) -> tuple[Events, ...]:
    events = target(0.1) if stream == "target" else _rows(20_000)
    return tuple(events[k : k + _BATCH] for k in range(0, len(events), _BATCH))


def _rows(count: int) -> Events:
    """Return `count` bursts of 1 to 64 pixels of a row, neighbours or with gaps, of one time and polarity."""
    rng = np.random.default_rng(636)
    bursts = []
    for k in range(count):
        columns = rng.integers(0, _WIDTH) + np.cumsum(rng.integers(1, rng.integers(2, 6), rng.integers(1, 65)))
        burst = np.zeros(int((columns < _WIDTH).sum()), EVENT)
        burst["t"], burst["y"], burst["on"] = 2 * k, k % _HEIGHT, rng.random() < 0.5
        burst["x"] = columns[columns < _WIDTH]
        bursts.append(burst)
    return join_events(bursts)


def _encoded_evt3(batches: tuple[Events, ...]) -> bytes:
    encoder = Evt3Encoder(width=_WIDTH)
    return b"".join(encoder.encode(batch) for batch in batches)


def _decoded_evt3(buffers: list[bytes]) -> list[Events]:
    decoder = Evt3Decoder()
    return [decoder.decode(buffer)[0] for buffer in buffers]


_STEP_US = 1000

_Stream = Literal["stars", "target"]


@dataclass(frozen=True)
class BlockEncoding:
    """Mev/s from a stream in time order to blocks."""

    stream: _Stream

    def __call__(self) -> float:
        """Measure."""
        batches = _block_batches(self.stream)
        return sum(map(len, batches)) / _median_s(lambda: _encoded_blocks(batches), time.perf_counter) * 1e-6


@dataclass(frozen=True)
class BlockDecoding:
    """Mev/s from blocks to events."""

    stream: _Stream

    def __call__(self) -> float:
        """Measure."""
        batches = _block_batches(self.stream)
        blocks = _encoded_blocks(batches)
        seconds = _median_s(lambda: [decode_block(block) for block in blocks], time.perf_counter)
        return sum(map(len, batches)) / seconds * 1e-6


@dataclass(frozen=True)
class BlockBits:
    """Bits an event, framed."""

    stream: _Stream
    tick_us: int

    def __call__(self) -> float:
        """Measure, and compare every event."""
        batches = _block_batches(self.stream)
        blocks = _encoded_blocks(batches, self.tick_us)
        received = join_events([decode_block(block).events for block in blocks])
        sent = as_received(join_events(batches), self.tick_us)
        if not np.array_equal(as_received(received, self.tick_us), sent):
            raise BenchFailed(f"{len(sent)} events were encoded in blocks, and the decoded events differ")
        profile = Profile("ccsds-cobs")
        line = b"".join(profile.wrap(Message(MessageKind.EVENTS, block, 0)) for block in blocks)
        return 8 * len(line) / len(sent)


@functools.cache
def _block_batches(stream: _Stream) -> tuple[Events, ...]:
    """Return the events of each step."""
    events = stars(0.2) if stream == "stars" else target(0.02)
    steps = np.arange(_STEP_US, int(events["t"][-1]) + 1, _STEP_US)
    return tuple(np.split(events, np.searchsorted(events["t"], steps)))


def _encoded_blocks(batches: tuple[Events, ...], tick_us: int = 1) -> list[bytes]:
    encoder = BlockEncoder(SIZE, BlockSettings(tick_us))
    waiting = join_events([as_received(batch, tick_us) for batch in batches])
    blocks = []
    while len(waiting):
        block, taken = encoder.encode(waiting)
        blocks.append(block)
        waiting = waiting[taken:]
    return blocks


COMPILER = shutil.which("cc")
"""The compiler, None if there is none."""


_MODES = {"blocks": "b", "line": "c", "kiss": "k", "csp": "x", "words": "d"}
_PROFILES = {"line": "ccsds-cobs", "kiss": "ccsds-kiss", "csp": "csp-kiss"}
_PROGRAM = Path(__file__).with_name("c_decoder.c")


@dataclass(frozen=True)
class CDecoding:
    """Mev/s from blocks, from a serial line (ccsds-cobs, ccsds-kiss, csp-kiss), or from DAVIS words to events."""

    form: Literal["blocks", "line", "kiss", "csp", "words"]

    def __call__(self) -> float:
        """Compile and measure; raises BenchFailed where there is no compiler or an event is wrong."""
        if COMPILER is None:
            raise BenchFailed("there is no C compiler (cc)")
        events = stars(0.6)
        with TemporaryFolder("bench") as folder:
            program, data = Path(folder, "c_decoder"), Path(folder, "data")
            files: list[str | Path] = [_PROGRAM, *sources(), "-o", program]
            subprocess.run([COMPILER, "-std=gnu99", "-O2", f"-I{FOLDER}", *files], check=True)
            data.write_bytes(_encoded_form(events, self.form))
            mode = _MODES[self.form]
            done = subprocess.run([program, mode, data, str(_REPEATS)], check=True, capture_output=True, text=True)
        first, *times_ns = done.stdout.splitlines()
        if first != f"{len(events)} {_sum(events)}":
            raise BenchFailed(f"of {len(events)} events with the sum {_sum(events)} came {first}")
        return len(events) / statistics.median(map(int, times_ns)) * 1e3


def _sum(events: Events) -> int:
    t, x, y, on = (events[name].astype(np.uint64) for name in ("t", "x", "y", "on"))
    return int((t * np.uint64(3) + x * np.uint64(5) + y * np.uint64(7) + on).sum())


def _encoded_form(events: Events, form: str) -> bytes:
    if form == "words":
        return WordEncoder(SIZE).encode(events).words.tobytes()
    encoder, profile, pieces = BlockEncoder(SIZE), Profile(_PROFILES.get(form, "ccsds-cobs")), []
    while len(events):
        block, taken = encoder.encode(events)
        if form in _PROFILES:
            pieces.append(profile.wrap(Message(MessageKind.EVENTS, block, int(events["t"][0]))))
        else:
            pieces.append(struct.pack("<I", len(block)) + block)
        events = events[taken:]
    return b"".join(pieces)
