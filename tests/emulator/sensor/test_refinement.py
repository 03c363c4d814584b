"""Suspects in halves behind an imager."""

import dataclasses

import numpy as np

from emulator.sensor.sensor import Sensor
from tests.emulator.sensor.pixels.test_refinement import MS, SMALL, Asked, picture, pixel_light


def test_the_imager_sees_single_pixels_as_it_sees_pictures():
    imager = dataclasses.replace(SMALL.imager, prnu=0.1, dcnu=0.5, quantum_efficiency=0.5)
    sensor = Sensor(dataclasses.replace(SMALL, imager=imager), 3)
    asked = Asked()
    for t_ns in (0, 4 * MS, 8 * MS):
        light, rate = picture(t_ns)
        if t_ns:
            sensor.expose(light, t_ns, rate, asked)
        else:
            sensor.reset(light, t_ns)
    (listed,) = asked.who[6 * MS]
    assert listed.size > 100
    light, _ = picture(6 * MS)
    told, _ = sensor._imager.see_pixels(pixel_light)(6 * MS, listed)
    np.testing.assert_array_equal(told, sensor._imager.see(light, 6 * MS).reshape(-1)[listed])
    assert sensor.undersampled_share < 0.05


def test_shot_noise_leaves_nothing_to_ask_for():
    imager = dataclasses.replace(SMALL.imager, photon_shot_noise=True)
    assert Sensor(dataclasses.replace(SMALL, imager=imager), 3)._imager.see_pixels(pixel_light) is None
