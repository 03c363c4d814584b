"""Rates in still light: counted pixel by pixel, and the curve of Noise2Params by its own formula."""

import csv
import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import norm, poisson

from emulator.sensor.parameters import BackgroundParameters
from emulator.sensor.presets import PRESETS
from laboratory.validation.background import counts
from laboratory.validation.recordings import DATA


def test_events_of_a_known_rate_are_counted_by_polarity():
    known = dataclasses.replace(PRESETS["ideal"], background=BackgroundParameters(hz=2.0, off_share=0.25))
    off, on = counts(known, 1.0, 1)
    assert off.shape == (9600,)
    assert off.mean() == pytest.approx(10, rel=0.02)  # 20 s; 6 standard deviations
    assert on.mean() == pytest.approx(30, rel=0.012)
    assert np.var(on) == pytest.approx(30, rel=0.1)


@pytest.mark.parametrize("lux", [10, 20, 50])
def test_the_curve_has_the_rates_of_the_published_model(lux):
    """ON where ln((N1 + theta) / (N2 + theta)) > B, by exact Poisson numbers and 101 quantiles of B."""
    with (DATA / "noise2params.csv").open() as file:
        rows = {float(line["lux"]): line for line in csv.DictReader(line for line in file if line[0] != "#")}
    assert len(rows) == 13
    mean, second = 4.5 * lux, np.arange(1000)
    theta = 18.917 + 35.490 * math.sqrt(mean) + 0.43944 * mean
    thresholds = norm.ppf((np.arange(101) + 0.5) / 101, 0.15, 0.00651)[:, None]
    on = poisson.pmf(second, mean) * poisson.sf(np.floor((second + theta) * np.exp(thresholds) - theta), mean)
    assert float(rows[lux]["on_hz"]) == pytest.approx(1e6 * (on.sum(axis=1).mean() + 9.5675e-9), rel=0.02)
