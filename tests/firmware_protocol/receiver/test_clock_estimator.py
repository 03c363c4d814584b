"""The reference estimator: below all points, exact where delays vanish, and good under the delays of a bus and a host.

Statistics: 200 seeded trials of 60 s at 10 Hz. That all 200 stay below 10 us says, at 95 % confidence, that fewer than
1.5 % of such runs do not (0.985^200 = 0.05).
"""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.receiver.clock_estimator import ClockEstimator

HZ, SECONDS, TRIALS = 10, 60, 200
DRIFT_PPM = 50


def delays_ns(rng, n):
    """Software stamps on a bus at 50 % load: a host's gamma and 1 % of 2 ms tail, and the frame that was being sent."""
    host = rng.gamma(2, 15e3, n) + (rng.random(n) < 0.01) * rng.exponential(2e6, n)
    return host + (rng.random(n) < 0.5) * rng.uniform(0, 135e3, n)


def trial(seed):
    """Stamps of one run, and the true offset at its end, ns."""
    n = HZ * SECONDS
    true_ns = np.arange(n) * 1_000_000_000 // HZ
    device = true_ns + true_ns * DRIFT_PPM // 1_000_000 + 123_456_789
    host = true_ns + 10**12 + delays_ns(np.random.default_rng(seed), n).astype(np.int64)
    return device, host, int(true_ns[-1] + 10**12 - device[-1])


def estimated(device, host, **settings):
    estimator = ClockEstimator(**settings)
    for pair in zip(np.asarray(device).tolist(), np.asarray(host).tolist(), strict=True):
        estimator.add(*pair)
    return estimator


def least_squares_ns(device, host):
    """The offset at the end by a straight line through all points, which is what fails."""
    y = (host - device).astype(float)
    return float(np.polyfit((device - device[-1]) / 1e9, y - y[-1], 1)[1] + y[-1])


def test_a_minute_of_software_stamps_gives_ten_microseconds():
    errors_us, line_errors_us, drifts = [], [], []
    for seed in range(TRIALS):
        device, host, true_ns = trial(seed)
        estimate = estimated(device, host).estimate
        errors_us.append((estimate.offset_ns - true_ns) / 1000)
        drifts.append(estimate.drift_ppm + DRIFT_PPM)
        line_errors_us.append((least_squares_ns(device, host) - true_ns) / 1000)
    assert max(np.abs(errors_us)) <= 10
    assert np.sqrt(np.mean(np.square(errors_us))) <= 3
    assert np.std(drifts) <= 0.1
    assert np.sqrt(np.mean(np.square(line_errors_us))) >= 50


def test_no_delay_no_error():
    device = np.arange(1, 100) * 10**8
    host = device + 777 + device // 20_000
    estimate = estimated(device, host).estimate
    assert estimate.offset_ns == host[-1] - device[-1]
    assert estimate.drift_ppm == pytest.approx(50)
    assert estimate.host_ns(int(device[10])) == pytest.approx(host[10], abs=1e-3)


def test_a_known_least_delay_is_taken_off():
    device = np.arange(1, 100) * 10**8
    plain = estimated(device, device + 25_000).estimate
    assert estimated(device, device + 25_000, least_delay_ns=25_000).estimate.offset_ns == plain.offset_ns - 25_000 == 0


@given(st.lists(st.tuples(st.integers(1, 1000), st.integers(0, 1000)), min_size=2, max_size=25))
def test_it_is_the_line_below_all_points_that_is_nearest_to_the_middle(steps):
    device = np.cumsum([step for step, _ in steps])
    y = np.array([delay for _, delay in steps])
    estimate = estimated(device, device + y).estimate
    slope = estimate.drift_ppm * 1e-6
    line = estimate.offset_ns + (device - device[-1]) * slope
    assert (line <= y + 1e-6).all()
    middle = (device[0] + device[-1]) / 2
    height = estimate.offset_ns + (middle - device[-1]) * slope
    for a, b in combinations(range(len(device)), 2):
        other = (y[b] - y[a]) / (device[b] - device[a])
        if (y[a] + (device - device[a]) * other <= y + 1e-6).all():
            assert y[a] + (middle - device[a]) * other <= height + 1e-6


def test_what_is_older_than_the_window_is_forgotten():
    old, new = np.arange(1, 600) * 10**8, np.arange(2000, 2600) * 10**8
    y_old, y_new = np.zeros(599, int), 5_000_000 + np.zeros(600, int)
    both = estimated(np.r_[old, new], np.r_[old + y_old, new + y_new], window_ns=60_000_000_000)
    assert both.estimate.offset_ns == 5_000_000
    assert both.estimate.drift_ppm == 0


def test_memory_is_bounded_whatever_comes():
    device = np.arange(1, 20_000) * 10**8
    assert estimated(device, device + (device // 10**8) ** 2, window_ns=10**15).corners <= 512


def test_a_clock_that_starts_anew_is_estimated_anew():
    estimator = estimated([100, 200, 300], [1100, 1200, 1300])
    estimator.add(5, 5000)
    assert estimator.estimate is None
    assert estimator.restarts == 1
    estimator.add(105, 5100)
    assert estimator.estimate.offset_ns == 4995


def test_loss_of_sync_is_an_alarm():
    estimator = ClockEstimator(period_ns=100, window_ns=10_000, alarm_periods=3)
    assert estimator.lost(0)
    estimator.add(50, 1000)
    assert not estimator.lost(1300)
    assert estimator.lost(1301)
    estimator.add(150, 1400)
    assert not estimator.lost(1401)


@pytest.mark.parametrize("settings", [{"period_ns": 0}, {"window_ns": 1}, {"alarm_periods": 1}])
def test_nonsense_is_refused(settings):
    with pytest.raises(ValueError, match="period"):
        ClockEstimator(**settings)
