"""The interpolation of log light is never clearly worse than a straight line; checked against an own float64 pixel."""

import pytest

from tests.laboratory.accuracy.float64_pixel import Cell, cubic_or_bend, straight

SHADED = [
    ("shaded edge", kind, 10, blur, speed)
    for kind in ("blurred", "kinked")
    for blur in (0.3, 0.6)
    for speed in (1.0, 4.0)
]
OTHERS = [
    ("edge", "kinked", 10, 0.6, 1.0),
    ("thin line", "kinked", 6, 1.0, 1.0),
    ("checkerboard", "kinked", 6, 0.6, 1.0),
    ("body", "blurred", 6, 0.6, 0.5),
    ("body", "kinked", 6, 0.6, 1.0),
    ("texture", "blurred", 6, 1.0, 1.0),
]


@pytest.mark.parametrize("at", [*SHADED, *OTHERS], ids=lambda at: "-".join(map(str, at)))
def test_never_clearly_worse_than_a_straight_line(at):
    cell = Cell(*at)
    line, hermite = cell.of_array(with_rate=False), cell.of_array(with_rate=True)
    assert hermite.right >= line.right - 2
    assert hermite.wrong <= line.wrong + 0.2


@pytest.mark.parametrize("at", [SHADED[1], SHADED[7], *OTHERS[1:4]], ids=lambda at: "-".join(map(str, at)))
def test_the_product_computes_the_rules_as_stated(at):
    cell = Cell(*at)
    for with_rate, rule in ((False, straight), (True, cubic_or_bend)):
        ours, stated = cell.of_array(with_rate=with_rate), cell.of_rule(rule)
        assert ours.right == pytest.approx(stated.right, abs=0.01)
        assert ours.wrong == pytest.approx(stated.wrong, abs=0.01)
