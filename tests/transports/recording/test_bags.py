"""ROS bags of other programs: topics of several cameras, messages of Prophesee's driver, folders that lack a file."""

import gc

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from firmware_protocol.recordings.part import IMU, Facts, Part
from tests.made_events import events_at
from tests.transports.recording.samples import SIZE
from transports.recording.files import OpenRecording, iter_events, read_events
from transports.recording.format import FORMATS
from transports.recording.part import RecordingError
from transports.recording.rosbag import DVS_EVENT, EVENT_ARRAY, BagReader, event_array

pytestmark = pytest.mark.usefixtures("forked_readers")

LEFT, RIGHT = "/left/events", "/right/events"
UNIX_US = 1_700_000_000_000_000


@pytest.fixture(params=["ros1", "ros2"])
def bag(request, tmp_path):
    """Return a function that writes a bag of messages (topic, events), of a package's EventArray."""
    is_ros1 = request.param == "ros1"

    def write(messages, package="dvs_msgs"):
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        types = {}
        for name, text in (("EventArray", EVENT_ARRAY), ("Event", DVS_EVENT)):
            text = text.replace("dvs_msgs", package).replace("time ts", "builtin_interfaces/Time ts")
            types |= get_types_from_msg(text, f"{package}/msg/{name}")
        store.register(types)
        path = tmp_path / ("a.bag" if is_ros1 else "a")
        with Bag1(path) if is_ros1 else Bag2(path, version=8) as file:
            connections = {
                topic: file.add_connection(topic, f"{package}/msg/EventArray", typestore=store)
                for topic in dict.fromkeys(topic for topic, _ in messages)
            }
            for k, (topic, events) in enumerate(messages):
                data = event_array(events, SIZE, UNIX_US, k, cdr=not is_ros1)
                file.write(connections[topic], (UNIX_US + 1000 * k) * 1000, data)
        return path

    return write


def test_the_events_of_two_cameras_are_read_by_their_topics(bag):
    path = bag([(LEFT, events_at([5, 9])), (RIGHT, events_at([7], x=3)), (LEFT, events_at([20]))])
    with pytest.raises(
        RecordingError, match=rf"{LEFT} \(2 messages\), {RIGHT} \(1 messages\): choose a topic by --topic"
    ):
        read_events(path)
    assert read_events(path, topic=LEFT)["t"].tolist() == [0, 4, 15]
    assert read_events(path, topic=RIGHT)["x"].tolist() == [3]
    with pytest.raises(RecordingError, match=f"no events of the topic /up, but of {LEFT}, {RIGHT}"):
        read_events(path, topic="/up")
    with OpenRecording(path, topic="") as recording:
        assert (recording.facts.camera, recording.facts.topics) == (LEFT, {LEFT: 2, RIGHT: 1})


def test_arrays_of_prophesee_are_those_of_dvs_msgs(bag):
    path = bag([("/prophesee/camera/cd_events_buffer", events_at([5, 9], x=8))], "prophesee_event_msgs")
    events = read_events(path)
    assert (events["t"].tolist(), events["x"].tolist()) == ([0, 4], [8, 8])


def test_an_event_before_the_first_message_is_damage(bag):
    path = bag([(LEFT, events_at([50, 60])), (LEFT, events_at([70, 20, 80]))])
    with OpenRecording(path, strict=False) as recording:
        parts = recording.parts()
        assert [next(parts).events["t"].tolist() for _ in range(2)] == [[0, 10], [20]]
        with pytest.raises(RecordingError, match=f"an event at {UNIX_US + 20} us is before its first message"):
            next(parts)


def test_a_format_without_topics_refuses_one(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y,on\n1,2,3,1\n")
    with pytest.raises(RecordingError, match="CSV has no topics: leave --topic out"):
        read_events(tmp_path / "a.csv", topic=LEFT)


@pytest.mark.parametrize("name", ["a_0.db3", "a_0.mcap"])
def test_a_bag_of_ros2_without_metadata_names_the_command_that_writes_it(name, tmp_path):
    content = b"SQLite format 3\0" if name.endswith("db3") else b"\x89MCAP0\r\n"
    (tmp_path / name).write_bytes(content + bytes(100))
    with pytest.raises(RecordingError, match=f"without metadata.yaml: `ros2 bag reindex {tmp_path}` writes it"):
        OpenRecording(tmp_path)
    with pytest.raises(RecordingError, match="name its folder; `ros2 bag reindex FOLDER`"):
        OpenRecording(tmp_path / name)


@pytest.mark.parametrize("form", ["ros1", "ros2", "ros1-dvs"])
def test_samples_before_the_first_event_keep_their_times(form, tmp_path):
    """Samples 50 and 20 ms before the camera's clock began: what is stored is Unix time."""
    path = tmp_path / f"a.{form}"
    writer = FORMATS[form].open_writer(path, Facts(SIZE, "A", UNIX_US - 50_000, frozenset({"imu"})))
    samples = np.zeros(3, IMU)
    samples["t"] = [0, 30_000, 60_000]
    writer.write(Part(imu=samples[:2]))
    writer._facts = Facts(SIZE, "A", UNIX_US)
    writer.write(Part(events_at([400, 900])))
    writer._facts = Facts(SIZE, "A", UNIX_US - 50_000)
    writer.write(Part(imu=samples[2:]))
    writer.close()
    with OpenRecording(path) as recording:
        parts = list(recording.parts())
        assert recording.facts.unix_us == UNIX_US - 50_000
    assert [int(t) for part in parts for t in part.imu["t"]] == [0, 30_000, 60_000]
    assert [int(t) for part in parts for t in part.events["t"]] == [50_400, 50_900]


def test_samples_that_come_later_than_events_and_are_earlier_are_counted(tmp_path):
    writer = FORMATS["ros1"].open_writer(tmp_path / "a.bag", Facts(SIZE, "A", UNIX_US, frozenset({"imu"})))
    writer.write(Part(events_at([400, 900])))
    writer._facts = Facts(SIZE, "A", UNIX_US - 5)
    writer._put = lambda topic, _, message, put=writer._put: put(topic, UNIX_US + 5000, message)
    writer.write(Part(imu=np.zeros(2, IMU)))
    writer.close()
    parts = iter_events(tmp_path / "a.bag")
    assert next(parts)["t"].tolist() == [400, 900]
    with pytest.raises(RecordingError, match="2 samples of its inertial unit are before its first events"):
        next(parts)


def test_a_reader_that_is_left_has_closed_its_bag(bag, recwarn):
    """Left with its facts alone, amid its parts, and by an error: python reports a file that is not closed."""
    path = bag([(LEFT, events_at([5, 9])), (RIGHT, events_at([7])), (LEFT, events_at([20]))])
    assert BagReader(path, None, LEFT).facts.camera == LEFT
    assert len(next(BagReader(path, None, LEFT).parts()).events) == 2
    with pytest.raises(RecordingError):
        BagReader(path, None, "/up")
    gc.collect()
    assert not [warning for warning in recwarn if warning.category is ResourceWarning]
