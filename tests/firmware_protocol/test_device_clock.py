"""The device clock: exact in integers, monotone, and the same however it is asked."""

import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.device.clock import ClockSettings, ClockStep, DeviceClock, Draw, normal

S = 1_000_000_000
ALL = ClockSettings(
    offset_us=123.456,
    drift_ppm=50,
    walk_ppb=20,
    ramp_ppm=-7,
    ramp_from_s=2,
    ramp_seconds=5,
    steps=(ClockStep(3.5, 1000), ClockStep(6.25, -250_000)),
)
TIMES = st.lists(st.integers(0, 20 * S), min_size=1, max_size=40).map(sorted)


@pytest.mark.parametrize("ppm", [50, -50, 0.001, 1000])
def test_drift_is_exact(ppm):
    clock = DeviceClock(ClockSettings(offset_us=7, drift_ppm=ppm), 1)
    for t in (0, 1, S - 1, S, 12_345_678_901, 86_400 * S):
        exact = t + 7000 + Fraction(str(ppm)) * t / 1_000_000
        assert abs(int(clock.shown_ns(t)[0]) - exact) < 2


def test_a_ramp_changes_the_frequency_evenly_and_then_stays():
    clock = DeviceClock(ClockSettings(ramp_ppm=10, ramp_from_s=1, ramp_seconds=4), 1)
    assert [clock.ppm(s * 1_000_000) for s in range(7)] == [0, 1.25, 3.75, 6.25, 8.75, 10, 10]
    assert int(clock.shown_ns(5 * S)[0]) - 5 * S == 20_000  # half of 10 ppm over 4 s


def test_the_walk_is_one_of_frequency():
    ends = [DeviceClock(ClockSettings(walk_ppb=10), seed).ppm(400_000_000) for seed in range(300)]
    assert np.std(ends) == pytest.approx(10e-3 * np.sqrt(401), rel=0.15)  # 3.7 standard errors of 300 draws
    assert abs(np.mean(ends)) < 4 * 0.2 / np.sqrt(300)


def test_steps_forward_are_jumps_and_steps_back_stand_still():
    steps = (ClockStep(1, 500), ClockStep(2, -300))
    clock = DeviceClock(ClockSettings(steps=steps), 1)
    t_us = np.array([999_999, 1_000_000, 1_999_999, 2_000_000, 2_000_299, 2_000_300])
    assert clock.shown_us(t_us).tolist() == [999_999, 1_000_500, 2_000_499, 2_000_499, 2_000_499, 2_000_500]


def test_steps_back_one_after_another_are_waited_out():
    clock = DeviceClock(ClockSettings(steps=(ClockStep(2, -1000), ClockStep(2.0005, -1000))), 1)
    shown = clock.shown_us(np.array([1_999_999, 2_000_600, 2_001_999, 2_002_005]))
    assert shown.tolist() == [1_999_999, 1_999_999, 1_999_999, 2_000_005]


@given(TIMES, st.data())
def test_it_does_not_depend_on_how_it_is_asked_and_never_runs_backward(times, data):
    whole = DeviceClock(ALL, 5).shown_ns(times)
    assert (np.diff(whole) >= 0).all()
    clock, parts = DeviceClock(ALL, 5), []
    cuts = sorted(data.draw(st.lists(st.integers(0, len(times)), max_size=4)))
    for a, b in zip([0, *cuts], [*cuts, len(times)], strict=True):
        parts.extend(clock.shown_ns(np.array(times[a:b], np.int64)).tolist())
    assert parts == whole.tolist()


@given(st.integers(0, 20_000_000))
def test_stream_time_comes_back_from_what_was_shown(t_us):
    clock = DeviceClock(dataclasses.replace(ALL, steps=()), 5)
    shown = clock.shown_us(t_us)
    assert abs(float(clock.stream_us(shown, t_us)[0]) - t_us) <= 2
    assert abs(float(clock.stream_us(shown, t_us + 300_000)[0]) - t_us) <= 2


def test_long_runs_keep_little_and_go_on_from_there():
    one, other = DeviceClock(ALL, 9), DeviceClock(ALL, 9)
    for hour in range(48):
        one.shown_ns(hour * 3600 * S)
    assert one.shown_ns(47 * 3600 * S + 17)[0] == other.shown_ns(47 * 3600 * S + 17)[0]
    assert len(one._rates) < 8000
    with pytest.raises(ValueError, match="no longer stored"):
        one.shown_ns(0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("offset_us", -1),
        ("offset_us", float("nan")),
        ("drift_ppm", 1001),
        ("ramp_ppm", -2000),
        ("walk_ppb", -1),
        ("ramp_seconds", 0),
        ("ramp_from_s", -1),
        ("restarts_s", (0,)),
    ],
)
def test_nonsense_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=field):
        ClockSettings(**{field: value})


@pytest.mark.parametrize(("at_s", "by_us", "name"), [(-1, 0, "at_s"), (0, float("nan"), "by_us")])
def test_nonsense_steps_are_refused_by_name(at_s, by_us, name):
    with pytest.raises(ValueError, match=name):
        ClockStep(at_s, by_us)


def test_keyed_draws_are_normal_and_keyed():
    draws = normal(3, Draw.CLOCK_WALK, np.arange(100_000))
    assert abs(draws.mean()) < 4 / np.sqrt(100_000)
    assert draws.std() == pytest.approx(1, abs=4 / np.sqrt(200_000))
    assert normal(3, Draw.CLOCK_WALK, 77)[0] == draws[77]
    assert not np.array_equal(draws[:10], normal(3, Draw.EDGE_JITTER, np.arange(10)))
    assert not np.array_equal(draws[:10], normal(4, Draw.CLOCK_WALK, np.arange(10)))
