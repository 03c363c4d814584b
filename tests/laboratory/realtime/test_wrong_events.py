"""Wrong events beside truth by point samples: few as shipped, more in long steps, most in another scene."""

import numpy as np
import pytest

from emulator.light import SceneError
from emulator.rig.loading import load_rig
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from laboratory.accuracy.rendering import Stretch
from laboratory.accuracy.sampled_scenes import SampledBoard
from laboratory.realtime import wrong_events as module
from laboratory.realtime.variants import SIZES, Setting, variant_of
from laboratory.realtime.wrong_events import has_truth, truth_of, wrong_events


@pytest.fixture
def board(tmp_path, monkeypatch):
    """A small board under a DAVIS346, of which the truth takes less than a second."""
    monkeypatch.setattr(module, "_MOST_PX", (48, 32))
    path = tmp_path / "board.toml"
    path.write_text('[scene]\nkind = "checkerboard"\nsquare_px = 7.0\nspeed_px_s = 200.0\ndirection_deg = 30.0\n')
    return variant_of(str(path), SIZES[0])


def test_a_sampled_board_is_the_board():
    parameters = CheckerboardParameters(square_px=7.3, speed_px_s=50.0, direction_deg=215.0, bright=2.0, dark=0.5)
    ours, exact = (np.zeros((20, 31), np.float32) for _ in range(2))
    for t_ns in (0, 123_456_789):
        SampledBoard(parameters, (31, 20)).light(t_ns, ours)
        Checkerboard(parameters, (31, 20)).light(t_ns, exact)
        np.testing.assert_allclose(ours, exact, atol=2 * 1.5 / 1024)


def test_a_turned_board_has_no_truth():
    with pytest.raises(SceneError, match="rotation_deg"):
        SampledBoard(CheckerboardParameters(rotation_deg=10.0), (8, 8))


def test_scenes_without_truth_are_known():
    assert has_truth(load_rig("checkerboard"))
    assert has_truth(load_rig("eros"))
    assert has_truth(load_rig("malapert"))
    assert not has_truth(load_rig("stars"))


def test_few_events_are_wrong_as_shipped_and_more_in_long_steps(board):
    truth = truth_of(board, Stretch(steps=20))
    shipped = wrong_events(board, truth)
    long = wrong_events(board.changed(Setting("long", {("run", "step_us"): 20_000})), truth)
    assert shipped.events > 1000
    assert shipped.false + shipped.missed < 0.005
    assert long.false + long.missed > 10 * (shipped.false + shipped.missed)
    assert long.events == shipped.events


def test_controlled_steps_keep_to_the_truth_too(board):
    truth = truth_of(board, Stretch(steps=20))
    for tolerance_us, most in ((20.0, 0.02), (100.0, 0.05)):
        found = wrong_events(board.changed(Setting("adaptive", {("run", "tolerance_us"): tolerance_us})), truth)
        assert found.false + found.missed < most


def test_a_stored_truth_is_read_again(board, tmp_path, monkeypatch):
    stretch, folder = Stretch(steps=4, samples=4, finer=2), tmp_path / "truths"
    drawn = truth_of(board, stretch)
    stored = truth_of(board, stretch, folder)
    other = truth_of(board.changed(Setting("other", {("scene", "square_px"): 3.0})), stretch, folder)
    monkeypatch.setattr(module, "_true_events", None)
    again = truth_of(board, stretch, folder)
    assert again.looks == drawn.looks
    for name in ("t_us", "on", "first"):
        values = [getattr(truth.streams[0], name) for truth in (drawn, stored, again)]
        assert all(np.array_equal(value, values[0]) for value in values)
    assert len(other.streams[0]) > len(drawn.streams[0])
    assert len(list(folder.iterdir())) == 2
