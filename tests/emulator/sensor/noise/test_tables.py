"""Tables of hazards: closed forms, limits, paths that are followed in fine steps, and the file as it is made anew."""

import math

import numba
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq
from scipy.special import hyp1f1, ndtr, pbdv

from tests.emulator.sensor.noise import hazard_tables as tables
from tests.emulator.sensor.noise.hazard_tables import (
    C_ONE,
    C_START,
    C_TWO,
    EXIT_SPEEDS,
    INVERSE_B,
    PAIR_ONE,
    PAIR_TWO,
    RHO,
    SPEEDS,
)

FILE = dict(np.load(tables.HAZARDS))
STILL = 32
ALPHA = 1e-4


def hazard(name, c, j, k=...):
    """H at nodes of c, column j of rho."""
    nodes = C_ONE if name == "one" else C_TWO
    i = np.searchsorted(nodes, c)
    return FILE[name][k, i, j] * (1 + abs(SPEEDS[j - 1])) * stats.norm.pdf(np.maximum(c, 0))


def test_still_hazards_of_one_pole_are_the_eigenvalues_of_its_equation():
    """On z < c the decay rate is the first n at which the parabolic cylinder function D_n(-c) is 0."""
    assert hazard("one", np.array([0.0, -1.0]), STILL) == pytest.approx([1, 2], rel=1e-5)
    for c in (0.5, 1.0, 2.0, 3.0, 4.0):
        exact = brentq(lambda n, c=c: pbdv(n, -c)[0], 1e-9, 0.99)
        assert hazard("one", c, STILL) == pytest.approx(exact, rel=1e-4)


def test_between_equal_thresholds_each_has_half_of_the_decay():
    """The even solution on (-a, a) is 1F1(-n / 2; 1 / 2; z^2 / 2), with n the decay rate."""
    for a in (0.5, 1.0, 2.0, 3.0):
        decay = brentq(lambda n, a=a: hyp1f1(-n / 2, 0.5, a * a / 2), 1e-9, 12 if a < 1 else 2.5)
        i = np.searchsorted(PAIR_ONE, a)
        assert FILE["one_pair"][i, i] * hazard("one", a, STILL) == pytest.approx(decay / 2, rel=2e-4)


def test_the_first_instant_after_a_reset_is_that_of_brownian_motion():
    """Also between the nodes, where both tables are interpolated."""
    c = np.concatenate([C_START[1:], C_START[4:-1] + 1 / 16])
    row = FILE["one"][np.searchsorted(C_ONE, c)]
    column = [np.interp(rho, RHO, values) for rho, values in zip(c / (1 + c), row, strict=True)]
    found = np.array(column) * (1 + c) * (1 + np.interp(c, C_START, FILE["one_start"]))
    assert found == pytest.approx(2 * c / np.array([math.erf(x / math.sqrt(2)) for x in c]), rel=1e-3)


@pytest.mark.parametrize("k", range(INVERSE_B.size))
def test_limits_of_two_poles(k):
    """A fast boundary cuts frozen noise: H = Rice / Phi(c); a far one is passed by paths that are alone: Rice."""
    rice = np.concatenate([[0.0], tables.rice(np.maximum(SPEEDS, -5))[0] / (1 + abs(SPEEDS)), [1.0]])
    ratio = FILE["two"][k] / np.maximum(rice, 1e-9) * np.exp(np.minimum(C_TWO, 0) ** 2 / 2)[:, None]
    c = C_TWO > -2
    assert ratio[c, -2] == pytest.approx(1 / ndtr(C_TWO[c]), rel=2e-3)
    assert ratio[-1, 56:] == pytest.approx(1, abs=5e-4)
    assert FILE["two_speed"][k, -1, 56:] == pytest.approx(1, abs=5e-4)


def test_two_poles_far_apart_are_one_behind_milnes_length():
    """At b = 8: the time constant is 1/a1 + 1/a2, the threshold lies 1.4604 / b farther out."""
    c = C_TWO[(C_TWO >= -1) & (C_TWO <= 0.75)]
    one = np.exp(np.interp(c + 1.4604 / 8, C_ONE, np.log(hazard("one", C_ONE, STILL))))
    assert hazard("two", c, STILL, 0) == pytest.approx(one / 8, rel=0.02)


@numba.njit
def passages(b, dt, until, paths, random):
    """Values of c at which paths first meet a boundary that comes down from 5 to `until` at the speed 1; else NaN.

    Steps of one pole (b = 0) are exact and have a Brownian bridge between them; those of two are straight in the slope.
    """
    found = np.full(paths, np.nan)
    decay, kick = math.exp(-dt), math.sqrt(1 - math.exp(-2 * dt))
    for path in range(paths):
        z, v, c = random.normal(), random.normal(), 5.0
        while c > until:
            gap = c - z
            if b > 0:
                middle = v - (z + b * v) * dt / 2 + math.sqrt(b * dt) * random.normal()
                z += middle * dt
                v = (middle - z * dt / 2 + math.sqrt(b * dt) * random.normal()) / (1 + b * dt / 2)
            else:
                z = z * decay + kick * random.normal()
            c -= dt
            left = c - z
            if left <= 0 or (b == 0 and random.random() < math.exp(-gap * left / dt)):
                found[path] = c + dt / 2
                break
    return found


@pytest.mark.parametrize("b", [0.0, 2.0, 4.0])
def test_passages_of_paths_before_a_coming_boundary(b):
    """Numbers of passages in intervals of c, which a right table fails with a probability of 1e-4."""
    name, column = ("one", ...) if b == 0 else ("two", np.searchsorted(INVERSE_B, 1 / b))
    nodes = C_ONE if b == 0 else C_TWO
    edges = nodes[(nodes >= 0) & (nodes <= 3)][:: 8 if b == 0 else 4]
    c = np.arange(0, 5, 1 / 64)
    along = np.exp(np.interp(c, nodes, np.log(hazard(name, nodes, 48, column))))
    total = np.append(0.0, np.cumsum((along[1:] + along[:-1]) / 128))
    survival = np.exp(-(total[-1] - np.interp(edges, c, total)))
    share = np.concatenate([[survival[0]], np.diff(survival), [1 - survival[-1]]])
    found = passages(b, 0.01, 0.0, 40_000, np.random.default_rng(3))
    counts = np.histogram(np.where(np.isnan(found), -1, found), np.concatenate([[-2], edges, [9]]))[0]
    assert stats.chisquare(counts, share / share.sum() * counts.sum()).pvalue > ALPHA


def test_the_file_is_what_the_program_makes():
    """A few columns and cells; the whole takes minutes."""
    j = 48
    for nu in (SPEEDS[20], SPEEDS[j]):
        column = np.searchsorted(SPEEDS, nu)
        made = tables.tabled(C_ONE, np.repeat(tables.one_pole(nu)[:, None], SPEEDS.size, axis=1))
        assert FILE["one"][:, column + 1] == pytest.approx(made[:, column + 1], rel=1e-4)
    made = tables.two_pole_ramp(2.0, SPEEDS[j], C_TWO[::-1])[::-1]
    of_two = tables.tabled(C_TWO, np.repeat(made[:, :1], SPEEDS.size, axis=1))
    assert FILE["two"][-1, :, j + 1] == pytest.approx(of_two[:, j + 1], rel=1e-4)
    assert FILE["two_speed"][-1, :, j + 1] == pytest.approx(made[:, 1] / tables.rice(SPEEDS[j])[1], rel=1e-4)
    flux, alone = (tables.two_pole_pair(2.0, 1.0, below)[0] for below in (0.5, PAIR_TWO[-1]))
    place = np.searchsorted(PAIR_TWO, [1.0, 0.5])
    assert FILE["two_pair"][-1][tuple(place)] == pytest.approx(flux / alone, rel=1e-4)
    assert FILE["exit"] == pytest.approx(tables.exit_quantiles(), rel=1e-4)


def test_quantiles_of_the_speed_divide_its_density():
    """The share below u of the density u phi(u - nu), in closed form."""
    nu, u = EXIT_SPEEDS[:, None], FILE["exit"].astype(np.float64)
    below = stats.norm.pdf(nu) - stats.norm.pdf(u - nu) + nu * (ndtr(u - nu) - ndtr(-nu))
    share = (below / tables.rice(nu)[0])[8:]
    assert share[:, :-1] == pytest.approx(np.broadcast_to(np.arange(64) / 64, share[:, :-1].shape), abs=1e-4)
    assert share[:, -1] == pytest.approx(1 - 1 / 600, abs=1e-5)
