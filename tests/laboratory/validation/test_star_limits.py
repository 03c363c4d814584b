"""Star limits: distributions with known answers, and a small field before a sensor."""

import dataclasses

import numpy as np
import pytest

from emulator.rig.loading import load_rig, shipped_rigs
from emulator.scene.stars.skies import stars_per_deg2
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.noise.law import corner_hz, still_hz
from emulator.sensor.parameters import BackgroundParameters, NoiseParameters, TemperatureParameters
from emulator.sensor.presets import PRESETS
from laboratory.validation.star_fields import FALSE_SOURCES, Observatory, Seen, observe
from laboratory.validation.stars import AMOS_G, AMOS_SHARE, Limits, amos_found

NOTHING = np.zeros((1, 1), np.float32)


def seen(limit, n=200_000, chance=0.0, seed=1):
    """A camera that finds all stars to a magnitude, none beyond, and any star by chance."""
    draws = np.random.default_rng(seed)
    magnitudes = draws.uniform(5.5, 12.5, n)
    return Seen(magnitudes, (magnitudes < limit) | (draws.random(n) < chance), chance, 0.0, NOTHING)


@pytest.mark.parametrize("chance", [0.0, 0.2])
def test_matched_stars_of_a_sharp_limit_are_distributed_as_the_sky_s(chance):
    limits = Limits.of([seen(10.0, chance=chance)])
    for percent in (10, 50, 90):
        g = limits.brighter_than(percent)
        assert stars_per_deg2(g) / stars_per_deg2(10.0) == pytest.approx(percent / 100, rel=0.06)
    assert limits.half_found == pytest.approx(10.0, abs=0.05)


def test_the_real_camera_s_share_gives_its_distribution_back():
    found = amos_found()
    again = np.cumsum(found * np.diff(stars_per_deg2(AMOS_G)))
    np.testing.assert_allclose(again / again[-1], (AMOS_SHARE[1:] - AMOS_SHARE[0]) / (1 - AMOS_SHARE[0]), atol=1e-12)
    assert found[np.searchsorted(AMOS_G, 7.5)] == 1
    assert found[-1] < 0.01


def test_the_gen3_rig_states_the_noise_of_its_pixels():
    rig = load_rig("stars-limit-gen3")
    text = shipped_rigs()["stars-limit-gen3"].read_text()
    preset = PRESETS["gen31_moke"]
    for parameters, light, words in (rig.camera.sensor, 0, "0.006 Hz"), (preset, 0, "0.58 Hz"), (preset, 1, "0.06 Hz"):
        sensor = at_temperature(parameters)
        noise_hz = sum(still_hz(sensor, float(corner_hz(sensor, light))))
        assert float(words.split()[0]) == pytest.approx(noise_hz, rel=0.04)
        assert words in text


@pytest.mark.system
def test_bright_stars_are_found_and_those_below_the_dark_current_are_not():
    background = BackgroundParameters(hz=0.1)
    effects = {"background": background, "noise": NoiseParameters(), "dark_current_relative": 0.001, "leak_hz": 0.0}
    effects["temperature"] = TemperatureParameters()
    sensor = dataclasses.replace(PRESETS["imx636"], width=320, height=240, **effects)
    scale = 320 / 1280
    rig = load_rig("stars-limit")
    lens = dataclasses.replace(rig.camera.lens, field_of_view_deg=rig.camera.lens.field_of_view_deg * scale)
    camera = Observatory(sensor, lens, rig.scene, 100_000_000)
    field = dataclasses.replace(rig.scene.drawn, numbers="ladder", per_deg2=150.0, radius_deg=1.0)
    bright = observe(camera, dataclasses.replace(field, brightest_g=6.0, faintest_g=7.5), 1)
    faint = observe(camera, dataclasses.replace(field, brightest_g=13.0, faintest_g=14.0), 1)
    assert len(bright.magnitudes) > 10
    assert bright.matched.mean() > 0.9
    assert faint.matched.mean() < 0.1
    assert bright.noise_hz == pytest.approx(0.05, rel=0.1)
    assert FALSE_SOURCES * 9 * np.pi / (320 * 240) < 0.02
