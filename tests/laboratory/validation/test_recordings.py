"""Statistics of recordings: counted by hand, and tables that belong to their recordings."""

import numpy as np
import pytest

from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Frame
from laboratory.characterise.still_light import StillLight, still_light
from laboratory.validation.recordings import DATA, kick_lags, sequences
from laboratory.verbs.validate import EXPERIMENTS


def stream(rows):
    return np.array(rows, EVENT)


def test_sequences_of_three_pixels_counted_by_hand():
    off, on = False, True
    events = stream([
        (0, 1, 0, off), (10, 1, 0, on), (40, 1, 0, on), (5, 3, 2, off), (105, 3, 2, off), (7, 0, 1, on),
    ])  # fmt: skip
    found = sequences(events[np.argsort(events["t"])], 4, 12)
    assert found["off_on"].tolist() == [10]
    assert found["on_on"].tolist() == [30]
    assert found["off_off"].tolist() == [100]
    assert found["on_off"].tolist() == []
    assert found["runs"].tolist() == [0, 2, 2]  # OFF and ON alone; ON ON, OFF OFF
    assert found["counts"].tolist() == [9, 1, 1, 1]
    assert found["events"].tolist() == [3, 6]


def test_a_pixel_of_the_tail_counts_in_the_counts_alone():
    tail = [(10 * k, 2, 0, k % 2 == 0) for k in range(9)]
    found = sequences(stream([*tail, (3, 0, 0, True)]), 4, 4)
    assert found["counts"].tolist() == [2, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert found["events"].tolist() == [1, 1]
    assert found["off_on"].size == found["on_off"].size == 0
    assert found["runs"].tolist() == [0, 1]


def test_lags_of_events_at_both_reads_of_their_row():
    seen = StillLight(np.zeros((260, 346), np.float32), np.ones((260, 346), bool), 1000, 40_000, 500)
    reset, signal = 1000 + 35.25 * 100 - 12, 1000 + 9165 + 500 + 35.25 * 100 - 28
    lags = kick_lags(stream([(round(reset) + 5, 3, 100, True), (round(signal) + 7, 3, 100, True)]), seen)
    assert np.abs(lags - 5).min() <= 0.5
    assert np.abs(lags - 7).min() <= 0.5
    assert not kick_lags(stream([(round(reset) + 5, 3, 100, False)]), seen).size


def frames(moving):
    """Twenty frames of noise about level 60, a bright square moving through the left half."""
    random, found = np.random.default_rng(2), []
    for k in range(20):
        picture = random.normal(60, 1.5, (120, 160))
        if moving:
            picture[40:60, 10 + 3 * k : 20 + 3 * k] += 60
        begin = 30_000 + 40_000 * k
        found.append(Frame(begin + 250, begin, begin + 500, picture.round().astype(np.uint8)))
    return found


def test_pixels_near_motion_are_not_still():
    seen = still_light(frames(moving=True), begin_us=0)
    assert not seen.still[42:58, 12:75].any()
    assert seen.still.mean() == pytest.approx(0.5, abs=0.06)
    assert np.median(seen.level) == pytest.approx(60, abs=1)
    assert (seen.interval_us, seen.exposure_us) == (40_000, 500)
    assert seen.first_us == 30_000 - 9165
    assert np.median(seen.light) == pytest.approx(0.75, abs=0.02)


def test_the_tables_hold_the_recordings():
    """Numbers of their readers: 242 events in the still half; 30 444 events of 742 746 quiet pixels."""
    with np.load(DATA / "davis346_street.npz") as table:
        assert len(table["t"]) == 242
        assert table["on"].all()
        assert np.unpackbits(table["still"]).sum() == 46_949
    with np.load(DATA / "evk4_quiet.npz") as table:
        counts = [table[f"counts_{half}"] for half in ("left", "right")]
        assert sum(one.sum() for one in counts) == 742_746
        assert sum((np.arange(len(one)) * one).sum() for one in counts) == 30_444
        waits = np.concatenate([table[f"off_on_{half}"] for half in ("left", "right")])
        assert np.median(waits) == pytest.approx(1.26e6, rel=0.01)


@pytest.mark.system
@pytest.mark.parametrize("name", ["davis346_street", "evk4_quiet"])
def test_the_simulated_sensors_are_near_the_recordings(name):
    found = EXPERIMENTS[name](2)
    apart = [datum.what for datum in found.data if not datum.alike]
    assert len(apart) <= 5, apart
    assert not {"intervals of a pixel", "lengths of runs of one polarity", "events"} & set(apart)
    assert len(found.data) > 10
