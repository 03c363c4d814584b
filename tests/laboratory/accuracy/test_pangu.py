"""PANGU's rule does what its authors say, on light whose answer can be worked out by hand."""

import math

import numpy as np
import pytest

from emulator.light import LightFrame
from laboratory.accuracy.peers.pangu import MOST_EVENTS, Pangu
from tests.laboratory.accuracy.rows import row

MS = 1_000_000
DARK = 1e-4


def ideal(pixels=1, **changes):
    """No mismatch, no leak, no filter: what is left is the rule."""
    plain = {"mismatch": 0.0, "leak_hz": 0.0, "leak_spread": 0.0, "corner_hz_at_reference": math.inf}
    return row(pixels, **(plain | changes))


def picture(*log_light):
    return (np.exp(np.array([log_light])) - DARK).astype(np.float32)


def started(rule, *log_light):
    rule.reset(LightFrame(0, picture(*log_light)))
    rule._r[:] = log_light  # on the light itself, so that levels lie at whole thresholds from it
    return rule


def test_the_rule_is_used_as_the_array_is():
    rule = Pangu(row(40), 3)
    rng = np.random.default_rng(0)
    light = rng.uniform(0.2, 1, (50, 1, 40)).astype(np.float32)
    rule.reset(LightFrame(5 * MS, light[0]))
    last = 5 * MS
    for k in range(1, 50):
        crossings = rule.step(LightFrame(last + MS, light[k], rate=np.zeros_like(light[k])))
        keys = list(zip(crossings.t_ns, crossings.pixel, strict=True))
        assert keys == sorted(keys)
        assert all(last <= t <= last + MS for t, _ in keys)
        last += MS
    assert rule.lost_in_pixel == rule.quiet_nan == 0
    assert len(rule.step(LightFrame(last, light[0]))) == 0
    with pytest.raises(ValueError, match="time does not go back"):
        rule.step(LightFrame(last - 1, light[0]))
    with pytest.raises(ValueError, match="float32"):
        rule.step(LightFrame(last, light[0].astype(float)))


def test_unreadable_light_is_silent_and_counted():
    rule = Pangu(ideal(3), 3)
    rule.reset(LightFrame(0, np.array([[1, np.nan, 1]], np.float32)))
    for k, middle in enumerate([np.inf, 0.1, 0.1, np.nan, 5.0, 5.0], 1):
        crossings = rule.step(LightFrame(k * MS, np.array([[1, middle, 1]], np.float32)))
        if k in (1, 2, 4, 5):
            assert len(crossings) == 0
    assert rule.quiet_nan == 2
    assert np.isfinite(rule._v).all()


def test_a_flash_beyond_the_cap_is_listed_up_to_it_and_counted():
    rule = started(Pangu(ideal(2, threshold_on=0.05), 3), -8.0, 0.0)
    crossings = rule.step(LightFrame(MS, picture(0.0, 0.0)))
    whole = math.floor(8.0 / 0.05 + 1e-9)
    assert len(crossings) == MOST_EVENTS
    assert crossings.lost_in_pixel == rule.lost_in_pixel
    assert rule.lost_in_pixel + MOST_EVENTS == pytest.approx(whole, abs=2)


def test_the_mixing_factor_is_clamped():
    for corner_hz, share in ((3000.0, 1.0), (10.0, 2 * math.pi * 10 * math.exp(0.1) * 1e-3)):
        rule = Pangu(row(1, corner_hz_at_reference=corner_hz, corner_max_hz=3000.0), 3)
        rule.reset(LightFrame(0, picture(0.0)))
        rule.step(LightFrame(MS, picture(0.1)))
        assert rule._v[0] == pytest.approx(0.1 * share, rel=1e-5)


def test_pangu_carries_over_what_the_floor_leaves():
    rule = started(Pangu(ideal(1), 3), 0.0)
    assert len(rule.step(LightFrame(MS, picture(0.35)))) == 1
    assert rule._r[0] == pytest.approx(0.2)
    assert len(rule.step(LightFrame(2 * MS, picture(0.45)))) == 1
    assert len(rule.step(LightFrame(3 * MS, picture(0.15)))) == 1  # 0.25 below 0.4


@pytest.mark.parametrize(
    ("refractory_us", "counts"),
    [
        (0.0, 5),
        (100.0, 3),  # first at 0.2 h, then one each 0.3 h: 0.2, 0.5, 0.8
        (300.0, 2),  # 0.2, 0.7
        (600.0, 2),  # 0.2, 1.0
        (700.0, 1),
        (5000.0, 1),
    ],
)
def test_pangu_counts_periods_of_reset_and_event(refractory_us, counts):
    rule = started(Pangu(ideal(1, refractory_us=refractory_us), 3), 0.0)
    assert len(rule.step(LightFrame(MS, picture(1.0 + 1e-5)))) == counts
