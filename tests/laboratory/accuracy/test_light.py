"""Light in closed form: derivatives against differences, and the figures that the scenes are named by."""

import numpy as np
import pytest

from laboratory.accuracy.scenes import (
    BlurredCheckerboard,
    Dark,
    DriftingStar,
    Flash,
    Flicker,
    LogEdge,
    LogSine,
    MovingEdge,
    ShadedEdge,
    SineGrating,
    SlowRamp,
    TexturedDisc,
    ThinLine,
    TurningBody,
)

SMOOTH = [
    ShadedEdge(profile="blurred"),
    ThinLine(profile="blurred"),
    TurningBody(profile="blurred"),
    SineGrating(),
    Flicker(),
    MovingEdge(),
    MovingEdge(sigma_px=0.3),
    BlurredCheckerboard(),
    BlurredCheckerboard(sigma_px=2.0, angle_rad=2.0),
    TexturedDisc(),
    DriftingStar(),
    SlowRamp(),
    LogSine(),
    LogSine(amplitude=0.0, level=0.1),
    LogEdge(width_s=0.01, middle_s=0.1),
    Dark(),
]
TIMES = np.linspace(0.003, 0.397, 41)


@pytest.mark.parametrize("scene", SMOOTH, ids=lambda s: type(s).__name__)
def test_the_rate_is_the_derivative_of_the_value(scene):
    d = 1e-6
    difference = (scene.value(TIMES + d) - scene.value(TIMES - d)) / (2 * d)
    np.testing.assert_allclose(scene.rate(TIMES), difference, atol=1e-6 * max(1.0, np.abs(difference).max()), rtol=1e-5)


@pytest.mark.parametrize("scene", [*SMOOTH, Flash()], ids=lambda s: type(s).__name__)
def test_light_is_a_row_at_each_time_and_never_negative(scene):
    value, rate = scene.value(TIMES), scene.rate(TIMES)
    assert value.shape == rate.shape == (TIMES.size, scene.pixels)
    assert value.dtype == rate.dtype == np.float64
    assert value.min() >= 0
    np.testing.assert_array_equal(scene.value(0.1)[0], scene.value([0.1])[0])


def test_a_flash_jumps_where_it_says():
    scene = Flash()
    jumps = scene.jumps_s()[:, 0]
    for k, jump in enumerate(jumps):
        assert scene.value(jump - 1e-9)[0, k] == scene.dark
        assert scene.value(jump)[0, k] == scene.bright
    assert SineGrating().jumps_s().shape == (60, 0)
