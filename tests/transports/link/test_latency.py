"""The latency histogram against sorted data."""

import numpy as np
import pytest

from transports.link.deliveries import LatencyHistogram, LatencySummary


def test_quantiles_are_within_a_bin():
    rng = np.random.default_rng(1)
    latencies = rng.gamma(2.0, 400.0, 20_000)
    histogram = LatencyHistogram()
    for part in np.array_split(latencies, 7):
        histogram.add(part)
    summary = histogram.summary()
    assert abs(summary.p50 - np.quantile(latencies, 0.5)) <= 10
    assert abs(summary.p99 - np.quantile(latencies, 0.99)) <= 10
    assert abs(summary.p999 - np.quantile(latencies, 0.999, method="inverted_cdf")) <= 10
    assert summary.max == latencies.max()


def test_latencies_follow_from_the_times_of_events_and_of_their_sending():
    times_us = np.sort(np.random.default_rng(3).integers(0, 40_000, 20_000))
    sent_us = (times_us // 1000 + 1) * 1000 + 0.7
    of_times, of_latencies = LatencyHistogram(), LatencyHistogram()
    of_latencies.add(sent_us - times_us)
    for now_us in np.unique(sent_us):
        of_times.add_times(times_us[sent_us == now_us], float(now_us))
    assert of_times.summary() == of_latencies.summary()


def test_nothing_measured_is_not_zero():
    assert LatencyHistogram().summary() == LatencySummary(None, None, None)


def test_an_event_before_its_time_counts_as_zero():
    histogram = LatencyHistogram()
    histogram.add(np.array([-5.0, 3e6]))
    assert histogram.summary() == LatencySummary(10.0, 3e6, 3e6, 3e6)


@pytest.mark.parametrize("scale_us", [1e5, 1e6, 1e8, 1e12])
def test_long_latencies_have_quantiles_too(scale_us):
    """Half of them above 0.2 s, or all: within 1 % above those of the sorted data."""
    latencies = np.random.default_rng(2).gamma(2.0, scale_us, 20_000)
    histogram = LatencyHistogram()
    for part in np.array_split(latencies, 7):
        histogram.add(part)
    summary = histogram.summary()
    for quantile_us, share in ((summary.p50, 0.5), (summary.p99, 0.99)):
        exact_us = np.quantile(latencies, share, method="inverted_cdf")
        assert exact_us <= quantile_us <= max(1.01 * exact_us, exact_us + 10)


def test_latencies_beyond_all_bins_give_the_maximum():
    histogram = LatencyHistogram()
    histogram.add(np.array([1e15, 1e300]))
    assert histogram.summary() == LatencySummary(1e300, 1e300, 1e300, 1e300)
