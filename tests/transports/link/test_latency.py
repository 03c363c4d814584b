"""The latency histogram against sorted data."""

import numpy as np

from transports.link.latency import LatencyHistogram, LatencySummary


def test_quantiles_are_within_a_bin():
    rng = np.random.default_rng(1)
    latencies = rng.gamma(2.0, 400.0, 20_000)
    histogram = LatencyHistogram()
    for part in np.array_split(latencies, 7):
        histogram.add(part)
    summary = histogram.summary()
    assert abs(summary.p50 - np.quantile(latencies, 0.5)) <= 10
    assert abs(summary.p99 - np.quantile(latencies, 0.99)) <= 10
    assert summary.max == latencies.max()


def test_nothing_measured_is_not_zero():
    assert LatencyHistogram().summary() == LatencySummary(None, None, None)


def test_latencies_beyond_the_last_bin_keep_their_maximum():
    histogram = LatencyHistogram()
    histogram.add(np.array([-5.0, 3e6]))
    summary = histogram.summary()
    assert summary.max == 3e6
    assert summary.p50 == 10.0
