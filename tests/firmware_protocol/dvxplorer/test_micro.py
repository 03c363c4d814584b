"""The DVXplorer Micro: its words, frames, registers, samples, filters, and any order of use."""

import struct

import numpy as np
import pytest
from camera_life import CameraLife
from dvxplorer_host import scans, scattered, streams
from frame_reader import FrameReader
from hypothesis import given, settings, stateful
from hypothesis import strategies as st

from firmware_protocol.device.items import ReadingKind
from firmware_protocol.dvxplorer.device import Dvxplorer
from firmware_protocol.dvxplorer.frame_stream import FrameStream, sample_of
from firmware_protocol.dvxplorer.frame_words import FrameDecoder, in_wire_order
from firmware_protocol.dvxplorer.micro import DvxplorerMicro, DvxplorerMicroSettings
from firmware_protocol.events import EVENT
from firmware_protocol.usb.device import SetupPacket, Stall
from tests.made_events import events_at, samples_at

OUT, IN = 0x40, 0xC0
RUN = (1, 3, 1)


class Host:
    """A host of firmware 10, or of an older one."""

    def __init__(self, camera):
        self.camera = camera
        self.bytes = 8 if camera.settings.has_new_firmware else 4
        camera.attached()
        camera.control(SetupPacket(0, 9, 1, 0, 0), b"")

    def write(self, module, address, value):
        setup = SetupPacket(OUT, 0xBF, module, address, self.bytes)
        self.camera.control(setup, value.to_bytes(self.bytes, "big"))

    def read(self, module, address):
        return int.from_bytes(self.camera.control(SetupPacket(IN, 0xBF, module, address, self.bytes), b""), "big")

    def request(self, request):
        self.camera.control(SetupPacket(OUT, request, 0, 0, 0), b"")

    def take(self, max_bytes=8192):
        """All transfers that the camera has now."""
        transfers = []
        while (transfer := self.camera.read(2, max_bytes)) is not None:
            self.camera.sent(transfer)
            transfers.append(transfer)
        return transfers


def running(*writes, **changes):
    camera = DvxplorerMicro(DvxplorerMicroSettings(start_delay_us=0, **changes))
    host = Host(camera)
    for one in (RUN if camera.settings.has_new_firmware else (5, 0x3000, 2), *writes):
        host.write(*one)
    return camera, host


def seen(host, events, max_bytes=8192):
    """What a strict reader finds in the stream of events, and the record of it."""
    host.camera.offer(events)
    host.camera.advance(int(events["t"][-1]) + 5000)
    transfers = host.take(max_bytes)
    reader = FrameReader().feed(b"".join(one.data for one in transfers))
    assert reader.wrong == []
    record = np.concatenate([one.events for one in transfers])
    assert reader.events == record.tolist()
    decoder = FrameDecoder()
    assert np.array_equal(np.concatenate([decoder.feed(one.data).events for one in transfers]), record)
    assert decoder.faults.total == 0
    return reader, record


@given(events=streams(max_size=60), frames=st.booleans(), max_bytes=st.sampled_from([4, 7, 512, 8192]))
@settings(max_examples=60)
def test_any_stream_is_read_as_it_was_recorded(events, frames, max_bytes):
    if not len(events):
        return
    _, host = running(has_frames=frames)
    _, record = seen(host, events, max_bytes)
    shown = sorted(map(tuple, events[["x", "y", "on"]].tolist()))
    assert sorted(map(tuple, record[["x", "y", "on"]].tolist())) == shown


def test_a_scan_is_one_frame_with_the_time_of_its_first_event():
    events = scans(20_000, 197)
    _, host = running()
    reader, record = seen(host, events)
    scan = events["t"].astype(int) // 197
    first = np.flatnonzero(np.diff(scan, prepend=-1))
    assert reader.frames == events["t"][first].tolist()
    assert np.array_equal(np.unique(record["t"]), events["t"][first])


def test_without_frames_no_time_is_changed():
    events = scans(3000, 197)
    _, host = running(has_frames=False)
    reader, record = seen(host, events)
    assert reader.frames == sorted(set(events["t"].tolist()))
    order = np.lexsort((events["y"], events["on"], events["y"] >> 3, events["x"], events["t"]))
    assert np.array_equal(record, events[order])


@pytest.mark.parametrize(("per_time", "columns"), [(1, 640), (3, 640), (39, 640), (40, 640), (900, 640), (900, 1)])
def test_the_order_on_the_wire_is_that_of_a_sort_by_time_column_group_polarity_and_row(per_time, columns):
    events = scattered(4000, 5, seed=per_time)
    events["t"] = 5 + np.arange(4000) // per_time
    events["x"] %= columns
    sorted_at = np.lexsort((events["y"], events["on"], events["y"] >> 3, events["x"], events["t"]))
    ordered = in_wire_order(events, (640, 480))
    assert ordered.tobytes() == events[sorted_at].tobytes()
    assert in_wire_order(ordered, (640, 480)) is ordered


def test_the_times_of_frames_are_not_written_into_the_caller_s_events():
    stream, events = FrameStream((640, 480), 1024), np.array([(10, 5, 5, True), (20, 9, 5, True)], EVENT)
    stream.period_us = 197.0
    stream.put(events)
    assert events["t"].tolist() == [10, 20]


@pytest.mark.parametrize(("at", "wrong"), [("t", "sorted by time"), ("x", "outside"), ("y", "outside")])
def test_events_outside_or_back_in_time_have_no_order(at, wrong):
    events = scattered(100, 5)
    events[at][-1] = 0 if at == "t" else 640
    with pytest.raises(ValueError, match=wrong):
        in_wire_order(events, (640, 480))


def test_both_polarities_of_a_group_share_a_word():
    events = np.array([(10, 5, 8 * 3 + k, k % 2 == 0) for k in range(4)] + [(10, 5, 480 - 1, True)], EVENT)
    _, host = running()
    host.camera.offer(events)
    (transfer,) = host.take()
    words = np.frombuffer(transfer.data, "<u4").tolist()
    off, on = 0b1010, 0b0101
    assert words[-3:] == [
        1 << 26 | 5 | 10 << 11 | 1 << 21,
        1 << 31 | 3 << 18 | 1 << 16 | on << 8 | off,
        1 << 31 | 59 << 18 | 0x80,
    ]


def test_time_words_come_each_millisecond_and_wrap_after_22_bits():
    camera, host = running()
    camera.advance(50_000)
    reader = FrameReader().feed(b"".join(one.data for one in host.take()))
    assert (reader.wrong, reader.ms) == ([], 50)
    before = ((1 << 22) - 2) * 1000
    camera.advance(before)
    decoder = FrameDecoder()
    for transfer in host.take():
        decoder.feed(transfer.data)
    events = scattered(20, before, step_us=501)
    camera.offer(events)
    data = b"".join(one.data for one in host.take())
    assert np.any(np.frombuffer(data, "<u4") == 1 << 27)
    assert decoder.feed(data).events["t"][-1] == events["t"][-1]
    assert decoder.faults.total == 0


def times_on_the_wire(data):
    """The times of time words, ms, and those of frames, us, of bytes as a reader receives them."""
    words = np.frombuffer(data, "<u4")
    is_time, is_first = (
        (words & (1 << 31 | 1 << 27)) == 1 << 27,
        (words & (7 << 26 | 1 << 31 | 1 << 21)) == 1 << 26 | 1 << 21,
    )
    ms = (words & (1 << 22) - 1)[is_time].astype(np.int64)
    before = np.cumsum(is_time)[is_first] - 1
    assert (before >= 0).all(), "a frame before the first time word"
    return ms, 1000 * ms[before] + (words >> 11 & 1023)[is_first]


@given(st.integers(0, 10**9), st.sampled_from([0.0, 100.0, 1000.0]))
def test_times_increase_for_a_reader_that_takes_little_and_whose_queue_is_dropped(seed, period_us):
    """dv-processing ends where one does not. Words beyond what a host requested are dropped with the queue."""
    rng, stream, now_us = np.random.default_rng(seed), FrameStream((640, 480), 8192), 500
    stream.start_time(now_us)
    stream.period_us, received = period_us, b""
    for _ in range(120):
        act = rng.random()
        if act < 0.5:
            ahead_us, n = (int(rng.choice(numbers)) for numbers in ((0, 5, 1000, 3000, 2_000_000), (0, 1, 3, 50, 1000)))
            events = events_at(
                np.sort(rng.integers(now_us, now_us + ahead_us + 1, n)),
                x=rng.integers(0, 640, n),
                y=rng.integers(0, 480, n),
            )
            stream.put(events)
            now_us += ahead_us
        elif act < 0.85:
            transfer = stream.take(now_us, int(rng.choice([4, 60, 600])))
            received += b"" if transfer is None else transfer.data
        else:
            stream.clear()
    for times in times_on_the_wire(received):
        assert (np.diff(times) > 0).all()


@pytest.mark.parametrize("first_us", [0, 1000, 3000, 2_000_000])
@pytest.mark.parametrize("has_read", [False, True])
def test_no_frame_has_the_time_of_the_first_time_word(first_us, has_read):
    """dv-processing ends there. `has_read`: the host takes the time words of the silence before the first event."""
    camera, host = running(has_frames=False)
    camera.advance(first_us)
    data = b"".join(one.data for one in (host.take() if has_read else []))
    camera.offer(np.array([(first_us, 5, 5, True), (first_us + 1, 5, 5, True)], EVENT))
    data += b"".join(one.data for one in host.take())
    ms, frames_us = times_on_the_wire(data)
    assert frames_us.tolist() == ([1, 2] if first_us == 0 else [first_us, first_us + 1])
    assert 1000 * ms[0] < frames_us[0]


def test_the_two_firmwares_have_registers_of_their_own():
    _, new = running()
    assert (new.read(1, 0), new.read(1, 13), new.read(1, 14), new.read(3, 5)) == (640, 8, 9, 11)
    with pytest.raises(Stall):
        new.camera.control(SetupPacket(IN, 0xBF, 1, 0, 4), b"")
    with pytest.raises(Stall):
        new.camera.control(SetupPacket(OUT, 0xBF, 1, 3, 4), bytes(4))
    with pytest.raises(Stall):
        new.camera.control(SetupPacket(OUT, 0xC2, 1, 0, 6), bytes((1, 3, 0, 0, 0, 0)))
    _, old = running(bcd_device=0x0409)
    assert (old.read(6, 0), old.read(6, 7), old.read(1, 2), old.camera.streaming) == (18, 4, 3, True)
    with pytest.raises(Stall):
        old.request(0xC7)


def test_the_flash_memory_has_the_configuration_and_survives_a_cable():
    camera, host = running((1, 14, 3), (3, 7, 8))
    host.request(0xC7)
    again = Host(camera)
    assert (again.read(1, 14), again.read(1, 3)) == (9, 0)
    again.request(0xC8)
    assert (again.read(1, 14), again.read(3, 7), again.read(1, 3)) == (3, 8, 0)


def test_thresholds_and_rates_act_as_those_of_a_dvxplorer():
    camera, host = running((1, 14, 17), (1, 15, 0), (1, 13, 7))
    other = Dvxplorer()
    for address, value in ((0x0B, 6), (0x1C, 8), (0x12, 0x7F), (0x1E, 8)):
        other.control(SetupPacket(OUT, 0xBF, 5, address, 4), value.to_bytes(4, "big"))
    assert camera.sensor_factors["threshold_on"] == other.sensor_factors["threshold_on"] == pytest.approx(1.584)
    assert camera.sensor_factors["threshold_off"] == other.sensor_factors["threshold_off"] == pytest.approx(0.343)
    assert camera.sensor_factors["scan_us"] == pytest.approx(499 / 199)
    host.write(1, 13, 0)
    assert camera.scan_us == 10_000


@pytest.mark.parametrize(("code", "interval", "period_us"), [(4, 24950, 500), (5, 9950, 200), (6, 4950, 100)])
def test_a_lossy_rate_has_exactly_its_period_on_both_models(code, interval, period_us):
    camera, _ = running((1, 13, code))
    older, _ = running(
        *((5, address, value) for address, value in ((0x325C, 1), (0x3240, 0), (0x3241, 0), (0x3242, 1))),
        *((5, 0x325D + k, interval >> 8 * (1 - k) & 255) for k in range(2)),
        bcd_device=0x0409,
    )
    assert camera.scan_us == older.scan_us == period_us
    assert camera.sensor_factors["scan_us"] == pytest.approx(older.sensor_factors["scan_us"])


@pytest.mark.parametrize(
    ("writes", "chosen"),
    [
        ([(1, 4, 1)], lambda e: e["x"] >= 0),
        ([(1, 4, 2)], lambda e: e["on"]),
        ([(1, 4, 3)], lambda e: ~e["on"]),
        ([(1, 5, 1), (1, 6, 3)], lambda e: (e["x"] % 2 == 0) & (e["y"] % 4 == 0)),
        (
            [(1, 19, 100), (1, 20, 50), (1, 21, 200), (1, 22, 30), (1, 23, 1)],
            lambda e: (e["x"] // 100 >= 1) & (e["x"] < 300) & (e["y"] >= 50) & (e["y"] < 80),
        ),
        ([(1, 19, 100)], lambda e: e["x"] >= 0),
        ([(1, 16, 2), (1, 17, 14), (1, 18, 1)], lambda e: (e["x"] // 32 != 2) | (e["y"] // 32 != 14)),
    ],
)
def test_registers_select_events_in_the_user_s_frame(writes, chosen):
    events = scattered(5000, 1)
    camera, host = running(*writes, has_frames=False)
    _, record = seen(host, events)
    expected = events[chosen(events)]
    assert record[["t", "x", "y"]].tolist() == expected[["t", "x", "y"]].tolist()
    assert camera.counters.not_selected == len(events) - len(expected)
    assert camera.counters.balanced


def samples(n, start_us=0):
    return samples_at(start_us + np.arange(n) * 1250, np.arange(7 * n).reshape(n, 7) - 20)


def test_samples_leave_at_the_interrupt_endpoint_when_their_time_has_come():
    camera, _ = running((3, 2, 1), (3, 3, 1), (3, 4, 1), imu_unit=3)
    assert camera.reading_settings(ReadingKind.IMU)[:3] == (1, 3, 0xEA)
    shown = samples(5, 100)
    camera.offer_readings(ReadingKind.IMU, shown)
    assert camera.read(1, 64) is None
    camera.advance(3000)
    taken = [camera.read(1, 64) for _ in range(3)]
    assert camera.read(1, 64) is None
    fields = struct.unpack("<BB7h", taken[1].data)
    assert fields == (1, 0xEA, *shown["counts"][1][[4, 5, 6, 0, 1, 2, 3]].tolist())
    assert sample_of(taken[2].data, 2600).tobytes() == shown[2:3].tobytes()
    for one in taken:
        camera.sent(one)
    camera.detached()
    fates = camera.counters.readings["imu"]
    assert (fates.delivered, fates.flushed, fates.balanced) == (3, 2, True)


def test_the_oldest_samples_go_where_no_host_reads_them():
    camera, _ = running((3, 2, 1), imu_unit=3)
    camera.offer_readings(ReadingKind.IMU, samples(40))
    camera.advance(100_000)
    fates = camera.counters.readings["imu"]
    assert (fates.dropped_fifo, fates.queued, fates.balanced) == (24, 16, True)


class Life(CameraLife):
    """A camera under any sequence of events, samples, time, requests and reads.

    Reads are of whole columns: a host that flushes the data path in the middle of one loses its frame.
    """

    AREA = (640, 480)

    def __init__(self):
        camera, self.host = running((3, 2, 1), fifo_bytes=1024, imu_unit=3)
        super().__init__(camera)
        self.reader = FrameReader()

    @stateful.rule(n=st.integers(1, 20))
    def offer_samples(self, n):
        self.camera.offer_readings(ReadingKind.IMU, samples(n, self.t_us))

    @stateful.rule(max_bytes=st.sampled_from([3, 1024, 8192]), is_good=st.booleans())
    def read(self, max_bytes, is_good):
        transfer = self.camera.read(2, max_bytes)
        if transfer is not None:
            (self.camera.sent if is_good else self.camera.lost)(transfer)
            self.reader.feed(transfer.data)
        if (sample := self.camera.read(1, 64)) is not None:
            self.camera.sent(sample)

    @stateful.rule(address=st.integers(4, 25), value=st.sampled_from([0, 1, 3, 8, 200]))
    def write(self, address, value):
        self.host.write(1, address, value)

    @stateful.rule(runs=st.integers(0, 1))
    def run(self, runs):
        if runs != self.host.read(1, 3):
            self.reader = FrameReader()
        self.host.write(1, 3, runs)

    @stateful.rule(request=st.sampled_from([0xC6, 0xC7, 0xC8, 0xB1]))
    def ask(self, request):
        self.host.request(request)

    @stateful.rule()
    def unplug(self):
        self.camera.detached()
        self.host, self.reader = Host(self.camera), FrameReader()

    @stateful.invariant()
    def the_reader_finds_no_fault(self):
        assert self.reader.wrong == []


Life.TestCase.settings = settings(stateful_step_count=30, max_examples=20)
test_any_life_of_a_micro_balances = Life.TestCase
