"""Lens figures against tables and closed forms; pictures through lenses against analytic ones."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate1d, gaussian_filter1d

from emulator.light import Scene, SceneError
from emulator.optics.lens import DistortionError, LensParameters
from emulator.optics.through import Bilinear, BlurWorkers, Through, bend, gaussian_taps
from emulator.photometry.reflectance import LUMENS_A_WATT, SUN_W_M2
from emulator.rig.kinds import CAMERA_MODELS

CHIP = CAMERA_MODELS["davis346"].chip


class Plane(Scene):
    """Radiance that follows a function of the direction's tangents and time."""

    def __init__(self, camera, radiance, distance_m=math.inf):
        self.camera, self._radiance, self._distance_m = camera, radiance, distance_m
        self.closed = False

    @property
    def size(self):
        return self.camera.size

    @property
    def motion_bound_px_s(self):
        return 5.0

    @property
    def distance_m(self):
        return self._distance_m

    def light(self, t_ns, out):
        c = self.camera
        x, y = np.meshgrid(np.arange(c.width) + 0.5 - c.width / 2, np.arange(c.height) + 0.5 - c.height / 2)
        out[:] = self._radiance(x / c.focal_px, y / c.focal_px, t_ns * 1e-9)

    def light_and_rate(self, t_ns, light, rate):
        before, after = np.zeros_like(light), np.zeros_like(light)
        self.light(t_ns - 1_000_000, before)
        self.light(t_ns + 1_000_000, after)
        self.light(t_ns, light)
        rate[:] = (after - before) / np.float32(2e-3)

    def close(self):
        self.closed = True


def look(lens, radiance, size=(64, 48), **more):
    with Through(lens, CHIP, size, lambda camera: Plane(camera, radiance, **more)) as scene:
        light, rate = np.zeros(size[::-1], np.float32), np.zeros(size[::-1], np.float32)
        scene.light(0, light)
        again = np.zeros_like(light)
        scene.light_and_rate(0, again, rate)
    return light, again, rate


def test_the_table_of_sunlit_things():
    """A white Lambert surface at 1 au through f/2: 7510 lx on the chip, 244 pA; Itokawa at I/F 0.13: 32 pA."""
    lens = LensParameters(f_number=2.0, transmission=0.9)
    white = SUN_W_M2 / math.pi
    assert white * lens.light_per_radiance * lens.reference_lux == pytest.approx(7510, rel=0.01)
    assert CHIP.photocurrent_a(white * lens.chip_share) == pytest.approx(244e-12, rel=0.02)
    assert CHIP.photocurrent_a(0.13 * white * lens.chip_share) == pytest.approx(32e-12, rel=0.02)
    assert lens.chip_irradiance_w_m2(1.0) * LUMENS_A_WATT == pytest.approx(lens.reference_lux)


@pytest.mark.parametrize("f_number", [0.7, 1.4, 8.0])
def test_the_light_of_a_cone_is_summed_over_its_solid_angle(f_number):
    """E = tau L times the integral of cos u over the cone whose edge has the sine 1 / (2 N), by Abbe's condition."""
    edge = math.asin(1 / (2 * f_number))
    u = (np.arange(100_000) + 0.5) * edge / 100_000
    cone = float(np.sum(2 * np.pi * np.sin(u) * np.cos(u))) * edge / 100_000
    assert LensParameters(f_number=f_number, transmission=0.8).chip_share == pytest.approx(0.8 * cone, rel=1e-6)


def test_light_falls_as_cos_to_the_fourth():
    lens = LensParameters(field_of_view_deg=90.0)
    light, _, _ = look(lens, lambda x, y, t: np.ones_like(x))
    camera = lens.pinhole((64, 48))
    tangent = math.hypot(63 / 2, 47 / 2) / camera.focal_px
    assert light[0, 0] == pytest.approx(lens.light_per_radiance * math.cos(math.atan(tangent)) ** 4, rel=1e-5)
    assert light[0, 0] == light[-1, -1]
    flat, _, _ = look(LensParameters(field_of_view_deg=90.0, vignetting=False), lambda x, y, t: np.ones_like(x))
    assert np.ptp(flat) == 0


def test_a_rate_goes_the_same_way_as_the_light():
    lens = LensParameters(field_of_view_deg=60.0, k1=-0.2, blur_px=1.0)
    light, again, rate = look(lens, lambda x, y, t: (2 + x + y) * (1 + 3 * t))
    np.testing.assert_allclose(again, light, rtol=1e-5)
    np.testing.assert_allclose(rate, 3 * light, rtol=1e-3)


@given(st.floats(-0.3, 0.3), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_straightening_undoes_bending(k1, p1, p2, x, y):
    distortion = LensParameters(k1=k1, k2=0.01, p1=p1, p2=p2)
    at = distortion.bend(np.array([x]), np.array([y]))
    back = distortion.straighten(*at)
    np.testing.assert_allclose(np.array(back).ravel(), [x, y], atol=1e-9)


def test_bending_is_opencv_s_formula():
    """x = .3, y = .2 by hand: r^2 = .13, radial 1.013171197."""
    (x,), (y,) = LensParameters(k1=0.1, k2=0.01, k3=0.001, p1=0.02, p2=-0.03).bend(np.array([0.3]), np.array([0.2]))
    assert (x, y) == pytest.approx((0.2970513591, 0.2032342394))


def test_a_bent_picture_shows_each_direction_where_the_model_says():
    lens = LensParameters(field_of_view_deg=60.0, k1=-0.2, p1=0.01, vignetting=False)
    light, _, _ = look(lens, lambda x, y, t: 2 + x)
    camera = lens.pinhole((64, 48))
    column, row = 50, 7
    seen = np.array([(column + 0.5 - 32) / camera.focal_px]), np.array([(row + 0.5 - 24) / camera.focal_px])
    (x,), _ = lens.straighten(*seen)
    assert light[row, column] == pytest.approx(lens.light_per_radiance * (2 + x), rel=1e-5)
    assert abs(x - seen[0][0]) * camera.focal_px > 0.3


def test_a_lens_that_folds_the_picture_is_refused():
    with pytest.raises(DistortionError, match="degrees off the axis"):
        LensParameters(k1=-0.5).straighten(np.array([0.2, 0.7]), np.array([0.0, 0.0]))
    with pytest.raises(SceneError, match=r"camera\.lens: k1"):
        look(LensParameters(field_of_view_deg=120.0, k1=-0.5), lambda x, y, t: x)


def blurred_and_scaled(pictures, taps, factor, part, threads=1):
    """Blur and scale a part; the rest stays 7."""
    outs = [np.full_like(picture, 7) for picture in pictures]
    workers = BlurWorkers(taps, factor, threads)
    workers(pictures, part, outs)
    workers.close()
    return np.array(outs)


@given(st.floats(0.1, 4.0))
def test_blur_keeps_all_light_and_is_a_gaussian(sigma):
    taps = gaussian_taps(sigma)
    assert taps.sum() == pytest.approx(1.0, abs=1e-6)
    picture, factor = np.random.default_rng(1).uniform(0, 1, (2, 21, 33)).astype(np.float32)
    (blurred,) = blurred_and_scaled([picture], taps, factor, (0, 21, 0, 33))
    oracle = picture.astype(float)
    for axis in (0, 1):
        oracle = correlate1d(oracle, taps, axis, mode="nearest")
    np.testing.assert_allclose(blurred, oracle * factor, atol=1e-5)


def test_blur_s_width_is_that_of_scipy():
    line = np.zeros((1, 101), np.float32)
    line[0, 50] = 1
    (blurred,) = blurred_and_scaled([line], gaussian_taps(2.0), np.ones_like(line), (0, 1, 0, 101))
    np.testing.assert_allclose(blurred[0], gaussian_filter1d(np.eye(1, 101, 50)[0], 2.0), atol=3e-3)


def test_looking_up_between_pixels_is_exact_for_a_plane():
    picture = np.add.outer(np.arange(8.0), 2 * np.arange(9.0)).astype(np.float32)
    columns, rows = np.array([[1.25, 8.9]]), np.array([[3.75, 0.1]])
    out = np.zeros((1, 2), np.float32)
    bend(picture, Bilinear(columns, rows, (9, 8)), out)
    np.testing.assert_allclose(out, [[3.25 + 2 * 0.75, 16.0]], atol=1e-6)


def test_defocus_by_the_thin_lens():
    """f = 25 mm at f/2 focused at 2 m; an object at 1 m: c = f^2 / (N (s - f)) |s - d| / d."""
    lens = LensParameters(f_number=2.0, focus_m=2.0)
    focal_px = 0.025 / 18.5e-6
    expected_m = 0.025**2 / (2 * (2 - 0.025)) * (2 - 1) / 1
    assert lens.confusion_px(CHIP, focal_px, 1.0) == pytest.approx(expected_m / 18.5e-6, rel=1e-6)
    assert lens.confusion_px(CHIP, focal_px, 2.0) == pytest.approx(0, abs=1e-9)
    assert LensParameters().confusion_px(CHIP, focal_px, math.inf) == 0


def test_defocus_blurs_what_is_near_and_a_sharp_lens_costs_nothing():
    def edge(x, y, t):
        return np.where(x < 0, 1.0, 0.1)

    sharp, _, _ = look(LensParameters(vignetting=False), edge)
    near, _, _ = look(LensParameters(vignetting=False, focus_m=1e6, f_number=1.4), edge, distance_m=0.005)
    assert np.unique(sharp[5]).size == 2
    assert np.unique(near[5]).size > 4


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    ("size", "part"), [((700, 350), (0, 350, 0, 700)), ((700, 350), (11, 343, 2, 697)), ((5, 4), (1, 4, 0, 3))]
)
@pytest.mark.parametrize("sigma_px", [0.3, 2.0])
def test_threads_blur_and_scale_to_the_same_bits(threads, size, part, sigma_px):
    random, (width, height) = np.random.default_rng(1), size
    pictures = [random.random((height, width), np.float32) for _ in range(2)]
    factor, taps = random.random((height, width), np.float32), gaussian_taps(sigma_px)
    first_row, last_row, first, last = part
    expected = np.full((2, height, width), 7, np.float32)
    frame = blurred_and_scaled(pictures, taps, factor, (0, height, 0, width))
    expected[:, first_row:last_row, first:last] = frame[:, first_row:last_row, first:last]
    assert (blurred_and_scaled(pictures, taps, factor, part, threads) == expected).all()


@pytest.mark.parametrize("bad", [{"f_number": 0.0}, {"transmission": 1.1}, {"k1": math.nan}, {"blur_px": -1.0}])
def test_nonsense_is_refused(bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))} must be .*, got "):
        LensParameters(**bad)
