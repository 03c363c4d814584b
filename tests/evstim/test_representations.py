"""Arrays for networks, beside those of tonic and by hand."""

import numpy as np
import pytest
import tonic.functional
from hypothesis import given
from hypothesis import strategies as st

from evstim.representations import TONIC, event_frame, time_surface, to_tonic, voxel_grid
from firmware_protocol.events import make_events

SIZE = (7, 5)


@st.composite
def many_events(draw):
    n = draw(st.integers(2, 200))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    t = np.sort(rng.integers(0, draw(st.sampled_from([10, 1000, 10**12])), n))
    t[-1] += 1  # tonic divides by the duration
    return make_events(t, rng.integers(0, 7, n), rng.integers(0, 5, n), rng.random(n) < 0.5)


@given(many_events())
def test_counts_are_those_of_tonic(events):
    theirs = tonic.functional.to_frame_numpy(to_tonic(events), (*SIZE, 2), n_event_bins=1)
    np.testing.assert_array_equal(event_frame(events, SIZE), theirs[0])
    assert event_frame(events, SIZE).sum() == len(events)


@given(many_events(), st.integers(1, 12))
def test_a_voxel_grid_is_that_of_tonic(events, bins):
    """Tonic's grid of n bins has the first n of the n + 1 bins that reach from the first to the last event."""
    theirs = tonic.functional.to_voxel_grid_numpy(
        to_tonic(events).astype([*TONIC.descr[:3], ("p", "i1")]), (*SIZE, 2), bins
    )
    np.testing.assert_allclose(voxel_grid(events, SIZE, bins + 1)[:-1], theirs[:, 0], atol=1e-5)


@given(many_events(), st.floats(1.0, 1e6))
def test_a_time_surface_is_that_of_tonic(events, tau_us):
    duration_us = int(events["t"][-1] - events["t"][0]) + 1
    (theirs,) = tonic.functional.to_timesurface_numpy(
        to_tonic(events), (*SIZE, 2), dt=duration_us, tau=tau_us, include_incomplete=True
    )
    ours = time_surface(events, SIZE, tau_us, int(events["t"][0]) + duration_us)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-30)


def test_a_voxel_grid_by_hand():
    events = make_events([0, 50, 75, 100], [1, 1, 2, 3], [0, 0, 0, 4], [True, False, True, True])
    grid = voxel_grid(events, SIZE, 3)
    assert grid.shape == (3, 5, 7)
    assert grid[:, 0, 1].tolist() == [1.0, -1.0, 0.0]
    assert grid[:, 0, 2].tolist() == [0.0, 0.5, 0.5]
    assert grid[:, 4, 3].tolist() == [0.0, 0.0, 1.0]
    later = voxel_grid(events, SIZE, 3, begin_us=50, end_us=100)  # the first event is left out
    assert later[:, 0, 1].tolist() == [-1.0, 0.0, 0.0]
    assert later[:, 0, 2].tolist() == [0.0, 1.0, 0.0]


def test_a_normalised_grid_has_mean_zero_and_deviation_one():
    rng = np.random.default_rng(1)
    events = make_events(np.arange(100), rng.integers(0, 7, 100), rng.integers(0, 5, 100), rng.random(100) < 0.7)
    plain, normalised = (voxel_grid(events, SIZE, 4, normalised=flag) for flag in (False, True))
    filled = normalised[plain != 0]
    assert filled.mean() == pytest.approx(0, abs=1e-6)
    assert filled.std() == pytest.approx(1, abs=1e-6)
    assert not normalised[plain == 0].any()


@pytest.mark.parametrize(
    ("call", "why"),
    [
        (lambda events: voxel_grid(events, SIZE, 1), "bins = 1"),
        (lambda events: time_surface(events, SIZE, 0.0), "tau_us = 0"),
        (lambda events: event_frame(events, (6, 5)), "beyond a sensor of 6 x 5"),
        (lambda events: voxel_grid(events, (7, 4), 2), "beyond a sensor of 7 x 4"),
    ],
)
def test_what_cannot_be_is_refused(call, why):
    with pytest.raises(ValueError, match=why):
        call(make_events([0, 1], [0, 6], [0, 4], [True, False]))
