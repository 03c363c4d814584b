"""Blocks that are skipped, and threads: events and state are those of the full pass by one thread, bit for bit."""

import copy
import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame, Region
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import BLOCK, PART, Field
from emulator.sensor.presets import PRESETS

WIDTH, HEIGHT = 346, 61
Y, X = np.mgrid[:HEIGHT, :WIDTH]
MS = 1_000_000
STEPS = 40


def sensor(**changes):
    return dataclasses.replace(PRESETS["davis346"], width=WIDTH, height=HEIGHT, **changes)


def black(k):
    return np.zeros((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH))


def still(k):
    return 0.1 + 0.5 * ((X * 7 + Y * 13) % 11) / 11, np.zeros((HEIGHT, WIDTH))


def spot(k, background=black):
    """A spot that moves, stands still, and moves again."""
    t = k if k < 12 else max(12, k - 15)
    light, rate = background(k)
    x = (X - 40 - 0.7 * t) / 2
    bell = np.exp(-(x**2 + ((Y - 20) / 2) ** 2) / 2) * (np.abs(x) < 4) * (np.abs(Y - 20) < 8)
    return light + bell, rate + bell * x * 350 * (k < 12 or k >= 27)


def spot_before_texture(k):
    return spot(k, still)


def flashes(k):
    light, rate = black(k)
    light[5:9, 50:60] = 0.7 * (k in (10, 11, 25))
    return light, rate


def broken(k):
    """Light that is not finite for a while, in one place."""
    light, rate = still(k)
    light[30, 100:110] = np.nan if 8 <= k < 12 else 0.3
    light[40, 100:110] = np.inf if k == 20 else 0.3
    return light, rate


def sparks(k):
    """Some pixels of two parts of each block, more than a table of candidates holds, change in every other step."""
    light, rate = black(k)
    place = X + WIDTH * Y
    lit = (place % BLOCK >= PART) & (place % BLOCK < 3 * PART) & (place % 7 == 0)
    return light + 0.1 + 0.9 * lit * ((place // 7 + k // 2) % 3 == 0), rate


SCENES = {
    "black": black,
    "still": still,
    "spot": spot,
    "texture": spot_before_texture,
    "flashes": flashes,
    "nan": broken,
    "sparks": sparks,
}
LOUD = NoiseParameters(rms=0.055, history_s=100.0)
EFFECTS = {
    "preset": {},
    "noise": {"noise": LOUD},
    "ideal": {"leak_hz": 0.0, "mismatch": 0.0, "refractory_us": 0.0, "noise": NoiseParameters()},
    "leaky": {"leak_hz": 20.0},
    "long refractory period": {"leak_hz": 3.0, "refractory_us": 7000.0},
    "second pole": {"source_follower_hz": 500.0},
    "parasitic leak": {"parasitic_hz_at_reference": 5.0},
    "all": {"source_follower_hz": 800.0, "parasitic_hz_at_reference": 2.0, "leak_hz": 2.0, "refractory_us": 900.0},
    "no low-pass": {"corner_hz_at_reference": float("inf")},
    "high-pass": {"highpass_hz": 60.0, "source_follower_hz": 500.0},
    "noise behind a high-pass": {"highpass_hz": 60.0, "noise": LOUD},
}


def changed_region(before, after, told):
    rows, columns = np.nonzero(
        ~((before[0] == after[0]) | np.isnan(before[0]) & np.isnan(after[0])) | (before[1] != after[1])
    )
    if not rows.size:
        return Region(0, 0, 0, 0)
    if told == "boxes":
        return Region(0, HEIGHT, 0, WIDTH, np.column_stack([rows, rows + 1, columns, columns + 1]))
    return Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)


def run(array, scene, steps_ns, *, slopes=True, told=False, full=False, begin_ns=0):
    """Return the events of all steps and the last state."""
    before = tuple(part.astype(np.float32) for part in scene(0))
    array.reset(LightFrame(begin_ns, before[0], before[1] if slopes else None))
    t_ns, found = begin_ns, []
    for k, h_ns in enumerate(steps_ns, 1):
        if full:
            array.wake()
        t_ns += h_ns
        light, rate = (part.astype(np.float32) for part in scene(k))
        region = changed_region(before, (light, rate), told) if told else None
        step = array.step(LightFrame(t_ns, light, rate if slopes else None, changed=region))
        found.append(np.rec.fromarrays([step.t_ns.copy(), step.pixel.copy(), step.on.copy()]))
        before = light, rate
    counts = array.candidates, array.undersampled, array.quiet_nan, array.lost_in_pixel
    return np.concatenate(found), array.state.fields, array.state.refractory_until_ns, counts


def assert_same(a, b):
    assert np.array_equal(a[0], b[0])
    assert np.array_equal(a[1], b[1], equal_nan=True)
    assert np.array_equal(a[2], b[2])
    assert a[3] == b[3]


def steps(kind):
    ragged = [(MS, 700_000, 1_300_000, 250_000)[k % 4] for k in range(STEPS)]
    return {"even": [MS] * STEPS, "ragged": ragged, "long": [400 * MS] * STEPS}[kind]


@pytest.mark.parametrize("effect", EFFECTS)
@pytest.mark.parametrize(
    "scene", [scene if scene == "spot" else pytest.param(scene, marks=pytest.mark.long) for scene in SCENES]
)
def test_skipping_changes_nothing(scene, effect):
    p = sensor(**EFFECTS[effect])
    full = run(PixelArray(p, 1), SCENES[scene], steps("even"), full=True)
    assert_same(run(PixelArray(p, 1), SCENES[scene], steps("even")), full)
    assert_same(run(PixelArray(p, 1), SCENES[scene], steps("even"), told=True), full)
    assert_same(run(PixelArray(p, 1), SCENES[scene], steps("even"), told="boxes"), full)


def test_only_parts_of_boxes_are_looked_at():
    array, light = PixelArray(sensor(**EFFECTS["ideal"]), 1), np.zeros((HEIGHT, WIDTH), np.float32)
    run(array, black, steps("even"))
    assert array._workers.idle.until_ns[(59 * WIDTH + 340) // BLOCK] > 0
    light[3, 40:60] = light[40, 100] = 1.0
    light[59, 340:] = light[40, 200] = 1.0  # not told: another block, and another part of a block with a box
    assert (40 * WIDTH + 100) // BLOCK == (40 * WIDTH + 200) // BLOCK
    boxes = np.array([[3, 4, 40, 60], [40, 41, 100, 101], [50, 50, 0, 9], [50, 51, 7, 7]])
    fired = set()
    for k in range(1, 9):
        found = array.step(
            LightFrame((STEPS + k) * MS, light, np.zeros_like(light), changed=Region(0, HEIGHT, 0, WIDTH, boxes))
        )
        fired |= set(found.pixel.tolist())
    assert fired == {*range(3 * WIDTH + 40, 3 * WIDTH + 60), 40 * WIDTH + 100}


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize("kind", ["ragged", "long"])
@pytest.mark.parametrize("slopes", [True, False])
@pytest.mark.parametrize("effect", ["preset", "noise", "leaky", "all"])
def test_skipping_changes_nothing_in_steps_of_any_length(effect, slopes, kind):
    p = sensor(**EFFECTS[effect])
    full = run(PixelArray(p, 1), spot, steps(kind), slopes=slopes, full=True)
    assert_same(run(PixelArray(p, 1), spot, steps(kind), slopes=slopes, told=True), full)


@pytest.mark.parametrize("effect", ["preset", "ideal", "second pole", "parasitic leak"])
def test_a_still_black_picture_is_skipped(effect):
    array = PixelArray(sensor(**(EFFECTS[effect] | {"noise": NoiseParameters()})), 1)
    run(array, black, steps("even"))
    idle = array._workers.idle.until_ns[: array.state.fields.shape[0]] > 0
    assert idle.mean() > 0.7


def test_parts_rest_where_noise_has_fired_no_pixel_for_ten_time_constants():
    """Of the slower pole: until then the noise remembers the pixel's reset. In the dark that is 0.53 s."""
    array, n = PixelArray(sensor(noise=LOUD), 1), 600
    found, *_ = run(array, black, [MS] * n)
    recent = np.zeros(WIDTH * HEIGHT // PART + 1, np.bool_)
    recent[found["f1"][found["f0"] > n * MS - 10e9 / (2 * np.pi * 3.0)] // PART] = True
    idle = array._workers.idle.until_ns[array.state.fields.shape[0] :][: recent.size] > 0
    assert 0.2 < recent.mean() < 0.8
    assert idle[~recent].mean() > 0.9


def test_of_a_block_with_little_change_only_the_parts_that_changed_are_moved():
    array = PixelArray(sensor(**EFFECTS["ideal"]), 1, threads=1)
    run(array, sparks, [MS] * 80)
    counts = []
    for k in range(81, 85):
        before = array.candidates
        light, rate = (part.astype(np.float32) for part in sparks(k))
        array.step(LightFrame(k * MS, light, rate))
        counts.append(array._workers._last - 12 * (array.candidates - before))
    blocks = array.state.fields.shape[0]
    beyond = blocks * BLOCK // PART - -(-WIDTH * HEIGHT // PART)  # these settle slowly in the dark
    assert 0 < max(counts) <= (2 * blocks + beyond) * PART


def test_a_change_of_leak_wakes_all_blocks():
    arrays = [PixelArray(sensor(leak_hz=0.0), 1) for _ in range(2)]
    results = []
    for array, full in zip(arrays, (False, True), strict=True):
        run(array, black, steps("even"), full=full)
        array.set_leak(np.full(WIDTH * HEIGHT, 50.0))
        light = np.zeros((HEIGHT, WIDTH), np.float32)
        results.append([array.step(LightFrame((STEPS + k) * MS, light, light)).t_ns.copy() for k in range(1, 30)])
    assert sum(map(len, results[0])) > 1000
    assert all(np.array_equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.sampled
@pytest.mark.parametrize("threads", [2, 3, 5])
@pytest.mark.parametrize("effect", ["preset", "all"])
def test_threads_change_nothing(effect, threads):
    def grating(k):
        angle = (X + 0.5 * Y - 1.5 * k) / 5
        return 0.5 * np.exp(np.sin(angle)), -0.5 * np.exp(np.sin(angle)) * np.cos(angle) * 300

    p = sensor(**EFFECTS[effect])
    one = run(PixelArray(p, 1, threads=1), grating, steps("even"))
    assert len(one[0]) > 10_000
    assert_same(run(PixelArray(p, 1, threads=threads), grating, steps("even")), one)
    mixed = run(PixelArray(p, 1, threads=1), spot_before_texture, steps("even"))
    assert_same(run(PixelArray(p, 1, threads=threads), spot_before_texture, steps("even"), told=True), mixed)


def test_a_copied_state_is_looked_at_whole():
    array, other = PixelArray(sensor(leak_hz=0.0), 1), PixelArray(sensor(leak_hz=0.0), 1)
    for each, scene in ((array, black), (other, still)):
        run(each, scene, steps("even"))
    other.state = copy.deepcopy(array.state)
    light, rate = (part.astype(np.float32) for part in still(0))
    t_ns = (STEPS + 1) * MS
    assert len(array.step(LightFrame(t_ns, light, rate))) == len(other.step(LightFrame(t_ns, light, rate))) > 0
    assert np.array_equal(array.state.fields[:, Field.FILTERED], other.state.fields[:, Field.FILTERED], equal_nan=True)


@pytest.mark.parametrize("effect", ["preset", "leaky", "all"])
def test_skipping_changes_nothing_before_stream_time_zero(effect):
    """Leak is counted from multiples of 2^33 ns, so without noise a stream that begins one earlier is the same one."""
    epoch_ns = 1 << 33
    p = sensor(**EFFECTS[effect])
    noisy, full = (
        run(PixelArray(p, 1), spot_before_texture, steps("even"), begin_ns=-epoch_ns, full=full)
        for full in (False, True)
    )
    assert_same(noisy, full)
    p = dataclasses.replace(p, noise=NoiseParameters())
    begun = run(PixelArray(p, 1), spot_before_texture, steps("even"), begin_ns=-epoch_ns)
    later = run(PixelArray(p, 1), spot_before_texture, steps("even"))
    assert np.array_equal(begun[0]["f0"] + epoch_ns, later[0]["f0"])
    assert np.array_equal(begun[0]["f1"], later[0]["f1"])


def test_skipping_changes_nothing_across_stream_time_zero():
    p = sensor(**EFFECTS["leaky"])
    begun = run(PixelArray(p, 1), spot_before_texture, steps("even"), begin_ns=-20 * MS)
    assert_same(begun, run(PixelArray(p, 1), spot_before_texture, steps("even"), begin_ns=-20 * MS, full=True))


def lamp(k):
    """Still light, in which a lamp goes on at step 20 and off at step 30."""
    light, rate = still(k)
    light[30, 100:140] += 20 <= k < 30
    return light, rate


@pytest.mark.sampled
@pytest.mark.parametrize("scene", [lamp, spot_before_texture])
@pytest.mark.parametrize("told", [True, "boxes"])
@pytest.mark.parametrize("slopes", [True, False])
@pytest.mark.parametrize("effect", ["preset", "all", "no low-pass"])
def test_a_frame_at_the_time_of_the_last_one_takes_its_place(effect, slopes, told, scene):
    """Light that changes in no time, in blocks that rest: the next step need not name it."""
    p = sensor(**EFFECTS[effect])
    lengths_ns = [0 if k in (7, 20, 21, 30) else MS for k in range(1, STEPS)]
    full = run(PixelArray(p, 1), scene, lengths_ns, slopes=slopes, full=True)
    assert len(full[0]) > 50
    assert_same(run(PixelArray(p, 1), scene, lengths_ns, slopes=slopes, told=told), full)
