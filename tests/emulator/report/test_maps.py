"""Maps and small pictures: PNG files that another library reads, scales, reduced sensors."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

from emulator.report.pictures import OFF_RGB, ON_RGB, ColourScale, count_map, palette_png, reduced, scene_picture


def pixels_of(element):
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', element)
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        return np.asarray(image.convert("RGB"))


def test_pillow_reads_a_png_with_a_palette():
    palette = np.array([[1, 2, 3], [250, 0, 7]], np.uint8)
    numbers = np.random.default_rng(1).integers(0, 2, (5, 9)).astype(np.uint8)
    with Image.open(io.BytesIO(palette_png(numbers, palette))) as image:
        assert np.array_equal(np.asarray(image.convert("RGB")), palette[numbers])


def test_only_pixels_without_an_event_have_the_lowest_level():
    levels = ColourScale(1_000_000).levels(np.array([0, 1, 10, 1000, 1_000_000]))
    assert levels[0] == 0
    assert (np.diff(levels.astype(int)) > 0).all()
    assert levels[-1] == 15
    assert not ColourScale(0).levels(np.zeros(3, np.int64)).any()


def test_a_hot_pixel_of_a_large_sensor_stays_visible():
    counts = np.zeros((700, 1281), np.int64)
    counts[699, 1280] = 9
    small = reduced(counts, 3)
    assert small.shape == (234, 427)
    assert small[233, 426] == 9
    assert small.sum() == 9
    shown = pixels_of(count_map(counts, ColourScale(9), "ON events"))
    assert shown.shape == (234, 427, 3)
    assert shown[233, 426].tolist() == [254, 232, 56]
    assert "the largest of 3 x 3 pixels is shown" in count_map(counts, ColourScale(9), "ON events")


def test_a_picture_has_events_over_dimmed_light():
    light = np.array([[0.0, 1.0], [0.5, 1.0]], np.float32)
    polarity = np.array([[0, 1], [-1, 0]], np.int8)
    rgb = pixels_of(scene_picture(light, polarity, "0.5 s"))
    assert rgb[0, 0].tolist() == [0, 0, 0]
    assert (tuple(rgb[0, 1]), tuple(rgb[1, 0])) == (ON_RGB, OFF_RGB)
    assert rgb[1, 1, 0] == pytest.approx(255 * 0.45, abs=1)
