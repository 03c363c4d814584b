"""With noise, events are those of seed, light, time and steps, to the bit: not of threads, skipping or restarts.

At other steps, or with certificates that end earlier, they follow the same law: rates and successors agree within 2 %
and 3.9 standard errors of the difference.
"""

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.sensor.parameters import NoiseParameters, ResetParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS
from tests.emulator.sensor.noise.noisy_arrays import (
    MS,
    begun,
    ends,
    events_of,
    forget_certificates,
    frame,
    one_pole,
    ramp,
    run,
    sine,
    statistics_of,
    still,
    two_poles,
)

IMX = dataclasses.replace(PRESETS["imx636"], width=24, height=16)
LOUD = dataclasses.replace(IMX, noise=dataclasses.replace(IMX.noise, rms=0.09))
SENSORS = {
    "two poles": LOUD,
    "quiet": IMX,
    "one pole": one_pole(3.0, 1e-3, leak_hz=20.0, random_start=True),
    "poles far apart": two_poles(2.5, 0.03, 84e-6, leak_hz=3.0),
    "leak": dataclasses.replace(LOUD, leak_hz=100.0, leak_spread=0.5),
    "leak by light": dataclasses.replace(LOUD, parasitic_hz_at_reference=5.0),
    "no dead time": dataclasses.replace(LOUD, refractory_us=0.0),
    "long dead time": dataclasses.replace(LOUD, refractory_us=30_000.0),
    "errors of resets": dataclasses.replace(LOUD, reset=ResetParameters(offset=0.01, noise=0.02)),
}
DIM = dataclasses.replace(LOUD, corner_hz_at_reference=30.0)


def same(one, other):
    return len(one.t_ns) == len(other.t_ns) > 100 and np.array_equal(one.rows(), other.rows())


def assert_alike(first, second, within=0.02):
    """Counts of pixels, and shares of opposite successors where there are some."""
    pixels = first.array.parameters.width * first.array.parameters.height
    counts = [np.bincount(found.pixel, minlength=pixels) for found in (first, second)]
    means = [count.mean() for count in counts]
    error = 3.9 * math.hypot(*(count.std() / math.sqrt(pixels) for count in counts))
    assert abs(means[0] - means[1]) < within * means[1] + error, means
    if min(means) > 1.5:
        a, b = statistics_of(first, 1.0), statistics_of(second, 1.0)
        assert a.opposite == pytest.approx(b.opposite, abs=within + 3.9 * math.sqrt(0.5 / len(a.waits_s)))


@pytest.mark.parametrize("step_ms", [0.2, 1, 80])
@pytest.mark.parametrize("sensor", SENSORS)
def test_steps_keep_the_law(sensor, step_ms):
    p, until_ms, level = (SENSORS[sensor], 320, 1.0) if sensor != "quiet" else (IMX, 960, 0.1)
    assert_alike(events_of(p, still(level), ends(10, until_ms)), events_of(p, still(level), ends(step_ms, until_ms)))


@given(steps=st.lists(st.integers(1, 50 * MS), min_size=1, max_size=12), begin_ns=st.integers(-(2**60), 2**60))
def test_any_division_of_time_has_its_events(steps, begin_ns):
    """Neither in the far past nor in the far future, nor across an epoch of the leak; in order, with the dead time."""
    until = begin_ns + np.cumsum(steps)
    parts = events_of(DIM, still(), until.tolist(), begin_ns)
    assert np.all((parts.t_ns >= begin_ns) & (parts.t_ns < until[-1]))
    assert np.all(np.diff(parts.t_ns) >= 0)
    order = np.lexsort((parts.t_ns, parts.pixel))
    waits_ns = np.diff(parts.t_ns[order])[np.diff(parts.pixel[order]) == 0]
    assert waits_ns.min(initial=10**9) >= DIM.refractory_us * 1000


@pytest.mark.parametrize("leak_hz", [0.0, 0.5])
def test_an_epoch_does_not_matter(leak_hz):
    p = dataclasses.replace(LOUD, leak_hz=leak_hz)
    across, within = (
        events_of(p, still(), range(begin_ns + step, begin_ns + 800 * MS + 1, step), begin_ns)
        for begin_ns in ((1 << 33) - 400 * MS, 0)
        for step in (10 * MS,)
    )
    assert_alike(across, within)
    assert_alike(across, events_of(p, still(), [(1 << 33) + 400 * MS], (1 << 33) - 400 * MS))


@pytest.mark.parametrize("sensor", ["two poles", "leak"])
def test_steps_that_end_at_events_lose_none(sensor):
    whole = events_of(SENSORS[sensor], still(), [30 * MS])
    times = np.unique(np.concatenate([whole.t_ns, whole.t_ns + 1, [30 * MS]]))
    assert_alike(whole, events_of(SENSORS[sensor], still(), times[times <= 30 * MS].tolist()))


def test_threads_do_not_matter():
    """Runs of 4096 pixels go to the threads in turn."""
    p = dataclasses.replace(LOUD, width=160, height=100)
    light = sine(0.5, 5.0)
    one, two = (run(begun(p, light, threads=threads), light, ends(10, 100)) for threads in (1, 2))
    assert same(one, two)


COLD = dataclasses.replace(IMX, width=64, height=64, dark_current_relative=2e-5, corner_min_hz=0.04)


def passing(t_s):
    """A bright spot comes and goes within 0.1 s; in the dark behind it the receptor is slow."""
    x = (t_s - 0.1) / 0.02
    level = 3e-3 * math.exp(-x * x)
    return level, level * -2 * x / 0.02


def stands_and_moves(t_s):
    """Light stands still for 50 ms, grows for 50 ms, and again."""
    beats, phase = divmod(t_s, 0.1)
    grown = beats * 0.05 + max(phase - 0.05, 0.0)
    return math.exp(2 * grown), 2 * math.exp(2 * grown) * (phase > 0.05)


@pytest.mark.parametrize(
    ("p", "light", "step_ms", "steps", "times"),
    [
        (LOUD, still(), 2, 200, 1.0),  # noise fires most pixels in each step
        (LOUD, stands_and_moves, 2, 200, 1.0),
        (dataclasses.replace(PRESETS["davis346"], width=64, height=64), stands_and_moves, 5, 200, 1.1),
        (LOUD, sine(0.05, 0.5), 5, 80, 1.0),
        (LOUD, sine(0.5, 2.0, 1.0), 1, 400, 1.0),
        (COLD, still(0.0), 50, 120, 40.0),  # many thresholds within 1.5 deviations, and noise of seconds
        (COLD, passing, 100, 120, 1.3),
        (IMX, sine(0.15, 1.0), 20, 100, 1.8),  # it leaves narrow limits in each step
    ],
)
def test_certificates_keep_the_law(p, light, step_ms, steps, times):
    """A pixel is left out of a step that its certificate covers; looked at, it has as many events."""
    until = ends(step_ms, steps * step_ms)
    usual = events_of(p, light, until)
    each = run(begun(p, light), light, until, forget_certificates)
    assert_alike(usual, each)
    assert each.array.candidates >= times * usual.array.candidates


def jumping(t_s):
    """Light that stands still, and jumps by 2 % after each tenth of a second."""
    return 0.1 * 1.02 ** math.ceil(t_s / 0.1 - 1e-6), 0.0


@pytest.mark.parametrize("change", ["leak", "references", "light"])
def test_certificates_for_still_light_end_where_something_else_moves_a_pixel(change):
    """Leak that changes, events of another source, as of the read-out's kicks, or light that jumps between steps."""
    p = dataclasses.replace(IMX, width=64, height=64, leak_hz=1.0)
    light = jumping if change == "light" else still(0.1)

    def disturb(array):
        k = array.state.t_ns // 10**7
        if change == "leak":
            array.set_leak(np.full(4096, 20.0 if k % 10 < 5 else 0.1))
        elif change == "light" and k % 10 == 0:
            array.step(frame(p, lambda t_s: jumping(t_s + 0.05), array.state.t_ns))
        elif change == "references" and k % 10 == 0:
            array.levels().fire(np.arange(k % 3, 4096, 3))

    def disturb_and_forget(array):
        disturb(array)
        forget_certificates(array)

    usual = run(begun(p, light), light, ends(10, 2000), disturb)
    assert len(usual.t_ns) > 4096
    assert_alike(usual, run(begun(p, light), light, ends(10, 2000), disturb_and_forget))


def test_a_pixel_far_from_its_thresholds_is_certified_at_any_speed():
    quiet = dataclasses.replace(IMX, noise=dataclasses.replace(IMX.noise, rms=0.01))
    light = sine(0.1, 100.0)  # less than half of a threshold, three times faster than slow certificates allow
    usual = events_of(quiet, light, ends(1, 200))
    each = run(begun(quiet, light), light, ends(1, 200), forget_certificates)
    assert_alike(usual, each)
    assert each.array.candidates > 3 * usual.array.candidates


def test_blocks_at_rest_do_not_matter():
    p = dataclasses.replace(IMX, width=240, height=160)
    usual = events_of(p, still(0.1), ends(1, 100))
    rests = usual.array._workers.idle.until_ns > 0
    assert rests.mean() > 0.2
    assert same(usual, run(begun(p, still(0.1)), still(0.1), ends(1, 100), PixelArray.wake))


@pytest.mark.parametrize("sensor", ["two poles", "one pole", "errors of resets", "long dead time"])
def test_a_copied_state_goes_on_elsewhere(sensor):
    p, light = SENSORS[sensor], sine(0.3, 3.0)
    first = begun(p, light)
    run(first, light, ends(7, 70))
    other = PixelArray(p, 1)
    other.state = copy.deepcopy(first.state)
    assert same(run(first, light, ends(5, 370, 70)), run(other, light, ends(5, 370, 70)))


@pytest.mark.parametrize(
    ("p", "light"),
    [(LOUD, sine(0.5, 3.0)), (dataclasses.replace(LOUD, width=128, height=48), sine(2.0, 12.0))],
    ids=["some pixels", "several batches in substeps"],
)
def test_other_pixels_do_not_matter(p, light):
    """A pixel's numbers are keyed by its place; its block's and its batch's other pixels have other light, or none."""
    few = dataclasses.replace(p, height=5)
    whole, part = events_of(p, light, ends(10, 300)), events_of(few, light, ends(10, 300))
    below = whole.pixel < few.width * few.height
    assert np.array_equal(whole.rows()[below], part.rows())
    array = begun(p, light)
    array.kill(np.arange(few.width * few.height, p.width * p.height))
    array.reset(frame(p, light, 0))
    alone = run(array, light, ends(10, 300))
    assert np.array_equal(alone.rows(), part.rows())


@pytest.mark.parametrize(
    ("name", "factor"), [("threshold_on", 0.7), ("threshold_off", 1.5), ("refractory_us", 9.0), ("corner_max_hz", 0.05)]
)
def test_steps_keep_the_law_after_a_bias_is_written(name, factor):
    found = []
    for step_ms in (0.5, 40):
        array = begun(LOUD, still())
        run(array, still(), ends(step_ms, 80))
        array.adjust(name, factor * array.adjustable[name])
        found.append(run(array, still(), ends(step_ms, 240, 80)))
    assert_alike(*found)
    unchanged = events_of(LOUD, still(), ends(40, 240)).rows()
    assert not np.array_equal(found[1].rows(), unchanged[unchanged["f0"] >= 80 * MS])


@pytest.mark.parametrize(
    ("light", "step_ms"), [(ramp(2.0, 0.05), 10), (ramp(-2.0), 40), (sine(0.5, 2.0), 1), (sine(0.5, 2.0), 10)]
)
def test_steps_keep_the_law_in_moving_light(light, step_ms):
    fine, coarse = (events_of(LOUD, light, ends(step, 400)) for step in (0.2, step_ms))
    assert len(fine.t_ns) > 5000
    assert_alike(fine, coarse)


def test_the_light_of_single_pixels_between_frames_does_not_matter():
    """A pixel whose light changes unseen is solved in halves, whoever else is."""
    p = dataclasses.replace(LOUD, width=32, height=24)
    phases = np.linspace(0, 6, 32 * 24)

    def light(t_s, among=slice(None)):
        level = np.exp(0.6 * np.sin(2 * np.pi * 30 * t_s + phases[among]))
        return level, level * 0.6 * 2 * np.pi * 30 * np.cos(2 * np.pi * 30 * t_s + phases[among])

    def between(t_ns, pixels):
        return tuple(values.astype(np.float32) for values in light(t_ns * 1e-9, pixels))

    found = []
    for forgets in (False, True):
        array, parts = begun(p, light), []
        for t_ns in ends(5, 300):
            step = array.step(frame(p, light, t_ns, at=between))
            parts.append(np.rec.fromarrays([step.t_ns.copy(), step.pixel.copy(), step.on.copy()]))
            if forgets:
                array._refinements.clear()
        found.append(np.concatenate(parts))
        assert array.refined > 5000
    assert len(found[0]) > 20_000
    assert np.array_equal(*found)


def test_without_noise_all_is_as_if_there_were_none():
    p = dataclasses.replace(LOUD, noise=NoiseParameters())
    light = sine(1.0, 5.0)
    found = events_of(p, light, ends(5, 200))
    assert found.array.state.memory.size == 0
    spread = dataclasses.replace(LOUD, noise=dataclasses.replace(LOUD.noise, rms=0.0, corner_hz=100.0))
    assert same(found, events_of(spread, light, ends(5, 200)))
