"""DAVIS words per second: encoding and decoding the events of the checkerboard rig's read-out.

One thread, one million events (about 1 Mev/s of stream, so nearly every microsecond has a timestamp word), in batches
of 20 000 as a busy link sees them. Median of the repeats, in processor time.

`words_encode_streams` has all that a DAVIS346 sends in its words: a saturated read-out's events (12.5 a microsecond),
25 frames of 346 x 260 a second, samples of the inertial unit and edges, 1000 a second each. What readings cost to
become words is counted too.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from emulator.bench.davis_streams import davis_batches
from emulator.bench.streams import checkerboard_stream
from firmware_protocol.davis346 import Decoder, WordEncoder

__all__ = ["words_decode", "words_encode", "words_encode_streams"]

_EVENTS = 1_000_000
_BATCH = 20_000
_REPEATS = 9


def words_encode() -> float:
    """Mev/s of the word encoder."""
    batches = np.array_split(checkerboard_stream(_EVENTS), _EVENTS // _BATCH)

    def encode() -> None:
        encoder = WordEncoder((346, 260))
        for batch in batches:
            encoder.encode(batch)

    return _EVENTS / _median_s(encode) * 1e-6


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


def _median_s(work: Callable[[], None]) -> float:
    times = []
    for _ in range(_REPEATS + 1):
        start_s = time.process_time()
        work()
        times.append(time.process_time() - start_s)
    return statistics.median(times[1:])
