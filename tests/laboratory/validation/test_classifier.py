"""The classifier: quantities of tiles counted by hand, and its area for samples of one process and of two."""

import dataclasses
import sys

import numpy as np
import pytest

from emulator.light import MachineLacks
from emulator.sensor.presets import PRESETS
from firmware_protocol.events import EVENT
from laboratory.characterise.still_light import still_events
from laboratory.validation import recordings
from laboratory.validation.classifier import QUANTITIES, Samples, area, tiles

OFF, ON = False, True


def test_quantities_of_two_tiles_counted_by_hand():
    rows = [
        (100_000, 0, 0, ON), (300_000, 0, 0, OFF), (400_000, 0, 0, ON),
        (305_000, 1, 1, ON),  # beside the second, after 5 ms
        (900_000, 1, 1, ON),
        (500_000, 7, 2, OFF),  # in a pixel that is not chosen
        (500_000, 8, 0, ON),  # beside the last whole tile
    ]  # fmt: skip
    chosen = np.ones((5, 9), bool)
    chosen[2, 7] = False
    of_all = tiles(np.array(rows, EVENT), chosen, 4, 1.2, 0.9)
    assert of_all.rows.tolist() == [0, 0]
    assert of_all.columns.tolist() == [0, 1]
    found = dict(zip(QUANTITIES, of_all.values[0].tolist(), strict=True))
    counts = np.bincount([1, 3, 3, 4, 9], minlength=12)  # in windows of 0.1 s
    waits, gaps = np.array([0.2, 0.1, 0.595]), np.diff([0.1, 0.3, 0.305, 0.4, 0.9])
    assert found == pytest.approx(
        {
            "events a pixel": 5 / 16,
            "ON share": 0.8,
            "share of pixels with an event": 2 / 16,
            "largest count of a pixel": 3,
            "mean interval of a pixel, s": waits.mean(),
            "shortest interval of a pixel, s": 0.1,
            "variation of the intervals of a pixel": waits.std() / waits.mean(),
            "share of intervals between opposite polarities": 2 / 3,
            "Fano factor": counts.var() / counts.mean(),
            "share of events beside one of a neighbour": 0.4,
            "variation of the intervals of the tile": gaps.std() / gaps.mean(),
        }
    )
    nothing = dict(zip(QUANTITIES, of_all.values[1], strict=True))
    assert nothing["events a pixel"] == nothing["largest count of a pixel"] == 0
    assert sum(np.isnan(list(nothing.values()))) == 8


def test_tiles_with_too_few_chosen_pixels_are_left_out():
    chosen = np.ones((8, 8), bool)
    chosen[:4, 4:6] = False
    nothing = np.zeros(0, EVENT)
    assert tiles(nothing, chosen, 4, 1.0, 0.5).columns.tolist() == [0, 1, 0, 1]
    assert tiles(nothing, chosen, 4, 1.0, 0.6).columns.tolist() == [0, 0, 1]


def noise(seed, hz, on_share=0.3, side=160):
    """Events of a square of pixels for 10 s, each at a time and place by chance."""
    random = np.random.default_rng(seed)
    events = np.zeros(random.poisson(hz * 10 * side**2), EVENT)
    events["t"] = random.uniform(0, 1e7, len(events))
    events["x"], events["y"] = random.integers(0, side, (2, len(events)))
    events["on"] = random.random(len(events)) < on_share
    return tiles(events, np.ones((side, side), bool), 8, 10.0, 1.0)


def test_samples_of_one_process_have_an_area_of_a_half_and_of_two_an_area_of_one():
    first = noise(1, 0.02)
    assert area(first, noise(2, 0.02)) == pytest.approx(0.5, abs=0.07)  # three deviations of 400 tiles of each
    assert area(first, noise(2, 0.06)) > 0.97
    assert area(first, noise(2, 0.02, on_share=0.7)) > 0.9


def test_no_row_of_the_chip_is_in_two_bands():
    """A value identifies its row, and a row has one origin: one can be judged only after learning from the same row."""
    random = np.random.default_rng(3)
    rows = np.repeat(np.arange(200), 8)
    samples = Samples((rows + random.uniform(0, 0.1, rows.size))[:, None].astype(np.float32), rows, rows)
    origin = random.permutation(200)[rows] % 2 == 0
    assert area(samples.where(origin), samples.where(~origin)) == pytest.approx(0.5, abs=0.1)


def test_without_the_library_the_command_that_installs_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    with pytest.raises(MachineLacks, match=r"\[validate\]"):
        area(noise(1, 0.02), noise(2, 0.02))


@pytest.mark.system
def test_simulated_sensors_are_alike_and_one_with_eight_times_the_leak_is_not():
    with np.load(recordings.DATA / "davis346_street.npz") as table:
        seen, _ = recordings._street(dict(table))
    preset = PRESETS["davis346"]
    changed = dataclasses.replace(preset, leak_hz=8 * preset.leak_hz)
    found = []
    for p, seed in ((preset, 4), (preset, 5), (changed, 5)):
        events = still_events(p, seen, 2.36, seed)
        found.append(recordings.single_events(events[seen.still[events["y"], events["x"]]], seen))
    assert area(found[0], found[1]) < recordings.ALIKE_EVENTS
    assert area(found[0], found[2]) > 0.7
