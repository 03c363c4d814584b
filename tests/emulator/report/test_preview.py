from __future__ import annotations

import sys

import numpy as np
import pytest
from PIL import Image

from emulator.light import SceneError
from emulator.report.preview import event_picture, save_png
from firmware_protocol.events import EVENT, empty_events

LIGHT = np.array([[0.0, 0.5, 1.0], [2.0, 0.25, 0.0]], np.float32)


def events(*rows):
    return np.array(list(rows), EVENT)


def test_on_is_green_off_is_red_and_the_last_is_seen():
    picture = event_picture(LIGHT, events((1, 0, 0, True), (2, 2, 1, False), (3, 1, 0, True), (4, 1, 0, False)))
    assert picture.shape == (2, 3, 3)
    assert picture.dtype == np.uint8
    assert picture[0, 0].tolist() == [0, 255, 0]
    assert picture[1, 2].tolist() == [255, 0, 0]
    assert picture[0, 1].tolist() == [255, 0, 0]


def test_light_is_encoded_for_a_screen_and_dimmed():
    grey = event_picture(LIGHT, empty_events(), white=1.0, dimming=1.0)
    assert grey[..., 0].tolist() == [[0, 188, 255], [255, 137, 0]]  # sRGB of 0.5 and 0.25
    assert (grey == grey[..., :1]).all()
    assert event_picture(LIGHT, empty_events()).max() == 64  # 25 %, white being the brightest of the picture


def test_a_black_picture_is_black():
    assert not event_picture(np.zeros((2, 2), np.float32), empty_events()).any()


def test_events_of_another_sensor_are_refused():
    with pytest.raises(ValueError, match="outside the 3 x 2 picture"):
        event_picture(LIGHT, events((1, 3, 0, True)))


def test_png_round_trip(tmp_path):
    rgb = event_picture(LIGHT, events((1, 0, 0, True)))
    save_png(tmp_path / "picture.png", rgb)
    with Image.open(tmp_path / "picture.png") as image:
        np.testing.assert_array_equal(np.asarray(image), rgb)
    with pytest.raises(SceneError, match="cannot be written"):
        save_png(tmp_path / "gone" / "picture.png", rgb)


def test_without_pillow_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(SceneError, match=r"evstim\[report\]"):
        save_png(tmp_path / "picture.png", np.zeros((1, 1, 3), np.uint8))
