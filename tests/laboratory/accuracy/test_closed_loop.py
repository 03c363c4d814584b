"""What controlled steps make of a wish, against the truth."""

import functools

import pytest

from laboratory.accuracy.harness import CASES
from laboratory.accuracy.sweeps import control

BY_NAME = {swept.case.name: swept.case for swept in CASES}
WISH_US = 10.0


@functools.cache
def run(name, *, with_rate=True, refined=False, wish_us=WISH_US):
    return control(BY_NAME[name], wish_us, with_rate=with_rate, refined=refined)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("refined", [False, True])
@pytest.mark.parametrize("name", ["sine", "edge03", "edge1", "checkerboard", "disc", "star", "flicker", "lowlight"])
def test_a_wish_is_met_with_the_right_sequences(name, refined):
    got = run(name, refined=refined)
    assert got.scores.t95_us <= WISH_US
    assert got.scores.right >= 0.99


def test_halves_spare_pictures_and_cost_less_than_they_spare():
    for name in ("sine", "flicker"):
        drawn, refined = run(name), run(name, refined=True)
        assert refined.frames_per_s < 0.6 * drawn.frames_per_s
        assert refined.frames_per_s + refined.pixel_frames_per_s < 0.9 * drawn.frames_per_s


@pytest.mark.parametrize(("name", "times"), [("edge1", 7), ("checkerboard", 7), ("disc", 9), ("star", 7)])
def test_slopes_spare_most_of_the_pictures(name, times):
    assert run(name, with_rate=False).frames_per_s >= times * run(name, refined=True).frames_per_s


def test_a_harder_wish_costs_pictures_by_its_fourth_root():
    hard, easy = run("checkerboard", wish_us=1.0), run("checkerboard", wish_us=16.0)
    assert hard.scores.t95_us < 1.5
    assert 1.6 < hard.frames_per_s / easy.frames_per_s < 2.4
