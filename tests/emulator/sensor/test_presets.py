"""Sensor parameters: what is accepted, what is refused and how that is said; the presets' figures."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.rig.kinds import CAMERA_MODELS
from emulator.sensor.parameters import BackgroundParameters, NoiseParameters
from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor

PLAIN = SensorParameters(width=4, height=3, threshold_on=0.2, threshold_off=0.2)


@pytest.mark.parametrize("name", [name for name in PRESETS if name != "ideal"])
def test_presets_are_there_and_plausible(name):
    p = PRESETS[name]
    assert 0.1 <= p.threshold_on <= 0.4
    assert 0.1 <= p.threshold_off <= 0.4
    assert 0.02 <= p.mismatch <= 0.15
    assert p.dark_current_relative > 0
    assert p.leak_hz <= (0.2 if name == "davis346_noisy" else 0.01)


def test_the_sizes_and_rates_of_the_presets():
    sizes = {name: (p.width, p.height) for name, p in PRESETS.items()}
    assert sizes == {
        "davis346": (346, 260), "davis346_noisy": (346, 260), "davis240c": (240, 180), "dvxplorer_micro": (640, 480),
        "ideal": (346, 260), "imx636": (1280, 720), "imx636_nist": (1280, 720),
        "imx636_noise2params": (1280, 720), "imx636_quiet": (1280, 720), "gen31": (640, 480), "gen31_nist": (640, 480),
        "gen31_moke": (640, 480), "genx320": (320, 320),
    }  # fmt: skip
    assert 1e3 / PRESETS["davis346"].readout.event_ns == pytest.approx(12, rel=0.05)  # Mev/s
    assert (PRESETS["imx636"].readout.row_ns, PRESETS["imx636"].readout.event_ns) == (127, 0.33)
    assert 1e3 / PRESETS["gen31"].readout.event_ns == pytest.approx(66, rel=0.01)
    assert [name for name, p in PRESETS.items() if p.readout.scan_us] == ["dvxplorer_micro"]


def events_of(p, light, seconds):
    """Events of a sensor in still light."""
    sensor, picture = Sensor(p, 1), np.full((p.height, p.width), light, np.float32)
    sensor.reset(LightFrame(0, picture))
    parts = [
        sensor.expose(LightFrame(int(t * 1e9), picture)) for t in np.linspace(0, seconds, 1 + round(seconds * 10))[1:]
    ]
    return np.concatenate([*parts, sensor.finish()])


def counts_in(events, p):
    return np.bincount(events["y"] * np.int64(p.width) + events["x"], minlength=p.width * p.height)


def still(name, light, seconds, **figures):
    """Counts of the pixels, and events, of a preset in still light."""
    p = dataclasses.replace(PRESETS[name], **figures)
    events = events_of(p, light, seconds)
    return counts_in(events, p), events


def test_the_davis346_in_still_light_is_as_quiet_as_the_recorded_one():
    """Recorded, still half of the pixels: 0.0024 Hz a pixel at level 80 to 120, 99.5 % silent in 2.36 s, all ON."""
    counts, events = still("davis346", 1.25, 2.36)
    assert counts.sum() / counts.size / 2.36 == pytest.approx(0.0027, rel=0.2)
    assert (counts == 0).mean() == pytest.approx(0.994, abs=0.002)
    assert events["on"].mean() > 0.994


def in_still_light(name, light, **figures):
    """Rate of a pixel, Hz, share of silent pixels and sd over mean of their counts, of 9600 pixels in 20 s."""
    events, _ = still(name, light, 20, width=120, height=80, **figures)
    return events.mean() / 20, (events == 0).mean(), events.std() / events.mean()


@pytest.mark.parametrize("name", ["dvxplorer_micro", "imx636", "imx636_noise2params", "gen31_moke", "genx320"])
def test_noise_rises_as_light_falls(name):
    """The chips whose noise shows; that of davis346, imx636_quiet and gen31_nist does not in any still light."""
    bright_light = 1.0 if name == "dvxplorer_micro" else 10.0
    dim, bright = (in_still_light(name, light, background=BackgroundParameters())[0] for light in (1e-3, bright_light))
    assert dim > 10 * bright
    assert dim > 0.05


def test_noise_of_the_davis346_fires_few_still_pixels_of_the_recording():
    """Recorded at level 0 to 10 of 255: 2 events of 1918 pixels in 2.36 s, at most 0.0016 Hz (95 %); leak included."""
    assert in_still_light("davis346", 5 / 80)[0] < 0.0016


@pytest.mark.parametrize("name", ["imx636_noise2params", "gen31_moke"])
def test_in_dim_light_noise_fires_at_a_few_hertz(name):
    hz, silent, _ = in_still_light(name, 0.1)
    assert 1 < hz < 4
    assert silent < 0.125


def test_noise_of_dim_light_is_spread_over_the_pixels_as_on_a_grid_of_time():
    """1500 pixels for 80 s in steps of 10 us, by other code: 1.74 Hz, 9.2 % silent in 20 s, sd over mean 1.16."""
    p = dataclasses.replace(
        PLAIN, width=120, height=80, threshold_on=0.223, threshold_off=0.223, mismatch=0.043,
        dark_current_relative=0.0139, corner_hz_at_reference=2180.0, corner_max_hz=30_000.0, source_follower_hz=4050.0,
        leak_hz=0.0062, refractory_us=105.0, noise=NoiseParameters(rms=0.0495, history_s=100.0),
    )  # fmt: skip
    counts = counts_in(events_of(p, 0.1, 20), p)
    assert counts.mean() / 20 == pytest.approx(1.74, rel=0.07)
    assert (counts == 0).mean() == pytest.approx(0.092, abs=0.02)
    assert counts.std() / counts.mean() == pytest.approx(1.16, abs=0.08)


def test_units_of_one_chip_differ_by_ten_in_bright_light():
    quiet, noisy = (in_still_light(name, 30.0)[0] for name in ("imx636_quiet", "imx636_noise2params"))
    assert quiet == pytest.approx(0.0024, rel=0.25)
    assert noisy == pytest.approx(0.041, rel=0.25)
    assert in_still_light("imx636_quiet", 0.1)[0] < 0.01


def test_the_noisy_davis346_has_the_rates_of_a_stated_one():
    """DND21: about 10 Hz in dim light, and a leak of about 0.2 Hz."""
    assert in_still_light("davis346_noisy", 0.01)[0] == pytest.approx(10, rel=0.2)
    assert in_still_light("davis346_noisy", 1.0)[0] == pytest.approx(0.2, rel=0.1)


FOLLOWED = {
    "the pole of signal and noise": ({"source_follower_hz": 4050.0, "noise": NoiseParameters(0.05)}, 1.0),
    "a pole of the noise": ({"source_follower_hz": 286.0, "noise": NoiseParameters(0.16, corner_hz=2.0)}, 1e-3),
}


@pytest.mark.sampled
@pytest.mark.parametrize("pole", FOLLOWED)
@pytest.mark.parametrize(("factor", "low", "high"), [(0.5, 0.0, 0.5), (1.5, 1.3, 20.0)])
def test_the_bandwidth_bias_acts_on_noise(factor, low, high, pole):
    """A slower follower takes noise away: bias_fo of a Prophesee sensor, PrSFBp of a DAVIS346."""
    figures, light = FOLLOWED[pole]
    p = dataclasses.replace(PLAIN, width=120, height=80, leak_hz=0.0, **figures)
    sensor, picture = Sensor(p, 1), np.full((80, 120), light, np.float32)
    sensor.reset(LightFrame(0, picture))
    sensor.adjust("source_follower_hz", factor * p.source_follower_hz)
    events = np.concatenate([sensor.expose(LightFrame(30_000_000_000, picture)), sensor.finish()])
    usual = len(events_of(p, light, 30))
    assert usual > 1000
    assert low < len(events) / usual < high


@pytest.mark.parametrize(("name", "hz", "on_share"), [("imx636_nist", 0.0024, 0.17), ("gen31_nist", 0.0024, 0.17)])
def test_the_default_units_are_quiet_in_bright_light(name, hz, on_share):
    """A recorded EVK4 has 0.0024 to 0.0027 Hz, 14 to 17 % ON; a leak of 0.006 Hz would make that 0.015 Hz, 81 % ON."""
    events, stream = still(name, 4.0, 20, width=120, height=80)
    ordinary = events <= 8
    on = stream["on"][ordinary[stream["y"] * np.int64(120) + stream["x"]]]
    assert events[ordinary].sum() / events.size / 20 == pytest.approx(hz, rel=0.25)
    assert on.mean() == pytest.approx(on_share, abs=0.08)


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_the_sensor_of_a_camera_is_a_preset(model):
    assert any(CAMERA_MODELS[model].sensor is p for p in PRESETS.values())
    assert (PRESETS["imx636"], PRESETS["gen31"]) == (PRESETS["imx636_nist"], PRESETS["gen31_nist"])


def test_the_quiet_imx636_has_the_background_that_was_recorded():
    """Recorded in still tiles: 0.0024 Hz, 10 to 14 % ON, 98 % silent in 10.8 s; 75 % opposite successors."""
    counts, events = still("imx636_quiet", 4.0, 10.8)
    pixel = events["y"] * np.int64(1280) + events["x"]
    order = np.lexsort([events["t"], pixel])
    opposite = np.diff(events["on"][order].astype(int))[np.diff(pixel[order]) == 0] != 0
    assert counts.sum() / counts.size / 10.8 == pytest.approx(0.0024, rel=0.1)
    assert events["on"][counts[pixel] <= 8].mean() == pytest.approx(0.12, abs=0.02)
    assert (counts == 0).mean() == pytest.approx(0.9805, abs=0.002)
    assert opposite.mean() == pytest.approx(0.75, abs=0.06)
    assert 5 <= (counts > 50).sum() <= 20
    ordinary = counts[pixel[order]] <= 8
    waits_s = np.diff(events["t"][order].astype(np.int64)) * 1e-6
    pair = (np.diff(pixel[order]) == 0) & ordinary[1:] & ~events["on"][order][:-1] & events["on"][order][1:]
    assert np.median(waits_s[pair]) == pytest.approx(1.26, rel=0.15)


def test_an_ideal_sensor_fires_at_whole_thresholds_of_the_first_picture():
    sensor = Sensor(dataclasses.replace(PRESETS["ideal"], width=8, height=4), 1)
    dark = PRESETS["ideal"].dark_current_relative
    light = np.full((4, 8), 0.5, np.float32)
    sensor.reset(LightFrame(0, light))
    after = ((0.5 + dark) * np.exp(0.2 * 3.5) - dark) * np.ones_like(light)
    events = np.concatenate([sensor.expose(LightFrame(7_000_000, after.astype(np.float32))), sensor.finish()])
    assert len(events) == 3 * 32
    assert events["on"].all()
    t = np.sort(events["t"].reshape(-1)).reshape(3, 32)  # 3.5 thresholds in 7 ms: one every 2 ms
    assert np.array_equal(np.unique(t), [2000, 4000, 6000]) or np.abs(t - [[2000], [4000], [6000]]).max() <= 1


def test_noise_needs_a_pole():
    with pytest.raises(ValueError, match=r"noise.rms = 0.05: must be 0 where nothing limits"):
        dataclasses.replace(PRESETS["ideal"], noise=NoiseParameters(rms=0.05))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 0), ("height", -1), ("width", 70_000),
        ("threshold_on", 0.0), ("threshold_on", -0.1), ("threshold_off", 0.0), ("threshold_off", math.nan),
        ("threshold_on", math.inf), ("mismatch", -0.01), ("mismatch", 0.5), ("mismatch", math.nan),
        ("dark_current_relative", 0.0), ("dark_current_relative", -1.0), ("dark_current_relative", math.inf),
        ("corner_hz_at_reference", 0.0), ("corner_hz_at_reference", math.nan), ("corner_min_hz", 0.0),
        ("corner_min_hz", math.inf), ("corner_max_hz", 1.0), ("leak_hz", -0.1), ("leak_hz", math.inf),
        ("leak_spread", -0.1), ("refractory_us", -1.0), ("refractory_us", math.nan), ("refractory_us", math.inf),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_by_name_and_value(field, value):
    with pytest.raises(ValueError, match=f"^{field} must be"):
        dataclasses.replace(PLAIN, **{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("refractory_us", 0.0), ("leak_hz", 0.0), ("mismatch", 0.0), ("corner_hz_at_reference", math.inf),
     ("corner_max_hz", math.inf)],
)  # fmt: skip
def test_what_is_extreme_but_makes_sense_is_accepted(field, value):
    assert getattr(dataclasses.replace(PLAIN, **{field: value}), field) == value


@pytest.mark.parametrize(("event_ns", "row_ns"), [(0.0, 10), (-1.0, 10), (math.nan, 10), (80.0, -1), (math.inf, 10)])
def test_an_arbiter_needs_times(event_ns, row_ns):
    with pytest.raises(ValueError, match="_ns must be"):
        ReadoutParameters(event_ns=event_ns, row_ns=row_ns)


def test_too_many_pixels_are_refused():
    with pytest.raises(ValueError, match="at most"):
        dataclasses.replace(PLAIN, width=65_536, height=65_536)
