"""Points of light: no light lost between pixels, known stars where they are, and brightness in closed form."""

import dataclasses
import math
import socket

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.geometry.attitude import quaternion_of
from emulator.light import SceneError
from emulator.optics.lens import LensParameters
from emulator.photometry.reflectance import SUN_W_M2, Sun
from emulator.rig.kinds import CAMERA_MODELS
from emulator.scene.stars.catalogue import SUN_V, boxes_of, irradiance_w_m2, load_stars, splat
from emulator.scene.stars.stars import StarField
from emulator.scene.stars.table import MovingPoint, StarsParameters
from emulator.trajectory.mounting import looking_along
from emulator.trajectory.parameters import FixedPath, Keyframe, KeyframePath, LivePath, SpinPath
from firmware_protocol.pose_message import NOW, PoseMessage

SIZE = (64, 48)
LENS = LensParameters(field_of_view_deg=20.0, blur_px=0.5, f_number=1.4)
CHIP = CAMERA_MODELS["davis346"].chip
NO_RATE = np.zeros((0, 0), np.float32)
SIRIUS = np.radians([101.287, -16.716])


def direction(ra, dec):
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


def at(sight):
    q = quaternion_of(looking_along(sight, (0, 0, 1)))
    return FixedPath(q_world_from_body=tuple(float(v) for v in q))


def drawn(parameters, lens=LENS, t_ns=0):
    light, rate = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.float32)
    with StarField(parameters, SIZE, lens, CHIP) as scene:
        scene.light_and_rate(t_ns, light, rate)
        again = np.zeros_like(light)
        scene.light(t_ns, again)
    np.testing.assert_array_equal(again, light)
    return light, rate


def draw_points(points, sigma, light, rate=NO_RATE):
    boxes = np.empty((len(points), 4), np.int64)
    boxes_of(np.array(points), sigma, light.shape[::-1], boxes)
    splat(np.array(points), sigma, boxes, light, rate)
    return boxes


@given(st.floats(20, 30), st.floats(20, 30), st.floats(0.3, 1.2))
def test_no_light_is_lost_between_pixels(x, y, sigma):
    light = np.zeros((50, 50), np.float32)
    draw_points([[x, y, 3.0, 0.0, 0.0]], sigma, light)
    assert light.sum(dtype=float) == pytest.approx(3.0, rel=1e-3)
    rows, columns = np.mgrid[:50, :50] + 0.5
    sampling = math.exp(-2 * (math.pi * sigma) ** 2) / math.pi  # pixels themselves cannot tell the middle better
    assert (light * columns).sum() / light.sum() == pytest.approx(x, abs=sampling + 2e-3)
    assert (light * rows).sum() / light.sum() == pytest.approx(y, abs=sampling + 2e-3)


@given(st.floats(-3, 53), st.floats(-3, 53), st.floats(-5, 5), st.floats(-5, 5))
def test_a_rate_is_the_light_s_derivative(x, y, vx, vy):
    h = 1e-2
    pictures = [np.zeros((50, 50), np.float32) for _ in range(4)]
    draw_points([[x - h * vx, y - h * vy, 1.0, 0, 0]], 0.7, pictures[0])
    draw_points([[x + h * vx, y + h * vy, 1.0, 0, 0]], 0.7, pictures[1])
    draw_points([[x, y, 1.0, vx, vy]], 0.7, pictures[2], pictures[3])
    np.testing.assert_allclose(pictures[3], (pictures[1] - pictures[0]) / (2 * h), atol=5e-3)


def test_a_point_beyond_the_picture_touches_nothing_outside():
    light = np.zeros((5, 5), np.float32)
    draw_points([[-100.0, 2, 1, 0, 0], [2, 1e9, 1, 0, 0], [5.2, 2, 1, 0, 0]], 0.5, light)
    assert 0 < light.sum() < 1


@given(st.floats(10, 40), st.floats(10, 40), st.floats(0.3, 1.2), st.floats(-6, 1))
def test_a_star_touches_no_more_pixels_than_have_light(x, y, sigma, exponent):
    flux, light = 10.0**exponent, np.zeros((50, 50), np.float32)
    rows, columns = np.mgrid[:51, :51]
    down, across = (np.vectorize(math.erf)((at - by) / (sigma * 2**0.5)) / 2 for at, by in ((rows, y), (columns, x)))
    whole = flux * np.diff(down, axis=0)[:, 1:] * np.diff(across, axis=1)[1:]
    ((top, bottom, left, right),) = draw_points([[x, y, flux, 0, 0]], sigma, light)
    np.testing.assert_allclose(light, whole, rtol=1e-5, atol=1.01e-7)
    reach = sigma * max(4.0, (2 * math.log(max(1e7 * flux / (2 * math.pi * sigma**2), 1))) ** 0.5)
    assert max(bottom - top, right - left) <= 2 * reach + 2


def test_the_brightest_star_is_where_sirius_is():
    stars = load_stars(2.0)
    assert math.degrees(math.acos(stars.directions[0] @ direction(*SIRIUS))) < 0.02
    vega = stars.magnitudes[np.argmax(stars.directions @ direction(*np.radians([279.235, 38.784])))]
    assert vega == pytest.approx(0.03, abs=0.1)
    assert len(load_stars(6.0)) == pytest.approx(5000, rel=0.05)
    assert np.linalg.norm(stars.directions, axis=1) == pytest.approx(1.0)


# V of the Bright Star Catalogue, 5th edition; right ascension and declination in degrees.
BRIGHT = {
    "Sirius": (101.287, -16.716, -1.46, 0.01),
    "Canopus": (95.988, -52.696, -0.72, 0.01),
    "Arcturus": (213.915, 19.182, -0.04, 0.01),
    "alpha Centauri A": (219.9204, -60.8351, -0.01, 0.01),
    "alpha Centauri B": (219.9141, -60.8395, 1.33, 0.01),
    "Vega": (279.235, 38.784, 0.03, 0.01),
    "Spica, B1": (201.298, -11.161, 0.98, 0.03),
    "Regulus, B7": (152.093, 11.967, 1.35, 0.02),
    "Bellatrix, B2": (81.283, 6.350, 1.64, 0.04),
    "Alnilam, B0": (84.053, -1.202, 1.70, 0.04),
    "Fomalhaut, A3": (344.413, -29.622, 1.16, 0.04),
    "tau Ceti, G8": (26.017, -15.937, 3.50, 0.02),
    "epsilon Eridani, K2": (53.233, -9.458, 3.73, 0.03),
    "51 Pegasi, G2": (344.367, 20.769, 5.49, 0.05),
    "61 Cygni A, K5": (316.725, 38.749, 5.21, 0.02),
    "Dubhe, K0": (165.932, 61.751, 1.79, 0.02),
    "Aldebaran, K5": (68.980, 16.509, 0.86, 0.03),
}


@pytest.mark.parametrize("star", BRIGHT)
def test_visual_magnitudes_are_those_of_the_bright_star_catalogue(star):
    ra, dec, v_mag, within = BRIGHT[star]
    stars = load_stars(6.0, 1991.25)
    nearest = np.argmax(stars.directions @ direction(*np.radians([ra, dec])))
    assert stars.magnitudes[nearest] == pytest.approx(v_mag, abs=within)


def test_the_sun_s_own_magnitude_gives_the_sun_s_light():
    assert irradiance_w_m2(SUN_V) == pytest.approx(SUN_W_M2)
    assert irradiance_w_m2(0.0) == pytest.approx(1.07e-8, rel=0.01)


def test_a_star_in_the_middle_brings_its_light_onto_the_chip():
    """Power through the aperture: E tau pi (f / 2 N)^2, on the chip spread over pixels of the pitch."""
    light, _ = drawn(StarsParameters(camera=at(direction(*SIRIUS)), faintest_v=-1.0))
    focal_m = LENS.pinhole(SIZE).focal_px * CHIP.pitch_um * 1e-6
    power_w = (
        float(irradiance_w_m2(load_stars(-1.0).magnitudes[0])) * LENS.transmission * math.pi * (focal_m / 2 / 1.4) ** 2
    )
    on_chip_w = LENS.chip_irradiance_w_m2(float(light.sum(dtype=float))) * (CHIP.pitch_um * 1e-6) ** 2
    assert on_chip_w == pytest.approx(power_w, rel=3e-3)
    row, column = np.unravel_index(light.argmax(), light.shape)
    assert abs(row - 23.5) < 1
    assert abs(column - 31.5) < 1


def test_a_turning_camera_s_stars_move_and_their_rate_says_so():
    spin = StarsParameters(camera=SpinPath(tilt_deg=-90.0, precession_deg_s=-2.0), faintest_v=5.0)
    (before, _), (_, rate), (after, _) = (drawn(spin, t_ns=t) for t in (10**9 - 10**6, 10**9, 10**9 + 10**6))
    np.testing.assert_allclose(rate, (after.astype(float) - before) / 2e-3, atol=2e-3 * np.abs(rate).max())
    assert np.abs(rate).max() > 0
    with StarField(spin, SIZE, LENS, CHIP) as scene:
        focal = LENS.pinhole(SIZE).focal_px
        assert math.radians(2) * focal < scene.motion_bound_px_s < 1.1 * math.radians(2) * focal


def test_a_moving_body_is_as_bright_as_its_phase_says():
    ahead = at(np.array([1.0, 0, 0]))
    point = MovingPoint(FixedPath((1e6, 0.0, 0.0)), radius_m=100.0, albedo=0.3)
    full = StarsParameters(camera=ahead, faintest_v=-2.0, sun=Sun((-1.0, 0, 0)), points=(point,))
    light, rate = drawn(full)
    focal = LENS.pinhole(SIZE).focal_px
    expected = SUN_W_M2 * 0.3 * (100 / 1e6) ** 2 * focal**2 * LENS.light_per_radiance
    assert light.sum(dtype=float) == pytest.approx(expected, rel=1e-3)
    assert np.abs(rate).max() == 0
    half, _ = drawn(dataclasses.replace(full, sun=Sun((0.0, 1.0, 0))))
    assert half.sum(dtype=float) == pytest.approx(expected / math.pi, rel=1e-3)
    night, _ = drawn(dataclasses.replace(full, sun=Sun((1.0, 0.0, 0))))
    assert night.max() < 1e-9 * expected
    behind, _ = drawn(dataclasses.replace(full, points=(dataclasses.replace(point, path=FixedPath((-1e6, 0, 0))),)))
    assert behind.max() == 0


def test_a_body_s_own_motion_is_in_the_rate():
    path = KeyframePath((Keyframe(0.0, (1e5, -100.0, 0.0)), Keyframe(1.0, (1e5, 300.0, 50.0))))
    moving = StarsParameters(
        camera=at(np.array([1.0, 0, 0])), faintest_v=-2.0, sun=Sun((-1.0, 0, 0)), points=(MovingPoint(path, 50.0),)
    )
    (before, _), (_, rate), (after, _) = (drawn(moving, t_ns=500_000_000 + d * 10**7) for d in (-1, 0, 1))
    np.testing.assert_allclose(rate, (after.astype(float) - before) / 2e-2, atol=2e-3 * np.abs(rate).max())


def test_distortion_moves_a_star_and_keeps_its_light():
    off_axis = direction(SIRIUS[0] + 0.1, SIRIUS[1])
    sky = StarsParameters(camera=at(off_axis), faintest_v=-1.0)
    straight, bent = (drawn(sky, dataclasses.replace(LENS, k1=k1))[0] for k1 in (0.0, 10.0))
    assert bent.sum(dtype=float) == pytest.approx(straight.sum(dtype=float), rel=2e-3)
    assert abs(int(bent.max(0).argmax()) - int(straight.max(0).argmax())) >= 1


def test_a_star_off_the_axis_sees_a_narrower_aperture():
    away = math.radians(7)
    ahead, aside = (
        drawn(StarsParameters(camera=at(direction(SIRIUS[0] + d, SIRIUS[1])), faintest_v=-1.0))[0] for d in (0.0, away)
    )
    cosine = math.cos(away) * math.cos(SIRIUS[1]) ** 2 + math.sin(SIRIUS[1]) ** 2
    assert aside.sum(dtype=float) / ahead.sum(dtype=float) == pytest.approx(cosine, abs=1e-3)


def test_the_sky_between_the_stars():
    light, _ = drawn(StarsParameters(faintest_v=-2.0, sky_w_m2_sr=0.01))
    assert np.unique(light).size == 1
    assert light[0, 0] == pytest.approx(0.01 * LENS.light_per_radiance)


@pytest.mark.socket
def test_a_camera_and_a_point_are_flown_over_one_port():
    """The point is 1, and is hidden until its pose puts it ahead of the camera, which is 0."""
    live = LivePath(port=0, position_m=(-1e6, 0.0, 0.0))
    sky = StarsParameters(
        camera=LivePath(port=0), faintest_v=-2.0, sun=Sun((0.0, 0.0, -1.0)), points=(MovingPoint(live, 100.0),)
    )
    light, still = np.zeros(SIZE[::-1], np.float32), (1.0, 0.0, 0.0, 0.0)
    with StarField(sky, SIZE, LENS, CHIP) as scene, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        scene.light(0, light)
        assert light.max() == 0
        for body, place in ((0, (0.0, 0.0, -1e5)), (1, (0.0, 0.0, 9e5)), (2, (0.0, 0.0, 0.0))):
            sender.sendto(bytes(PoseMessage(NOW, place, still, body)), scene.camera_path.receiver.address)
        scene.light(10_000_000, light)
        scene.light(20_000_000, light)
        counts = scene.counts
    expected = SUN_W_M2 * 0.2 * (100 / 1e6) ** 2 * LENS.pinhole(SIZE).focal_px ** 2 * LENS.light_per_radiance
    assert light.sum(dtype=float) == pytest.approx(expected, rel=2e-3)
    assert (counts["poses taken"], counts["poses of unknown bodies"]) == (2, 1)


def test_a_camera_inside_a_point_is_refused():
    with pytest.raises(SceneError, match="inside one of the scene's points"):
        drawn(StarsParameters(points=(MovingPoint(FixedPath()),)))
    with pytest.raises(SceneError, match="scene: an empty trajectory"):
        drawn(StarsParameters(camera=KeyframePath()))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: StarsParameters(faintest_v=9.0), "faintest_v"),
        (lambda: StarsParameters(time_scale=0.0), "time_scale"),
        (lambda: StarsParameters(epoch_year=math.nan), "epoch_year"),
        (lambda: StarsParameters(sky_w_m2_sr=-1.0), "sky_w_m2_sr"),
        (lambda: MovingPoint(radius_m=0.0), "radius_m"),
        (lambda: MovingPoint(albedo=math.inf), "albedo"),
    ],
)
def test_nonsense_is_refused(make, name):
    with pytest.raises(ValueError, match=f"{name} must be .*, got "):
        make()
