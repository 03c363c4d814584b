"""The pixel step with the light's time derivative: order, odd light, rare poles, tiles, restarts and hostile slopes.

Held against the continuous-time truth in float64. The full list of assertions is in accuracy/test_assertions.py.
"""

import pickle
from functools import lru_cache

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import BLOCK, Field
from laboratory.accuracy.scenes import BlurredCheckerboard, Flash, Flicker, MovingEdge, SineGrating
from laboratory.accuracy.scores import Stream
from laboratory.accuracy.truth import true_events
from tests.laboratory.accuracy.rows import row

MS = 1_000_000
PIXELS, SEED, DURATION_S = 40, 3, 0.3


def sensor(**changes):
    return row(**{"pixels": PIXELS, "leak_hz": 0.0, "leak_spread": 0.0} | changes)


@lru_cache
def truth(scene, parameters):
    return true_events(scene, parameters, SEED, DURATION_S)


def ours(scene, parameters, dt_s):
    array = PixelArray(parameters, SEED)
    parts = []
    for k in range(round(DURATION_S / dt_s) + 1):
        light, rate = (f(k * dt_s).astype(np.float32) for f in (scene.value, scene.rate))
        if k == 0:
            array.reset(LightFrame(0, light, rate))
            continue
        c = array.step(LightFrame(round(k * dt_s * 1e9), light, rate))
        parts.append((c.t_ns / 1e3, c.pixel.astype(np.int64), c.on.copy()))
    return Stream.of(*(np.concatenate(field) for field in zip(*parts, strict=True)), PIXELS), array


def score(scene, parameters, dt_s):
    """Share of pixels with the right sequence, |error| in us at 50 % and 95 % over those, and the array."""
    a, (b, array) = truth(scene, parameters), ours(scene, parameters, dt_s)
    right, errors = 0, []
    for p in range(PIXELS):
        i, j = slice(*a.first[p : p + 2]), slice(*b.first[p : p + 2])
        if np.array_equal(a.on[i], b.on[j]):
            right += 1
            errors.append(np.abs(a.t_us[i] - b.t_us[j]))
    return right / PIXELS, *np.quantile(np.concatenate(errors), [0.5, 0.95]), array


SINE, EDGE, BOARD = (kind(pixels=PIXELS) for kind in (SineGrating, MovingEdge, BlurredCheckerboard))


@pytest.mark.system
def test_the_step_is_of_fourth_order():
    for scene in (SINE, BOARD):
        coarse, fine = (score(scene, sensor(corner_hz_at_reference=200.0), dt)[1] for dt in (2e-3, 1e-3))
        assert coarse / fine > 12


@pytest.mark.system
@pytest.mark.parametrize(
    ("scene", "dt_s", "t50", "t95", "changes"),
    [
        (SINE, 2e-3, 0.29, 1.3, {"corner_hz_at_reference": 200.0}),
        (EDGE, 2e-3, 0.63, 1.5, {}),
        (BOARD, 2e-3, 0.24, 0.98, {}),
        (SINE, 2e-3, 0.22, 1.3, {"corner_hz_at_reference": 200.0, "source_follower_hz": 100.0}),
        (EDGE, 2e-3, 0.49, 1.5, {"source_follower_hz": 1000.0}),
        (SINE, 2e-3, 0.29, 1.3, {"corner_hz_at_reference": 200.0, "parasitic_hz_at_reference": 5.0}),
        (EDGE, 2e-3, 0.63, 1.5, {"parasitic_hz_at_reference": 5.0}),
        (BOARD, 2e-3, 0.5, 5.0, {"refractory_us": 1000.0}),
        (BOARD, 2e-3, 0.5, 5.0, {"refractory_us": 100.0, "source_follower_hz": 500.0,
                                "parasitic_hz_at_reference": 2.0}),
    ],
)  # fmt: skip
def test_timestamps_are_within_twice_those_of_the_prototype(scene, dt_s, t50, t95, changes):
    """Its median and 95th percentile in us; with a refractory period 0.25 % of the step at the 95th."""
    right, median, high, array = score(scene, sensor(**changes), dt_s)
    assert right >= 0.97
    assert median <= 2 * t50
    assert high <= 2 * t95
    assert array.undersampled == 0


@pytest.mark.parametrize("changes", [{}, {"source_follower_hz": 300.0}, {"corner_hz_at_reference": 30.0}])
@pytest.mark.parametrize("dt_s", [1e-3, 1e-2])
def test_a_flash_between_two_pictures_is_a_jump_at_mid_step(changes, dt_s):
    """The instant is not known to better than half a step; all else is right."""
    flash = Flash(pixels=PIXELS, last_s=0.0393)
    right, median, high, array = score(flash, sensor(**changes), dt_s)
    assert right >= 0.99
    assert median < 0.4 * dt_s * 1e6
    assert high < 0.55 * dt_s * 1e6
    assert array.undersampled == PIXELS


def test_a_turn_right_in_the_middle_of_a_step_keeps_its_slopes():
    """100 Hz in steps of 1 ms: every trough lies between two equal pictures; flat, it loses 3 % of all events."""
    lamp = Flicker(pixels=PIXELS, modulation=0.5)
    a, (b, _) = truth(lamp, sensor()), ours(lamp, sensor(), 1e-3)
    assert b.counts.sum() == pytest.approx(a.counts.sum(), rel=0.01)


def test_undersampled_steps_are_counted_where_frames_are_too_far_apart():
    near, far = (ours(BOARD, sensor(), dt)[1] for dt in (2e-3, 2e-2))
    assert near.undersampled == 0
    assert far.undersampled > 0.05 * far.candidates > 0


def picture(t_ns, width=2500):
    """Light of many kinds at once, and its derivative: slow, fast, dark, bright and flashing pixels."""
    x, t = np.arange(width), t_ns * 1e-9
    w = 2 * np.pi * np.where(x % 7 == 0, 140.0, 25.0)
    level = np.where(x % 11 == 0, 1e-3, 0.5)
    light = level * np.exp(1.3 * np.sin(w * t + 0.3 * x))
    rate = light * 1.3 * w * np.cos(w * t + 0.3 * x)
    flash = (x % 13 == 0) & (t_ns // (20 * MS) % 2 == 1)
    return (light + 3 * flash).astype(np.float32), rate.astype(np.float32)


def run(array, times, here=slice(None), since_ns=0):
    parts = []
    for t in times:
        light, rate = picture(t)
        c = array.step(LightFrame(t + since_ns, light[None, here].copy(), rate[None, here].copy()))
        parts.append(np.stack([c.t_ns - since_ns, c.pixel.astype(np.int64), c.on.astype(np.int64)], axis=1))
    return np.concatenate(parts)


def started(here=slice(None), since_ns=0, **changes):
    light, rate = picture(0)
    array = PixelArray(sensor(pixels=light[here].size, leak_hz=3.0, **changes), SEED)
    array.reset(LightFrame(since_ns, light[None, here].copy(), rate[None, here].copy()))
    return array


RARE = [{"refractory_us": 700.0}, {"source_follower_hz": 200.0, "parasitic_hz_at_reference": 3.0}]
TIMES = [3 * MS * k for k in range(1, 40)]


@pytest.mark.parametrize("changes", RARE)
def test_a_tile_gives_the_events_that_the_whole_picture_gives_there(changes):
    """The same light and draws at another place, block, lane and batch."""
    tile = slice(1333, 1790)
    whole, part = started(**changes), started(tile, **changes)
    there = np.arange(tile.start, tile.stop)
    for which in (Field.REFERENCE, Field.ON, Field.OFF, Field.LEAK):
        values = whole.state.fields[there // BLOCK, which, there % BLOCK]
        part.state.fields[0, which, : there.size] = values
    events = run(whole, TIMES)
    inside = events[(events[:, 1] >= tile.start) & (events[:, 1] < tile.stop)]
    inside[:, 1] -= tile.start
    assert len(inside) > 3000
    assert np.array_equal(inside, run(part, TIMES, tile))
    assert whole.undersampled > 0


@pytest.mark.parametrize("changes", RARE)
def test_a_restart_and_thirty_days_change_nothing(changes):
    days = 30 * 86_400_000_000_000 >> 33 << 33
    array, late = started(**changes), started(since_ns=days, **changes)
    events = run(array, TIMES)
    other = started(**changes)
    first = run(other, TIMES[:13])
    copied = PixelArray(other.parameters, SEED)
    copied.state = pickle.loads(pickle.dumps(other.state))
    assert np.array_equal(events, np.concatenate([first, run(copied, TIMES[13:])]))
    assert np.array_equal(events, run(late, TIMES, since_ns=days))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
def test_a_slope_that_is_not_one_is_a_slope_that_is_not_known(bad):
    """Two steps of a grating with no slope at their common end: the parabola keeps the sequence of nearly all."""

    class Gap(SineGrating):
        def rate(self, t_s):
            return np.where(abs(np.asarray(t_s) - 0.1) < 1e-9, bad, super().rate(t_s))

    gap = Gap(pixels=PIXELS)
    a, (b, array) = truth(SINE, sensor()), ours(gap, sensor(), 1e-3)
    assert abs(a.counts.sum() - b.counts.sum()) <= 0.01 * a.counts.sum()
    assert array.quiet_nan == 0
    assert np.all(np.isfinite(array.field(Field.FILTERED)))


def test_slopes_that_contradict_the_light_end_and_stay_finite():
    array, rng = PixelArray(sensor(pixels=1000), SEED), np.random.default_rng(5)
    array.reset(LightFrame(0, np.ones((1, 1000), np.float32)))
    for k in range(1, 30):
        light = np.exp(rng.normal(0, 3, (1, 1000))).astype(np.float32)
        c = array.step(LightFrame(k * MS, light, (rng.normal(0, 1e6, (1, 1000)) * light).astype(np.float32)))
        assert np.all((c.t_ns >= (k - 1) * MS) & (c.t_ns <= k * MS))
    assert np.all(np.isfinite(array.field(Field.FILTERED)))
    assert array.undersampled > 10_000


def test_black_light_has_no_slope():
    array = PixelArray(sensor(), SEED)
    black, rate = np.zeros((1, PIXELS), np.float32), np.full((1, PIXELS), 1e6, np.float32)
    array.reset(LightFrame(0, black, rate))
    assert [len(array.step(LightFrame(k * MS, black, rate))) for k in range(1, 5)] == [0] * 4


def test_with_and_without_slopes_in_turn():
    """Where a derivative is missing at one end, a parabola; the events stay near the truth."""
    array, parts = PixelArray(sensor(), SEED), []
    array.reset(LightFrame(0, SINE.value(0.0).astype(np.float32)))
    for k in range(1, 301):
        light, rate = (f(k * 1e-3).astype(np.float32) for f in (SINE.value, SINE.rate))
        parts.append(len(array.step(LightFrame(k * MS, light, rate if k % 3 else None))))
    assert sum(parts) == pytest.approx(truth(SINE, sensor()).counts.sum(), rel=0.01)


def test_a_rate_of_another_shape_is_refused():
    array = PixelArray(sensor(), SEED)
    light = np.ones((1, PIXELS), np.float32)
    array.reset(LightFrame(0, light))
    with pytest.raises(ValueError, match=r"light or rate is \(40,\) float32"):
        array.step(LightFrame(MS, light, light[0]))
