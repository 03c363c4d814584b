"""Heightmaps from files: what is read, filled and refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from emulator.light import SceneError
from emulator.scene.terrain.heightmap import filled, load_heightmap
from emulator.scene.terrain.table import Heightmap

MOON_M = 1_737_400.0


def geotiff(path, heights, *, nodata=None, scale=(5.0, 5.0, 0.0), tie=(0.0, 0.0, 0.0, -19000.0, -4000.0, 0.0)):
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for number, values in ((33550, scale), (33922, tie)):
        if values:
            tags[number], tags.tagtype[number] = values, 12
    if nodata:
        tags[42113], tags.tagtype[42113] = nodata, 2
    Image.fromarray(heights).save(path, tiffinfo=tags)
    return str(path)


def saved(path, heights):
    np.save(path, heights)
    return str(path)


def test_a_table_of_heights_is_read_with_north_up(tmp_path):
    heights = np.arange(20.0).reshape(4, 5)
    ground = load_heightmap(Heightmap(path=saved(tmp_path / "map.npy", heights), post_m=10.0), MOON_M)
    assert ground.unit_m == 10.0
    north, south = ground.height_m(0.0, 20.0), ground.height_m(0.0, -10.0)
    assert (north, south) == (2.0 - 12.0, 17.0 - 12.0)  # row 0 is north; the site's own height is taken away
    assert ground.height_m(10.0, 0.0) == 1.0


def test_a_geotiff_brings_its_scale_and_its_place(tmp_path):
    heights = np.random.default_rng(1).normal(0, 1, (40, 30)).astype(np.float32)
    ground = load_heightmap(Heightmap(path=geotiff(tmp_path / "site.tif", heights)), MOON_M)
    x, y = -19000.0 + 15 * 5, -4000.0 - 20 * 5
    tangent = math.hypot(x, y) / (2 * MOON_M)
    assert ground.unit_m == pytest.approx(5.0 / (1 + tangent**2), rel=1e-9)
    (note,) = ground.notes
    assert f"{90 - math.degrees(2 * math.atan(tangent)):.2f} degrees" in note
    expected = heights[::-1] - heights[::-1][19, 14]
    np.testing.assert_allclose(ground.heights_m[0], expected, atol=1e-5)


@pytest.mark.parametrize("x_m", [1e9, 1e200])
def test_a_place_beyond_the_body_is_refused(tmp_path, x_m):
    """A damaged tag of a GeoTIFF gave 1e200 m, whose square no float holds."""
    path = saved(tmp_path / "map.npy", np.zeros((9, 9)))
    with pytest.raises(SceneError, match="beyond the body"):
        load_heightmap(Heightmap(path=path, post_m=20.0, centre_m=(x_m, 0.0)), MOON_M)


def test_integers_kilometres_and_a_value_for_nothing(tmp_path):
    heights = np.full((20, 20), 3, np.int16)
    heights[4, 5] = -32768
    ground = load_heightmap(Heightmap(path=geotiff(tmp_path / "map.tif", heights, nodata="-32768"), units_m=0.5), 0.0)
    assert (ground.heights_m == 0).all()
    assert ground.notes == ("1 of 400 posts are holes, filled from their neighbours",)


def test_holes_are_filled_from_their_edge_inwards():
    rows, columns = np.mgrid[:12, :12].astype(float)
    plane = 2 * rows + columns
    holed = plane.copy()
    holed[5:8, 5:8] = np.nan
    out, count = filled(holed, 0.1)
    assert count == 9
    np.testing.assert_array_equal(out[np.isfinite(holed)], plane[np.isfinite(holed)])
    assert out[6, 6] == pytest.approx(plane[6, 6])
    assert np.abs(out - plane).max() < 2.5


@given(st.integers(0, 2**32), st.floats(0.0, 0.5))
def test_filling_leaves_no_hole_and_never_goes_beyond_what_was_there(seed, share):
    rng = np.random.default_rng(seed)
    heights = rng.normal(size=(7, 9))
    heights[rng.random((7, 9)) < share * 0.9] = np.nan
    known = heights[np.isfinite(heights)]
    if known.size and known.size >= heights.size / 2:
        out, _ = filled(heights, 0.5)
        assert known.min() - 1e-12 <= out.min() <= out.max() <= known.max() + 1e-12


def nothing(path):
    return str(path)


def text(path):
    path.write_text("no map")
    return str(path)


@pytest.mark.parametrize(
    ("name", "write", "changes", "message"),
    [
        ("map.npy", nothing, {}, "cannot be read: No such file"),
        ("map.npy", text, {}, "map.npy: cannot be read"),
        ("map.tif", text, {}, "is not a TIFF"),
        ("map.jpg", text, {}, "name the file .npy or .tif"),
        ("map.npy", lambda p: saved(p, np.zeros((9, 9))), {}, "give post_m"),
        ("map.npy", lambda p: saved(p, np.zeros(9)), {"post_m": 1.0}, "numbers in rows and columns"),
        ("map.npy", lambda p: saved(p, np.array([["a"] * 9] * 9)), {"post_m": 1.0}, "numbers in rows and columns"),
        ("map.npy", lambda p: saved(p, np.zeros((2, 9))), {"post_m": 1.0}, "2 x 9 posts"),
        ("map.npy", lambda p: saved(p, np.full((9, 9), np.nan)), {"post_m": 1.0}, "81 of 81 posts .* are holes"),
        ("map.npy", lambda p: saved(p, np.full((9, 9), np.inf)), {"post_m": 1.0}, "are holes"),
        (
            "map.npy",
            lambda p: saved(p, np.random.default_rng(1).normal(0, 30, (9, 9))),
            {"post_m": 5.0, "units_m": 1000.0},
            "look at units_m and post_m",
        ),
        ("map.tif", lambda p: geotiff(p, np.zeros((9, 9), np.float32), scale=None), {}, "give post_m"),
        ("map.tif", lambda p: geotiff(p, np.zeros((9, 9), np.float32), scale=(5.0, 7.0, 0.0)), {}, "square ones"),
        ("map.tif", lambda p: geotiff(p, np.zeros((9, 9), np.float32), nodata="none"), {}, "GDAL_NODATA"),
        ("map.tif", lambda p: geotiff(p, np.zeros((9, 9, 3), np.uint8)), {}, "numbers in rows and columns"),
    ],
)
def test_what_is_no_map_is_told(tmp_path, name, write, changes, message):
    with pytest.raises(SceneError, match=message):
        load_heightmap(Heightmap(path=write(tmp_path / name), **changes), MOON_M)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "path is missing"),
        ({"post_m": -1.0}, "post_m must be .*, got -1"),
        ({"units_m": 0.0}, "units_m must be .*, got 0"),
    ],
)
def test_nonsense_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Heightmap(**({"path": "map.npy"} if changes else {}), **changes)
