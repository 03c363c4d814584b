from __future__ import annotations

import sys

import av
import numpy as np
import pytest
from PIL import Image

from emulator.light import MachineLacks, SceneError
from emulator.report.pictures import OFF_RGB, ON_RGB, captioned, event_picture, save_movie, save_png, white_of
from firmware_protocol.events import EVENT, empty_events

LIGHT = np.array([[0.0, 0.5, 1.0], [2.0, 0.25, 0.0]], np.float32)


def events(*rows):
    return np.array(list(rows), EVENT)


def test_on_is_orange_off_is_blue_and_the_last_is_seen():
    picture = event_picture(LIGHT, events((1, 0, 0, True), (2, 2, 1, False), (3, 1, 0, True), (4, 1, 0, False)))
    assert picture.shape == (2, 3, 3)
    assert picture.dtype == np.uint8
    assert picture[0, 0].tolist() == [230, 159, 0]
    assert picture[1, 2].tolist() == [86, 180, 233]
    assert picture[0, 1].tolist() == [86, 180, 233]


def test_light_is_encoded_for_a_screen_and_dimmed():
    grey = event_picture(LIGHT, empty_events(), white=1.0, dimming=1.0)
    assert grey[..., 0].tolist() == [[0, 188, 255], [255, 137, 0]]  # sRGB of 0.5 and 0.25
    assert (grey == grey[..., :1]).all()
    assert event_picture(LIGHT, empty_events()).max() == 64  # 25 % for white


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
    with pytest.raises(SceneError, match=r"'\.\[report\]'"):
        save_png(tmp_path / "picture.png", np.zeros((1, 1, 3), np.uint8))


def test_a_glint_does_not_make_the_rest_dark():
    light = np.full((100, 100), 0.1, np.float32)
    light[0, 0] = 1000.0
    assert white_of(light) == pytest.approx(0.1)
    assert event_picture(light, empty_events(), dimming=1.0).min() == 255
    assert white_of(np.zeros((2, 2), np.float32)) == 0.0


def luminance(rgb):
    linear = np.array([(v / 255 / 12.92) if v <= 10 else ((v / 255 + 0.055) / 1.055) ** 2.4 for v in rgb])
    return float(linear @ [0.2126, 0.7152, 0.0722])


# Full protanopia and deuteranopia by Vienot, Brettel and Mollon (1999): the one sees red by green alone, and so on.
@pytest.mark.parametrize("seen_red_green", [(0.11238, 0.88762), (0.29275, 0.70725)])
def test_both_colours_differ_for_people_who_cannot_tell_red_from_green(seen_red_green):
    on, off = ((np.dot(seen_red_green, rgb[:2]), rgb[2]) for rgb in (ON_RGB, OFF_RGB))
    assert abs(on[1] - off[1]) > 150  # blue stays
    assert min(luminance(ON_RGB), luminance(OFF_RGB)) > 0.3  # both brighter than light at 40 % of white


def test_a_caption_stands_below_the_picture():
    rgb = np.full((50, 300, 3), 7, np.uint8)
    below = captioned(rgb, "eros  0.50 s")
    assert (below[:50] == 7).all()
    text = below[50:].reshape(-1, 3)
    assert text.max() == 255
    assert (text == ON_RGB).all(axis=1).any()
    assert (text == OFF_RGB).all(axis=1).any()


PICTURES = [np.full((20, 31, 3), 80 * k, np.uint8) for k in range(3)]


def test_a_gif_holds_every_picture(tmp_path):
    save_movie(tmp_path / "a.gif", iter(PICTURES), 25)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (3, (31, 20), 40)


def test_an_mp4_holds_every_picture(tmp_path):
    save_movie(tmp_path / "a.mp4", iter(PICTURES), 25)
    with av.open(str(tmp_path / "a.mp4")) as file:
        levels = [frame.to_ndarray(format="rgb24").mean() for frame in file.decode(video=0)]
    assert levels == pytest.approx([0, 80, 160], abs=6)


@pytest.mark.parametrize(("name", "module", "extra"), [("a.gif", "PIL", "report"), ("a.mp4", "av", "files")])
def test_a_movie_names_the_extra_that_it_needs(name, module, extra, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MachineLacks, match=rf"'\.\[{extra}\]'"):
        save_movie(tmp_path / name, iter(PICTURES), 25)


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_a_movie_that_cannot_be_written_is_told(name, tmp_path):
    with pytest.raises(SceneError, match="cannot be written"):
        save_movie(tmp_path / "gone" / name, iter(PICTURES), 25)
