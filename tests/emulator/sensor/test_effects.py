"""The figures of effects: what is refused, how that is said, and how a rig gives them."""

import dataclasses
import math

import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.sensor.parameters import (
    ComparatorParameters,
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    ResetParameters,
    TemperatureParameters,
)
from emulator.sensor.presets import PRESETS, SensorParameters

EFFECTS = ("temperature", "defects", "noise", "jitter", "imager", "radiation", "comparator", "reset")
RIG = """
[scene]
kind = "checkerboard"
[camera.sensor]
parasitic_hz_at_reference = 0.2
[camera.sensor.noise]
rms = 0.06
[camera.sensor.defects]
hot_pixels = [[3, 4], [345, 259]]
dead_share = 0.01
"""


@pytest.mark.parametrize(
    ("cls", "field", "value"),
    [
        (TemperatureParameters, "celsius", -300.0), (TemperatureParameters, "celsius", math.inf),
        (TemperatureParameters, "celsius", math.nan),
        (DefectParameters, "hot_share", 1.1), (DefectParameters, "dead_share", -0.1),
        (DefectParameters, "hot_hz", -1.0),
        (DefectParameters, "hot_spread", 4.0), (NoiseParameters, "rms", -0.1), (NoiseParameters, "rms", math.nan),
        (NoiseParameters, "corner_hz", 0.5), (NoiseParameters, "grade", "fine"),
        (JitterParameters, "latency_us", -1.0), (JitterParameters, "deviation_us", 1.0),
        (JitterParameters, "leak_share", 2.0), (ImagerParameters, "system_efficiency", 0.0),
        (ImagerParameters, "quantum_efficiency", -1.0), (ImagerParameters, "prnu", 0.5),
        (ImagerParameters, "dcnu", -1.0),
        (ImagerParameters, "electrons_per_s_at_reference", 0.0), (ImagerParameters, "shot_grid_us", 1),
        (RadiationParameters, "hits_per_cm2_s", -1.0), (RadiationParameters, "pixel_pitch_um", 0.0),
        (RadiationParameters, "depth_um", math.nan), (RadiationParameters, "off_share", 1.5),
        (RadiationParameters, "recovery_us", 0.0), (RadiationParameters, "dose_krad", -1.0),
        (RadiationParameters, "dose_krad_per_day", math.inf), (RadiationParameters, "hot_share_per_krad", 2.0),
        (ComparatorParameters, "on_us", -1.0), (ComparatorParameters, "off_us", math.nan),
        (ComparatorParameters, "contrast_per_e", 0.0),
        (ResetParameters, "offset", 2.0), (ResetParameters, "noise", -0.1),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_by_name_and_value(cls, field, value):
    with pytest.raises(ValueError, match=f"^{field} .*must be"):
        cls(**{field: value})


@pytest.mark.parametrize("name", ["hot_pixels", "dead_pixels"])
@pytest.mark.parametrize("place", [(346, 0), (0, 260), (-1, 5)])
def test_a_defect_must_lie_on_the_chip(name, place):
    with pytest.raises(ValueError, match=f"defects.{name}: .* within 346 x 260"):
        dataclasses.replace(PRESETS["davis346"], defects=DefectParameters(**{name: (place,)}))


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_switch_on_what_recordings_show_and_nothing_else(preset):
    p, plain = PRESETS[preset], SensorParameters(width=1, height=1, threshold_on=0.2, threshold_off=0.2)
    on = {name for name in EFFECTS if getattr(p, name) != getattr(plain, name)}
    on |= {"background"} if p.background != plain.background else set()
    chips = {name: {"noise"} for name in ("davis346", "davis346_noisy", "davis240c", "dvxplorer_micro")} | {
        "ideal": set()
    }
    assert on == chips.get(preset, {"background", "jitter", "noise", "temperature"})  # all of Prophesee's have these


def test_a_rig_gives_effects_as_tables():
    sensor = parse_rig(RIG, "rig.toml", "rig").camera.sensor
    assert sensor.noise == dataclasses.replace(PRESETS["davis346"].noise, rms=0.06)
    assert sensor.defects == DefectParameters(hot_pixels=((3, 4), (345, 259)), dead_share=0.01)
    assert sensor.parasitic_hz_at_reference == 0.2


@pytest.mark.parametrize(
    ("written", "instead", "message"),
    [
        ("rms = 0.06", "rms = -1.0", r"line 7: camera\.sensor\.noise\.rms: rms must be 0 to 1, got -1"),
        ("rms = 0.06", "sigma = 0.06", r"line 7: camera\.sensor\.noise\.sigma: .*not known"),
        ("dead_share = 0.01", "dead_share = 2.0", r"line 10: camera\.sensor\.defects\.dead_share: .* be 0 to 1, got 2"),
        ("[345, 259]", "[346, 259]", r"camera\.sensor\.defects.*\[346, 259\] must lie within"),
    ],
)
def test_a_mistake_in_an_effect_is_found_by_its_key(written, instead, message):
    with pytest.raises(RigError, match=message):
        parse_rig(RIG.replace(written, instead), "rig.toml", "rig")
