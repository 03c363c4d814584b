"""What noise does to the events of moving light, followed in time, against the law that plans quote.

Light rises by a ramp in the logarithm; the shift is the time of an event less that without noise. A mean or a deviation
that is the law's fails its test with a probability of 1e-4 (the seed is fixed).
"""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from emulator.light import LightFrame
from emulator.plan.costs import noise_shift
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.methods.grid import NoisyPixels

Z = stats.norm.isf(1e-4 / 2)
THRESHOLD, A, NODE_CROSSINGS = 0.3, 12, 4000
SIGMA = THRESHOLD / A
TAU_S = 1 / (2 * np.pi * 300.0)
P = SensorParameters(
    width=60, height=50, threshold_on=THRESHOLD, threshold_off=THRESHOLD, mismatch=0.0, leak_hz=0.0,
    corner_hz_at_reference=np.inf, dark_current_relative=1e-6,
    noise=NoiseParameters(rms=SIGMA, corner_hz=300.0, grade="grid"),
)  # fmt: skip
PHASE = draw(P, 1).phase
FAR = PHASE < 0.5  # these have six rms to go before their first event


def shifts(rho, events=1):
    """The shifts of each far pixel's first events on a ramp of contrast rate rho rms / tau, in rms over contrast rate.

    (pixels, events).
    """
    rate = rho * SIGMA / TAU_S
    pixels = NoisyPixels(P, 1)
    end_ns = round((events + 1) * THRESHOLD / rate * 1e9)

    def light(t_ns):
        return np.full((P.height, P.width), 1e-3 * np.exp(rate * t_ns * 1e-9), np.float32)

    pixels.reset(LightFrame(0, light(0)))
    found = pixels.step(LightFrame(end_ns, light(end_ns)))
    t_s = np.full((PHASE.size, events), np.nan)
    for pixel in np.flatnonzero(FAR):
        t_s[pixel] = found.t_ns[found.pixel == pixel][:events] * 1e-9
    free_s = (np.arange(1, events + 1) - PHASE[:, None]) * THRESHOLD / rate
    assert np.all(found.on)
    return ((t_s - free_s) * rate / SIGMA)[FAR]


@pytest.mark.parametrize("rho", [0.3, 1.0, 3.0])
def test_events_come_earlier_and_scattered_as_the_law_says(rho):
    shift = shifts(rho)[:, 0]
    earlier, deviation = noise_shift(rho)
    draws = 1 / shift.size + 1 / NODE_CROSSINGS  # the law was simulated too
    assert abs(-shift.mean() - earlier) < Z * deviation * np.sqrt(draws) + 0.01  # and rounded
    assert abs(shift.std() - deviation) < Z * deviation * np.sqrt(draws / 2) + 0.01


def test_all_events_of_a_ramp_are_shifted_alike_so_that_intervals_stay():
    shift = shifts(1.0, events=3)
    deviation = noise_shift(1.0)[1]
    assert np.abs(shift.mean(axis=0) - shift.mean()).max() < Z * deviation / np.sqrt(len(shift))
    neighbours = stats.pearsonr(shift[:, 0], shift[:, 1])
    assert neighbours.pvalue > 1e-4  # a shift is forgotten after an interval of twelve time constants


def test_a_point_process_leaves_them_where_they_are():
    p = dataclasses.replace(P, noise=dataclasses.replace(P.noise, grade="points"))
    quiet = dataclasses.replace(P, noise=NoiseParameters())
    times = []
    for one in (p, quiet):
        sensor = Sensor(one, 1)
        sensor.reset(LightFrame(0, np.full((P.height, P.width), 1e-3, np.float32)))
        sensor.expose(LightFrame(10_000_000, np.full((P.height, P.width), 1e-3 * np.exp(0.5), np.float32)))
        times.append(np.concatenate([sensor.finish()])["t"])
    assert np.array_equal(*times)
