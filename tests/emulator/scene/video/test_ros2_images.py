"""Images of a topic as a scene: straight lines in log light, times, and messages that are refused; no DDS is used."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.scene.video.ros2_images import Ros2ImageParameters, Ros2Images
from firmware_protocol.ros2 import Header, Image, image_message

SIZE = (12, 8)
MS = 1_000_000
LINEAR = Ros2ImageParameters(levels="linear", floor=1e-6, delay_ms=0.0)


@dataclasses.dataclass
class Written:
    data: bytes
    written_ns: int


class Fake:
    """A topic, and the wall's clock of both sides."""

    def __init__(self, epoch_ns=1_700_000_000 * 10**9):
        self.epoch_ns = self.now_ns = epoch_ns
        self.waiting = []
        self.closed = False

    def clock(self):
        return self.now_ns

    def take(self):
        taken, self.waiting = self.waiting, []
        return taken

    def close(self):
        self.closed = True

    def write(self, light, t_ns, stamp_ns=0, size=SIZE):
        levels = np.broadcast_to(np.float32(light), size[::-1]).astype("<f4")
        image = Image(Header(stamp_ns, "camera"), size, "32FC1", 4 * size[0], levels.tobytes())
        self.waiting.append(Written(image_message(image), self.epoch_ns + t_ns))


def scene(fake, **changes):
    return Ros2Images(dataclasses.replace(LINEAR, **changes), SIZE, fake, fake.clock)


def drawn(images, fake, t_ns):
    """Return the light and rate of a picture that is drawn at its own time."""
    fake.now_ns = fake.epoch_ns + t_ns
    light, rate = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.float32)
    images.light_and_rate(t_ns, light, rate)
    again = np.zeros_like(light)
    images.light(t_ns, again)
    np.testing.assert_array_equal(again, light)
    return float(light[0, 0]), float(rate[0, 0])


def test_until_an_image_comes_it_is_grey_and_then_the_last_one_stays():
    fake = Fake()
    images = scene(fake, light_at_white=2.0)
    assert drawn(images, fake, 0) == (pytest.approx(1.0, rel=1e-5), 0)
    fake.write(0.25, 9 * MS)
    assert drawn(images, fake, 10 * MS) == (pytest.approx(0.5, rel=1e-5), 0)
    assert drawn(images, fake, 10**12)[0] == pytest.approx(0.5, rel=1e-5)
    assert images.counts == {"images": 1, "pictures without a new image": 4}  # each is drawn twice


def test_light_goes_straight_in_log_between_images_that_are_shown_later():
    fake = Fake()
    images = scene(fake, delay_ms=50.0)
    drawn(images, fake, 0)
    for k, light in enumerate((0.1, 0.4, 0.2)):
        fake.write(light, 40 * k * MS)
    drawn(images, fake, 85 * MS)
    light, rate = drawn(images, fake, 70 * MS)  # half way between the first two
    assert light == pytest.approx(0.2, rel=1e-4)
    assert rate == pytest.approx(0.2 * math.log(4) / 0.04, rel=1e-4)
    light, rate = drawn(images, fake, 120 * MS)
    assert light == pytest.approx(0.4 / 2 ** (30 / 40), rel=1e-4)
    assert rate == pytest.approx(-light * math.log(2) / 0.04, rel=1e-4)


@pytest.mark.parametrize("start_ns", [0, 1_650_000_000 * 10**9], ids=["another simulation's", "Unix"])
def test_stamps_tell_distances_in_time_where_the_rig_says_so(start_ns):
    """Images 40 ms apart by their stamps come in one heap; the first sets the time."""
    fake = Fake()
    images = scene(fake, stamps="header", delay_ms=100.0)
    drawn(images, fake, 0)
    fake.write(0.1, 10 * MS, start_ns)
    drawn(images, fake, 10 * MS)
    fake.write(0.4, 60 * MS, start_ns + 40 * MS)
    fake.write(0.2, 60 * MS, start_ns + 80 * MS)
    drawn(images, fake, 100 * MS)
    assert drawn(images, fake, 130 * MS)[0] == pytest.approx(0.2, rel=1e-4)
    assert drawn(images, fake, 150 * MS)[0] == pytest.approx(0.4, rel=1e-4)
    assert "jumps of the images' clock" not in images.counts


@pytest.mark.parametrize("stamp_ns", [-(10**18), 0, 10**18])
def test_a_stamp_that_leads_astray_begins_anew_at_the_arrival(stamp_ns):
    fake = Fake()
    images = scene(fake, stamps="header")
    drawn(images, fake, 0)
    fake.write(0.1, 10 * MS, 5 * 10**9)
    drawn(images, fake, 20 * MS)
    fake.write(0.3, 30 * MS, abs(stamp_ns))
    assert drawn(images, fake, 40 * MS)[0] == pytest.approx(0.3, rel=1e-4)
    assert images.counts["jumps of the images' clock"] == 1


@pytest.mark.parametrize("written_ns", [-(10**18), 10**18])
def test_a_writers_clock_that_is_wrong_puts_no_image_beyond_now(written_ns):
    fake = Fake()
    images = scene(fake)
    drawn(images, fake, 0)
    fake.write(0.3, written_ns)
    assert drawn(images, fake, 40 * MS)[0] == pytest.approx(0.3, rel=1e-4)


def test_images_at_the_same_time_are_refused_and_older_ones_too():
    fake = Fake()
    images = scene(fake)
    drawn(images, fake, 0)
    for light, t_ns in ((0.1, 10 * MS), (0.2, 10 * MS), (0.3, 5 * MS)):
        fake.write(light, t_ns)
    assert drawn(images, fake, 20 * MS)[0] == pytest.approx(0.1, rel=1e-4)
    assert images.counts["images at the time of the one before"] == 2


def test_levels_of_srgb_are_decoded():
    fake = Fake()
    images = Ros2Images(Ros2ImageParameters(delay_ms=0.0, floor=1e-6), SIZE, fake, fake.clock)
    drawn(images, fake, 0)
    image = Image(Header(0, ""), SIZE, "mono8", 12, bytes([128]) * 96)
    fake.waiting.append(Written(image_message(image), fake.epoch_ns + MS))
    assert drawn(images, fake, 2 * MS)[0] == pytest.approx(0.2158605, rel=1e-4)  # of IEC 61966-2-1


def test_hostile_messages_are_counted_and_the_last_image_stays():
    fake = Fake()
    images = scene(fake)
    drawn(images, fake, 0)
    fake.write(0.3, 10 * MS)
    drawn(images, fake, 20 * MS)
    good = Image(Header(0, ""), SIZE, "mono8", 12, bytes(96))
    for bad in ({"encoding": "yuv422"}, {"step": 11}, {"size": (2**32 - 1, 2**32 - 1)}, {"data": bytes(95)}):
        fake.waiting.append(Written(image_message(dataclasses.replace(good, **bad)), fake.epoch_ns + 30 * MS))
    fake.waiting += [Written(noise, 0) for noise in (b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 100)]
    fake.write(np.nan, 30 * MS)
    assert drawn(images, fake, 40 * MS)[0] == pytest.approx(0.3, rel=1e-4)
    refused = {name: count for name, count in images.counts.items() if "refused" in name}
    assert refused == {
        "images refused: encoding not known": 1,
        "images refused: size and data do not agree": 2,
        "images refused: no pixels, or too many": 1,
        "images refused: a message is not plain CDR": 1,
        "images refused: a message is cut": 2,
        "images refused: light that is negative or not finite": 1,
    }


def test_when_time_begins_anew_the_last_image_stays():
    fake = Fake()
    images = scene(fake, delay_ms=50.0)
    drawn(images, fake, 0)
    fake.write(0.3, 10 * 10**9)
    drawn(images, fake, 11 * 10**9)
    fake.epoch_ns += 12 * 10**9
    assert drawn(images, fake, 0)[0] == pytest.approx(0.3, rel=1e-4)
    fake.write(0.4, 10 * MS)
    assert drawn(images, fake, 60 * MS)[0] == pytest.approx(0.4, rel=1e-4)


@pytest.mark.parametrize(("changes", "message"), [
    ({"topic": "image"}, "a topic begins with"),
    ({"delay_ms": -1.0}, "delay_ms must be .*, got -1"),
    ({"wait_s": math.nan}, "wait_s must be .*, got nan"),
    ({"floor": 0.0}, "floor must be .*, got 0"),
    ({"domain": 500}, "domain must be"),
    ({"peers": ("192.0.2.7",)}, "name the network interface"),
])  # fmt: skip
def test_parameters_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Ros2ImageParameters(**changes)
