"""Topics of a link: pictures, triggers, what is told of the types; readers that sleep, vanish or come late."""

import contextlib
import os
import signal
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the `ros2` extra is not installed")

from emulator.rig.loading import RigError, parse_rig
from emulator.run.link_process import LinkFailed
from evstim.testing.link_contract import event_stream
from tests.transports.opened_links import balanced, wait_until
from tests.transports.opened_links import opened as link_of
from tests.transports.ros2.ros_readers import DOMAIN, EventReader, Peer, decoded, own_topic, typestore
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING

pytestmark = [pytest.mark.system, pytest.mark.socket]

TYPES = typestore()


def opened(topic, more="", domain=DOMAIN):
    return link_of(f'kind = "ros2"\ntopic = "{topic}"\ndomain = {domain}\n{more}')


def first_of(peer, count):
    """Return the first messages that a peer gets."""
    return [peer.messages.get(timeout=120) for _ in range(count)]


@pytest.mark.sampled
@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
def test_messages_tell_their_number_size_frame_and_type(reliability):
    topic, events = own_topic(), event_stream(20_000, start_us=500)
    link = opened(topic, 'frame_id = "bore sight"')
    with closing(EventReader(link, topic, reliability=reliability)) as reader:
        reader.matched()
        link.start(FREE_RUNNING)
        link.push_all(events, 61_000)
        np.testing.assert_array_equal(reader.read(len(events)), events)
        assert link.stop(10.0).delivered == len(events)
        told = reader.process.stderr.readline().decode()
    packets = reader.packets
    assert [packet.seq for packet in packets] == list(range(len(packets)))
    assert {(p.width, p.height, p.encoding, p.is_bigendian, p.header.frame_id) for p in packets} == {
        (346, 260, "evt3", False, "bore sight")
    }
    assert (packets[0].header.stamp.sec, packets[0].header.stamp.nanosec) == (0, 500_000)
    hashed = TYPES.hash_rihs01("event_camera_msgs/msg/EventPacket")
    assert told == f"event_camera_msgs::msg::dds_::EventPacket_ typehash={hashed};\n"


def test_a_paced_run_stamps_messages_with_unix_time():
    topic, events = own_topic(), event_stream(3000)
    link = opened(topic, f'image_topic = "{own_topic("images")}"')
    with closing(EventReader(link, topic)) as reader:
        before_ns = time.time_ns()
        link.start(MonotonicClock().now_ns() + 20_000_000)
        link.push(events, 9000)
        reader.read(len(events))
        after_ns = time.time_ns()
        link.stop(5.0)
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in reader.packets]
    assert before_ns < stamps[0] < after_ns
    # a message a millisecond, fewer on a busy machine, and each stamp is the time of its first event
    assert 2 <= len(stamps) <= 12
    firsts = [int(decoded([packet])["t"][0]) for packet in reader.packets]
    assert [stamp - stamps[0] for stamp in stamps] == [1000 * (t - firsts[0]) for t in firsts]


@pytest.mark.sampled
@pytest.mark.parametrize("image", ["display", "event_image"])
def test_pictures_are_those_of_the_events(image):
    topic, pictures, events = own_topic(), own_topic("images"), event_stream(20_000)
    link = opened(topic, f'image_topic = "{pictures}"\nimage = "{image}"\nframe_ms = 10.0')
    with closing(Peer(pictures, "Image")) as peer:
        wait_until(link, lambda report: report.state.startswith("1 reader"))
        link.start(FREE_RUNNING)
        link.push_all(events, 60_000)
        messages = first_of(peer, 5)
        report = link.stop(10.0)
    assert report.delivered == len(events)
    images = [TYPES.deserialize_cdr(message, "sensor_msgs/msg/Image") for message in messages]
    assert [one.header.stamp.nanosec for one in images] == [10_000_000 * k for k in range(1, 6)]
    first = events[events["t"] < 10_000]
    counts = np.zeros((2, 260, 346), int)
    np.add.at(counts, (first["on"].astype(int), first["y"], first["x"]), 1)
    if image == "display":
        assert (images[0].encoding, images[0].step) == ("rgb8", 3 * 346)
        rgb = images[0].data.reshape(260, 346, 3)
        np.testing.assert_array_equal((rgb == (0, 255, 0)).all(axis=2), counts[1] > counts[0])
        np.testing.assert_array_equal((rgb == (255, 0, 0)).all(axis=2), counts[0] > counts[1])
    else:
        assert (images[0].encoding, images[0].step) == ("32FC5", 20 * 346)
        channels = images[0].data.view("<f4").reshape(260, 346, 5)
        np.testing.assert_array_equal(channels[..., 0], counts[1])
        np.testing.assert_array_equal(channels[..., 1], counts[0])


def test_a_sleeping_reader_costs_others_nothing():
    """A paced run of 2 s, one of two reliable readers stopped: the other has every event.

    A writer that waited for the sleeper would take 0.1 s for each of some 2000 messages, and drop most of them.
    """
    topic, events = own_topic(), event_stream(700_000)
    link = opened(topic, "depth = 4")
    with closing(EventReader(link, topic)) as reader, closing(Peer(topic)) as sleeper:
        wait_until(link, lambda report: report.state.startswith("2 readers"))
        sleeper.process.send_signal(signal.SIGSTOP)
        link.start(MonotonicClock().now_ns())
        link.push(events, 2_100_000)
        received = reader.read(len(events))
        report = link.stop(5.0)
        sleeper.process.send_signal(signal.SIGCONT)
    np.testing.assert_array_equal(received, events)
    assert report.delivered == len(events)
    balanced(report, len(events))


@pytest.mark.long
def test_events_that_wait_for_others_when_the_last_reader_leaves_are_lost():
    topic = own_topic()
    link = opened(topic, "message_ms = 1000.0")
    link.start(FREE_RUNNING)
    with closing(EventReader(link, topic)) as reader:
        reader.matched()
        link.push_all(event_stream(500), 1500)
        wait_until(
            link, lambda report: report.camera.offered == 500
        )  # they are gathered, and would leave after a second
        reader.process.send_signal(signal.SIGINT)
        wait_until(link, lambda report: "waiting" in report.state)
    report = link.stop(5.0)
    balanced(report, 500)
    assert (report.delivered, report.camera.lost_on_link) == (0, 500)


def test_events_without_a_reader_are_counted_and_a_later_one_gets_later_ones():
    topic, early, late = own_topic(), event_stream(1000), event_stream(2000, 1_000_000)
    link = opened(topic)
    assert link.report.state == f"waiting for a reader of {topic} in domain {DOMAIN}"
    link.start(FREE_RUNNING)
    link.push_all(early, 500_000)
    wait_until(link, lambda report: report.camera is not None and report.camera.not_running == 1000)
    with closing(EventReader(link, topic)) as reader:
        link.push_all(late, 2_000_000)
        received = reader.read(len(late))
        report = link.stop(5.0)
    np.testing.assert_array_equal(received, late)
    assert (report.delivered, report.camera.not_running) == (2000, 1000)


@pytest.mark.long
def test_a_reader_that_leaves_takes_only_what_was_on_its_way():
    topic, events = own_topic(), event_stream(3000)
    link = opened(topic)
    link.start(FREE_RUNNING)
    with closing(EventReader(link, topic)) as reader:
        link.push_all(events, 9000)
        reader.read(len(events))
        reader.process.send_signal(signal.SIGINT)  # it says goodbye to its domain
        wait_until(link, lambda report: "waiting" in report.state)
    link.push_all(event_stream(500, 20_000), 30_000)
    report = link.stop(5.0)
    balanced(report, 3500)
    assert (report.delivered, report.camera.not_running) == (3000, 500)


def test_nothing_but_the_loopback_interface_is_used():
    """Of the link's UDP sockets, the one that sends is bound to 127.0.0.1, and none is in a multicast group."""
    link = opened(own_topic())
    inodes = set()
    for descriptor in Path(f"/proc/{link.pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            inodes.add(os.readlink(descriptor))
    rows = [line.split() for line in Path(f"/proc/{link.pid}/net/udp").read_text().splitlines()[1:]]
    own = [row[1] for row in rows if f"socket:[{row[9]}]" in inodes]
    link.stop(0.0)
    base = 7400 + 250 * DOMAIN
    ports = {address: int(address.split(":")[1], 16) for address in own}
    assert any(address.startswith("0100007F:") for address in own)
    assert all(address.startswith("0100007F:") or base <= ports[address] < base + 250 for address in own)
    groups = Path("/proc/net/igmp").read_text()
    assert "0100FFEF" not in groups  # 239.255.0.1, where DDS looks for others


def test_an_interface_that_is_not_there_says_what_to_do():
    with pytest.raises(LinkFailed, match="is the interface there"):
        opened(own_topic(), 'interfaces = ["nosuch0"]')


@pytest.mark.parametrize(("table", "message"), [
    ('topic = "events"', 'a topic begins with "/"'),
    ('topic = "/a b"', 'a topic begins with "/"'),
    ('image_topic = "/event_camera/events"', "name of its own"),
    ("domain = 233", "domain must be 0 to 232"),
    ("domain = -1", "domain must be 0 to 232"),
    ("depth = 1", "depth must be"),
    ("message_ms = 0.0", "message_ms must be"),
    ("[links.pictures]\nlight_share = 0.5", "pictures needs image_topic"),
    ('peers = ["192.0.2.7"]', 'interfaces = \\["eth0"\\]'),
    ("multicast = true", 'interfaces = \\["eth0"\\]'),
    ('frame_id = "a\\nb"', "printable"),
])  # fmt: skip
def test_a_table_that_cannot_be_is_refused(table, message):
    with pytest.raises(RigError, match=message):
        parse_rig(f'[scene]\nkind = "checkerboard"\n[[links]]\nkind = "ros2"\n{table}\n', "a.toml", "a")
