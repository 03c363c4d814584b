"""The laws of parameters, against scipy's distributions and counting."""

import numpy as np
import pytest
from scipy.stats import loguniform, truncnorm

from emulator.campaign.sampling import LAWS, Integers, LogUniform, Normal, OneOf, Uniform

SHARES = np.linspace(0.0, 0.999, 41)


def test_uniform_goes_from_low_to_high():
    law = Uniform("a", low=-2.0, high=6.0)
    assert [law.at(u) for u in (0.0, 0.25, 0.5)] == [-2.0, 0.0, 2.0]


def test_log_uniform_is_that_of_scipy():
    law = LogUniform("a", low=0.01, high=100.0)
    assert [law.at(u) for u in SHARES] == pytest.approx(loguniform(0.01, 100.0).ppf(SHARES), rel=1e-9)


def test_normal_is_the_cut_distribution_of_scipy():
    law = Normal("a", mean=3.0, deviation=2.0, low=2.0, high=9.0)
    known = truncnorm(-0.5, 3.0, loc=3.0, scale=2.0).ppf(SHARES)
    assert [law.at(u) for u in SHARES] == pytest.approx(known, rel=1e-9)


def test_integers_are_each_as_likely():
    law = Integers("a", low=-1, high=3)
    drawn = [law.at(k / 1000) for k in range(1000)]
    assert [drawn.count(k) for k in range(-1, 4)] == [200] * 5
    assert all(type(k) is int for k in drawn)


def test_a_list_gives_each_value_as_often():
    law = OneOf("a", values=("x", True, 2))
    assert [law.at(u) for u in (0.0, 0.34, 0.99)] == ["x", True, 2]


def test_grids():
    assert Uniform("a", low=0.0, high=1.0, steps=5).grid() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert LogUniform("a", low=1.0, high=100.0, steps=3).grid() == pytest.approx([1.0, 10.0, 100.0])
    assert Integers("a", low=2, high=4).grid() == [2, 3, 4]
    assert OneOf("a", values=(1, "b")).grid() == [1, "b"]
    with pytest.raises(ValueError, match="steps is missing"):
        Uniform("a", low=0.0, high=1.0).grid()
    with pytest.raises(ValueError, match="has no grid"):
        Normal("a", mean=0.0, deviation=1.0).grid()


@pytest.mark.parametrize(
    ("kind", "figures", "message"),
    [
        ("uniform", {"low": 2.0, "high": 1.0}, "low must be below high"),
        ("uniform", {"low": 2.0}, "both needed"),
        ("uniform", {"low": 0.0, "high": float("inf")}, "finite"),
        ("log-uniform", {"low": 0.0, "high": 1.0}, "above 0"),
        ("normal", {"deviation": 1.0}, "mean is missing"),
        ("normal", {"mean": 1.0, "deviation": 0.0}, "deviation must be above 0"),
        ("integers", {"low": 3, "high": 3}, "low must be below high"),
        ("list", {}, "values must be a list"),
    ],
)
def test_figures_that_make_no_law_are_refused(kind, figures, message):
    with pytest.raises(ValueError, match=message):
        LAWS[kind]("a", **figures)
