"""Suspects in halves: the same as smaller steps for those pixels alone, whatever the sensor has besides."""

import copy
import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels import array as pixels
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.curve import REFINED_UNSEEN_SHARE
from emulator.sensor.pixels.state import FIELDS
from emulator.sensor.presets import PRESETS
from laboratory.accuracy.scores import Stream, compare

MS = 1_000_000
OMEGA = 2 * np.pi * 50
SMALL = dataclasses.replace(PRESETS["davis346"], width=40, height=30, refractory_us=0.0)
PHASE = np.linspace(0, 2 * np.pi, 1200, endpoint=False)
EFFECTS = {
    "plain": {},
    "short refractory": {"refractory_us": 150.0},
    "long refractory": {"refractory_us": 5200.0},
    "second pole": {"source_follower_hz": 800.0},
    "parasitic leak": {"parasitic_hz_at_reference": 20.0},
    "high-pass": {"highpass_hz": 30.0, "source_follower_hz": 800.0},
}


def log_light(t_ns, phase=PHASE):
    return 0.9 * np.sin(OMEGA * t_ns * 1e-9 + phase)


def pixel_light(t_ns, listed, phase=PHASE):
    light = np.exp(log_light(t_ns, phase[listed]))
    return light.astype(np.float32), (light * 0.9 * OMEGA * np.cos(OMEGA * t_ns * 1e-9 + phase[listed])).astype("f4")


def picture(t_ns, phase=PHASE):
    return tuple(values.reshape(30, 40) for values in pixel_light(t_ns, np.arange(1200), phase))


def run(times_ns, at=None, parameters=SMALL, phase=PHASE):
    array = PixelArray(parameters, 3)
    light, rate = picture(0, phase)
    array.reset(LightFrame(0, light, rate))
    return array, [stepped(array, t_ns, at, phase) for t_ns in times_ns]


def stepped(array, t_ns, at=None, phase=PHASE):
    light, rate = picture(t_ns, phase)
    return copy.deepcopy(array.step(LightFrame(t_ns, light, rate, at)))


def joined(parts):
    return [np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "pixel", "on")]


def of(parts, wanted):
    t_ns, pixel, on = joined(parts)
    kept = np.isin(pixel, wanted)
    return t_ns[kept], pixel[kept], on[kept]


def stream(events):
    t_ns, pixel, on = events
    return Stream.of(t_ns * 1e-3, pixel, on, 1200)


class Asked:
    """Tells the light, and remembers of whom and when."""

    def __init__(self):
        self.who = {}

    def __call__(self, t_ns, listed):
        self.who.setdefault(t_ns, []).append(listed.copy())
        return pixel_light(t_ns, listed)

    def at(self, t_ns):
        return np.sort(np.concatenate(self.who[t_ns])) if t_ns in self.who else np.empty(0, np.int64)


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_pixel_that_is_halved_has_the_events_and_the_state_of_half_the_step(effect, monkeypatch):
    monkeypatch.setattr(pixels, "UNSEEN_SHARE", REFINED_UNSEEN_SHARE)  # what is plain is the same for both
    parameters, asked = dataclasses.replace(SMALL, **EFFECTS[effect]), Asked()
    halved, found = run([MS, 4 * MS], asked, parameters)
    twice, finer = run([MS, MS + 3 * MS // 2, 4 * MS], parameters=parameters)
    quarters = np.union1d(asked.at(MS + 3 * MS // 4), asked.at(MS + 9 * MS // 4))
    once = np.setdiff1d(asked.at(MS + 3 * MS // 2), np.union1d(quarters, asked.at(MS // 2)))
    assert 50 < once.size < 1100
    for one, other in zip(of(found, once), of(finer, once), strict=True):
        np.testing.assert_array_equal(one, other)
    fields = [array.state.fields.transpose(0, 2, 1).reshape(-1, FIELDS)[once, :10] for array in (halved, twice)]
    np.testing.assert_array_equal(*fields)
    refractory = [array.state.refractory_until_ns[once] for array in (halved, twice)]
    np.testing.assert_array_equal(*(np.where(np.isnan(fields[0][:, 4]), until, 0) for until in refractory))


def test_undersampled_pixels_all_over_are_solved_like_frames_at_an_eighth_of_the_step():
    """Without noise, whose times follow the steps."""
    plain, steps = dataclasses.replace(SMALL, noise=NoiseParameters()), [k * 4 * MS for k in range(1, 6)]
    halved, found = run(steps, pixel_light, plain)
    truth = joined(run([k * MS // 8 for k in range(1, 161)], None, plain)[1])
    coarse = joined(run(steps, None, plain)[1])

    near, far = (compare(stream(events), stream(truth)) for events in (joined(found), coarse))
    assert near.right > 0.998
    assert near.t95_us < 3
    assert far.right < 0.99
    assert far.t95_us > 10 * near.t95_us
    assert halved.undersampled < 0.01 * halved.candidates


def test_what_a_pixel_does_does_not_depend_on_who_else_is_halved():
    still = PHASE.copy()
    still[100:] = np.nan  # no light at all for the others

    def dark(t_ns, listed):
        return tuple(np.nan_to_num(values) for values in pixel_light(t_ns, listed, still))

    times_ns = [k * 3 * MS for k in range(1, 8)]
    among = of(run(times_ns, pixel_light)[1], np.arange(100))
    array = PixelArray(SMALL, 3)
    pictures = [dark(t_ns, np.arange(1200)) for t_ns in (0, *times_ns)]
    shaped = [tuple(values.reshape(30, 40) for values in both) for both in pictures]
    array.reset(LightFrame(0, shaped[0][0], shaped[0][1]))
    parts = [
        copy.deepcopy(array.step(LightFrame(t_ns, light, rate, dark)))
        for t_ns, (light, rate) in zip(times_ns, shaped[1:], strict=True)
    ]
    for one, other in zip(among, of(parts, np.arange(100)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_restart_in_the_middle_changes_nothing():
    array, _ = run([3 * MS, 6 * MS], pixel_light)
    other = PixelArray(SMALL, 3)
    other.state = copy.deepcopy(array.state)
    for t_ns in (9 * MS, 12 * MS):
        one, again = stepped(array, t_ns, pixel_light), stepped(other, t_ns, pixel_light)
        for name in ("t_ns", "pixel", "on"):
            np.testing.assert_array_equal(getattr(one, name), getattr(again, name))


def test_nobody_is_asked_where_pictures_are_close_enough_or_come_without_a_derivative():
    def never(t_ns, listed):
        raise AssertionError

    array, _ = run([k * MS // 10 for k in range(1, 20)], never)
    assert array.refined == 0 < array.candidates
    light, _ = picture(9 * MS)
    array.step(LightFrame(9 * MS, light, None, never))


def test_light_that_is_not_a_number_in_between_silences_the_pixel_and_is_counted():
    def blank(t_ns, listed):
        light, rate = pixel_light(t_ns, listed)
        light[listed == 7] = np.nan
        return light, rate

    array, found = run([4 * MS, 8 * MS, 12 * MS], blank)
    others = np.setdiff1d(np.arange(1200), [7])
    for one, other in zip(of(found, others), of(run([4 * MS, 8 * MS, 12 * MS], pixel_light)[1], others), strict=True):
        np.testing.assert_array_equal(one, other)
    assert array.quiet_nan >= 1
    assert np.isfinite(array.field(1)).all()


@pytest.mark.parametrize(("rotation_deg", "direction_deg"), [(0, 0), (90, 30), (7, 20)])
def test_a_board_tells_the_same_light_pixel_by_pixel(rotation_deg, direction_deg):
    board = CheckerboardParameters(square_px=5.3, direction_deg=direction_deg, rotation_deg=rotation_deg)
    with Checkerboard(board, (40, 30)) as scene:
        light, rate = np.empty((30, 40), np.float32), np.empty((30, 40), np.float32)
        scene.light_and_rate(123_456_789, light, rate)
        some = np.random.default_rng(1).permutation(1200)[:500]
        told = scene.pixel_light(123_456_789, some)
    np.testing.assert_allclose(told[0], light.reshape(-1)[some], rtol=1e-5)
    np.testing.assert_allclose(told[1], rate.reshape(-1)[some], atol=1e-4 * np.abs(rate).max())
