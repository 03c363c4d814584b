"""An image topic as a scene of a run: a writer in another process, and a link that is read back."""

import contextlib
import itertools
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the `ros2` extra is not installed")

import evstim
from emulator.light import SceneError
from emulator.scene.video.ros2_images import Ros2ImageParameters, open_ros2_images
from tests.transports.ros2.ros_readers import DOMAIN, PEER, own_topic, typestore

pytestmark = [pytest.mark.system, pytest.mark.socket]

TYPES = typestore()


class Writer:
    """A process that writes images, from a thread here that hands them to it until it is closed.

    It never ends by itself: a writer finds its reader before this reader finds it, by any time on a busy machine.
    """

    def __init__(self, topic, messages, period_s):
        self.process = subprocess.Popen(
            [sys.executable, str(PEER), "write", str(DOMAIN), topic, "Image", "reliable"],
            stdin=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self._messages, self._period_s = itertools.cycle(messages), period_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._write_on)
        self._thread.start()

    def _write_on(self):
        with contextlib.suppress(BrokenPipeError):  # it was killed
            for message in self._messages:
                self.process.stdin.write(struct.pack("<I", len(message)) + message)
                self.process.stdin.flush()
                if self._closing.wait(self._period_s):  # the images' own period
                    break

    def close(self):
        self._closing.set()
        self._thread.join()
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        self.process.wait(120)

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if kind is not None:
            self.process.kill()
        self.close()


def wait_until(is_so):
    until = time.monotonic() + 120
    while not is_so():
        assert time.monotonic() < until
        time.sleep(0.05)


def image(levels, encoding, stamp_s=0, step=None):
    """Return the message of an image by rosbags."""
    types = TYPES.types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_s, nanosec=0)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")
    data = levels.reshape(-1).view(np.uint8)
    message = types["sensor_msgs/msg/Image"](
        header=header, height=levels.shape[0], width=levels.shape[1], encoding=encoding, is_bigendian=0,
        step=step or levels.strides[0], data=data,
    )  # fmt: skip
    return bytes(TYPES.serialize_cdr(message, "sensor_msgs/msg/Image"))


@pytest.mark.parametrize("encoding", ["mono8", "mono16", "32FC1", "rgb8"])
def test_an_image_of_another_process_is_the_light(encoding):
    topic = own_topic("images")
    levels = {"mono8": np.uint8(51), "mono16": np.uint16(13_107), "32FC1": np.float32(0.2), "rgb8": np.uint8(51)}
    shape = (26, 34, 3) if encoding == "rgb8" else (26, 34)
    messages = [image(np.full(shape, levels[encoding]), encoding)]
    parameters = Ros2ImageParameters(topic, levels="linear", floor=1e-6, delay_ms=0.0, domain=DOMAIN, wait_s=120.0)
    with Writer(topic, messages, 0.01), open_ros2_images(parameters, (34, 26)) as scene:
        light = np.zeros((26, 34), np.float32)
        scene.light(1_000_000, light)
        np.testing.assert_allclose(light, 0.2, rtol=1e-4)


def test_no_image_in_time_says_what_to_look_at():
    parameters = Ros2ImageParameters(own_topic("images"), domain=DOMAIN, wait_s=0.1)
    for _ in range(2):  # the domain can be joined again after that
        with pytest.raises(SceneError, match=r"no image came on .* no program in reach writes sensor_msgs/msg/Image"):
            open_ros2_images(parameters, (34, 26))


@pytest.mark.long
def test_images_that_are_refused_are_told_where_none_came():
    topic = own_topic("images")
    parameters = Ros2ImageParameters(topic, domain=DOMAIN, wait_s=10.0)
    bad = image(np.zeros((4, 4), np.uint8), "mono8", step=3)
    with Writer(topic, [bad], 0.01), pytest.raises(SceneError, match="size and data do not agree"):
        open_ros2_images(parameters, (34, 26))


def test_a_run_sees_the_images_and_goes_on_when_their_writer_has_gone():
    """Light goes up and down by a factor of 1.5 each 40 ms, until the writer ends, 3 s before the run does."""
    topic, size = own_topic("images"), (34, 26)
    messages = [image(np.full(size[::-1], 0.4 * 1.5 ** (k % 2), np.float32), "32FC1") for k in range(2)]
    parameters = Ros2ImageParameters(topic, delay_ms=60.0, domain=DOMAIN, wait_s=120.0)
    camera = evstim.Camera(sensor=evstim.Sensor("ideal", width=size[0], height=size[1], threshold_on=0.15,
                                                threshold_off=0.15).parameters)  # fmt: skip
    rig = evstim.Rig("topic", "An image topic as a scene", parameters, camera)
    with Writer(topic, messages, 0.04) as writer, evstim.run(rig, seconds=0.0) as run:
        run.wait_until_ready()
        wait_until(lambda: run.status.sim_seconds > 4.0)
        writer.close()
        ended_s = run.status.sim_seconds
        wait_until(lambda: run.status.sim_seconds > ended_s + 3.0)
        run.stop()
        events = np.concatenate(list(run))
    result = run.result
    assert result.scene_counts["images"] >= 50
    assert result.scene_counts["pictures without a new image"] > 100
    assert result.ledger.balanced
    per_pixel = np.bincount(events["y"].astype(int) * size[0] + events["x"], minlength=size[0] * size[1])
    assert per_pixel.min() >= 50  # two a ramp of 2.7 thresholds
    assert np.mean(events["on"]) == pytest.approx(0.5, abs=0.05)
    assert events["t"].max() < (ended_s + 2.0) * 1e6
