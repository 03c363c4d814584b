"""The pixel array as its users see it: order, fates, seeds, restarts, hostile light and hostile times."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest
from scipy import stats

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import BLOCK, Field
from emulator.sensor.presets import PRESETS, SensorParameters

MS = 1_000_000
EPOCH_NS = 1 << 33


def sensor(width=40, height=30, **changes):
    plain = SensorParameters(
        width=width, height=height, threshold_on=0.25, threshold_off=0.25, mismatch=0.0, leak_hz=0.0, leak_spread=0.0
    )
    return dataclasses.replace(plain, **changes)


def flat(parameters, value):
    return np.full((parameters.height, parameters.width), value, np.float32)


def wave(parameters, t_ns):
    """Moving light that makes many pixels fire, some of them twice in a step and some turning."""
    y, x = np.mgrid[: parameters.height, : parameters.width]
    return (0.5 * np.exp(1.2 * np.sin(0.3 * x + 0.2 * y + t_ns * 2e-7))).astype(np.float32)


def run(array, times, light=wave):
    """Step through `times`; return all crossings as one (n, 3) array of t_ns, pixel, on."""
    parts = []
    for t in times:
        c = array.step(LightFrame(t, light(array.parameters, t)))
        parts.append(np.stack([c.t_ns, c.pixel.astype(np.int64), c.on.astype(np.int64)], axis=1))
    return np.concatenate(parts)


def started(parameters, t_ns=0, seed=1, light=wave):
    array = PixelArray(parameters, seed)
    array.reset(LightFrame(t_ns, light(parameters, 0)))
    return array


def test_crossings_are_sorted_by_time_and_pixel_and_lie_within_their_step():
    array = started(sensor(refractory_us=100.0))
    total = 0
    for t in range(5 * MS, 100 * MS, 5 * MS):
        c = array.step(LightFrame(t, wave(array.parameters, t)))
        order = np.lexsort((c.pixel, c.t_ns))
        assert np.array_equal(order, np.arange(len(c)))
        assert np.all((c.t_ns >= t - 5 * MS) & (c.t_ns <= t))
        assert (c.t_ns.dtype, c.pixel.dtype, c.on.dtype) == (np.int64, np.uint32, np.bool_)
        total += len(c)
    assert total > 2000


def test_without_low_pass_a_ramp_fires_at_the_times_of_its_logarithm():
    """Closed form: with refractory period 0, event k is where ln i = reference + k threshold."""
    parameters = sensor(
        width=700, height=1, corner_hz_at_reference=np.inf, mismatch=0.1, dark_current_relative=0.01, refractory_us=0.0
    )
    array = PixelArray(parameters, 5)
    start, end = flat(parameters, 0.01), flat(parameters, 5.0)
    array.reset(LightFrame(0, start))
    reference, on = array.field(Field.REFERENCE)[0].astype(float), array.field(Field.ON)[0].astype(float)
    c = array.step(LightFrame(10 * MS, end))
    u0, u1 = np.log(np.float32(0.01) + 0.01), np.log(5.0 + 0.01)
    expected = []
    for pixel in range(700):
        levels = np.arange(reference[pixel] + on[pixel], u1, on[pixel])
        expected += [((level - u0) / (u1 - u0) * 10 * MS, pixel) for level in levels]
    expected.sort()
    assert np.all(c.on)
    assert abs(len(c) - len(expected)) <= 1  # one within a rounding of the end
    by_pixel = np.lexsort((c.t_ns, c.pixel))
    truth = np.array(sorted(expected, key=lambda e: (e[1], e[0])))
    assert np.array_equal(c.pixel[by_pixel], truth[:, 1])
    assert np.max(np.abs(c.t_ns[by_pixel] - truth[:, 0])) < 30  # ns: float32 of the references


def test_the_same_seed_gives_the_same_events_and_another_seed_others():
    parameters = sensor(mismatch=0.03, leak_hz=5.0, leak_spread=0.3)
    times = range(3 * MS, 60 * MS, 3 * MS)
    first, again, other = (run(started(parameters, seed=s), times) for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_restart_from_a_pickle_goes_on_with_the_same_events():
    parameters = sensor(mismatch=0.03, leak_hz=5.0, leak_spread=0.3, refractory_us=2000.0)
    times = list(range(3 * MS, 60 * MS, 3 * MS))
    array = started(parameters)
    run(array, times[:9])
    other = PixelArray(parameters, 1)
    other.state = pickle.loads(pickle.dumps(array.state))
    assert np.array_equal(run(array, times[9:]), run(other, times[9:]))


def test_a_pixel_does_the_same_wherever_it_lies():
    """The same light and draws at another place, block and lane of the picture."""
    wide, narrow = (sensor(width=w, height=1, refractory_us=300.0) for w in (1500, 37))
    shift = 1000

    def light(parameters, t):
        x = np.arange(parameters.width) - (shift if parameters.width == 1500 else 0)
        return (0.5 * np.exp(1.2 * np.sin(0.3 * x + t * 2e-7)))[None].astype(np.float32)

    a, b = started(wide, light=light), started(narrow, light=light)
    there = np.arange(shift, shift + 37)
    for which in (Field.REFERENCE, Field.ON, Field.OFF, Field.LEAK):
        a.state.fields[there // BLOCK, which, there % BLOCK] = b.state.fields[0, which, :37]
    times = range(3 * MS, 90 * MS, 3 * MS)
    events = run(a, times, light)
    events = events[(events[:, 1] >= shift) & (events[:, 1] < shift + 37)]
    events[:, 1] -= shift
    assert len(events) > 100
    assert np.array_equal(events, run(b, times, light))


def test_thirty_days_later_the_events_are_the_same_to_the_nanosecond():
    parameters = sensor(mismatch=0.03, leak_hz=5.0, leak_spread=0.3, refractory_us=500.0)
    days = 30 * 86_400_000_000_000 // EPOCH_NS * EPOCH_NS
    times = np.arange(3 * MS, 200 * MS, 3 * MS)
    early, late = started(parameters), started(parameters, t_ns=days)
    first = run(early, [int(t) for t in times])
    second = run(late, [int(t) for t in times + days], lambda p, t: wave(p, t - days))
    second[:, 0] -= days
    assert len(first) > 3000
    assert np.array_equal(first, second)


def test_leak_has_its_rate_and_its_phases_are_spread():
    """Means of 89 960 pixels with a spread of 30 %: standard error 0.1 %. Phases: Kolmogorov-Smirnov at 1e-3."""
    parameters = dataclasses.replace(
        PRESETS["davis346"], leak_hz=0.1, leak_spread=0.3, refractory_us=0.0, source_follower_hz=0.0,
        parasitic_hz_at_reference=0.0, noise=NoiseParameters(),
    )  # fmt: skip
    array = PixelArray(parameters, 7)
    still = flat(parameters, 0.3)
    array.reset(LightFrame(0, still))
    rates = array.field(Field.LEAK) / array.field(Field.ON)
    assert np.mean(rates) == pytest.approx(0.1, rel=0.004)
    assert np.std(np.log(rates)) == pytest.approx(0.3, rel=0.01)
    events = run(array, [second * 1_000_000_000 for second in range(1, 101)], lambda p, t: still)
    assert np.all(events[:, 2] == 1)
    assert len(events) / 100 / still.size == pytest.approx(0.1, rel=0.01)
    first = np.unique(events[:, 1], return_index=True)[1]
    phase = events[first, 0] * 1e-9 * rates.reshape(-1)[events[first, 1]]
    assert stats.kstest(phase[phase < 1], "uniform").pvalue > 1e-3


@pytest.mark.system
def test_leak_keeps_its_rate_over_days_in_long_steps():
    """Two days in steps of six hours, which are longer than an epoch: the count is right to one event."""
    parameters = sensor(width=4, height=4, leak_hz=0.1, leak_spread=0.3, mismatch=0.03)
    array = PixelArray(parameters, 3)
    still = flat(parameters, 1.0)
    array.reset(LightFrame(0, still))
    hours = 3600 * 1_000_000_000
    events = run(array, [6 * k * hours for k in range(1, 9)], lambda p, t: still)
    rates = (array.field(Field.LEAK).astype(float) / array.field(Field.ON)).reshape(-1)
    counts = np.bincount(events[:, 1], minlength=16)
    assert array.lost_in_pixel == 0
    assert np.all(np.abs(counts - 48 * 3600 * rates) <= 1.01 + 1e-6 * counts)


def test_a_step_across_a_long_time_leaves_the_light_on_its_straight_line():
    """One step of 60 s against 60 of 1 s along the same line in log light."""
    parameters = sensor(width=30, height=1, corner_hz_at_reference=np.inf, dark_current_relative=1e-8)
    one, many = PixelArray(parameters, 2), PixelArray(parameters, 2)

    def light(p, t):
        return flat(p, 0.001 * np.exp(t * 1e-10))

    for array in (one, many):
        array.reset(LightFrame(0, light(parameters, 0)))
    a = run(one, [60_000_000_000], light)
    b = run(many, [k * 1_000_000_000 for k in range(1, 61)], light)
    a, b = (e[np.lexsort((e[:, 0], e[:, 1]))] for e in (a, b))
    assert len(a) > 600
    assert np.array_equal(a[:, 1:], b[:, 1:])
    assert np.max(np.abs(a[:, 0] - b[:, 0])) < 200_000  # of 60 s: the dark current bends the line


def test_light_that_comes_back_to_a_level_again_and_again_fires_each_time():
    """Up by four thresholds and down again: as many ON as OFF each time, none lost, none added."""
    parameters = sensor(corner_hz_at_reference=np.inf, dark_current_relative=1e-6)
    array = PixelArray(parameters, 1)
    low, high = flat(parameters, 0.1), flat(parameters, 0.1 * np.exp(1.0))
    array.reset(LightFrame(0, low))
    array.state.fields[:, Field.REFERENCE] = array.state.fields[:, Field.FILTERED]
    counts = [
        (int(c.on.sum()), int((~c.on).sum()))
        for k in range(1, 41)
        for c in [array.step(LightFrame(k * MS, high if k % 2 else low))]
    ]
    pixels = parameters.width * parameters.height
    for up, down in zip(counts[0::2], counts[1::2], strict=True):
        assert up[1] == 0
        assert down[0] == 0
        assert up[0] in (3 * pixels, 4 * pixels)  # whether the fourth is touched is a matter of the last bit
        assert up[0] == down[1]


def test_a_signal_that_stays_on_a_level_fires_once():
    parameters = sensor(width=8, height=1, corner_hz_at_reference=np.inf)
    array = PixelArray(parameters, 1)
    light = flat(parameters, 0.5)
    array.reset(LightFrame(0, light))
    fields = array.state.fields[0, :, :8]
    fields[Field.REFERENCE] = fields[Field.FILTERED] - fields[Field.ON]
    assert len(array.step(LightFrame(MS, light))) == 8
    assert [len(array.step(LightFrame(k * MS, light))) for k in range(2, 10)] == [0] * 8


@pytest.mark.parametrize("refractory_us", [0.0, 5.0])
def test_crossings_beyond_the_cap_are_counted_and_the_pixel_goes_on(refractory_us):
    parameters = sensor(
        width=10,
        height=1,
        threshold_on=0.02,
        threshold_off=0.02,
        dark_current_relative=0.01,
        corner_hz_at_reference=np.inf,
        refractory_us=refractory_us,
    )
    array = PixelArray(parameters, 1)
    array.reset(LightFrame(0, flat(parameters, 0.0)))
    c = array.step(LightFrame(1000 * MS, flat(parameters, 1.0)))
    assert len(c) == 640
    all_of_them = np.log(1.01 / 0.01) / 0.02
    assert len(c) + c.lost_in_pixel == pytest.approx(10 * all_of_them, abs=10 * (1 if refractory_us == 0 else 3))
    assert array.lost_in_pixel == c.lost_in_pixel > 0
    assert array.step(LightFrame(1001 * MS, flat(parameters, 1.0))).lost_in_pixel == 0
    assert np.all(np.abs(array.field(Field.FILTERED) - array.field(Field.REFERENCE)) <= 0.0201)


def test_every_pixel_of_a_large_array_may_fire_at_once():
    parameters = sensor(width=640, height=480, mismatch=0.03)
    array = PixelArray(parameters, 1)
    array.reset(LightFrame(0, flat(parameters, 0.01)))
    events = run(array, [MS, 2 * MS, 50 * MS], lambda p, t: flat(p, 1.0))
    assert np.all(np.bincount(events[:, 1], minlength=640 * 480) >= 15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_unreadable_light_makes_a_pixel_silent_and_is_counted(bad):
    parameters = sensor(leak_hz=0.1, refractory_us=100.0)
    array, twin = started(parameters), started(parameters)
    for k in range(1, 40):
        light = wave(parameters, k * MS)
        twin_events = twin.step(LightFrame(k * MS, light))
        if k in (10, 11, 12):
            light = light.copy()
            light[5:8] = bad
        c = array.step(LightFrame(k * MS, light))
        rows = c.pixel // parameters.width
        assert not (k in (10, 11, 12) and np.any((rows >= 5) & (rows < 8)))
        elsewhere = (twin_events.pixel // parameters.width < 5) | (twin_events.pixel // parameters.width >= 8)
        assert np.array_equal(c.t_ns[(rows < 5) | (rows >= 8)], twin_events.t_ns[elsewhere])
    assert array.quiet_nan == 3 * 3 * parameters.width
    assert np.all(np.isfinite(array.field(Field.FILTERED)))
    late = run(array, [k * MS for k in range(40, 140)])
    assert np.isin(np.arange(5 * parameters.width, 8 * parameters.width), late[:, 1]).all()


def test_a_start_on_unreadable_light_is_a_start_at_the_first_readable():
    parameters = sensor()
    array = PixelArray(parameters, 1)
    array.reset(LightFrame(0, flat(parameters, np.nan)))
    events = run(array, [k * MS for k in range(1, 100)])
    assert np.unique(events[:, 1]).size == parameters.width * parameters.height


@pytest.mark.parametrize("dark", [0.0, -1.0, -0.0, 1e-42])
def test_no_light_and_less_is_darkness(dark):
    parameters = sensor(dark_current_relative=0.01)
    array = PixelArray(parameters, 1)
    array.reset(LightFrame(0, flat(parameters, 1.0)))
    run(array, [1000 * MS, 4000 * MS], lambda p, t: flat(p, dark))
    assert array.field(Field.LOG_LIGHT) == pytest.approx(np.log(np.float32(0.01)), abs=1e-6)
    assert array.field(Field.FILTERED) == pytest.approx(np.log(np.float32(0.01)), abs=1e-4)


def test_the_brightest_finite_light_is_read():
    parameters = sensor()
    array = PixelArray(parameters, 1)
    array.reset(LightFrame(0, flat(parameters, 1.0)))
    run(array, [MS, 500 * MS], lambda p, t: flat(p, np.finfo(np.float32).max))
    assert array.quiet_nan == 0
    assert array.field(Field.LOG_LIGHT) == pytest.approx(np.log(float(np.finfo(np.float32).max)), rel=1e-6)


def test_no_time_is_no_step_and_time_does_not_go_back():
    array = started(sensor())
    array.step(LightFrame(MS, wave(array.parameters, MS)))
    before = copy.deepcopy(array.state)
    assert len(array.step(LightFrame(MS, flat(array.parameters, 9.0)))) == 0
    assert np.array_equal(before.fields, array.state.fields, equal_nan=True)
    with pytest.raises(ValueError, match="time does not go back"):
        array.step(LightFrame(MS - 1, flat(array.parameters, 9.0)))


@pytest.mark.parametrize(
    "light",
    [np.zeros((3, 4), np.float32), np.zeros((30, 40)), np.zeros(1200, np.float32)],
    ids=["size", "type", "flat"],
)
def test_a_picture_of_another_shape_or_type_is_refused(light):
    array = started(sensor())
    with pytest.raises(ValueError, match=r"must be \(30, 40\) float32"):
        array.step(LightFrame(MS, light))


def test_a_picture_that_is_a_view_is_read_rightly():
    parameters = sensor()
    big = np.repeat(np.repeat(wave(parameters, MS), 2, axis=0), 2, axis=1)
    a, b = started(parameters), started(parameters)
    c, d = a.step(LightFrame(MS, big[::2, ::2])), b.step(LightFrame(MS, wave(parameters, MS)))
    assert np.array_equal(c.t_ns, d.t_ns)


def test_light_that_jumps_at_once_passes_the_filter_alone():
    """Light rises by e^0.5 in no time: v = 0.5 (1 - exp(-2 pi f t)), so the first event is at its closed form."""
    parameters = sensor(
        corner_hz_at_reference=1e9, corner_max_hz=50.0, random_start=False, threshold_on=0.2, mismatch=0.0, leak_hz=0.0,
        dark_current_relative=1e-9,
    )  # fmt: skip
    array = PixelArray(parameters, 1)
    array.reset(LightFrame(0, flat(parameters, 1.0)))
    array.step(LightFrame(MS, flat(parameters, 1.0)))
    assert len(array.step(LightFrame(MS, flat(parameters, np.exp(0.5))))) == 0
    found = array.step(LightFrame(3 * MS, flat(parameters, np.exp(0.5))))
    expected_ns = MS - np.log(1 - 0.2 / 0.5) / (2 * np.pi * 50.0) * 1e9
    assert len(found) == parameters.width * parameters.height
    assert np.abs(found.t_ns - expected_ns).max() < 1000


@pytest.mark.parametrize("effects", [{}, {"source_follower_hz": 500.0, "parasitic_hz_at_reference": 3.0}])
def test_the_same_frame_again_at_the_same_time_changes_nothing(effects):
    once, again = (started(sensor(leak_hz=2.0, **effects)) for _ in range(2))
    for k in range(1, 30):
        light = wave(once.parameters, k * MS)
        expected = once.step(LightFrame(k * MS, light))
        events = [tuple(part.copy() for part in (expected.t_ns, expected.pixel, expected.on))]
        found = again.step(LightFrame(k * MS, light))
        events.append((found.t_ns.copy(), found.pixel.copy(), found.on.copy()))
        assert len(again.step(LightFrame(k * MS, light))) == 0
        assert all(np.array_equal(a, b) for a, b in zip(*events, strict=True))


def test_unreadable_light_that_is_replaced_at_the_same_time_restarts_the_filter():
    array = started(sensor())
    array.step(LightFrame(MS, flat(array.parameters, np.nan)))
    assert array.quiet_nan == array.parameters.width * array.parameters.height
    array.step(LightFrame(MS, flat(array.parameters, 2.0)))
    array.step(LightFrame(2 * MS, flat(array.parameters, 2.0)))
    assert array.quiet_nan == array.parameters.width * array.parameters.height
    assert array.field(Field.FILTERED) == pytest.approx(array.field(Field.LOG_LIGHT))
