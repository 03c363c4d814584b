"""References at the start of a stream: a sensor on which noise has acted before has no burst.

Counts are compared within 3.9 standard errors of both, found from the spread between pixels, and 5 %: settled
references that are right fail in one of 10 000 cases. The seeds are fixed.
"""

import dataclasses
import math

import numpy as np
import pytest

from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import Field
from emulator.sensor.presets import PRESETS
from tests.emulator.sensor.noise.noisy_arrays import MS, begun, ends, events_of, frame, one_pole, run, still, two_poles

Z = 3.9
LARGE = {"width": 64, "height": 48, "mismatch": 0.12}


def before(p, history_s=1000.0, spread=0.15, rms=None, **changes):
    noise = dataclasses.replace(p.noise, history_s=history_s, spread=spread, rms=p.noise.rms if rms is None else rms)
    return dataclasses.replace(p, noise=noise, **changes)


def counts_in(found, begin_ms, end_ms):
    pixels = found.array.parameters.width * found.array.parameters.height
    inside = (found.t_ns >= begin_ms * MS) & (found.t_ns < end_ms * MS)
    return np.bincount(found.pixel[inside], minlength=pixels)


def assert_alike(one, other, within=0.05):
    error = math.hypot(*(counts.std() / math.sqrt(counts.size) for counts in (one, other)))
    assert abs(one.mean() - other.mean()) < within * other.mean() + Z * error, (one.mean(), other.mean())


@pytest.mark.sampled
@pytest.mark.parametrize("p", [two_poles(3.0, 52.6e-6, 84e-6, **LARGE), two_poles(4.2, 487e-6, 84e-6, **LARGE),
                               one_pole(3.5, 1e-3, 0.2, **LARGE), two_poles(3.0, 5e-3, 84e-6, **LARGE)])  # fmt: skip
def test_the_rate_of_the_first_instant_is_that_of_later_times(p):
    found = events_of(before(p), still(), ends(100, 2000))
    first, later = counts_in(found, 0, 100), counts_in(found, 1900, 2000)
    assert first.sum() > 300
    assert_alike(first, later)
    fresh = counts_in(events_of(before(p, 0.0), still(), [100 * MS]), 0, 100)
    assert fresh.sum() > 1.05 * first.sum()


def test_without_noise_before_there_is_a_burst():
    p = two_poles(7.0, 52.6e-6, 84e-6, **LARGE)
    fresh, settled = (len(events_of(before(p, seconds), still(), [100 * MS]).t_ns) for seconds in (0.0, 100.0))
    assert fresh > 10 * settled


def test_a_longer_time_before_leaves_fewer_events():
    """Of references at random phases, those nearest to a threshold are left first."""
    p = two_poles(6.0, 52.6e-6, 84e-6, **LARGE)
    events = [len(events_of(before(p, seconds), still(), [200 * MS]).t_ns) for seconds in (0.0, 0.1, 10.0)]
    assert events[0] > 1.2 * events[1] > 2 * events[2]


@pytest.mark.parametrize("leak_hz", [0.1, 3.0, 100.0])
def test_noise_and_leak_before_the_start(leak_hz):
    """Noise makes leak events earlier, all by the same, so that their number is that of the leak from the start on."""
    p = before(two_poles(12.0, 300e-6, 84e-6, width=128, height=96, leak_hz=leak_hz, refractory_us=0.0), spread=0.0)
    turns = 3
    found = events_of(p, still(), ends(turns * 1e3 / leak_hz / 10, turns * 1e3 / leak_hz))
    counts = np.bincount(found.pixel, minlength=128 * 96)
    assert found.on.all()
    assert abs(counts.mean() - turns) < Z * counts.std() / math.sqrt(counts.size) + 0.02
    first = counts_in(found, 0, 300 / leak_hz).mean()
    assert first == pytest.approx(0.3, abs=0.05)


def test_noise_before_the_start_acts_in_the_light_of_the_reset():
    """The first step ends in light that is no number, in which no noise acts."""
    p = two_poles(7.0, 52.6e-6, 84e-6, **LARGE)
    found = []
    for seconds in (0.0, 100.0):
        array = begun(before(p, seconds), still())
        events = 0
        for t_ns, level in ((10, np.nan), (20, 1.0), (100 * MS, 1.0)):
            events += len(array.step(frame(p, still(level), t_ns)))
        found.append(events)
    assert found[0] > 10 * found[1]


def test_pixels_without_light_or_life_stay_as_they_are():
    p = before(two_poles(2.5, 52.6e-6, 84e-6, width=32, height=4))
    array = PixelArray(p, 1)
    array.kill(np.arange(32))
    level = np.ones((4, 32))
    level[1], level[2] = np.nan, np.inf
    array.reset(frame(p, still(level), 0))
    phased = PixelArray(dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0)), 1)
    phased.kill(np.arange(32))
    phased.reset(frame(p, still(level), 0))
    settled, plain = (one.field(Field.REFERENCE) for one in (array, phased))
    assert np.array_equal(settled[:3], plain[:3], equal_nan=True)
    assert np.abs(settled[3] - plain[3]).max() > 0.01
    found = run(array, still(level), [100 * MS])
    assert found.pixel.size > 100
    assert found.pixel.min() >= 96


def test_the_start_is_that_of_the_seed_and_of_the_pixel():
    p = before(two_poles(3.0, 52.6e-6, 84e-6, width=24, height=16))
    references = [begun(p, still(), seed=seed).field(Field.REFERENCE) for seed in (1, 1, 2)]
    assert np.array_equal(references[0], references[1])
    assert not np.array_equal(references[0], references[2])
    few = begun(dataclasses.replace(p, height=5), still()).field(Field.REFERENCE)
    assert np.array_equal(few, references[0][:5])


def test_the_start_of_a_preset_is_quiet():
    """imx636: rates of the first tenth of a second and of another one, ten seconds later, in dim light."""
    p = dataclasses.replace(PRESETS["imx636"], width=128, height=96)
    found = events_of(p, still(0.1), ends(100, 10_100))
    assert_alike(counts_in(found, 0, 1000), counts_in(found, 9100, 10_100), 0.1)


@pytest.mark.parametrize("rms", [0.003, 0.01])
@pytest.mark.parametrize("leaks", [{"leak_hz": 0.03}, {"leak_hz": 0.0, "parasitic_hz_at_reference": 0.03}])
def test_a_sensor_that_leaks_starts_at_its_rate(rms, leaks):
    """However quiet its noise is: leak has moved the references of all pixels past many deviations."""
    p = dataclasses.replace(PRESETS["davis346"], **leaks)
    found = events_of(before(p, 100.0, rms=rms), still(), ends(100, 6000))
    assert_alike(counts_in(found, 0, 2000), counts_in(found, 2000, 6000) / 2, 0.1)
    assert counts_in(found, 0, 6000).mean() == pytest.approx(6 * 0.03, rel=0.1)  # noise fires before the leak does
