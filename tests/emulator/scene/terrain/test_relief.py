"""The made ridge: spectrum, size laws, shapes, the nest of grids, and the cache."""

import dataclasses
import itertools
import math
import mmap
import os

import numpy as np
import pytest
from scipy import integrate, special

from emulator.scene import files
from emulator.scene.files import cached_array
from emulator.scene.terrain.ground import nested
from emulator.scene.terrain.relief import (
    DEPTH,
    HURST,
    REACH,
    RIM,
    boulder_sizes,
    crater_places,
    crater_shapes,
    crater_sizes,
    fractal,
    height_of_boulder,
    height_of_crater,
    make_albedo,
    make_ridge,
    raise_boulders,
    sink_craters,
)
from emulator.scene.terrain.table import Ridge

FRESH = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
SMALL = Ridge(size_m=2048.0, finest_m=4.0, posts=128, ridge_m=300.0)


def test_relief_has_the_spectrum_s_slope_and_the_height_differences_of_its_law():
    rng, n, rough = np.random.default_rng(5), 512, 0.1
    power = np.mean([np.abs(np.fft.fft2(fractal(rng, n, 1.0, 0.0, 0.5, rough))) ** 2 for _ in range(4)], axis=0)
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    inside = (k > 4 / n) & (k < 0.5)
    slope, _ = np.polyfit(np.log(k[inside]), np.log(power[inside]), 1)
    # each of 2e5 log powers scatters by about 0.7: the slope's standard error is some 0.005
    assert slope == pytest.approx(-(2 * HURST + 2), abs=0.02)
    # v(r)^2 is an integral over the band that the map holds
    r, a = 8.0, rough**2 / (4 * math.pi * (2 * math.pi) ** (2 * HURST) * _bessel_integral())
    band = integrate.quad(
        lambda q: 4 * math.pi * a * q ** (-2 * HURST - 1) * (1 - special.j0(2 * math.pi * q * r)), 1 / n, 0.5, limit=400
    )[0]
    z = np.stack([fractal(rng, n, 1.0, 0.0, 0.5, rough) for _ in range(4)])
    assert np.mean((z[:, :, 8:] - z[:, :, :-8]) ** 2) == pytest.approx(band, rel=0.15)


def _bessel_integral():
    return integrate.quad(lambda x: x ** (-2 * HURST - 1) * (1 - special.j0(x)), 0, 200, limit=2000)[0]


def test_the_strength_s_integral_is_the_closed_form():
    h = HURST
    closed = math.gamma(1 - h) / (2 ** (2 * h + 1) * h * math.gamma(1 + h))
    assert _bessel_integral() == pytest.approx(closed, rel=1e-3)


def test_craters_are_as_many_of_each_size_as_the_law_says():
    area, limits = 4e6, (10.0, 300.0)
    sizes = crater_sizes(np.random.default_rng(7), 0.046, *limits, area)
    assert (np.diff(sizes) <= 0).all()
    for d in (10.0, 20.0, 50.0):
        expected = 0.046 * (d**-2 - limits[1] ** -2) * area
        assert abs((sizes > d).sum() - expected) < 4 * math.sqrt(expected)  # four standard deviations
    # maximum likelihood of a truncated power law's exponent; its standard error is about 2 / sqrt(n)
    inner = sizes[sizes < 100]
    exponent = len(inner) / np.log(inner / 10).sum()
    assert exponent == pytest.approx(2.0, abs=0.05 + 8 / math.sqrt(len(inner)))


def test_boulders_cover_the_share_of_the_ground_that_the_law_says():
    k, limits, area = 0.02, (0.1, 0.4), 2e4
    q = 1.79 + 0.152 / k
    sizes = boulder_sizes(np.random.default_rng(3), k, *limits, area)
    covered = (math.pi / 4 * sizes**2).sum() / area
    assert covered == pytest.approx(k * (math.exp(-q * limits[0]) - math.exp(-q * limits[1])), rel=0.05)
    assert limits[0] <= sizes.min() <= sizes.max() <= limits[1]
    assert boulder_sizes(np.random.default_rng(3), 0.0, *limits, area).size == 0


def test_a_crater_has_its_depth_its_rim_and_its_volume():
    posts, d = 301, 80.0
    heights = np.zeros((posts, posts))
    sink_craters(heights, np.array([[150.0, 150.0]]), np.array([d]), FRESH)
    assert heights.min() == pytest.approx(-(DEPTH - RIM) * d)
    assert heights.max() == pytest.approx(RIM * d, rel=0.05)
    profile = integrate.quad(
        lambda r: 2 * math.pi * r * height_of_crater(r, d, 1.0, 0.0) * (d / 2) ** 2, 0, REACH, points=[1.0]
    )
    bowl = math.pi * (d / 2) ** 2 * d * (RIM - DEPTH / 2)  # integral of 0.2 (r^2 - 1) + 0.04
    edge = RIM / REACH**3
    blanket = RIM * (1 - 1 / REACH) - edge / (REACH - 1) * ((REACH**3 - 1) / 3 - (REACH**2 - 1) / 2)
    assert profile[0] == pytest.approx(bowl + 2 * math.pi * (d / 2) ** 2 * d * blanket, rel=1e-6)
    assert heights.sum() == pytest.approx(profile[0], rel=0.01)
    assert heights[0, 0] == 0


def test_an_old_crater_is_shallower_its_rim_is_gone_first_and_its_floor_is_flat():
    heights = np.zeros((301, 301))
    worn = np.array([[0.5, 0.3, 0.0, 0.0, 0.0, 0.0]])
    sink_craters(heights, np.array([[150.0, 150.0]]), np.array([80.0]), worn)
    assert heights.max() == pytest.approx(0.25 * RIM * 80, rel=0.05)
    assert heights.min() == pytest.approx((-0.5 * DEPTH * 0.7 + 0.25 * RIM) * 80)
    assert (heights == heights.min()).sum() == pytest.approx(0.3 * math.pi * 40**2, rel=0.02)


def test_most_craters_are_old_and_some_stand_in_chains():
    rng = np.random.default_rng(4)
    ages = crater_shapes(rng, 20_000)[:, 0]
    assert 0.12 <= ages.min() <= ages.max() <= 1
    assert ages.mean() == pytest.approx(0.12 + 0.88 / 2.5, abs=0.01)  # mean of u^1.5
    diameters = np.sort(rng.uniform(1, 2, 5000))[::-1]
    places = crater_places(rng, diameters, 1000.0)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    near = steps < 2.5 * diameters[:-1]
    lonely = np.linalg.norm(np.diff(rng.random((5000, 2)) * 1000, axis=0), axis=1) < 2.5 * diameters[:-1]
    assert near.sum() == pytest.approx(5000 / 30 * 7 / 8, rel=0.25)
    assert lonely.sum() < 5


@pytest.mark.system
def test_boulders_have_flat_sides_a_circle_s_area_and_half_their_width_at_most():
    lots = np.random.default_rng(8).random((200, 4))
    x, y = np.meshgrid(np.linspace(-1.7, 1.7, 120), np.linspace(-1.7, 1.7, 120))
    grids = np.array(
        [[height_of_boulder(a, b, lot) for a, b in zip(x.ravel(), y.ravel(), strict=True)] for lot in lots]
    )
    areas = (grids > 0).mean(axis=1) * 3.4**2
    assert areas.mean() == pytest.approx(math.pi, rel=0.02)
    assert grids.max() < 1.25
    one = np.maximum(grids[0].reshape(x.shape), 0)
    inside = one > 0.05
    bend = np.abs(one[1:-1, 2:] - 2 * one[1:-1, 1:-1] + one[1:-1, :-2])[inside[1:-1, 1:-1]]
    assert (bend < 1e-9).mean() > 0.7  # flat, but for its edges
    heights = np.zeros((61, 61))
    raise_boulders(heights, np.array([[30.0, 30.0]]), np.array([20.0]), lots[:1])
    assert heights.max() == pytest.approx(10 * grids[0].max(), rel=0.1)


def test_albedo_has_the_stated_mean_and_agrees_between_grids():
    many = Ridge(size_m=2048.0, finest_m=4.0, posts=128, ridge_m=0.0, albedo_rms=0.1)
    albedo = make_albedo(many)
    assert albedo.shape == make_ridge(many).heights_m.shape
    assert albedo[-1].mean() == pytest.approx(1, abs=0.01)
    for finer, coarser in itertools.pairwise(albedo):
        np.testing.assert_array_equal(finer[::2, ::2], coarser[32:97, 32:97])
    bare = make_albedo(dataclasses.replace(many, crater_density=0.0))
    assert bare[0].std() == pytest.approx(0.1, rel=0.4)
    assert (albedo > bare - 0.1).mean() > 0.99  # young craters brighten


def test_grids_agree_where_they_overlap_and_the_site_is_at_zero():
    ground = make_ridge(SMALL)
    assert ground.grids == 3
    assert ground.unit_m == pytest.approx(4.0)
    for finer, coarser in zip(ground.heights_m[:-1], ground.heights_m[1:], strict=True):
        np.testing.assert_array_equal(finer[::2, ::2], coarser[32:97, 32:97])
    assert ground.height_m(0.0, 0.0) == 0
    assert ground.height_m(1024.1, 0.0) is None
    curved = ground.curved(1_737_400.0)
    drop = ground.height_m(-1000.0, 600.0) - curved.height_m(-1000.0, 600.0)
    assert drop == pytest.approx((1000.0**2 + 600.0**2) / (2 * 1_737_400.0), rel=0.01)
    for finer, coarser in zip(curved.heights_m[:-1], curved.heights_m[1:], strict=True):
        np.testing.assert_array_equal(finer[::2, ::2], coarser[32:97, 32:97])


def test_a_map_is_the_same_for_a_seed_and_another_for_another():
    first, again = (make_ridge(SMALL).heights_m for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = make_ridge(Ridge(size_m=2048.0, finest_m=4.0, posts=128, ridge_m=300.0, seed=2)).heights_m
    assert np.abs(first - other).max() > 1


def test_heights_between_posts_are_linear():
    rows, columns = np.mgrid[:9, :13].astype(float)
    ground = nested(2.0, [3 * rows + columns])
    assert ground.first(0) == (-6, -4)
    assert ground.height_m(3.0, -5.0) == pytest.approx(3 * (-2.5) + 1.5)
    assert ground.half_m == 8.0


def test_what_was_made_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = []

    def make():
        made.append(1)
        return np.full((1, 2, 3), len(made), np.float32)

    for _ in range(2):
        assert cached_array("thing", SMALL, make)[0, 0, 0] == 1
    assert cached_array("thing", Ridge(), make)[0, 0, 0] == 2
    assert len(list((tmp_path / "evstim").iterdir())) == 2


@pytest.mark.parametrize(
    "damaged",
    [
        lambda content: content[:-5],  # cut short by a full disk
        lambda content: content[:-5] + bytes([content[-5] ^ 1]) + content[-4:],
        lambda content: content.replace(b"(1, 2, 3)", b"(1, 3, 2)"),
        lambda content: bytes(len(content)),  # as a power failure leaves it
        lambda content: bytes(4),
        lambda content: b"",
    ],
    ids=["short", "bit", "shape", "zeros", "few zeros", "empty"],
)
def test_a_damaged_array_is_made_anew(tmp_path, monkeypatch, damaged):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = np.arange(6, dtype=np.float32).reshape(1, 2, 3)
    cached_array("thing", SMALL, lambda: made)
    (path,) = (tmp_path / "evstim").iterdir()
    sound = path.read_bytes()
    path.write_bytes(damaged(sound))
    np.testing.assert_array_equal(cached_array("thing", SMALL, lambda: made), made)
    assert path.read_bytes() == sound
    path.unlink()
    path.mkdir()
    np.testing.assert_array_equal(cached_array("thing", SMALL, lambda: made), made)


def test_an_array_of_the_cache_is_mapped_and_changes_to_it_leave_the_file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        array = cached_array("thing", SMALL, lambda: np.ones((1, 2, 3), np.float32))
        assert array.all()
        base = array
        while isinstance(base, np.ndarray):
            base = base.base
        array[:] = 0
    assert isinstance(memoryview(base).obj, mmap.mmap)


def test_arrays_that_were_not_used_for_longest_make_room(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(files, "_MOST_BYTES", 3000)
    made = []

    def make():
        made.append(1)
        return np.zeros((1, 16, 16), np.float32)

    def last_used(seconds):
        newest = max((tmp_path / "evstim").iterdir(), key=lambda path: path.stat().st_mtime)
        os.utime(newest, (seconds, seconds))

    for seconds, name in enumerate(["first", "second"]):
        cached_array(name, SMALL, make)
        last_used(seconds)
    cached_array("first", SMALL, make)  # used again
    cached_array("third", SMALL, make)
    assert len(made) == 3
    assert {path.name.split("-")[0] for path in (tmp_path / "evstim").iterdir()} == {"first", "third"}
    cached_array("large", SMALL, lambda: np.zeros((1, 64, 64), np.float32))  # larger than the room for all
    assert [path.name.split("-")[0] for path in (tmp_path / "evstim").iterdir()] == ["large"]


def test_a_cache_that_can_only_be_read_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cached_array("thing", SMALL, lambda: np.ones((1, 2, 2), np.float32))

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.os, "utime", refuse)
    assert cached_array("thing", SMALL, refuse).all()


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(files, "cache_folder", lambda: tmp_path / "file" / "evstim")
    assert cached_array("thing", SMALL, lambda: np.ones((1, 2, 2), np.float32)).all()
    assert "cannot be written" in capsys.readouterr().err


def test_a_user_without_a_place_at_home_has_a_folder_below_tmpdir(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    private = tmp_path / f"evstim-{os.geteuid()}"
    monkeypatch.setenv("HOME", "/dev/null")
    assert files.cache_folder() == private
    private.chmod(0o755)
    assert np.all(cached_array("thing", SMALL, lambda: np.ones((1, 2, 2), np.float32)))
    assert list(tmp_path.rglob("*")) == [private]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"posts": 100}, "posts is 100"),
        ({"ridge_m": 5000.0, "size_m": 8000.0}, "does not fit"),
        ({"seed": -1}, "seed must be .*, got -1"),
        ({"slope_deg": float("nan")}, "slope_deg must be .*, got nan"),
    ],
)
def test_nonsense_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Ridge(**changes)
