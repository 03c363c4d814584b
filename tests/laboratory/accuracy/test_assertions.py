"""What each method keeps up to which boundary: the assertions of the stability map that the method was chosen by.

The numbers S1 ... are those of that list.
"""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import draw
from laboratory.accuracy.harness import SEED, Case, events, methods, score
from laboratory.accuracy.scenes import BlurredCheckerboard, Flash, MovingEdge, SineGrating
from laboratory.accuracy.stability import smooth_case
from tests.laboratory.accuracy.rows import row

BY_NAME = {method.name: method for method in methods()}
HERMITE, REFINED_UNSEEN_SHARE, LINE = (BY_NAME[name] for name in ("hermite", "refined", "line"))

DT_OVER_TAU = [0.03, 1.0, 10.0]


def board(motion_px, sigma_px, step_s, **changes):
    scene = BlurredCheckerboard(pixels=40, sigma_px=sigma_px, speed_px_s=motion_px / step_s)
    return Case("board", scene, row(40, **changes), 0.3)


def slow_sine(hz=5.0):
    return Case("slow", SineGrating(pixels=40, hz=hz), row(40, corner_hz_at_reference=200.0), 0.4)


@pytest.mark.parametrize("dt_over_tau", DT_OVER_TAU)
@pytest.mark.parametrize("contrast", [0.1, 0.3])
def test_s1_smooth_light_in_short_steps(contrast, dt_over_tau):
    """Steps of 10 ms, so that float32 does not decide."""
    scores = score(HERMITE, smooth_case(contrast, dt_over_tau, 1e-2), 1e-2)
    assert scores.right >= 0.98
    assert scores.t95_us <= 1e-4 * 1e4


@pytest.mark.parametrize("dt_over_tau", DT_OVER_TAU)
def test_s2_smooth_light_of_a_threshold_a_step(dt_over_tau):
    scores = score(HERMITE, smooth_case(1.0, dt_over_tau), 1e-3)
    assert scores.right >= 0.97
    assert scores.t95_us <= 0.006 * 1e3


@pytest.mark.parametrize("dt_over_tau", DT_OVER_TAU)
@pytest.mark.parametrize("contrast", [0.1, 0.3])
def test_s3_a_line_on_smooth_light_in_short_steps(contrast, dt_over_tau):
    scores = score(LINE, smooth_case(contrast, dt_over_tau), 1e-3)
    assert scores.right >= 0.97
    assert scores.t95_us <= 0.03 * 1e3


@pytest.mark.parametrize(
    ("name", "step_s", "least", "most"),
    [("hermite", 2e-3, 12, 40), ("line", 2e-3, 3.5, 5), ("pangu", 5e-4, 1.8, 2.2)],  # whose filter lags in longer steps
)
def test_s4_order_of_the_step(name, step_s, least, most):
    case = slow_sine(20.0 if name == "hermite" else 5.0)  # of slower light float32 decides, not the step
    coarse, fine = (score(BY_NAME[name], case, s).t50_us for s in (step_s, step_s / 2))
    assert least <= coarse / fine <= most


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(("motion_px", "sigma_px"), [(0.5, 0.5), (0.25, 0.3), (0.5, 1.0)])
def test_s5_a_checkerboard_within_half_a_pixel_and_a_blur_a_step(motion_px, sigma_px):
    scores = score(HERMITE, board(motion_px, sigma_px, 5e-3), 5e-3)
    assert scores.right >= 0.95
    assert scores.t95_us <= 0.012 * 5e3


@pytest.mark.system
@pytest.mark.parametrize(("motion_px", "sigma_px"), [(0.125, 0.5), (0.125, 0.3), (0.25, 1.0), (0.5, 2.0)])
def test_s6_a_line_on_a_checkerboard_within_a_quarter_of_a_blur_a_step(motion_px, sigma_px):
    scores = score(LINE, board(motion_px, sigma_px, 5e-3), 5e-3)
    assert scores.right >= 0.95
    assert scores.t95_us <= 0.12 * 5e3


@pytest.mark.system
@pytest.mark.parametrize(("motion_px", "sigma_px"), [(1.0, 0.3), (0.5, 0.5), (1.0, 0.5), (1.0, 2.0)])
def test_s7_a_checkerboard_of_a_pixel_a_step_with_refinement(motion_px, sigma_px):
    scores = score(REFINED_UNSEEN_SHARE, board(motion_px, sigma_px, 5e-3), 5e-3)
    assert scores.right >= 0.95
    assert scores.t95_us <= 0.012 * 5e3


@pytest.mark.parametrize("motion_px", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("name", ["hermite", "line"])
def test_s8_a_single_edge_keeps_its_sequence(name, motion_px):
    scene = MovingEdge(pixels=40, sigma_px=0.5, speed_px_s=motion_px / 5e-3, duration_s=0.2)
    scores = score(BY_NAME[name], Case("edge", scene, row(40), 0.2), 5e-3)
    assert scores.right >= 0.96
    assert scores.t95_us <= 0.8 * 5e3


@pytest.mark.system
@pytest.mark.parametrize("share", [0, 0.1, 1, 10])
def test_s9_a_refractory_period_of_any_length(share):
    scores = score(HERMITE, board(0.25, 0.5, 2.5e-3, refractory_us=2500 * share), 2.5e-3)
    assert scores.right >= 0.97
    assert scores.count == pytest.approx(1, abs=0.005)


@pytest.mark.parametrize("step_s", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize(("name", "share"), [("hermite", 0.55), ("line", 0.8)])
def test_s10_a_flash_at_an_unknown_instant(name, share, step_s):
    """Half a step is the best that can be had; a line in log light that ended there would give ten steps."""
    scores = score(BY_NAME[name], Case("flash", Flash(pixels=40), row(40), 0.1), step_s)
    assert scores.right >= 0.99
    assert scores.t95_us <= share * step_s * 1e6


@pytest.mark.long
@pytest.mark.system
def test_s14_leak_alone_for_thirty_days_in_jumps():
    """Ten minutes a step: each pixel's last event is where its rate and phase put it, after 130 000 of them."""
    p = row(8, leak_hz=0.05)
    d, array = draw(p, SEED), PixelArray(p, SEED)
    light, day_s = np.ones((1, 8), np.float32), 86400
    array.reset(LightFrame(0, light))
    last, count = np.zeros(8), np.zeros(8)
    for k in range(1, 30 * day_s // 600 + 1):
        crossings = array.step(LightFrame(k * 600 * 10**9, light))
        assert crossings.on.all()
        last[crossings.pixel] = crossings.t_ns * 1e-9
        count += np.bincount(crossings.pixel, minlength=8)
    assert array.lost_in_pixel == 0
    rate_hz = d.leak / d.on
    np.testing.assert_allclose(count, 30 * day_s * rate_hz, rtol=1e-3)
    np.testing.assert_allclose(last, (count - d.phase) / rate_hz, rtol=1e-3)


@pytest.mark.parametrize("name", ["hermite", "line"])
def test_thirty_days_change_nothing(name):
    now = slow_sine()
    later = dataclasses.replace(now, start_ns=(30 * 86400 * 10**9 >> 33) << 33)
    one, other = (events(BY_NAME[name], case, 1e-3)[0] for case in (now, later))
    np.testing.assert_array_equal(one.on, other.on)
    np.testing.assert_allclose(one.t_us, other.t_us, atol=1e-3, rtol=0)


def test_a_signal_that_comes_back_fires_as_often_down_as_up_and_rests_in_between():
    """Levels are those stored, never recomputed from counts: what went up by n events comes down by n."""
    p = row(20, mismatch=0.0, leak_hz=0.0, corner_hz_at_reference=2e3, corner_min_hz=2e3, corner_max_hz=2e3)
    ours, on, off = PixelArray(p, 3), 0, 0
    ours.reset(LightFrame(0, np.ones((1, 20), np.float32)))
    t_ns = 0
    for k in range(60):
        light = np.full((1, 20), 1.0 if k % 2 else 1.9, np.float32)
        for t_ms in (1, 5):
            moved = ours.step(LightFrame(t_ns + t_ms * 1_000_000, light))
            on, off = on + int(moved.on.sum()), off + int((~moved.on).sum())
        assert len(ours.step(LightFrame(t_ns + 6 * 1_000_000, light))) == 0
        t_ns += 6 * 1_000_000
    # Each pixel comes down to within a threshold of where it started.
    assert 0 <= on - off <= 20
    assert off >= 20 * 30 * 2
