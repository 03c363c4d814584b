"""Pixels on the graphics card raise the events that those of the processor do, within what `docs/gpu.md` states."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.evaluation.accuracy.harness import CASES as ACCURACY_CASES
from emulator.evaluation.accuracy.harness import Method, score
from emulator.evaluation.accuracy.scores import Stream, compare
from emulator.gl.context import open_context
from emulator.gl.render_target import Stage
from emulator.light import MachineLacks
from emulator.sensor.effects import NoiseParameters
from emulator.sensor.gpu import array as gpu_array
from emulator.sensor.gpu.array import GpuArray
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS

pytestmark = [pytest.mark.gl, pytest.mark.usefixtures("gl")]

WIDTH, HEIGHT = 37, 21  # no multiples of a work group
Y, X = np.mgrid[:HEIGHT, :WIDTH]
MS = 1_000_000
RIGHT, T95_SHARE = 0.995, 2e-3
"""What docs/gpu.md states: pixels of the same sequence, and the 95th percentile of time differences over the step."""


def sensor(**changes):
    plain = {"leak_hz": 0.1, "parasitic_hz_at_reference": 0.0, "source_follower_hz": 0.0}
    plain["noise"] = NoiseParameters()
    return dataclasses.replace(PRESETS["davis346"], **{"width": WIDTH, "height": HEIGHT, **plain, **changes})


def grating(px_s):
    def light(t_s):
        angle = 2 * np.pi * (X + 0.5 * Y - px_s * t_s) / 12
        value = 0.5 * np.exp(np.sin(angle))
        return value, -value * np.cos(angle) * 2 * np.pi * px_s / 12

    return light


def checkerboard(t_s):
    """Squares of 8 px at 100 px/s behind a blur of half a pixel."""
    along = (X - 100 * t_s + 8 * (Y // 8)) % 16
    value, slope = np.full(X.shape, 0.1), np.zeros(X.shape)
    for edge, sign in ((0, 1), (8, -1), (16, 1)):
        z = (along - edge) / 0.5
        value += sign * 0.45 * np.vectorize(math.erf)(z / math.sqrt(2))
        slope += sign * 0.9 * np.exp(-(z**2) / 2) / 0.5 / math.sqrt(2 * np.pi)
    return value + 0.45, -100 * slope


def ramp(t_s):
    value = 0.2 * np.exp(t_s * (X - 18) * 2)
    return value, value * (X - 18) * 2


def flicker(t_s):
    angle = 2 * np.pi * 100 * t_s + X
    return 0.5 + 0.25 * np.sin(angle), 50 * np.pi * np.cos(angle)


def flash(t_s):
    value = np.full(X.shape, 1.0 if math.floor(t_s * 90 + 0.3) % 2 else 0.005)
    return value, np.zeros(X.shape)


def events(array, light, steps, h_ns, *, slopes=True, start_ns=0):
    """Return the array's events over `steps` steps, (t_ns, pixel, on)."""
    pictures = [[part.astype(np.float32) for part in light(k * h_ns * 1e-9)] for k in range(steps + 1)]
    array.reset(pictures[0][0], start_ns, pictures[0][1] if slopes else None)
    found = []
    for k, (value, rate) in enumerate(pictures[1:], 1):
        step = array.step(value, start_ns + k * h_ns, rate if slopes else None)
        found.append((step.t_ns.copy(), step.pixel.copy(), step.on.copy()))
    return [np.concatenate(column) for column in zip(*found, strict=True)]


def stream(found, start_ns=0):
    return Stream.of((found[0] - start_ns) * 1e-3, found[1], found[2], WIDTH * HEIGHT)


def assert_alike(a, b, h_ns, start_ns=0):
    scores = compare(stream(a, start_ns), stream(b, start_ns))
    assert scores.true_events > 300
    assert scores.right >= RIGHT
    assert scores.t95_us <= T95_SHARE * h_ns * 1e-3
    return scores


CASES = {
    "grating": (sensor(), grating(40), {}),
    "grating, fast": (sensor(), grating(400), {}),
    "grating, lines": (sensor(), grating(40), {"slopes": False}),
    "grating, low light": (sensor(corner_hz_at_reference=100.0), grating(100), {}),
    "checkerboard": (sensor(), checkerboard, {}),
    "checkerboard, long refractory period": (sensor(refractory_us=2500.0), checkerboard, {}),
    "checkerboard, no low-pass": (sensor(corner_hz_at_reference=math.inf, refractory_us=0.0), checkerboard, {}),
    "ramp": (sensor(), ramp, {}),
    "flicker": (sensor(), flicker, {}),
    "flash": (sensor(refractory_us=0.0), flash, {}),
    "leak": (sensor(leak_hz=40.0), grating(1), {}),
    "leak, steep": (sensor(leak_hz=400.0), grating(1500), {}),
    "davis346": (dataclasses.replace(PRESETS["davis346"], width=WIDTH, height=HEIGHT), grating(40), {}),
    "second pole": (sensor(source_follower_hz=286.0), checkerboard, {}),
    "second pole, fast": (sensor(source_follower_hz=5000.0), flicker, {}),
    "second pole, lines": (sensor(source_follower_hz=286.0), grating(40), {"slopes": False}),
    "parasitic leak": (sensor(parasitic_hz_at_reference=40.0), grating(20), {}),
    "parasitic leak, refractory": (sensor(parasitic_hz_at_reference=100.0, refractory_us=2500.0), checkerboard, {}),
    "both": (sensor(source_follower_hz=286.0, parasitic_hz_at_reference=20.0), ramp, {}),
}


@pytest.mark.parametrize("h_ns", [MS // 2, MS])
@pytest.mark.parametrize("case", CASES)
def test_the_events_are_those_of_the_processor(case, h_ns):
    parameters, light, how = CASES[case]
    ours, theirs = (make(parameters, 3) for make in (GpuArray, PixelArray))
    found = events(ours, light, 60, h_ns, **how)
    assert_alike(found, events(theirs, light, 60, h_ns, **how), h_ns)
    assert ours.undersampled == theirs.undersampled
    assert ours.candidates <= theirs.candidates
    keys = np.lexsort((found[1], found[0]))
    np.testing.assert_array_equal(keys, np.arange(keys.size))


@pytest.mark.parametrize("name", ["sine", "star"])
def test_they_are_as_near_to_the_truth(name):
    case = next(swept.case for swept in ACCURACY_CASES if swept.case.name == name)
    ours, theirs = (score(Method(name, make, rate=True), case, 1e-3) for make in (GpuArray, PixelArray))
    assert ours.right == theirs.right == 1
    assert ours.t95_us == pytest.approx(theirs.t95_us, rel=0.1)


def test_two_arrays_of_a_seed_are_equal_and_of_two_seeds_are_not():
    runs = [events(GpuArray(sensor(), seed), grating(100), 30, MS) for seed in (3, 3, 4)]
    for column, again in zip(runs[0], runs[1], strict=True):
        np.testing.assert_array_equal(column, again)
    assert compare(stream(runs[0]), stream(runs[2])).right < 0.9


FOLLOWED = {"source_follower_hz": 286.0, "parasitic_hz_at_reference": 20.0}


@pytest.mark.parametrize("more", [{}, FOLLOWED], ids=["one pole", "followed"])
def test_day_30_and_the_turn_of_an_epoch_change_nothing(more):
    for start_ns in ((1 << 33) - 20 * MS, 30 * 86_400_000 * MS):
        ours, theirs = (
            events(make(sensor(leak_hz=20.0, **more), 3), grating(100), 40, MS, start_ns=start_ns)
            for make in (GpuArray, PixelArray)
        )
        assert_alike(ours, theirs, MS, start_ns)


@pytest.mark.parametrize("more", [{}, FOLLOWED], ids=["one pole", "followed"])
def test_unreadable_light_and_unknown_slopes_are_taken_as_the_processor_does(more):
    def light(t_s):
        value, rate = grating(100)(t_s)
        step = round(t_s * 1000)
        value[step % HEIGHT, ::3] = (np.nan, np.inf, -np.inf)[step % 3]
        rate[(step + 5) % HEIGHT, ::2] = (np.nan, np.inf)[step % 2]
        value[3, :], value[4, :] = -1.0, 0.0
        return value, rate

    arrays = GpuArray(sensor(**more), 3), PixelArray(sensor(**more), 3)
    ours, theirs = (events(array, light, 60, MS) for array in arrays)
    assert_alike(ours, theirs, MS)
    assert arrays[0].quiet_nan == arrays[1].quiet_nan > 500


def test_light_may_begin_unreadable_and_slopes_may_come_and_go():
    arrays = GpuArray(sensor(), 3), PixelArray(sensor(), 3)
    found = []
    for array in arrays:
        first = grating(100)(0)[0].astype(np.float32)
        first[:, ::4] = np.nan
        array.reset(first, 0)
        steps = []
        for k in range(1, 60):
            value, rate = (part.astype(np.float32) for part in grating(100)(k * 1e-3))
            step = array.step(value, k * MS, rate if k % 3 else None)
            steps.append((step.t_ns.copy(), step.pixel.copy(), step.on.copy()))
        found.append([np.concatenate(column) for column in zip(*steps, strict=True)])
    assert_alike(*found, MS)


def test_crossings_beyond_64_a_pixel_are_counted_and_not_listed():
    parameters = sensor(threshold_on=0.05, threshold_off=0.05, mismatch=0.0, refractory_us=0.0, leak_hz=0.0)
    arrays = GpuArray(parameters, 3), PixelArray(parameters, 3)
    ours, theirs = (events(array, flash, 12, MS) for array in arrays)
    assert arrays[0].lost_in_pixel == arrays[1].lost_in_pixel > 1000
    assert len(ours[0]) == len(theirs[0])


def test_a_list_that_is_too_short_is_made_longer_and_the_step_taken_again(monkeypatch):
    expected = events(GpuArray(sensor(), 3), grating(400), 10, MS)
    monkeypatch.setattr(gpu_array, "_FIRST_CAPACITY", 3)
    array = GpuArray(sensor(), 3)
    for column, same in zip(events(array, grating(400), 10, MS), expected, strict=True):
        np.testing.assert_array_equal(column, same)
    assert array.lost_in_pixel == 0


def test_what_no_list_can_hold_is_counted():
    whole, short = GpuArray(sensor(), 3), GpuArray(sensor(), 3)
    short._largest_capacity = short._capacity = 50
    expected = events(whole, grating(400), 10, MS)
    found = events(short, grating(400), 10, MS)
    assert len(found[0]) < len(expected[0])
    assert len(found[0]) + short.lost_in_pixel == len(expected[0])


FRAGMENT = """
#version 430
uniform float t;
out float r;
void main() { r = 0.5 * exp(sin((gl_FragCoord.x + 0.5 * gl_FragCoord.y - 100.0 * t) * 0.5)); }
"""
CORNERS = """
#version 430
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }
"""


def test_a_picture_drawn_in_the_same_context_need_not_leave_it():
    stage = Stage((WIDTH, HEIGHT), 2)
    with stage.context as gl:
        program = gl.program(vertex_shader=CORNERS, fragment_shader=FRAGMENT)
        cover = gl.vertex_array(program, [])
    inside, outside = GpuArray(sensor(), 3, stage.context), GpuArray(sensor(), 3)
    picture = np.zeros((HEIGHT, WIDTH), np.float32)

    def draw(k):
        def render(gl):
            program["t"] = k * 1e-3
            gl.disable(gl.CULL_FACE | gl.DEPTH_TEST)
            cover.render(gl.TRIANGLES, vertices=3)

        stage.draw(render, picture)

    draw(0)
    for array in (inside, outside):
        array.reset(picture, 0)
    total = 0
    for k in range(1, 30):
        draw(k)
        ours, theirs = inside.step_drawn(stage.picture, k * MS), outside.step(picture, k * MS)
        for name in ("t_ns", "pixel", "on"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        total += len(ours)
    assert total > 300
    with pytest.raises(ValueError, match="another context"):
        outside.step_drawn(stage.picture, 30 * MS)
    with stage.context as gl:
        small = gl.texture((4, 4), 1, dtype="f4")
    with pytest.raises(ValueError, match=r"must be \(37, 21\)"):
        inside.step_drawn(small, 30 * MS)


def test_wrong_use_is_refused_and_changes_nothing():
    array = GpuArray(sensor(), 3)
    value, rate = (part.astype(np.float32) for part in grating(400)(0))
    array.reset(value, 5 * MS, rate)
    bad = (
        (value, 4 * MS, "does not go back"),
        (value, 5 * MS + (1 << 31) + 1, "at most 2.1"),
        (value[:-1], 6 * MS, "must be"),
        (value.astype(np.float64), 6 * MS, "float32"),
    )
    for light, t_ns, meaning in bad:
        with pytest.raises(ValueError, match=meaning):
            array.step(light, t_ns)
    assert len(array.step(value, 5 * MS)) == 0
    later = [part.astype(np.float32) for part in grating(400)(1e-3)]
    fresh = GpuArray(sensor(), 3)
    fresh.reset(value, 5 * MS, rate)
    ours, theirs = (a.step(later[0], 6 * MS, later[1]) for a in (array, fresh))
    assert len(ours) > 20
    np.testing.assert_array_equal(ours.t_ns, theirs.t_ns)


@pytest.mark.parametrize(
    ("changes", "meaning"),
    [
        ({"refractory_us": 3e6}, "at most 2147483"),
    ],
)
def test_what_is_not_done_on_the_card_is_refused(changes, meaning):
    with pytest.raises(ValueError, match=meaning):
        GpuArray(sensor(**changes), 3)


def test_a_sensor_that_the_card_cannot_hold_is_refused():
    with pytest.raises(MachineLacks, match="takes at most"):
        GpuArray(dataclasses.replace(sensor(), width=20_000, height=2), 3)


def test_the_context_ends_with_the_array_unless_it_is_the_callers():
    gl = open_context()
    array = GpuArray(sensor(), 3, gl)
    del array
    with gl:
        gl.buffer(reserve=16).release()
    gl.release()
