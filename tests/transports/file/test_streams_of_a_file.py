"""All that a camera sends in files of every format, in the order of time whatever the step, read by other programs.

A link is fed as a run feeds it: the edges and readings of a step before its events. Somebody presses the trigger
meanwhile.
"""

import asyncio
import struct
import warnings
from dataclasses import dataclass
from functools import cache

import dv_processing
import evt3
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from emulator.light import LightFrame
from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from emulator.sensor.frames import FrameSource
from emulator.sensor.parameters import FrameParameters
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import EdgeKind
from firmware_protocol.evt.words import evt3_header
from firmware_protocol.imu_samples import ImuScale, no_samples, physical
from tests.firmware_protocol.evt2_words import by_the_tables
from tests.made_events import scattered
from tests.npz_records import load_edges, load_frames, load_imu
from tests.transports.recording.test_other_readers import by_aedat, by_dv, by_dv_from_the_lower_right
from tests.transports.word_readers import as_events, by_evlib, by_evt3, by_expelliarmus, by_faery
from transports.link.pacing import FakeClock
from transports.link.process import Link
from transports.link.rings import FREE_RUNNING
from transports.recording.files import OpenRecording
from transports.recording.format import FORMATS
from transports.recording.record import load_record
from transports.recording.rosbag import EVENT_PACKET

with warnings.catch_warnings(action="ignore"):  # it uses Python's old `imp`
    import dv

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("forked_readers")]

SIZE = (346, 260)
LENGTH_US, PERIOD_US, PRESSED_AFTER_US = 1_000_000, 50_000, 500_000
STEPS_US = (1000, 270_000)  # the second no multiple of the periods of triggers and frames, the last step shorter
EVENTS = 100_000
WITH_EDGES = [name for name, form in FORMATS.items() if "edges" in form.holds]
RIG = """
[scene]
kind = "checkerboard"
[camera]
model = "davis346"
[camera.frames]
[camera.imu]
[trigger]
period_ms = 50.0
kind = "rising"
[[links]]
kind = "file"
path = "{path}"
format = "{form}"
"""


@dataclass(frozen=True)
class Sent:
    """What went into a link, and what its report says."""

    events: np.ndarray
    edges: list[tuple[int, int]]
    imu: np.ndarray
    lines: np.ndarray
    report: object


def random_events():
    return scattered(np.sort(np.random.default_rng(5).integers(0, LENGTH_US + 1, EVENTS)))


def random_samples():
    imu = no_samples(1000)
    imu["t"], imu["scale"] = np.arange(1, 1001) * 998, int(ImuScale())
    imu["counts"] = np.random.default_rng(6).integers(-32768, 32768, (1000, 7))
    return imu


@cache
def lines_of_frames(settings):
    """Return the lines of the frames that the link asks for, of a still picture."""
    source = FrameSource(FrameParameters(), 3, SIZE)
    light = np.random.default_rng(7).random(SIZE[::-1]).astype(np.float32)
    source.reset(LightFrame(0, light))
    return np.concatenate(
        [source.read(LightFrame(t * 1000, light), settings) for t in range(10_000, LENGTH_US + 1, 10_000)]
    )


def between(records, t0, t1):
    """Return the records of a step, which ends with `t1`."""
    t = records["t"].astype(np.int64)
    return records[(t > (t0 or -1)) & (t <= t1)]


async def run_link(setup, step_us, sent, press=EdgeKind.FALLING):
    """Feed a link in steps, press the trigger in the middle, and close it; return when it was pressed."""
    events, readings = sent
    link, pressed_us = Link(setup, FakeClock(0)), None
    await link.endpoint.start()
    setup.ring.start(FREE_RUNNING)
    for t0 in range(0, LENGTH_US, step_us):
        t1 = min(t0 + step_us, LENGTH_US)
        for ring in setup.readings:
            ring.push(between(readings[ring.kind], t0, t1))
        setup.ring.push(between(events, t0, t1))
        setup.ring.publish(t1)
        link.tick()
        if pressed_us is None and t1 >= PRESSED_AFTER_US:
            while not link.idle:
                link.tick()
            pressed_us = link._device.now_us
            link.happen(press)
    while not link.idle:
        link.tick()
    await link.close()
    return pressed_us, link.report(final=True)


def recorded(path, name, step_us, press=EdgeKind.FALLING):
    """Write a file by a link, step by step."""
    (setup,) = link_setups(parse_rig(RIG.format(path=path, form=name), "a.toml", "a"))
    settings = {ring.kind: ring.settings for ring in setup.readings}
    events, imu, lines = random_events(), random_samples(), lines_of_frames(settings[ReadingKind.FRAMES])
    readings = {ReadingKind.IMU: imu, ReadingKind.FRAMES: lines}
    pressed_us, report = asyncio.run(run_link(setup, step_us, (events, readings), press))
    edges = [(t, int(EdgeKind.RISING)) for t in range(PERIOD_US, LENGTH_US + 1, PERIOD_US)]
    if press is not None:
        edges = sorted([*edges, (pressed_us, int(press))], key=lambda edge: edge[0])
    return Sent(events, edges, imu, lines, report)


def frame_times(sent):
    """Return begin and end of the exposure of each whole frame, us: a global shutter of 4 ms every 40 ms."""
    begin, end = (sent.lines["t"][sent.lines["kind"] == kind].astype(int) for kind in (2, 3))
    whole = int(np.count_nonzero(sent.lines["kind"] == 5))
    return list(zip(begin[:whole].tolist(), end[:whole].tolist(), strict=True))


def pictures(sent):
    """Return the brightness of each whole frame, (n, 260, 346): the difference of its reads."""
    reset, signal = (sent.lines[sent.lines["kind"] == kind]["samples"] for kind in (1, 4))
    n = len(signal) // 260
    reads = [one[: 260 * n].reshape(n, 260, 346).astype(int) for one in (reset, signal)]
    return np.where(reads[1] == 0, 1023, np.clip(reads[0] - reads[1], 0, 1023))


@pytest.fixture(autouse=True)
def pieces(monkeypatch):
    """A step of a busy sensor has more events than are handed over at once."""
    monkeypatch.setattr("transports.file._MOST_EVENTS", 4096)


@pytest.mark.sampled
@pytest.mark.parametrize("step_us", STEPS_US)
@pytest.mark.parametrize("name", WITH_EDGES)
def test_all_that_a_camera_sends_is_in_the_file_in_the_order_of_time(name, step_us, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    sent = recorded(path, name, step_us)
    assert (sent.report.error, sent.report.file_troubles) == (None, ())
    assert sent.report.edges_balanced
    assert sent.report.readings_balanced
    (summary,) = sent.report.recordings
    counts = {"events": EVENTS, "edges": 21, "imu": 1000, "frames": 25}
    holds = FORMATS[name].holds
    assert summary.written == {key: n for key, n in counts.items() if key in holds}
    assert summary.left_out == {key: n for key, n in counts.items() if key not in holds}
    READ_BY_OTHERS[name](path, sent)
    read_by_evstim(path, sent, holds)


def read_by_evstim(path, sent, holds):
    with OpenRecording(path, SIZE) as recording:
        parts = list(recording.parts())
    events, edges, imu = (np.concatenate([getattr(one, key) for one in parts]) for key in ("events", "edges", "imu"))
    np.testing.assert_array_equal(events, sent.events)
    assert [tuple(edge) for edge in edges[["t", "kind"]].tolist()] == sent.edges
    if "imu" in holds:
        assert imu["t"].tolist() == sent.imu["t"].tolist()
        assert_samples(imu, sent, g=4.001 if path.suffix == ".aedat2" else 99)
    if "frames" in holds:
        frames = [frame for part in parts for frame in part.frames]
        assert [frame.t_us for frame in frames] == [begin for begin, _ in frame_times(sent)]
        for frame, picture in zip(frames, pictures(sent), strict=True):
            shift = 2 if frame.pixels.dtype == np.uint8 else 0
            np.testing.assert_array_equal(frame.pixels, picture >> shift)


def assert_samples(imu, sent, g=99.0):
    """Compare samples with those that were sent, up to `g` where the format has a range."""
    expected = physical(sent.imu)
    for k, axis in enumerate("xyz"):
        np.testing.assert_allclose(
            imu[f"accelerometer_{axis}"], np.clip(expected["acceleration_g"][:, k], -g, g), atol=2e-4
        )
        np.testing.assert_allclose(imu[f"gyroscope_{axis}"], expected["rate_deg_s"][:, k], rtol=1e-3, atol=0.05)


def aedat4_by_others(path, sent):
    reader, store = dv_processing.io.MonoCameraRecording(str(path)), dv_processing.EventStore()
    while (batch := reader.getNextEventBatch()) is not None:
        store.add(batch)
    read = store.numpy()
    np.testing.assert_array_equal(as_events(*(read[n] for n in ("timestamp", "x", "y", "polarity"))), sent.events)
    triggers, samples, frames = [], [], []
    while (batch := reader.getNextTriggerBatch()) is not None:
        triggers += [(one.timestamp, {1: 2, 2: 3}[one.type.value]) for one in batch]
    while (batch := reader.getNextImuBatch()) is not None:
        samples += [one.timestamp for one in batch]
    while (frame := reader.getNextFrame()) is not None:
        frames.append((frame.timestamp, frame.image.copy()))
    assert triggers == sent.edges
    assert samples == sent.imu["t"].tolist()
    assert [t for t, _ in frames] == [begin for begin, _ in frame_times(sent)]
    for (_, image), picture in zip(frames, pictures(sent), strict=True):
        np.testing.assert_array_equal(image.reshape(260, 346), picture >> 2)
    for read in (by_aedat, by_faery, by_evlib):
        np.testing.assert_array_equal(read(path), sent.events)


def aedat2_by_others(path, sent):
    """Dv takes each step back for a wrap of the time, of all records together, and pin events for events."""
    data = path.read_bytes()
    records = np.frombuffer(data[data.index(b"End Of ASCII Header\r\n") + 21 :], [("address", ">u4"), ("t", ">i4")])
    assert bool((np.diff(records["t"]) >= 0).all())
    pins = records[records["address"] >> 10 & 0x2000_03 == 1]
    assert [(int(t), {2: 3, 3: 2}[int(a) & 0x3FF]) for a, t in pins] == sent.edges
    read = by_dv_from_the_lower_right(path)
    is_pin = (read["x"] == 345) & (read["y"] == 259) & np.isin(read["t"], [t for t, _ in sent.edges]) & ~read["on"]
    real = (sent.events["x"] == 345) & (sent.events["y"] == 259)
    assert not real[np.isin(sent.events["t"], [t for t, _ in sent.edges])].any()
    np.testing.assert_array_equal(read[~is_pin], sent.events)
    with dv.LegacyAedatFile(str(path), enable_frames=True) as file:
        frames = [one for one in file if one.type.name == "Frame"]
    assert [(one.start_of_exposure, one.end_of_exposure) for one in frames] == frame_times(sent)


def aedat31_by_others(path, sent):
    np.testing.assert_array_equal(by_dv(path), sent.events)


def evt3_by_others(path, sent):
    for read in (by_evt3, by_faery, by_evlib):
        np.testing.assert_array_equal(read(path), sent.events)
    _, triggers = evt3.decode_file_with_triggers(str(path))
    kinds = np.where(np.asarray(triggers.value), 2, 3).tolist()
    assert list(zip(np.asarray(triggers.timestamp).tolist(), kinds, strict=True)) == sent.edges


def evt2_by_others(path, sent):
    assert path.name == "a.evt2.raw"
    for read in (by_expelliarmus, by_faery, by_evlib):
        np.testing.assert_array_equal(read(path), sent.events)
    assert triggers_of_evt2(path.read_bytes()) == sent.edges


def triggers_of_evt2(data):
    """Return time and kind of each trigger word, as Prophesee's description of EVT2 has them."""
    high, triggers = 0, []
    for (word,) in struct.iter_unpack("<I", data[data.index(b"% end\n") + 6 :]):
        if word >> 28 == 8:
            high = word & 0xFFF_FFFF
        elif word >> 28 == 10:
            triggers.append((high << 6 | word >> 22 & 0x3F, 2 if word & 1 else 3))
    return triggers


def evt21_by_others(path, sent):
    """evlib reads the little-endian order alone, and the tables of the format both."""
    form = path.name.removeprefix("a.").removesuffix(".raw")
    events, triggers = by_the_tables(path.read_bytes().partition(b"% end\n")[2], form)
    for read in (events, by_evlib(path)) if form == "evt21" else (events,):
        np.testing.assert_array_equal(read, sent.events)
    assert triggers[["t", "kind"]].tolist() == sent.edges


def bags_by_others(path, sent):
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(EVENT_PACKET, "event_camera_msgs/msg/EventPacket"))
    found = {}
    with AnyReader([path], default_typestore=store) as bag:
        for connection, _, data in bag.messages():
            found.setdefault(connection.topic, []).append(bag.deserialize(data, connection.msgtype))
    words = b"".join(packet.events.tobytes() for packet in found["/event_camera/events"])
    read = evt3.decode_bytes(evt3_header(SIZE) + words, *SIZE)
    np.testing.assert_array_equal(as_events(read.t, read.x, read.y, np.asarray(read.p) > 0), sent.events)
    stamps = {
        topic: [one.header.stamp.sec * 1_000_000 + one.header.stamp.nanosec // 1000 for one in messages]
        for topic, messages in found.items()
    }
    assert stamps["/event_camera/imu"] == sent.imu["t"].tolist()
    assert stamps["/event_camera/image_raw"] == [begin for begin, _ in frame_times(sent)]
    assert stamps["/event_camera/events"] == sorted(stamps["/event_camera/events"])
    expected = physical(sent.imu)
    got = [[getattr(one.linear_acceleration, axis) / 9.80665 for axis in "xyz"] for one in found["/event_camera/imu"]]
    np.testing.assert_allclose(got, expected["acceleration_g"], atol=1e-4)
    got = [np.rad2deg([getattr(one.angular_velocity, a) for a in "xyz"]) for one in found["/event_camera/imu"]]
    np.testing.assert_allclose(got, expected["rate_deg_s"], atol=1e-3)
    for image, picture in zip(found["/event_camera/image_raw"], pictures(sent), strict=True):
        assert (image.encoding, image.width, image.height, image.step) == ("mono8", *SIZE, 346)
        np.testing.assert_array_equal(image.data.reshape(260, 346), picture >> 2)


def npz_by_numpy(path, sent):
    with np.load(path) as arrays:
        np.testing.assert_array_equal(arrays["events"], sent.events)
        assert [tuple(edge) for edge in arrays["edges"][["t", "kind"]].tolist()] == sent.edges
        assert arrays["imu"]["t"].tolist() == sent.imu["t"].tolist()
        assert arrays["frames"]["t"].tolist() == [begin for begin, _ in frame_times(sent)]
        np.testing.assert_array_equal(arrays["frames"]["pixels"], pictures(sent))
    assert len(load_record(path)[0]) == EVENTS
    assert [len(load(path)[0]) for load in (load_edges, load_imu, load_frames)] == [21, 1000, 25]


READ_BY_OTHERS = {
    "aedat4": aedat4_by_others, "aedat2": aedat2_by_others, "aedat31": aedat31_by_others, "evt3": evt3_by_others,
    "evt2": evt2_by_others, "evt21": evt21_by_others, "evt21-legacy": evt21_by_others, "ros1": bags_by_others,
    "ros2": bags_by_others, "npz": npz_by_numpy,
}  # fmt: skip


@pytest.mark.parametrize("name", ["ros1-dvs", "csv"])
def test_what_a_format_cannot_hold_is_counted(name, tmp_path):
    sent = recorded(tmp_path / f"a{FORMATS[name].suffixes[0]}", name, 120_000)
    (summary,) = sent.report.recordings
    left = {"edges": 21} if name == "ros1-dvs" else {"edges": 21, "imu": 1000, "frames": 25}
    assert (summary.left_out, sent.report.file_troubles) == (left, ())
    assert summary.lines[1].startswith(f"left out, as {FORMATS[name].title} cannot hold them: 21 triggers")


@pytest.mark.parametrize("name", ["aedat4", "aedat2", "evt3"])
def test_a_clock_that_starts_anew_in_the_middle_has_a_file_of_its_own_with_all_streams(name, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    sent = recorded(path, name, 120_000, press=None)
    assert sent.report.file_troubles == ()
    (summary,) = sent.report.recordings
    paths = [path, path.with_name(f"a-clock2{path.suffix}")]
    assert summary.paths == tuple(str(one) for one in paths)
    parts = []
    for one in paths:
        with OpenRecording(one, SIZE) as recording:
            parts.append(list(recording.parts()))
    reset_us = 600_000  # the end of the step in which it was reset
    files = list(zip((0, reset_us), parts, strict=True))
    for at_us, of_file in files:
        for stream in ("events", "edges", "imu"):
            t = np.concatenate([getattr(one, stream)["t"] for one in of_file]).astype(np.int64) + at_us
            assert ((t >= at_us) & (t <= (LENGTH_US if at_us else reset_us))).all()
    events = np.concatenate([one.events["t"] + np.uint64(at) for at, of in files for one in of])
    np.testing.assert_array_equal(events, sent.events["t"])
    if "frames" in FORMATS[name].holds:
        frames = [frame.t_us + at for at, of in files for one in of for frame in one.frames]
        assert frames == [begin for begin, _ in frame_times(sent)]
