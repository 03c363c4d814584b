"""EVT3 words per second: encoding and decoding.

One thread, batches of 20 000 events and buffers of 128 KiB, as a busy link sees them. Two streams: a textured target,
where pixels fire one by one at their own microsecond (see `sparse_streams`), and rows, where many pixels of a row fire
at the same time, which vectors code. Median of the repeats; every event is decoded and compared once.
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
from emulator.bench.sparse_streams import target
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import EVENT, Events
from firmware_protocol.evt3.decoding import Evt3Decoder
from firmware_protocol.evt3.encoding import Evt3Encoder

__all__ = ["Evt3Bytes", "Evt3Decoding", "Evt3Encoding", "Stream"]

_BATCH = 20_000
_BUFFER = 131_072
_REPEATS = 9
_WIDTH, _HEIGHT = 1280, 720

Stream = Literal["target", "rows"]


@dataclass(frozen=True)
class Evt3Encoding:
    """Mev/s from events to words."""

    stream: Stream

    def __call__(self) -> float:
        """Measure."""
        batches = _batches(self.stream)
        return sum(map(len, batches)) / _median_s(lambda: _encoded(batches)) * 1e-6


@dataclass(frozen=True)
class Evt3Decoding:
    """Mev/s from words to events."""

    stream: Stream

    def __call__(self) -> float:
        """Measure, and compare every event."""
        events, data = join_events(_batches(self.stream)), _encoded(_batches(self.stream))
        buffers = [data[k : k + _BUFFER] for k in range(0, len(data), _BUFFER)]
        if not np.array_equal(join_events(_decoded(buffers)), events):
            raise BenchFailed(f"{len(events)} events went into EVT3 words, and did not come out of them")
        return len(events) / _median_s(lambda: _decoded(buffers)) * 1e-6


@dataclass(frozen=True)
class Evt3Bytes:
    """Bytes an event."""

    stream: Stream

    def __call__(self) -> float:
        """Measure."""
        batches = _batches(self.stream)
        return len(_encoded(batches)) / sum(map(len, batches))


@functools.cache
def _batches(stream: Stream) -> tuple[Events, ...]:
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


def _encoded(batches: tuple[Events, ...]) -> bytes:
    encoder = Evt3Encoder(width=_WIDTH)
    return b"".join(encoder.encode(batch) for batch in batches)


def _decoded(buffers: list[bytes]) -> list[Events]:
    decoder = Evt3Decoder()
    return [decoder.decode(buffer)[0] for buffer in buffers]


def _median_s(work: Callable[[], object]) -> float:
    times = []
    for _ in range(_REPEATS + 1):
        start_s = time.perf_counter()
        work()
        times.append(time.perf_counter() - start_s)
    return statistics.median(times[1:])
