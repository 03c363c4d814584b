"""Event images and the display, against sums pixel by pixel."""

import io

import numpy as np
import pytest
from scipy.signal import lfilter

from firmware_protocol.events import EVENT, empty_edges
from firmware_protocol.network_streams.coders import PictureSettings, StreamFacts
from firmware_protocol.network_streams.pictures import DisplayCoder, EventFrames, EventImageCoder
from tests.made_events import scattered

SIZE = (7, 5)
FRAME_US = 100


def some_events(count=400, span_us=450):
    return scattered(np.sort(np.random.default_rng(3).integers(0, span_us, count)), SIZE)


def image_by_hand(events, frame):
    """Return the image of a frame, one event after another."""
    image = np.zeros((5, SIZE[1], SIZE[0]))
    image[2:4] = np.nan
    for t, x, y, on in events.tolist():
        if t >= (frame + 1) * FRAME_US:
            break
        image[4, y, x] += 1 if on else -1
        if t >= frame * FRAME_US:
            image[0 if on else 1, y, x] += 1
            image[2, y, x] = np.fmin(image[2, y, x], t - frame * FRAME_US)
            image[3, y, x] = t - frame * FRAME_US
    return image


def arrays_of(data):
    stream, arrays = io.BytesIO(data), []
    while stream.tell() < len(data):
        arrays.append(np.lib.format.read_array(stream)[0])
    return arrays


def test_event_images_are_those_made_by_hand_however_the_events_are_cut():
    events = some_events()
    for pieces in (1, 3, 57):
        coder = EventImageCoder(StreamFacts(SIZE, "", FRAME_US))
        data = b"".join(coder.encode(part, empty_edges()) for part in np.array_split(events, pieces)) + coder.finish()
        images = arrays_of(data)
        assert [int(one["t_us"]) for one in images] == [100, 200, 300, 400, 500]
        for frame, one in enumerate(images):
            np.testing.assert_array_equal(one["image"], image_by_hand(events, frame))


def test_a_silence_gives_empty_frames_and_a_long_one_only_one():
    frames = EventFrames(SIZE, FRAME_US)
    assert list(frames.add(some_events(1, 1))) == []
    assert [(t_us, image[:2].sum()) for t_us, image in frames.reach(350)] == [(100, 1), (200, 0), (300, 0)]
    assert [t_us for t_us, _ in frames.reach(10_000_000)] == [400]


def test_a_restart_ends_the_frame():
    coder = EventImageCoder(StreamFacts(SIZE, "", FRAME_US))
    assert coder.encode(some_events(5, 50), empty_edges()) == b""
    (cut,) = arrays_of(coder.restart())
    assert cut["image"][:2].sum() == 5
    assert coder.finish() == b""


def test_the_display_shows_each_pixel_in_its_colour():
    events = np.array([(0, 1, 0, True), (1, 2, 1, False), (2, 3, 4, True), (3, 3, 4, False)], EVENT)
    coder = DisplayCoder(StreamFacts(SIZE, "", FRAME_US))
    picture = coder.encode(events, empty_edges()) + coder.advance(FRAME_US)
    assert picture[:11] == b"P6\n7 5\n255\n"
    pixels = np.frombuffer(picture[11:], np.uint8).reshape(5, 7, 3)
    assert pixels[0, 1].tolist() == [0, 255, 0]
    assert pixels[1, 2].tolist() == [255, 0, 0]
    assert pixels[4, 3].tolist() == [255, 255, 0]
    assert (pixels == 32).all(axis=2).sum() == 7 * 5 - 3


def images_of(events, settings, pieces=1):
    coder = EventImageCoder(StreamFacts(SIZE, "", FRAME_US, pictures=settings))
    data = b"".join(coder.encode(part, empty_edges()) for part in np.array_split(events, pieces))
    return arrays_of(data + coder.finish())


def test_the_channels_are_those_that_are_asked_for_in_their_order():
    events = some_events()
    for one, five in zip(
        images_of(events, PictureSettings(channels=("count", "last_us"))),
        images_of(events, PictureSettings()),
        strict=True,
    ):
        assert one["image"].shape == (2, SIZE[1], SIZE[0])
        np.testing.assert_array_equal(one["image"][0], five["image"][0] - five["image"][1])
        np.testing.assert_array_equal(one["image"][1], five["image"][3])


@pytest.mark.parametrize("pieces", [1, 57])
def test_the_filtered_level_is_that_of_a_low_pass_sampled_each_microsecond(pieces):
    """A recursive filter of scipy, exact for a level that is constant within each microsecond."""
    events, tau_us = some_events(), 130.0
    level = np.zeros((501, SIZE[1], SIZE[0]))
    np.add.at(level, (events["t"].astype(int), events["y"], events["x"]), np.where(events["on"], 1, -1))
    kept = np.exp(-1 / tau_us)
    expected = lfilter([0, 1 - kept], [1, -kept], level.cumsum(axis=0), axis=0)[100:501:100]
    images = images_of(events, PictureSettings(channels=("filtered",), filter_ms=tau_us / 1000), pieces)
    np.testing.assert_allclose([one["image"][0] for one in images], expected, atol=1e-6)


def test_the_filter_forgets_over_a_long_silence_of_which_only_one_frame_is_made():
    frames = EventFrames(SIZE, FRAME_US, 20_000.0)
    list(frames.add(np.array([(10, 2, 1, True)], EVENT)))
    told = {t_us: float(image[6, 1, 2]) for until_us in (50_100, 50_200) for t_us, image in frames.reach(until_us)}
    assert list(told) == [100, 50_200]
    for t_us, filtered in told.items():
        assert filtered == pytest.approx(1 - np.exp(-(t_us - 10) / 20_000), abs=1e-6)


def shown(events, **settings):
    coder = DisplayCoder(StreamFacts(SIZE, "", FRAME_US, pictures=PictureSettings(**settings)))
    picture = coder.encode(events, empty_edges()) + coder.finish()
    return np.frombuffer(picture[-5 * 7 * 3 :], np.uint8).reshape(5, 7, 3).astype(int)


ONE_OF_EACH = np.array([(0, 1, 0, True), (1, 2, 1, False), (2, 3, 4, True), (3, 3, 4, False)], EVENT)


def test_the_colours_of_the_display_are_free():
    colours = {
        "on_colour": (255, 255, 255),
        "off_colour": (0, 0, 0),
        "both_colour": (1, 2, 3),
        "background": (9, 9, 99),
    }
    pixels = shown(ONE_OF_EACH, **colours)
    assert pixels[0, 1].tolist() == [255, 255, 255]
    assert pixels[1, 2].tolist() == [0, 0, 0]
    assert pixels[4, 3].tolist() == [1, 2, 3]
    assert (pixels == (9, 9, 99)).all(axis=2).sum() == 7 * 5 - 3


def test_the_light_behind_the_events_is_grey_and_below_them_where_asked():
    earlier = np.array([(0, 5, 3, True)] * 4 + [(0, 6, 3, False)] * 4, EVENT)
    later = ONE_OF_EACH.copy()
    later["t"] += 900_000 // FRAME_US * FRAME_US  # when the filter has come to rest
    events = np.concatenate([earlier, later])
    alone = shown(events, light_share=0.5, contrast=0.3)
    grey = [0.5 * 255 * light / (1 + light) for light in (np.exp(4 * 0.3), 1, np.exp(-4 * 0.3))]
    assert [alone[3, 5].tolist(), alone[0, 0].tolist(), alone[3, 6].tolist()] == [[round(g)] * 3 for g in grey]
    assert alone[0, 1].tolist() == [0, 255, 0]
    mixed = shown(events, light_share=0.5, contrast=0.3, light_below_events=True)
    assert mixed[0, 1].tolist() == [64, 255, 64]
    assert mixed[3, 5].tolist() == alone[3, 5].tolist()


@pytest.mark.parametrize(
    "wrong",
    [{"channels": ()}, {"channels": ("on", "on")}, {"filter_ms": 0.0}, {"light_share": 1.5},
     {"on_colour": (0, 256, 0)}, {"contrast": 0.0}],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused_by_their_name(wrong):
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))} must be"):
        PictureSettings(**wrong)
