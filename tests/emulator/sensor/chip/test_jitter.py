"""Delays of events: their law, and that order and steps do not suffer. Statistical tests fail with probability 1e-4."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from emulator.sensor.chip.readout import Jitter
from emulator.sensor.parameters import JitterParameters
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, joined

ALPHA = 1e-4
US, MS = 1000, 1_000_000
PIXELS = 50


def crossings(n, end_ns, seed=1, start_ns=0):
    random = np.random.default_rng(seed)
    t_ns = np.sort(random.integers(start_ns, end_ns, n))
    pixel, on = random.integers(0, PIXELS, n).astype(np.uint32), random.random(n) < 0.5
    order = np.lexsort([pixel, t_ns])
    return Crossings(t_ns, pixel[order], on[order])


def delayed(events, ends, parameters, seed=1, start_ns=0):
    """The events that leave when `events` come in steps that end at `ends`."""
    jitter = Jitter(parameters, seed, PIXELS)
    jitter.reset(start_ns)
    parts, k = [], 0
    for end in ends:
        n = int(np.searchsorted(events.t_ns, end, side="left"))
        parts.append(jitter.step(Crossings(events.t_ns[k:n], events.pixel[k:n], events.on[k:n]), end))
        assert len(parts[-1]) == 0 or parts[-1].t_ns[-1] < end
        k = n
    return joined(parts), jitter


def test_delays_are_log_normal_of_the_given_mean_and_deviation():
    events = Crossings(np.arange(PIXELS) * US, np.arange(PIXELS, dtype=np.uint32), np.ones(PIXELS, bool))
    delays = []
    for seed in range(200):
        found, _ = delayed(events, [10**12], JitterParameters(latency_us=30.0, deviation_us=20.0), seed)
        delays.append(found.t_ns[np.argsort(found.pixel)] - events.t_ns)
    delays = np.concatenate(delays) / US
    spread = np.sqrt(np.log1p((20 / 30) ** 2))
    assert stats.kstest((np.log(delays / 30) + spread**2 / 2) / spread, "norm").pvalue > ALPHA
    assert delays.mean() == pytest.approx(30, rel=0.03)
    assert delays.std() == pytest.approx(20, rel=0.06)


def test_each_event_of_a_pixel_has_a_delay_of_its_own():
    times = np.arange(200) * 100 * MS
    events = Crossings(times, np.full(200, 7, np.uint32), np.ones(200, bool))
    found, _ = delayed(events, [10**12], JitterParameters(latency_us=30.0, deviation_us=20.0))
    delays = found.t_ns - times
    assert np.unique(delays).size > 195
    assert abs(stats.pearsonr(delays[1:], delays[:-1]).statistic) < 0.3


def test_without_deviation_all_are_late_alike():
    events = crossings(1000, 10**9)
    found, jitter = delayed(events, [2 * 10**9], JitterParameters(latency_us=7.0))
    assert np.abs(found.t_ns - events.t_ns - 7 * US).max() <= 1
    assert np.array_equal(found.pixel, events.pixel)
    assert jitter.waiting == 0


@given(
    ends=st.lists(st.integers(1, 20 * MS), max_size=10), n=st.integers(0, 400), start_ns=st.integers(0, 2**61),
    latency_us=st.sampled_from([50.0, 5000.0]), deviation_us=st.sampled_from([0.0, 10.0, 10_000.0]),
)  # fmt: skip
def test_nothing_depends_on_the_steps_and_no_pixel_is_put_out_of_order(ends, n, start_ns, latency_us, deviation_us):
    parameters = JitterParameters(latency_us, deviation_us)
    events = crossings(n, start_ns + 20 * MS, start_ns=start_ns)
    ends = [*(start_ns + e for e in sorted(ends)), start_ns + 10**11]
    found, jitter = delayed(events, ends, parameters, start_ns=start_ns)
    whole, _ = delayed(events, ends[-1:], parameters, start_ns=start_ns)
    assert len(found) + jitter.waiting == n
    assert np.array_equal(found.t_ns, whole.t_ns)
    assert np.array_equal(found.pixel, whole.pixel)
    assert np.array_equal(found.on, whole.on)
    for pixel in range(PIXELS):
        mine = found.pixel == pixel
        before = events.pixel == pixel
        assert np.array_equal(found.on[mine], events.on[before])
        assert np.all(np.diff(found.t_ns[mine]) > 0)
        assert np.all(found.t_ns[mine] >= events.t_ns[before])


def test_what_waits_is_counted_and_leaves_in_the_end():
    jitter = Jitter(JitterParameters(latency_us=5000.0), 1, PIXELS)
    assert len(jitter.step(crossings(100, MS), MS)) == 0
    assert jitter.waiting == 100
    assert jitter.last_ns() > 5 * MS
    assert len(jitter.step(NO_CROSSINGS, jitter.last_ns() + 1)) == 100
    assert jitter.waiting == 0
    assert jitter.last_ns() == jitter.last_ns()


def test_a_step_of_days_loses_no_time():
    days_ns, pixels = 2 * 86_400 * 10**9, 346 * 260
    t_ns = np.arange(1, 40) * (days_ns // 40)
    events = Crossings(t_ns, (t_ns % pixels).astype(np.uint32), np.ones(39, bool))
    jitter = Jitter(JitterParameters(latency_us=7.0), 1, pixels)
    found = jitter.step(events, days_ns)
    assert np.abs(found.t_ns - t_ns - 7 * US).max() <= 1
    assert np.array_equal(found.pixel, events.pixel)


def test_off_events_have_a_delay_of_their_own():
    events = crossings(1000, 10**9)
    found, _ = delayed(events, [2 * 10**9], JitterParameters(latency_us=7.0, off_latency_us=11.0))
    late_ns = found.t_ns[np.lexsort((found.t_ns, found.pixel))] - events.t_ns[np.lexsort((events.t_ns, events.pixel))]
    on = events.on[np.lexsort((events.t_ns, events.pixel))]
    assert 0 < on.sum() < on.size
    assert np.median(late_ns[on]) == pytest.approx(7 * US, abs=1)
    assert np.median(late_ns[~on]) == pytest.approx(11 * US, abs=1)


def test_a_share_of_the_events_is_late_by_an_exponential_time():
    n = 20_000
    events = Crossings(np.arange(n) * US, np.arange(n, dtype=np.uint32) % PIXELS, np.ones(n, bool))
    events = Crossings(np.arange(n, dtype=np.int64) // PIXELS * 10**9, events.pixel, events.on)
    found, _ = delayed(events, [10**13], JitterParameters(latency_us=7.0, late_share=0.1, late_us=3000.0))
    late_us = (found.t_ns % 10**9) / US - 7
    late = late_us[late_us > 1]
    assert late.size / n == pytest.approx(0.1, rel=0.1)
    assert stats.kstest(late, "expon", args=(0, 3000)).pvalue > ALPHA


def test_a_changed_delay_of_off_events_holds_from_then_on_and_keeps_their_order():
    times = np.array([0, 10 * MS, 20 * MS, 20 * MS + 1 * US])
    events = Crossings(times, np.array([1, 1, 2, 2], np.uint32), np.array([False, True, False, True]))
    jitter = Jitter(JitterParameters(latency_us=7.0, off_latency_us=11.0), 1, PIXELS)
    jitter.reset(0)
    first = jitter.step(Crossings(times[:2], events.pixel[:2], events.on[:2]), 15 * MS)
    jitter.set_off_latency(1100.0)
    later = jitter.step(Crossings(times[2:], events.pixel[2:], events.on[2:]), 60 * MS)
    assert first.t_ns.tolist() == pytest.approx([11 * US, 10 * MS + 7 * US], abs=2)
    assert later.t_ns.tolist() == pytest.approx([20 * MS + 1100 * US] * 2, abs=2)
    assert later.on.tolist() == [False, True]
