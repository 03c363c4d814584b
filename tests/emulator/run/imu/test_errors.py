"""The noise of an IMU against its density and its walk, by the Allan deviation."""

import math

import numpy as np
import pytest

from emulator.run.imu import ElementErrors, Errors

PERIOD_S = 1e-3
ZERO = np.zeros(6)


def errors(density=0.0, walk=0.0, seed=5):
    return ElementErrors(Errors(np.full(6, density), np.full(6, walk), ZERO, ZERO), PERIOD_S, seed)


def allan_deviation(samples, m):
    """Not overlapped: half the mean square difference of neighbouring means of m samples; (axes,)."""
    means = samples[: len(samples) // m * m].reshape(-1, m, samples.shape[1]).mean(axis=1)
    return np.sqrt(0.5 * (np.diff(means, axis=0) ** 2).mean(axis=0))


@pytest.mark.parametrize("m", [1, 10, 100])
def test_white_noise_has_the_allan_deviation_of_its_density(m):
    """n / sqrt(2 tau), within 4.5 standard errors.

    Of K not overlapped differences of white noise the Allan variance has the relative standard error sqrt(3 / K), its
    root half of that (IEEE 952, annex C; Lesage and Audoin 1973).
    """
    samples = errors(density=0.01).at(1, 200_000)
    expected = 0.01 / math.sqrt(2 * m * PERIOD_S)
    error = 0.5 * math.sqrt(3 / (len(samples) // m - 1))
    np.testing.assert_allclose(allan_deviation(samples, m), expected, rtol=4.5 * error)


def test_a_walk_grows_with_the_root_of_time():
    """K sqrt(t): of 2000 paths the deviation is within 4.5 standard errors, each 1 / sqrt(2 * 2000)."""
    ends = np.array([errors(walk=0.5, seed=s).at(401, 1)[0, 0] for s in range(2000)])
    assert np.std(ends) == pytest.approx(0.5 * math.sqrt(401 * PERIOD_S), rel=4.5 / math.sqrt(4000))


def test_axes_are_independent():
    """Correlations of 50 000 samples are within 4.5 / sqrt(50 000) of 0."""
    correlations = np.corrcoef(errors(density=1.0).at(1, 50_000).T) - np.eye(6)
    assert np.abs(correlations).max() < 4.5 / math.sqrt(50_000)


def test_samples_are_white():
    samples = errors(density=1.0).at(1, 50_000)[:, 0]
    assert abs(np.corrcoef(samples[1:], samples[:-1])[0, 1]) < 4.5 / math.sqrt(50_000)


def test_biases_are_drawn_with_their_spread():
    """Of 1200 biases the deviation is within 4.5 standard errors, each 1 / sqrt(2 * 1200)."""
    spread = Errors(ZERO, ZERO, np.full(6, np.nan), np.full(6, 0.4))
    drawn = np.array([ElementErrors(spread, PERIOD_S, seed).bias for seed in range(200)])
    assert np.std(drawn) == pytest.approx(0.4, rel=4.5 / math.sqrt(2400))
