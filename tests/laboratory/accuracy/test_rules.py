"""The rules of others do what their authors say, on light whose answer can be worked out by hand."""

import math

import numpy as np
import pytest

from emulator.light import LightFrame
from laboratory.methods.other_simulators import (
    MOST_EVENTS,
    OTHER_SIMULATORS,
    RAW_CHANNELS,
    Esim,
    Pangu,
    Sikorski,
    V2e,
    V2eExactFilter,
)
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


def listed(crossings):
    return list(zip(crossings.t_ns.tolist(), crossings.pixel.tolist(), crossings.on.tolist(), strict=True))


@pytest.mark.parametrize("name", OTHER_SIMULATORS)
def test_each_rule_is_used_as_the_array_is(name):
    rule = OTHER_SIMULATORS[name](row(40), 3)
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


@pytest.mark.parametrize("name", OTHER_SIMULATORS)
def test_unreadable_light_is_silent_and_counted(name):
    rule = OTHER_SIMULATORS[name](ideal(3), 3)
    rule.reset(LightFrame(0, np.array([[1, np.nan, 1]], np.float32)))
    for k, middle in enumerate([np.inf, 0.1, 0.1, np.nan, 5.0, 5.0], 1):
        crossings = rule.step(LightFrame(k * MS, np.array([[1, middle, 1]], np.float32)))
        if k in (1, 2, 4, 5):
            assert len(crossings) == 0
    assert rule.quiet_nan == 2
    assert np.isfinite(rule._v).all()


@pytest.mark.parametrize("name", OTHER_SIMULATORS)
def test_a_flash_beyond_the_cap_is_listed_up_to_it_and_counted(name):
    rule = started(OTHER_SIMULATORS[name](ideal(2, threshold_on=0.05), 3), -8.0, 0.0)
    crossings = rule.step(LightFrame(MS, picture(0.0, 0.0)))
    whole = math.floor(8.0 / 0.05 + 1e-9)
    assert len(crossings) == MOST_EVENTS
    assert crossings.lost_in_pixel == rule.lost_in_pixel
    assert rule.lost_in_pixel + MOST_EVENTS == pytest.approx(whole, abs=2)


def test_v2e_spreads_its_count_with_the_last_at_the_end():
    rule = started(V2e(ideal(3), 3), 0.0, 0.0, 0.0)
    assert listed(rule.step(LightFrame(MS, picture(0.45, -0.25, 0.15)))) == [
        (500_000, 0, True),
        (MS, 0, True),
        (MS, 1, False),
    ]
    # what is left over counts in the next step
    assert listed(rule.step(LightFrame(2 * MS, picture(0.61, -0.25, 0.15)))) == [(2 * MS, 0, True)]


def test_the_mixing_factor_is_clamped_in_v2e_and_exact_in_held():
    p = row(1, corner_hz_at_reference=3000.0, corner_max_hz=3000.0)
    for kind, share in ((V2e, 1.0), (V2eExactFilter, 1 - math.exp(-2 * math.pi * 3)), (Pangu, 1.0)):
        rule = kind(p, 3)
        rule.reset(LightFrame(0, picture(0.0)))
        rule.step(LightFrame(MS, picture(0.1)))
        assert rule._v[0] == pytest.approx(0.1 * share, abs=1e-6)
    slow = V2e(row(1, corner_hz_at_reference=10.0), 3)
    slow.reset(LightFrame(0, picture(0.0)))
    slow.step(LightFrame(MS, picture(0.1)))
    assert slow._v[0] == pytest.approx(0.1 * 2 * math.pi * 10 * math.exp(0.1) * 1e-3, rel=1e-5)


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


def test_the_raw_event_image_tells_what_the_step_did():
    rule = started(Pangu(ideal(4, refractory_us=200.0), 3), 0.0, 0.0, 0.0, 0.0)
    rule.step(LightFrame(MS, picture(0.4, -0.25, 0.05, 0.0)))
    raw = rule.raw_event_image()
    assert raw.shape == (1, 4, len(RAW_CHANNELS))
    assert raw.dtype == np.float32
    count, first, reference, filtered, end = (dict(zip(RAW_CHANNELS, raw[0].T, strict=True))[c] for c in RAW_CHANNELS)
    assert count.tolist() == [1, -1, 0, 0]
    np.testing.assert_allclose(first, [500, 800, np.nan, np.nan], rtol=1e-4)
    np.testing.assert_allclose(filtered, [0.4, -0.25, 0.05, 0.0], atol=1e-6)
    np.testing.assert_allclose(end, [700, 1000, np.nan, np.nan], rtol=1e-4)
    np.testing.assert_allclose(reference, [0.28, -0.25, 0.0, 0.0], atol=1e-5)
    before = raw.copy()
    rule.step(LightFrame(2 * MS, picture(1.4, -0.25, 0.05, 0.0)))
    np.testing.assert_array_equal(raw, before)


def test_a_straight_line_has_exact_times():
    for kind in (Sikorski, Esim):
        rule = started(kind(ideal(2), 3), 0.0, 0.0)
        found = listed(rule.step(LightFrame(MS, picture(0.5, -0.3))))
        assert [(p, on) for _, p, on in found] == [(0, True), (1, False), (0, True)]
        np.testing.assert_allclose([t for t, _, _ in found], [0.4 * MS, 2 / 3 * MS, 0.8 * MS], atol=5)


def test_a_latency_swallows_crossings_and_the_reference_moves_on():
    for kind in (Sikorski, Esim):
        rule = started(kind(ideal(1, refractory_us=500.0), 3), 0.0)
        found = listed(rule.step(LightFrame(MS, picture(1.0 + 1e-5))))
        np.testing.assert_allclose([t for t, _, _ in found], [0.2 * MS, 0.8 * MS], atol=20)
        assert rule._r[0] == pytest.approx(1.0)
