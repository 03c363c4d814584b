"""Four streams of a free-running camera through wraps of 2^15 us, and what the comparison sees.

EVSTIM_STREAM_HOURS=24 python -m pytest tests/hostile/test_stream_soak.py    # 40 times through 2^31 us too
"""

import os

import numpy as np
import pytest

from tests.hostile.looped import Looped
from tests.hostile.stream_soak import GAP_US, StreamSoak, soak
from tests.hostile.word_reader import WordReader

HOURS = float(os.environ.get("EVSTIM_STREAM_HOURS", "0.02"))


@pytest.mark.long
@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(900 + HOURS * 3600)
def test_every_time_and_exposure_is_right_through_the_wraps():
    seen, summary = soak(HOURS)
    assert summary["balanced"], summary
    assert summary["links"]["usbip"]["error"] is None
    assert seen.device_us > HOURS * 3.6e9
    assert seen.frames >= HOURS * 3600 / 8 - 1
    assert seen.samples >= HOURS * 3600 * 5 - 1
    assert seen.edges >= HOURS * 3600 * 2 - 2


def words(*numbers):
    return np.array(numbers, "<u2").tobytes()


def test_the_reader_knows_events_edges_samples_and_wraps():
    reader = WordReader()
    head = words(9, 0x8003, 1, 0x8005, 0x1007, 0x3009, 0x7001, 0x2008, 0x8001, 3)
    events = reader.feed(head + words(5, 0x53E5, 0x5001, 0x5002, 7))
    assert events.tolist() == [(5, 9, 7, True), (32768, 8, 7, False)]
    assert reader.edges == [(32769, 3)]
    assert reader.samples == [(32769, 0xE5, b"\1\2")]
    assert reader.feed(words(0x7002, 0x3001)).tolist() == [(3 * 32768, 1, 7, True)]


@pytest.mark.parametrize("wrong", [(0x8005, 0x8005), (0x7001, 0x8000), (0x8009, 0x8004)])
def test_times_that_do_not_increase_are_seen(wrong):
    with pytest.raises(AssertionError, match="do not increase"):
        WordReader().feed(words(1, *wrong))


@pytest.mark.parametrize("late", [0, 1])
def test_a_sample_or_an_edge_at_a_wrong_time_is_seen(late):
    soaking = StreamSoak(Looped(100, GAP_US))
    soaking.take(words(1, 0x8000 + 100, 3, 0x8000 + 200, 2))
    far = [0x7001] * (1_000_100 >> 15)
    edge = words(*far, 0x8000 + (1_000_100 + late & 0x7FFF), 3)
    if late:
        with pytest.raises(AssertionError):
            soaking.take(edge)
    else:
        soaking.take(edge)
        assert soaking.seen.edges == 3
