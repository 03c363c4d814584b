"""The star tracker of examples/: its parts on events with known answers, and one rate of its table."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import evstim

FOLDER = Path(__file__).parents[2] / "examples/star_tracker"
SIZE = (320, 240)


@pytest.fixture(scope="module")
def parts():
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("star_tracker"), importlib.import_module("measure")
    sys.path.remove(str(FOLDER))
    sys.modules.pop("star_tracker"), sys.modules.pop("measure")


def sky(motion, stars, seed=1, noise=400):
    """ON events of 0.2 s: stars at known places at 0.1 s, moving with the picture, each event within half a pixel."""
    draws, parts = np.random.default_rng(seed), []
    for x, y, n in stars:
        t_s = draws.uniform(0, 0.2, n)
        right, down = motion.at(np.array(x), np.array(y))
        parts.append((t_s, x + right * (t_s - 0.1), y + down * (t_s - 0.1)))
    parts.append((draws.uniform(0, 0.2, noise), draws.uniform(-160, 160, noise), draws.uniform(-120, 120, noise)))
    t_s, x, y = (np.concatenate(values) for values in zip(*parts, strict=True))
    events = np.zeros(len(t_s), evstim.EVENT)
    events["t"], events["on"] = t_s * 1e6, True
    events["x"], events["y"] = np.floor(x + 160).clip(0, 319), np.floor(y + 120).clip(0, 239)
    return np.sort(events, order="t")


def test_motion_and_places_of_stars_are_found_in_their_events(parts):
    tracker, _ = parts
    motion = tracker.Motion(60.0, -25.0, 0.3)
    stars = [(-100.3, 60.2, 150), (40.6, -70.1, 90), (90.4, 80.7, 120), (-30.2, -10.8, 70), (5.5, 40.3, 60)]
    events = sky(motion, stars)
    found = tracker.motion_of(events, SIZE)
    assert found.right_px_s == pytest.approx(60, abs=1.5)
    assert found.down_px_s == pytest.approx(-25, abs=1.5)
    assert found.turn_rad_s == pytest.approx(0.3, abs=0.02)
    places = tracker.centroids(events, found, 100_000, SIZE)
    assert len(places) == 5
    for x, y, _ in stars:
        assert np.hypot(places[:, 0] - x, places[:, 1] - y).min() < 0.3
    assert np.all(np.diff(places[:, 2]) <= 0), "the brightest first"


def test_errors_are_along_the_motion_across_it_and_of_roll(parts):
    _, measure = parts
    true = measure.true_attitude(evstim.load_rig(str(measure.RIG)), 1.0)
    second = np.radians(1 / 3600)
    for axis, expected in (((0, 1, 0), (5, 0, 0)), ((1, 0, 0), (0, -5, 0)), ((0, 0, 1), (0, 0, 5))):
        found = Rotation.from_rotvec(5 * second * np.array(axis)).as_matrix() @ true
        assert measure.errors_arcsec(found, true, (10.0, 0.0)) == pytest.approx(expected, abs=1e-3)
    moved = Rotation.from_rotvec([0, 5 * second, 0]).as_matrix() @ true
    assert (moved @ true[2])[0] > 0, "stars placed too far right, along a motion to the right"


@pytest.mark.system
def test_an_attitude_is_found_to_some_arc_seconds(parts, tmp_path):
    tracker, measure = parts
    rig = evstim.load_rig(str(measure.RIG))
    measured = measure.measure(rig, tracker.Tracker((1280, 720), 15.0), 0.5, windows=2)
    assert measured.solved == 2
    assert np.abs(measured.errors[:, 1]).max() < 20
    assert np.abs(measured.errors[:, 0]).max() < 84, "two pixels"
    assert measured.row()["solved"] == "2 of 2"
    measure.draw([measured], tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 10_000
    assert measure.table([measured]).count("\n") == 3
