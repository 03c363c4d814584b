"""Background activity against a play of its law pixel by pixel, in numpy alone."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import kstest

from emulator.sensor.chip.sources import BackgroundEvents
from emulator.sensor.parameters import BackgroundParameters
from emulator.sensor.presets import SensorParameters

WIDTH, HEIGHT = 400, 250
NONE = np.zeros(0, np.int64)
PARAMETERS = BackgroundParameters(
    hz=0.05, off_share=0.8, pair_share=0.2, on_pair_factor=3.0, again_share=0.4, pair_us=200_000.0, on_wait_factor=2.0
)


def source(background, seed=3):
    plain = SensorParameters(width=WIDTH, height=HEIGHT, threshold_on=0.2, threshold_off=0.2)
    return BackgroundEvents(dataclasses.replace(plain, background=background), seed, NONE)


def drawn(background, seconds, steps=1, begin_s=0.0):
    """Times in s, pixels and polarities of all events, pixel by pixel."""
    events = source(background)
    events.reset(round(begin_s * 1e9))
    ends = begin_s + seconds * np.arange(1, steps + 1) / steps
    parts = [events.step(round(end * 1e9)) for end in ends]
    t, pixel, on = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "pixel", "on"))
    order = np.lexsort([t, pixel])
    return t[order] * 1e-9, pixel[order].astype(np.int64), on[order]


def waits(t, pixel, on, first):
    """Times from events of polarity `first` to the next one of the same pixel, if that is of the other polarity."""
    pair = (np.diff(pixel) == 0) & (on[:-1] == first) & (on[1:] != first)
    return np.diff(t)[pair]


def test_followers_come_after_their_waits_as_often_as_their_shares():
    rare = dataclasses.replace(PARAMETERS, hz=0.0025)  # chance hardly adds to the followers
    t, pixel, on = drawn(rare, 40.0)
    primaries = rare.hz / (1 + (0.8 * 0.2 + 0.2 * 0.6) / 0.6) * 40 * WIDTH * HEIGHT
    assert len(t) == pytest.approx(rare.hz * 40 * WIDTH * HEIGHT, rel=0.03)
    for first, wait_s, share in ((False, 0.2, 0.8 * 0.2), (True, 0.4, 0.2 * 0.6)):
        near = waits(t, pixel, on, first)
        near = near[near < 3 * wait_s]
        assert kstest(near, "truncexpon", args=(3, 0, wait_s)).pvalue > 1e-3
        other = 0.8 * 0.2 if first else 0.2 * 0.6
        chain = (share + 0.4 * other) / (1 - 0.4**2)  # primaries of that polarity, followers of the other
        assert len(near) == pytest.approx(primaries * chain * (1 - np.exp(-3)), rel=0.05)


def test_the_start_has_the_followers_of_events_before_it():
    t, _, _ = drawn(PARAMETERS, 4.0)
    rates = np.histogram(t, np.arange(0, 4.1, 0.1))[0] / (0.1 * WIDTH * HEIGHT)
    assert rates[:3].mean() == pytest.approx(rates[10:].mean(), rel=0.06)


def test_events_do_not_depend_on_steps_or_on_the_start():
    whole, steps, later = drawn(PARAMETERS, 3.0), drawn(PARAMETERS, 3.0, 37), drawn(PARAMETERS, 1.0, 5, begin_s=2.0)
    assert all(np.array_equal(a, b) for a, b in zip(whole, steps, strict=True))
    assert len(later[0]) > 100
    late = whole[0] >= 2.0
    assert np.array_equal(later[0], whole[0][late])


def test_hot_pixels_are_a_tail_that_alternates_at_its_own_pace():
    hot = BackgroundParameters(hot_share=0.02, hot_hz=4.0, hot_spread=1.0, hot_pair_share=0.6, pair_us=2_000_000.0)
    t, pixel, on = drawn(hot, 20.0)
    counts = np.bincount(pixel, minlength=WIDTH * HEIGHT)
    rates = counts[counts > 20] / 20
    assert (counts > 0).mean() == pytest.approx(0.02, rel=0.1)
    assert counts[counts > 0].mean() / 20 == pytest.approx(4.0, rel=0.12)  # of 2000 pixels: 4 standard errors
    assert np.log(rates).std() == pytest.approx(0.85, abs=0.15)  # cut off at 20 events
    assert len(t) == len(on) == counts.sum()
    fast = np.isin(pixel, np.flatnonzero(counts > 200))
    assert np.median(waits(t[fast], pixel[fast], on[fast], False)) < 0.2


def test_a_drawn_pixel_lies_between_the_two_places_where_it_is_looked_for():
    rates = source(dataclasses.replace(PARAMETERS, spread=1.5, hot_share=0.05))._rates
    shares = np.append(np.random.default_rng(3).random(100_000), [0.0, 0.5, 1 - 2**-53])
    at = (shares * (len(rates.first) - 1)).astype(np.int64)
    pixel = np.searchsorted(rates.below, shares * rates.below[-1], side="right")
    assert (rates.first[at] <= pixel).all()
    assert (pixel <= rates.first[at + 1]).all()
