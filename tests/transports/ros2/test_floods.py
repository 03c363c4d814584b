"""A flood of participants and datagrams in the domain of a link, and of images before a scene."""

import contextlib
import os
import subprocess
import sys
import threading
from collections import deque
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the `ros2` extra is not installed")

import evstim
from emulator.scene.video.ros2_images import Ros2ImageParameters
from evstim.testing.link_contract import event_stream
from tests.hostile.memory import MIB, resident_bytes
from tests.transports.ros2.ros_readers import DOMAIN, PEER, EventReader, own_topic
from tests.transports.ros2.test_image_scene import Writer, image
from tests.transports.ros2.test_topics import balanced, opened, wait_until
from transports.link.rings import FREE_RUNNING

pytestmark = [pytest.mark.system, pytest.mark.socket]

ROUNDS = max(2, int(os.environ.get("EVSTIM_FLOOD", "200")) // 100)
FLOOD = PEER.with_name("flood.py")


@contextlib.contextmanager
def flood(topic):
    """A flood that goes on meanwhile; gives its process, of which each round is a line."""
    command = [sys.executable, str(FLOOD), str(DOMAIN), topic, "1000000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_flood_of_participants_and_datagrams_costs_a_reader_nothing():
    """Each batch of events is sent while the flood goes on; memory of the link stays within a bound."""
    topic, count = own_topic(), 6000
    link = opened(topic)
    with closing(EventReader(link, topic)) as reader:
        reader.matched()
        threading.Thread(target=deque, args=(reader.process.stderr, 0)).start()  # it tells of each bad datagram
        link.start(FREE_RUNNING)
        before = resident_bytes(link.pid)
        with flood(topic) as process:
            for k in range(ROUNDS):
                link.push_all(part := event_stream(count, k * 20_000), (k + 1) * 20_000)
                assert process.stdout.readline() == f"round {k}\n"
                wait_until(link, lambda report, due=(k + 1) * count: report.delivered >= due)
        received = reader.read(ROUNDS * count)
        grown = resident_bytes(link.pid) - before
        report = link.stop(10.0)
    sent = np.concatenate([event_stream(count, k * 20_000) for k in range(ROUNDS)])
    np.testing.assert_array_equal(received, sent)
    assert part["t"][-1] == received["t"][-1]
    balanced(report, len(sent))
    assert report.delivered == len(sent)
    assert grown < 256 * MIB


def test_a_flood_of_images_leaves_the_newest_and_bounded_memory():
    """As many images as the writer can write; the run takes what is new at its steps and ends in time."""
    topic, size = own_topic("images"), (346, 260)
    levels = [np.full(size[::-1], 0.4 + 0.01 * (k % 2), np.float32) for k in range(2)]
    messages = [image(one, "32FC1") for one in levels] * (ROUNDS * 500)
    parameters = Ros2ImageParameters(topic, delay_ms=60.0, domain=DOMAIN, wait_s=20.0)
    rig = evstim.Rig("flooded", "More images than can be shown", parameters, evstim.Camera())
    with Writer(topic, messages, 0.0) as writer, evstim.run(rig, seconds=0.5) as run:
        run.wait_until_ready()
        before = resident_bytes(None)
        result = run.wait()
        grown = resident_bytes(None) - before
        writer.process.kill()
    assert result.ledger.balanced
    assert result.scene_counts["images"] > 0
    assert grown < 512 * MIB
