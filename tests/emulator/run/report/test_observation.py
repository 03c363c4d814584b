"""What is observed of a run: counts of every event, in any batches, in memory that does not grow."""

import numpy as np
import pytest

from emulator.run.outcome import RunStatus
from emulator.run.pacing import Lateness
from emulator.run.report.observation import INTERVAL_EDGES_US, Observation, PictureStrip
from firmware_protocol.events import EVENT
from tests.made_events import events_at, scattered
from transports.link.feed import EdgeReport
from transports.link.report import LinkReport

SIZE = (20, 10)


def stream(count, until_us=5_000_000, seed=3):
    return scattered(np.sort(np.random.default_rng(seed).integers(0, until_us, count)), SIZE, seed)


def observed(events, pieces):
    seen = Observation(SIZE)
    for part in np.array_split(events, pieces):
        seen.take(part)
    return seen


@pytest.mark.parametrize("pieces", [1, 7, 997])
def test_every_event_is_counted_once_whatever_the_batches(pieces):
    events = stream(2000)
    seen = observed(events, pieces)
    for counts, on in ((seen.on, True), (seen.off, False)):
        truth = np.zeros((SIZE[1], SIZE[0]), int)
        np.add.at(truth, (events["y"][events["on"] == on], events["x"][events["on"] == on]), 1)
        assert np.array_equal(counts, truth)
    assert np.array_equal(seen.rates.column(Observation.EVENTS), np.histogram(events["t"], np.arange(51) * 100_000)[0])
    assert seen.rates.column(Observation.ON).sum() == events["on"].sum()


@pytest.mark.parametrize("pieces", [1, 7, 997])
def test_intervals_are_those_of_the_sampled_pixels(pieces):
    events = stream(2000)
    sampled = events[(events["x"] + events["y"]) % 8 == 0]
    gaps = [
        np.diff(sampled["t"][(sampled["x"] == x) & (sampled["y"] == y)].astype(int))
        for x in range(SIZE[0])
        for y in range(SIZE[1])
    ]
    truth = np.histogram(np.maximum(np.concatenate(gaps), 1), INTERVAL_EDGES_US)[0]
    assert np.array_equal(observed(events, pieces).intervals, truth)


def test_a_long_run_has_longer_bins_and_no_more_of_them():
    seen = Observation(SIZE)
    for second in range(0, 7200, 10):
        events = events_at(second * 1_000_000 + np.array([0, 1, 2]), on=[True, False, False])
        seen.take(events)
    assert len(seen.rates.column(Observation.EVENTS)) <= 2000
    assert seen.rates.bin_us == 6_400_000
    assert seen.rates.column(Observation.EVENTS).sum() == 3 * 720
    assert seen.rates.column(Observation.ON).sum() == 720


def test_late_steps_and_edges_are_counted_when_they_are_reported():
    seen = Observation(SIZE)
    for t_s, late, edges in ((0.05, 1, 0), (0.15, 1, 0), (0.25, 4, 7), (1.05, 4, 9)):
        links = {"a": LinkReport("open", edges=EdgeReport(taken=edges)), "b": LinkReport("open")}
        seen.renew(RunStatus(t_s, t_s, 0, 0, Lateness(frames_late=late), links))
    assert np.flatnonzero(seen.counts.column(Observation.LATE)).tolist() == [0, 2]
    assert seen.counts.column(Observation.LATE).sum() == 4
    assert seen.counts.column(Observation.EDGES)[[2, 10]].tolist() == [7, 2]


def test_a_picture_has_the_last_event_of_each_pixel_before_it():
    strip, light = PictureStrip((4, 2)), np.ones((2, 4), np.float32)
    rows = [(1_000, 0, 0, True), (45_000, 1, 0, True), (46_000, 2, 1, True), (49_000, 2, 1, False)]
    for k, row in enumerate(rows):
        strip.take(np.array([row], EVENT), light, (k + 1) * 12_500)
    (only,) = strip.chosen(6)
    assert only.polarity.tolist() == [[0, 1, 0, 0], [0, 0, -1, 0]]
