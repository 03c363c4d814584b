"""The log light after events, against the light that made them."""

import numpy as np
import pytest

import evstim


def test_the_log_light_comes_back():
    start = np.full((3, 4), np.log(0.1))
    end = start + np.linspace(-1, 1, 12).reshape(3, 4)
    plain = {"sensor": "ideal", "random_start": True, "dark_current_relative": 1e-9}
    thresholds = {"threshold_on": 0.1, "threshold_off": 0.15}
    events = evstim.events_from_frames(np.exp([start, end]), [0, 10_000], **plain, **thresholds)
    found = evstim.reconstruct(events, start, **thresholds)
    assert np.abs(found - end).max() < 0.1 + 0.15, "the first reference lies anywhere between the two thresholds"
    assert np.array_equal(evstim.reconstruct(events, start, t_us=0, **thresholds), start)


def test_each_event_adds_the_threshold_of_its_pixel():
    events = np.array([(1, 0, 0, True), (2, 0, 0, True), (2, 1, 0, False), (3, 0, 0, False)], evstim.EVENT)
    thresholds = {"threshold_on": 0.2, "threshold_off": [[0.1, 0.3]]}
    np.testing.assert_allclose(evstim.reconstruct(events, [[1.0, 2.0]], t_us=2, **thresholds), [[1.4, 1.7]])
    np.testing.assert_allclose(evstim.reconstruct(events, [[1.0, 2.0]], **thresholds), [[1.3, 1.7]])


def test_events_outside_are_refused():
    events = np.zeros(1, evstim.EVENT)
    events["x"] = 4
    with pytest.raises(ValueError, match="outside the 4 x 3 array"):
        evstim.reconstruct(events, np.zeros((3, 4)), threshold_on=0.2, threshold_off=0.2)
    with pytest.raises(ValueError, match="log_light has the shape"):
        evstim.reconstruct(events, np.zeros(4), threshold_on=0.2, threshold_off=0.2)
