"""The baud rate, kept by ourselves: exact over any ticks, no catching up after silence, never faster than the line."""

from collections import deque

import hypothesis.strategies as st
from hypothesis import given

from transports.serial_line.endpoint import BaudClock, Frame, Transmitter

SECOND_NS = 1_000_000_000
TICK_NS = 500_000


class Sink:
    """A port that takes what it has room for."""

    def __init__(self, room=1 << 40):
        self.room = room
        self.data = b""

    def write(self, data):
        taken = data[: self.room]
        self.room -= len(taken)
        self.data += taken
        return len(taken)


def transmitter(baud=100_000, frames=(), bits=10):
    waiting, left = deque(frames), []

    def pull():
        return Frame(waiting[0], waiting.popleft()) if waiting else None

    return Transmitter(BaudClock(baud, bits), pull, left.append, 600_000), waiting, left


@given(st.lists(st.integers(1, 8_000_000), min_size=20, max_size=60), st.sampled_from([9600, 115_200, 3_000_000]))
def test_a_full_line_carries_its_capacity_however_the_ticks_fall(steps, baud):
    out, _, _ = transmitter(baud, [bytes(1000)] * 2000)
    sink, now = Sink(), 0
    for step in steps:
        out.pump(sink.write, now)
        now += step
        assert len(sink.data) * 10 * SECOND_NS <= now * baud, "never faster than the line"
    out.pump(sink.write, now)
    assert (now * baud // (10 * SECOND_NS)) - len(sink.data) <= 1


def test_silence_cannot_be_made_up_for():
    out, waiting, _ = transmitter(100_000)
    sink = Sink()
    for tick in range(2000):
        out.pump(sink.write, tick * TICK_NS)
    waiting.append(bytes(100))
    out.pump(sink.write, SECOND_NS)
    assert len(sink.data) <= 5, "half a millisecond of the line, not a second of it"


def test_a_stall_is_made_up_for_only_as_far_as_a_buffer_holds():
    out, _, _ = transmitter(100_000, [bytes(1000)] * 100)
    sink = Sink()
    out.pump(sink.write, 0)
    out.pump(sink.write, SECOND_NS)
    assert len(sink.data) == 500, "50 ms of 10 kB/s"


def test_frames_leave_in_order_when_their_last_byte_has():
    frames = [b"abc", b"defgh", b"i"]
    out, _, left = transmitter(10_000, frames)
    sink = Sink()
    for ms in range(1, 9):
        out.pump(sink.write, ms * 1_000_000)
        assert sink.data == b"".join(frames)[: len(sink.data)]
        assert left == [f for i, f in enumerate(frames) if len(b"".join(frames[: i + 1])) <= len(sink.data)]
    assert left == frames[:2]


def test_a_full_port_holds_the_line_and_is_counted():
    out, _, left = transmitter(1_000_000, [bytes(100)] * 100)
    sink = Sink(room=250)
    for tick in range(20):
        out.pump(sink.write, tick * TICK_NS)
    assert len(sink.data) == 250
    assert len(left) == 2
    assert out.held > 0
    sink.room = 10_000
    out.pump(sink.write, 20 * TICK_NS)
    assert len(sink.data) <= 250 + 51, "held time is gone: the line was at a stand"


def test_what_is_dropped_is_named_and_the_next_frame_begins_afresh():
    out, waiting, left = transmitter(10_000, [b"abcdef", b"ghi"])
    sink = Sink()
    out.pump(sink.write, 0)
    out.pump(sink.write, 3_000_000)
    assert sink.data == b"abc"
    assert out.drop() == [b"abcdef"]
    assert out.waiting == 0
    out.pump(sink.write, 4_000_000)
    out.pump(sink.write, 9_000_000)
    assert sink.data.startswith(b"abcghi")
    assert left == [b"ghi"]
    assert not waiting
