"""What controlled steps make of a wish, against the truth."""

import pytest

from emulator.accuracy.cases import CASES
from emulator.accuracy.closed_loop import control
from emulator.steps import Limits

BY_NAME = {swept.case.name: swept.case for swept in CASES}
WISH_US = 10.0


def run(name, *, with_rate=True, wish_us=WISH_US):
    return control(BY_NAME[name], Limits(wish_us), with_rate=with_rate)


@pytest.mark.parametrize("name", ["sine", "edge1", "checkerboard", "disc", "star", "lowlight", "ramp"])
def test_a_wish_is_met_with_the_right_sequences(name):
    got = run(name)
    assert got.scores.t95_us <= WISH_US
    assert got.scores.right >= 0.98
    assert got.scores.wrong_events < 0.001


def test_an_edge_sharper_than_a_pixel_costs_half_as_much_again():
    got = run("edge03")
    assert got.scores.t95_us <= 1.5 * WISH_US
    assert got.scores.right == 1.0


def test_a_flicker_keeps_its_times_but_not_all_of_its_sequences():
    """150 events a pixel, all of them at turning points of the light: one slip fails a pixel's whole sequence."""
    got = run("flicker")
    assert got.scores.t95_us <= WISH_US
    assert got.scores.wrong_events < 0.005


@pytest.mark.parametrize(("name", "times"), [("edge1", 6), ("checkerboard", 6), ("disc", 9), ("star", 8)])
def test_slopes_spare_most_of_the_pictures(name, times):
    assert run(name, with_rate=False).frames_per_s > times * run(name).frames_per_s


def test_a_harder_wish_costs_pictures_by_its_fourth_root():
    hard, easy = run("checkerboard", wish_us=1.0), run("checkerboard", wish_us=16.0)
    assert hard.scores.t95_us < 1.5
    assert 1.6 < hard.frames_per_s / easy.frames_per_s < 2.4
