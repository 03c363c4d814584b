from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.geometry.camera import Cycle
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters

NS = 1_000_000_000
MONTH_NS = 30 * 86_400 * NS


def draw(size=(64, 48), t_ns=0, **parameters):
    out = np.full((size[1], size[0]), np.nan, np.float32)
    with Checkerboard(CheckerboardParameters(**parameters), size) as board:
        board.light(t_ns, out)
    return out


def sampled(p, size, t_s, n=64):
    """The same board by n x n point samples a pixel, from the definition in the module's first lines."""
    width, height = size
    x = (np.arange(width * n) + 0.5) / n - width / 2
    y = (np.arange(height * n) + 0.5) / n - height / 2
    x, y = np.meshgrid(x, y)
    d, r = math.radians(p.direction_deg), math.radians(p.rotation_deg)
    x, y = x - p.speed_px_s * t_s * math.cos(d), y - p.speed_px_s * t_s * math.sin(d)
    u, v = x * math.cos(r) + y * math.sin(r), -x * math.sin(r) + y * math.cos(r)
    even = (np.floor(u / p.square_px) + np.floor(v / p.square_px)) % 2 == 0
    fine = np.where(even, p.bright, p.dark)
    return fine.reshape(height, n, width, n).mean(axis=(1, 3))


@pytest.mark.parametrize("square_px", [0.7, 1.0, 3.3, 12.3])
@pytest.mark.parametrize("direction_deg", [0.0, 37.0, 200.0])
def test_each_pixel_is_the_mean_over_its_square(square_px, direction_deg):
    p = CheckerboardParameters(square_px=square_px, speed_px_s=31.0, direction_deg=direction_deg, bright=2.0, dark=0.2)
    got = draw((24, 20), 130_000_000, **vars(p))
    # 64 samples along an axis place each edge to 1/128 px, and a pixel of the finest board holds four edges
    np.testing.assert_allclose(got, sampled(p, (24, 20), 0.13), atol=1.8 * 4 / 128)


def test_edges_are_exact():
    # squares of 2 px; at t = 0.25 s the board has moved 0.25 px to the right
    row = draw((8, 2), NS // 4, square_px=2.0, speed_px_s=1.0, bright=1.0, dark=0.0)[1]
    # bright from 0.25 to 2.25 px right of the middle, and the same every four pixels
    np.testing.assert_allclose(row, [0.75, 1, 0.25, 0, 0.75, 1, 0.25, 0], atol=1e-7)


def test_a_turned_board_keeps_the_mean_and_stays_close_to_its_samples():
    p = CheckerboardParameters(square_px=12.3, rotation_deg=7.0, direction_deg=30.0, speed_px_s=100.0)
    got, want = draw((96, 64), 77_000_000, **vars(p)), sampled(p, (96, 64), 0.077, 32)
    assert got.mean() == pytest.approx(want.mean(), rel=1e-3)
    error = np.abs(got - want) / (p.bright - p.dark)
    assert error.max() < 0.12  # a turned square against the pixel's own: only edge pixels differ
    assert error.mean() < 0.004


@pytest.mark.parametrize("rotation_deg", [0.0, 90.0, 180.0, 270.0])
def test_mean_light_is_conserved(rotation_deg):
    # 12 squares of 10 px across: whole periods in both directions
    light = draw((120, 120), 12_345_678, square_px=10.0, rotation_deg=rotation_deg, bright=3.0, dark=1.0)
    assert light.mean(dtype=np.float64) == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize(
    ("direction_deg", "shift"), [(0.0, (0, 1)), (90.0, (1, 0)), (180.0, (0, -1)), (270.0, (-1, 0))]
)
def test_it_moves_where_it_says(direction_deg, shift):
    before = draw(square_px=7.5, speed_px_s=10.0, direction_deg=direction_deg)
    after = draw(square_px=7.5, speed_px_s=10.0, direction_deg=direction_deg, t_ns=NS // 10)
    np.testing.assert_allclose(after[1:-1, 1:-1], np.roll(before, shift, (0, 1))[1:-1, 1:-1], atol=1e-6)


@pytest.mark.parametrize("rotation_deg", [0.0, 7.0])
def test_a_month_later_it_is_as_good(rotation_deg):
    # 1234.5 px/s over squares of 10 px: a period of 20/1234.5 s; 2469 periods make exactly 40 s
    board = {"square_px": 10.0, "speed_px_s": 1234.5, "direction_deg": rotation_deg, "rotation_deg": rotation_deg}
    now, later = draw(t_ns=5_000_001, **board), draw(t_ns=MONTH_NS + 5_000_001, **board)
    np.testing.assert_array_equal(now, later)


def test_light_depends_on_nothing_but_time():
    a, b = np.empty((2, 48, 64), np.float32)
    with Checkerboard(CheckerboardParameters(), (64, 48)) as board:
        board.light(5 * NS, a)
        for t in (0, 17, 9 * NS):
            board.light(t, b)
        board.light(5 * NS, b)
    np.testing.assert_array_equal(a, b)


def test_zero_light_and_zero_contrast_are_correct_pictures():
    assert not draw(bright=0.0, dark=0.0).any()
    assert (draw(bright=0.5, dark=0.5, rotation_deg=3.0) == 0.5).all()
    assert draw(bright=1.0, dark=0.0, square_px=0.37, speed_px_s=0.0).min() >= 0.0


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"square_px": 0.0}, "square_px is 0"),
        ({"square_px": math.nan}, "square_px is nan"),
        ({"speed_px_s": -5.0}, "turn direction_deg by 180"),
        ({"speed_px_s": math.inf}, "finite"),
        ({"dark": 2.0}, "dark is 2 and bright is 1"),
        ({"dark": -0.1}, "0 <= dark"),
        ({"bright": 1e12}, "bright is 1e"),
    ],
)
def test_wrong_parameters_say_what_would_be_right(wrong, says):
    with pytest.raises(ValueError, match=says):
        CheckerboardParameters(**wrong)


def test_a_tenth_of_a_second_is_exactly_that():
    assert Cycle(10.0).turns(MONTH_NS + 25_000_000) == 0.25
    assert Cycle(0.1, 0.75).turns(5 * NS) == 0.25


@given(st.floats(-1e6, 1e6), st.floats(0, 1), st.integers(-MONTH_NS, MONTH_NS))
def test_phase_is_exact(rate_hz, start, t_ns):
    with localcontext() as context:
        context.prec = 400
        turns = Decimal(repr(start)) + Decimal(repr(rate_hz)) * t_ns / NS
        want = float(turns - turns.to_integral_value(rounding="ROUND_FLOOR"))
    assert Cycle(rate_hz, start).turns(t_ns) == pytest.approx(want, abs=1e-15)


@pytest.mark.parametrize(("rotation_deg", "direction_deg"), [(0.0, 0.0), (0.0, 30.0), (20.0, 50.0), (90.0, 200.0)])
def test_the_rate_is_the_light_s_derivative(rotation_deg, direction_deg):
    """Against the difference over 2 us, in float32: away from the instants at which an edge meets a pixel's side."""
    parameters = CheckerboardParameters(
        square_px=12.3, speed_px_s=200.0, rotation_deg=rotation_deg, direction_deg=direction_deg
    )
    board, t_ns = Checkerboard(parameters, (64, 48)), 123_456_789
    light, rate, before, after = (np.zeros((48, 64), np.float32) for _ in range(4))
    board.light_and_rate(t_ns, light, rate)
    board.light(t_ns - 1000, before)
    board.light(t_ns + 1000, after)
    difference = (after.astype(float) - before) / 2e-6
    assert np.abs(difference).max() > 50
    assert np.mean(np.abs(rate - difference) < 0.2) > 0.999
    board.light(t_ns, before)
    assert np.array_equal(light, before)


@pytest.mark.parametrize("rotation_deg", [0.0, 7.0])
def test_a_board_at_rest_is_drawn_once_and_nothing_changes_from_then_on(rotation_deg):
    size, parameters = (40, 30), CheckerboardParameters(speed_px_s=0.0, rotation_deg=rotation_deg)
    light, rate = (np.full(size[::-1], np.nan, np.float32) for _ in range(2))
    with Checkerboard(parameters, size) as board:
        board.light_and_rate(0, light, rate)
        assert board.changed is None
        np.testing.assert_array_equal(light, draw(size, **vars(parameters)))
        assert not rate.any()
        before = light.copy()
        board.light_and_rate(NS, light, rate)
        assert board.changed is not None
        assert board.changed.empty
        np.testing.assert_array_equal(light, before)
