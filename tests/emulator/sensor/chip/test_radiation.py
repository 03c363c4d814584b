"""Particles: where their tracks go, how often and how they come. Statistical tests fail with probability 1e-4."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from emulator.sensor.chip.sources import Particles, _Track, hits_per_second, path
from emulator.sensor.parameters import RadiationParameters
from emulator.sensor.pixels.crossings import joined
from emulator.sensor.presets import SensorParameters

ALPHA = 1e-4
MS = 1_000_000
S = 1000 * MS
W, H = 100, 80
PLAIN = SensorParameters(
    width=W, height=H, threshold_on=0.2, threshold_off=0.2,
    radiation=RadiationParameters(hits_per_cm2_s=1e4, pixel_pitch_um=20.0, depth_um=10.0, off_share=0.0),
)  # fmt: skip
NONE_DEAD = np.empty(0, np.int64)


def with_(**figures):
    return dataclasses.replace(PLAIN, radiation=dataclasses.replace(PLAIN.radiation, **figures))


def run(p=PLAIN, seed=1, step_ns=MS, end_ns=S, start_ns=0, dead=NONE_DEAD):
    particles = Particles(p, seed, dead)
    particles.reset(start_ns)
    return joined([particles.step(t) for t in range(start_ns + step_ns, start_ns + end_ns + 1, step_ns)])


def tracks(found):
    """The pixels of each hit: events of one time (two particles in one nanosecond are not expected)."""
    return np.split(found.pixel.astype(int), np.flatnonzero(np.diff(found.t_ns)) + 1)


def path_of(x, y, along_x, along_y):
    pixel = np.empty(W + H + 2, np.int64)
    n = path(_Track(x, y, along_x, along_y), W, H, pixel)
    return pixel[:n] % W, pixel[:n] // W


@given(
    x=st.floats(0, W, exclude_max=True), y=st.floats(0, H, exclude_max=True),
    length=st.one_of(st.just(0.0), st.floats(0, 500)), angle=st.floats(0, 2 * math.pi),
)  # fmt: skip
def test_a_track_is_what_lies_under_its_line(x, y, length, angle):
    along_x, along_y = length * math.cos(angle), length * math.sin(angle)
    columns, rows = path_of(x, y, along_x, along_y)
    steps = np.abs(np.diff(columns)) + np.abs(np.diff(rows))
    assert (columns[0], rows[0]) == (int(x), int(y))
    assert np.all(steps == 1)
    share = np.linspace(0, 1, 2000)
    at_x, at_y = x + share * along_x, y + share * along_y
    inside = (at_x >= 0) & (at_x < W) & (at_y >= 0) & (at_y < H)
    first_out = inside.argmin() if not inside.all() else inside.size
    under = set(zip(at_x[:first_out].astype(int), at_y[:first_out].astype(int), strict=True))
    border = np.minimum(abs(at_x - np.round(at_x)), abs(at_y - np.round(at_y))) < 1e-9
    touched = set(zip(at_x[border].astype(int), at_y[border].astype(int), strict=True))
    assert under - set(zip(columns.tolist(), rows.tolist(), strict=True)) <= touched
    # and no pixel of the path is further from the line than half its diagonal
    off = np.abs((columns + 0.5 - x) * math.sin(angle) - (rows + 0.5 - y) * math.cos(angle))
    assert length == 0 or off.max() <= math.sqrt(0.5) + 1e-6


def test_hits_come_at_the_rate_of_the_area_and_at_random():
    assert hits_per_second(PLAIN) == pytest.approx(1e4 * 0.2 * 0.16)
    found = run(end_ns=20 * S)
    starts = np.unique(found.t_ns)
    assert stats.poisson(20 * hits_per_second(PLAIN)).cdf(starts.size) == pytest.approx(0.5, abs=0.5 - ALPHA)
    gaps = np.diff(starts)
    assert stats.kstest(gaps, "expon", (0, gaps.mean())).pvalue > ALPHA


def test_tracks_are_as_long_as_isotropic_flux_makes_them():
    p = with_(depth_um=100.0)
    found = run(p, end_ns=20 * S)
    spans = [(np.ptp(t % W), np.ptp(t // W)) for t in tracks(found)]
    wide, high = np.array(spans).T
    length = np.hypot(wide, high)
    # tan > t with probability 1 / (1 + t^2); a track of 5 tan pixels spans its length to within a pixel or so
    for tangent in (1, 2, 4):
        expected = 1 / (1 + tangent**2)
        assert np.mean(length >= 5 * tangent) == pytest.approx(expected, abs=0.04)
    flat, steep = int((wide > high).sum()), int((wide < high).sum())
    assert stats.binomtest(flat, flat + steep).pvalue > ALPHA


def test_particles_come_down_all_over_the_chip():
    first = np.array([track[0] for track in tracks(run(with_(depth_um=0.0), end_ns=20 * S))])
    cells = (first // W // 20) * 4 + (first % W) // 25
    assert stats.chisquare(np.bincount(cells, minlength=16)).pvalue > ALPHA
    assert first.min() < W
    assert first.max() >= W * (H - 1)


def test_a_share_of_pixels_recovers_with_an_off_event():
    found = run(with_(off_share=0.4, recovery_us=500.0, depth_um=0.0), end_ns=20 * S)
    assert stats.binomtest(int((~found.on).sum()), int(found.on.sum()), 0.4).pvalue > ALPHA
    order = np.lexsort([found.t_ns, found.pixel])
    t_ns, pixel, on = found.t_ns[order], found.pixel[order], found.on[order]
    pairs = (pixel[1:] == pixel[:-1]) & on[:-1] & ~on[1:]
    assert stats.kstest(np.diff(t_ns)[pairs] / 500_000, "expon").pvalue > ALPHA


@pytest.mark.parametrize("step_ns", [500_000, 5 * MS, 20 * MS])
def test_steps_do_not_matter(step_ns):
    p = with_(off_share=0.5)
    one, other = run(p), run(p, step_ns=step_ns)
    assert len(one) > 300
    for name in ("t_ns", "pixel", "on"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_dead_pixels_stay_silent_and_seeds_differ():
    dead = np.arange(0, W * H, 2)
    found = run(dead=dead)
    assert len(found) > 100
    assert np.all(found.pixel % 2 == 1)
    assert not np.array_equal(run(seed=2).t_ns[:50], run(seed=3).t_ns[:50])


def test_after_thirty_days_the_rate_is_the_same():
    starts = np.unique(run(start_ns=30 * 86_400 * S, end_ns=20 * S).t_ns)
    assert stats.poisson(20 * hits_per_second(PLAIN)).cdf(starts.size) == pytest.approx(0.5, abs=0.5 - ALPHA)
