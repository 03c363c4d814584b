"""Every format that is written, read by a program of others: each event, exactly."""

import re
import warnings

import aedat
import dv_processing
import event_stream
import evt3
import h5py
import numpy as np
import pytest
import tonic.io
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from firmware_protocol.events import EVENT
from firmware_protocol.evt.words import evt3_header
from tests.firmware_protocol.evt2_words import by_the_tables
from tests.transports.recording.samples import SIZE, UNIX_US, sample_edges, sample_events, write
from tests.transports.word_readers import as_events, by_evlib, by_evt3, by_expelliarmus, by_faery
from transports.recording.rosbag import DVS_EVENT, EVENT_ARRAY, EVENT_PACKET

with warnings.catch_warnings(action="ignore"):  # it uses Python's old `imp`
    import dv

EVENTS = sample_events()
EDGES = sample_edges(EVENTS)


def by_dv_processing(path):
    reader, store = dv_processing.io.MonoCameraRecording(str(path)), dv_processing.EventStore()
    assert reader.getCameraName() == "DAVIS346_00000346"
    assert reader.getEventResolution() == SIZE
    while (batch := reader.getNextEventBatch()) is not None:
        store.add(batch)
    read = store.numpy()
    return as_events(read["timestamp"], read["x"], read["y"], read["polarity"])


def by_aedat(path):
    packets = [packet["events"] for packet in aedat.Decoder(path) if "events" in packet]
    return np.concatenate(packets).astype(EVENT)


def by_event_stream(path):
    """Rows count from the bottom."""
    with event_stream.Decoder(str(path)) as packets:
        read = np.concatenate(list(packets))
    return as_events(read["t"], read["x"], SIZE[1] - 1 - read["y"], read["on"])


def by_the_tables_of_evt21(path):
    """No package reads the order of octets of the IMX636: OpenEB alone does."""
    head, _, words = path.read_bytes().partition(b"% end\n")
    order = re.search(rb"^% format EVT21;endianness=(\w+);height=260;width=346$", head, re.MULTILINE)[1].decode()
    return by_the_tables(words, {"little": "evt21", "legacy": "evt21-legacy"}[order])[0]


def by_dv(path):
    with dv.LegacyAedatFile(str(path)) as file:
        return as_events(*np.array([(e.timestamp, e.x, e.y, e.polarity) for e in file]).T)


def by_dv_from_the_lower_right(path):
    read = by_dv(path)
    read["x"], read["y"] = SIZE[0] - 1 - read["x"], SIZE[1] - 1 - read["y"]
    return read


def by_tonic(path):
    shape, start_ms, read = tonic.io.read_davis_346(str(path))
    assert shape == SIZE
    assert start_ms == UNIX_US // 1000
    return as_events(*(read[name] for name in "txyp"))


def by_numpy(path):
    return np.load(path)["events"]


def by_text(path):
    return as_events(*np.loadtxt(path, np.int64, delimiter=",", skiprows=1).T)


def by_h5py(path):
    with h5py.File(path) as file:
        t, starts = file["events/t"][:], file["ms_to_idx"][:]
        assert file["t_offset"][()] == UNIX_US
        for ms in (0, 1, 20_000, 20_001, 37_500, len(starts) - 1):
            assert (t[starts[ms] :] >= 1000 * ms).all()
            assert (t[: starts[ms]] < 1000 * ms).all()
        return as_events(t, *(file[f"events/{name}"][:] for name in "xyp"))


PATHS = [
    ("aedat4", "a.aedat4", by_dv_processing, UNIX_US),
    ("aedat4", "a.aedat4", by_aedat, UNIX_US),
    ("aedat4", "a.aedat4", by_evlib, UNIX_US),
    ("aedat4", "a.aedat4", by_faery, UNIX_US),
    ("aedat2", "a.aedat2", by_tonic, 0),
    ("aedat2", "a.aedat2", by_dv_from_the_lower_right, 0),
    ("aedat31", "a.aedat31", by_dv, 0),
    ("evt3", "a.raw", by_evt3, 0),
    ("evt3", "a.raw", by_faery, 0),
    ("evt3", "a.raw", by_evlib, 0),
    ("evt2", "a.raw", by_evlib, 0),
    ("evt2", "a.raw", by_faery, 0),
    ("evt2", "a.raw", by_expelliarmus, 0),
    ("evt21", "a.raw", by_evlib, 0),
    ("evt21", "a.raw", by_the_tables_of_evt21, 0),
    ("evt21-legacy", "a.raw", by_the_tables_of_evt21, 0),
    ("dat", "a.dat", by_expelliarmus, 0),
    ("es", "a.es", by_event_stream, 0),
    ("es", "a.es", by_faery, 0),
    ("csv", "a.csv", by_text, 0),
    ("csv", "a.csv", by_faery, 0),
    ("dsec", "a.h5", by_h5py, 0),
    ("dsec", "a.h5", by_evlib, 0),
    ("npz", "a.npz", by_numpy, 0),
]


@pytest.mark.parametrize(("name", "file", "read", "zero_us"), PATHS, ids=lambda value: getattr(value, "__name__", None))
def test_every_event_is_read_by_others(name, file, read, zero_us, tmp_path):
    write(tmp_path / file, name, EVENTS)
    got = read(tmp_path / file)
    got["t"] -= np.uint64(zero_us)
    np.testing.assert_array_equal(got, EVENTS)


@pytest.fixture(scope="module", params=["ros1", "ros2"])
def ros(request):
    return request.param


def messages_of(path, definitions):
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text.replace("time ts", "builtin_interfaces/Time ts"), name))
    with AnyReader([path], default_typestore=store) as bag:
        for connection, time_ns, data in bag.messages():
            yield time_ns, bag.deserialize(data, connection.msgtype)


def test_event_packets_of_bags_are_read_by_rosbags_and_evt3(ros, tmp_path):
    path = tmp_path / ("a.bag" if ros == "ros1" else "a.ros2")
    write(path, ros, EVENTS, EDGES)
    packets = list(messages_of(path, {"event_camera_msgs/msg/EventPacket": EVENT_PACKET}))
    assert {(p.encoding, p.width, p.height, p.is_bigendian) for _, p in packets} == {("evt3", *SIZE, False)}
    assert [p.seq for _, p in packets] == list(range(len(packets)))
    read = evt3.decode_bytes(evt3_header(SIZE) + b"".join(p.events.tobytes() for _, p in packets), *SIZE)
    np.testing.assert_array_equal(as_events(read.t, read.x, read.y, np.asarray(read.p) > 0), EVENTS)
    stamps_us = [p.header.stamp.sec * 1_000_000 + p.header.stamp.nanosec // 1000 for _, p in packets]
    assert stamps_us[0] == UNIX_US + int(EVENTS["t"][0])
    assert [time_ns // 1000 for time_ns, _ in packets] == stamps_us


def test_event_arrays_of_bags_are_read_by_rosbags(ros, tmp_path):
    path = tmp_path / ("a.dvs.bag" if ros == "ros1" else "a.dvs.ros2")
    events = EVENTS[:3000]
    write(path, f"{ros}-dvs", events)
    definitions = {"dvs_msgs/msg/EventArray": EVENT_ARRAY, "dvs_msgs/msg/Event": DVS_EVENT}
    arrays = [array for _, array in messages_of(path, definitions)]
    assert {(array.width, array.height) for array in arrays} == {SIZE}
    rows = [
        (one.ts.sec * 1_000_000 + one.ts.nanosec // 1000 - UNIX_US, one.x, one.y, one.polarity)
        for array in arrays
        for one in array.events
    ]
    np.testing.assert_array_equal(as_events(*zip(*rows, strict=True)), events)
