"""The last block of an array has room for pixels beyond the sensor's end, which never fire."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS

STEP_NS = 1_000_000


@pytest.mark.parametrize("size", [(10, 10), (16, 16)])
def test_no_pixel_beyond_the_end_fires(size):
    pixels = PixelArray(dataclasses.replace(PRESETS["davis346"], width=size[0], height=size[1]), 0, threads=1)
    dark, bright = np.zeros(size, np.float32), np.ones(size, np.float32)
    pixels.reset(LightFrame(0, dark))
    for k in range(1, 4):
        events = pixels.step(LightFrame(k * STEP_NS, bright, dark))
        assert len(events)
        assert events.pixel.max() < size[0] * size[1]
        assert (k - 1) * STEP_NS <= events.t_ns[0] <= events.t_ns[-1] <= k * STEP_NS
    assert pixels.candidates <= 512 + 2 * size[0] * size[1]  # nor is it solved again
