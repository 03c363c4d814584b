"""Suspects in halves behind an imager."""

import dataclasses

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.sensor import Sensor
from tests.emulator.sensor.pixels.test_refinement import MS, SMALL, Asked, picture, pixel_light


def test_the_imager_sees_single_pixels_as_it_sees_pictures():
    imager = dataclasses.replace(SMALL.imager, prnu=0.1, dcnu=0.5, quantum_efficiency=0.5)
    sensor = Sensor(dataclasses.replace(SMALL, imager=imager), 3)
    asked = Asked()
    for t_ns in (0, 4 * MS, 8 * MS):
        light, rate = picture(t_ns)
        if t_ns:
            sensor.expose(LightFrame(t_ns, light, rate, asked))
        else:
            sensor.reset(LightFrame(t_ns, light))
    (listed,) = asked.who[6 * MS]
    assert listed.size > 100
    light, _ = picture(6 * MS)
    seen = sensor._imager.see(LightFrame(6 * MS, light, at=pixel_light))
    np.testing.assert_array_equal(seen.at(6 * MS, listed)[0], seen.light.reshape(-1)[listed])
    assert sensor.undersampled_share < 0.05


def test_shot_noise_leaves_nothing_to_ask_for():
    imager = dataclasses.replace(SMALL.imager, photon_shot_noise=True)
    frame = LightFrame(0, picture(0)[0], at=pixel_light)
    assert Sensor(dataclasses.replace(SMALL, imager=imager), 3)._imager.see(frame).at is None
