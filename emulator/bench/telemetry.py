"""Event blocks: speed of encoding and decoding, and bits per event on the line.

One thread, blocks of 1024 bytes at most, streams of a sparse sky and of a textured target (see `sparse_streams`). As in
a link, what one step of 1 ms brings is put in block order before blocks are cut from it; encoding includes that. Every
block is decoded and compared. Bits are those of the default profile: CCSDS packet with time and CRC-16, in COBS.
"""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from emulator.bench.failed import BenchFailed
from emulator.bench.sparse_streams import SIZE, stars, target
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events
from firmware_protocol.packets.message import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry import BlockEncoder, BlockSettings, as_received, decode_block

__all__ = ["BlockBits", "BlockDecoding", "BlockEncoding"]

_REPEATS = 9
_STEP_US = 1000

_Stream = Literal["stars", "target"]


@dataclass(frozen=True)
class BlockEncoding:
    """Mev/s from a stream in time order to blocks."""

    stream: _Stream
    tick_us: int = 1

    def __call__(self) -> float:
        """Measure."""
        batches = _batches(self.stream)
        seconds = _median_s(lambda: _encoded(batches, self.tick_us))
        return sum(map(len, batches)) / seconds * 1e-6


@dataclass(frozen=True)
class BlockDecoding:
    """Mev/s from blocks to events."""

    stream: _Stream
    tick_us: int = 1

    def __call__(self) -> float:
        """Measure."""
        batches = _batches(self.stream)
        blocks = _encoded(batches, self.tick_us)
        seconds = _median_s(lambda: [decode_block(block) for block in blocks])
        return sum(map(len, batches)) / seconds * 1e-6


@dataclass(frozen=True)
class BlockBits:
    """Bits an event, framed."""

    stream: _Stream
    tick_us: int

    def __call__(self) -> float:
        """Measure, and compare every event."""
        batches = _batches(self.stream)
        blocks = _encoded(batches, self.tick_us)
        received = join_events([decode_block(block).events for block in blocks])
        sent = as_received(join_events(batches), self.tick_us)
        if not np.array_equal(as_received(received, self.tick_us), sent):
            raise BenchFailed(f"{len(sent)} events went into blocks, and did not come out of them")
        profile = Profile("ccsds-cobs")
        line = b"".join(profile.wrap(Message(MessageKind.EVENTS, block, 0)) for block in blocks)
        return 8 * len(line) / len(sent)


@functools.cache
def _batches(stream: _Stream) -> tuple[Events, ...]:
    """Return what each step brings."""
    events = stars(0.2) if stream == "stars" else target(0.02)
    steps = np.arange(_STEP_US, int(events["t"][-1]) + 1, _STEP_US)
    return tuple(np.split(events, np.searchsorted(events["t"], steps)))


def _encoded(batches: tuple[Events, ...], tick_us: int) -> list[bytes]:
    encoder = BlockEncoder(SIZE, BlockSettings(tick_us))
    waiting = join_events([as_received(batch, tick_us) for batch in batches])
    blocks = []
    while len(waiting):
        block, taken = encoder.encode(waiting)
        blocks.append(block)
        waiting = waiting[taken:]
    return blocks


def _median_s(work: Callable[[], object]) -> float:
    times = []
    for _ in range(_REPEATS + 1):
        start_s = time.perf_counter()
        work()
        times.append(time.perf_counter() - start_s)
    return statistics.median(times[1:])
