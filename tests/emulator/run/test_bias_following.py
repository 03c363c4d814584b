"""A sensor follows the biases that hosts write: thresholds measured from events, several links, refusals."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from emulator.run.changes import BiasFollowing, Change, Changes
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from firmware_protocol.davis346.biases import BIASES, CoarseFine, sensor_factors
from firmware_protocol.dvxplorer.device import Dvxplorer
from firmware_protocol.genx320.device import Genx320
from firmware_protocol.imx636.evk4 import Evk4
from firmware_protocol.packets.telecommands import SetBias
from firmware_protocol.prophesee.biases import BiasModel
from firmware_protocol.usb.device import SetupPacket
from transports.link.report import CameraSettings

ADDRESSES = {bias.name: bias.address for bias in BIASES}
DEFAULTS = {bias.address: int(bias.default) for bias in BIASES}
LN_RAMP = 20.0
START = {1: 10.0, -1: 10.0 * math.exp(LN_RAMP)}  # far above the dark current
IDEAL = dataclasses.replace(PRESETS["ideal"], width=8, height=4, threshold_on=0.283, threshold_off=0.262)


class Adjusted:
    """A sensor that remembers what was adjusted."""

    longest_step_ns = 1 << 62

    def __init__(self, refuses=()):
        self.adjustable = {"threshold_on": 0.2, "corner_max_hz": 3000.0}
        self.refuses = refuses

    def adjust(self, name, value):
        if name in self.refuses:
            raise ValueError(f"{name} is what it is")
        self.adjustable = {**self.adjustable, name: value}


def report(**factors):
    return CameraSettings(0, "register", factors)


def events_of_ramp(sensor, towards):
    """Events of one polarity that each pixel fires while the light goes by e^20 in a second, all of it bright."""
    t0_ns = sensor.pixels.settled_ns
    count = 0
    for k in range(1, 201):
        level = np.full((4, 8), START[towards] * math.exp(towards * LN_RAMP * k / 200), np.float32)
        events = sensor.expose(LightFrame(t0_ns + k * 5_000_000, level))
        count += np.count_nonzero(events["on"] == (towards > 0))
    return count / 32


@pytest.mark.parametrize(
    ("name", "value"), [("OnBn", CoarseFine(5, 60)), ("OnBn", CoarseFine(6, 200)), ("DiffBn", CoarseFine(4, 80))]
)
@pytest.mark.parametrize("towards", [1, -1])
def test_thresholds_measured_from_events_follow_the_formula(name, value, towards):
    sensor = Sensor(IDEAL, 1)
    sensor.reset(LightFrame(0, np.full((4, 8), START[towards], np.float32)))
    factors = sensor_factors({**DEFAULTS, ADDRESSES[name]: int(value)})
    BiasFollowing(sensor).follow("usbip", report(**factors))
    expected = (0.283 * factors["threshold_on"]) if towards > 0 else (0.262 * factors["threshold_off"])
    assert events_of_ramp(sensor, towards) == pytest.approx(LN_RAMP / expected, rel=0.03, abs=1)


def test_a_change_multiplies_what_is_there_and_goes_back():
    sensor = Adjusted()
    following = BiasFollowing(sensor)
    following.follow("usbip", report(threshold_on=2.0))
    sensor.adjust("threshold_on", 0.8)  # a slider
    following.follow("usbip", report(threshold_on=1.0))
    assert sensor.adjustable["threshold_on"] == pytest.approx(0.4)


def test_the_same_report_is_followed_once():
    sensor = Adjusted()
    following = BiasFollowing(sensor)
    for _ in range(3):
        following.follow("usbip", report(corner_max_hz=0.5))
        following.follow("serial", report())
    assert sensor.adjustable["corner_max_hz"] == pytest.approx(1500.0)


@pytest.mark.parametrize(("factor", "bound"), [(0.1, 0.1), (0.2, 0.1), (40.0, 1000.0), (1000.0, 1000.0)])
def test_the_biases_of_several_links_have_one_bound(factor, bound, caplog):
    sensor = Adjusted()
    following = BiasFollowing(sensor)
    for link in ("usbip", "serial", "can"):
        following.follow(link, report(threshold_on=factor))
    assert sensor.adjustable["threshold_on"] == pytest.approx(0.2 * bound)
    assert f"limited to {bound:g}" in caplog.text
    following.follow("serial", report(threshold_on=1.0))
    following.follow("can", report())
    assert sensor.adjustable["threshold_on"] == pytest.approx(0.2 * factor)
    following.follow("usbip", report(threshold_on=1.0))
    assert sensor.adjustable["threshold_on"] == pytest.approx(0.2)


def test_each_change_is_recorded_with_its_time_its_origin_and_both_values():
    sensor, changes = Adjusted(refuses=("corner_max_hz",)), Changes()
    following = BiasFollowing(sensor, changes)
    factors = {"threshold_on": 2.0, "corner_max_hz": 3.0, "unknown": 4.0}
    for t_us in (1_300, 1_700):
        following.follow("usbip", CameraSettings(t_us, "register", factors), 2_000_000)
    following.follow("serial", CameraSettings(2_000, "telecommand", {"threshold_on": 0.5}), 3_000_000)
    assert changes.listed == (
        Change(2_000_000, "register", "threshold_on", "usbip", 0.2, 0.4, 1_300),
        Change(3_000_000, "telecommand", "threshold_on", "serial", 0.4, 0.2, 2_000),
    )


def test_figures_that_the_sensor_lacks_or_refuses_are_left():
    sensor = Adjusted(refuses=("threshold_on",))
    BiasFollowing(sensor).follow("usbip", report(threshold_on=2.0, refractory_us=3.0, corner_max_hz=2.0))
    assert sensor.adjustable == {"threshold_on": 0.2, "corner_max_hz": 6000.0}


def test_what_has_no_effect_is_told_once(caplog):
    following = BiasFollowing(Adjusted())
    idle = CameraSettings(0, "register", without_effect={"hpf": "there is no high-pass"})
    for one in (idle, idle, report(), report(refractory_us=2.0), report(refractory_us=2.0)):
        following.follow("gige", one)
    assert [one.message for one in caplog.records] == [
        "gige: bias hpf has no effect: there is no high-pass",
        "gige: biases have no effect on refractory_us: this source of events cannot change it",
    ]


@pytest.mark.parametrize(("address", "value", "towards", "slope"), [(0x1104, 60, 1, 0.0286), (0x110C, 19, -1, 0.0416)])
def test_thresholds_of_a_genx320_measured_from_events_follow_its_registers(address, value, towards, slope):
    camera, opened = Genx320(), {0x1104: 25, 0x110C: 28}
    camera.write_register(address, 0x1101_0000 | value)
    sensor = Sensor(dataclasses.replace(IDEAL, threshold_on=0.223, threshold_off=0.223), 1)
    sensor.reset(LightFrame(0, np.full((4, 8), START[towards], np.float32)))
    BiasFollowing(sensor).follow("usbip", report(**camera.sensor_factors))
    expected = 0.223 * math.exp(slope * (value - opened[address]))
    assert events_of_ramp(sensor, towards) == pytest.approx(LN_RAMP / expected, rel=0.03, abs=1)


@pytest.mark.parametrize("steps", [-85, -30, 60, 140])
@pytest.mark.parametrize(("bias", "towards"), [("diff_on", 1), ("diff_off", -1)])
def test_thresholds_of_an_imx636_measured_from_events_follow_the_slopes(bias, steps, towards):
    imx636 = dataclasses.replace(IDEAL, threshold_on=0.223, threshold_off=0.223)
    sensor = Sensor(imx636, 1)
    slope = 0.0143 if bias == "diff_on" else (0.0208 if steps < 0 else 0.0136)
    expected = 0.223 * math.exp(min(slope * steps, 1.0))
    sensor.reset(LightFrame(0, np.full((4, 8), START[towards], np.float32)))
    BiasFollowing(sensor).follow("gige", report(**BiasModel().factors({bias: steps})))
    assert events_of_ramp(sensor, towards) == pytest.approx(LN_RAMP / expected, rel=0.03, abs=1)


@pytest.mark.parametrize("steps", [-35, 55])
def test_the_low_pass_of_an_imx636_follows_its_bias(steps):
    """The first event after a small step of bright light comes when 1 - exp(-2 pi f t) has reached the threshold."""
    corner_hz, rise = 3000.0, 0.3
    imx636 = dataclasses.replace(IDEAL, threshold_on=0.2, corner_hz_at_reference=1e6, corner_max_hz=corner_hz)
    sensor = Sensor(imx636, 1)
    sensor.reset(LightFrame(0, np.full((4, 8), 10.0, np.float32)))
    BiasFollowing(sensor).follow("gige", report(**BiasModel().factors({"fo": steps})))
    sensor.expose(LightFrame(1_000_000, np.full((4, 8), 10.0, np.float32)))
    sensor.expose(LightFrame(1_000_001, np.full((4, 8), 10.0 * math.exp(rise), np.float32)))
    events = sensor.expose(LightFrame(3_000_000, np.full((4, 8), 10.0 * math.exp(rise), np.float32)))
    first_s = (events["t"].astype(float).mean() - 1000.5) * 1e-6  # stamps are whole microseconds, cut off
    assert len(events) == 32
    expected_s = math.log(rise / (rise - 0.2)) / (2 * math.pi * corner_hz * (1 + 0.012 * steps))
    assert first_s == pytest.approx(expected_s, rel=0.03)


def test_the_high_pass_of_an_evk4_follows_its_bias():
    """After a jump by 1 of log light the pixel falls by an OFF threshold, 0.223, when e^-2 pi f t has."""
    camera, sensor = Evk4(), Sensor(dataclasses.replace(IDEAL, threshold_on=0.223, threshold_off=0.223), 1)
    camera.write_register(0x100C, 0x11A1_0000 | 40)
    sensor.reset(LightFrame(0, np.full((4, 8), 1.0, np.float32)))
    sensor.expose(LightFrame(10_000_000, np.full((4, 8), 1.0, np.float32)))  # at rest, and skipped
    BiasFollowing(sensor).follow("usbip", report(**camera.sensor_factors))
    bright = np.full((4, 8), math.e, np.float32)
    sensor.expose(LightFrame(10_000_001, bright))
    events = sensor.expose(LightFrame(20_000_000, bright))
    off_us = events["t"][~events["on"]][:32] - 10_000
    jump = math.log((math.e + IDEAL.dark_current_relative) / (1 + IDEAL.dark_current_relative))
    first_us = 1e6 * math.log(jump / (3 * 0.223)) / (2 * math.pi * 40.0)  # the references are 4 thresholds up
    assert off_us == pytest.approx(first_us, abs=2)


def test_the_cut_offs_of_links_add_and_go_back_to_none():
    sensor = Adjusted()
    sensor.adjustable["highpass_hz"] = 0.0
    following = BiasFollowing(sensor)
    following.follow("usbip", report(highpass_hz=0.3))
    following.follow("serial", report(highpass_hz=0.7))
    assert sensor.adjustable["highpass_hz"] == 1.0
    following.follow("usbip", report())
    assert sensor.adjustable["highpass_hz"] == 0.7
    following.follow("serial", report())
    assert sensor.adjustable["highpass_hz"] == 0.0


@pytest.mark.parametrize(("steps", "refractory_us"), [(-10, 20_000.0), (20, 5000.0)])
def test_the_refractory_period_of_an_imx636_follows_its_bias(steps, refractory_us):
    """On a ramp, events of a pixel are threshold / slope + refractory period apart."""
    imx636 = dataclasses.replace(IDEAL, refractory_us=10_000.0)
    sensor = Sensor(imx636, 1)
    sensor.reset(LightFrame(0, np.full((4, 8), START[1], np.float32)))
    BiasFollowing(sensor).follow("gige", report(**BiasModel().factors({"refr": steps})))
    apart_us = 1e6 / events_of_ramp(sensor, 1)
    assert apart_us == pytest.approx(1e6 * 0.283 / LN_RAMP + refractory_us, rel=0.03)


SERIAL_RIG = """
title = "t"
[scene]
kind = "checkerboard"
[camera]
model = "{model}"
[[links]]
kind = "serial"
"""


@pytest.mark.parametrize(
    ("model", "number", "value", "factor"),
    [("davis346", ADDRESSES["RefrBp"], int(CoarseFine(4, 50, n_type=False)), 0.5), ("evk4", 8, 40, 0.5),
     ("triton2", 8, 30, 2 / 3), ("imx636", 8, 40, 0.5)],
)  # fmt: skip
def test_telecommands_set_the_biases_of_the_camera_s_own_chip(model, number, value, factor):
    (setup,) = link_setups(parse_rig(SERIAL_RIG.format(model=model), "t.toml", "t"))
    instrument = setup.device()
    instrument.execute(SetBias(number, value))
    assert instrument.sensor_factors["refractory_us"] == pytest.approx(factor)


def test_the_scan_of_a_dvxplorer_follows_the_rate_that_its_host_writes():
    sensor = Sensor(dataclasses.replace(PRESETS["dvxplorer_micro"], width=8, height=8), 0)
    camera, following = Dvxplorer(), BiasFollowing(sensor)
    exposure_us = SetupPacket(0x40, 0xBF, 5, 0x3241, 4), SetupPacket(0x40, 0xBF, 5, 0x3242, 4)
    camera.attached()
    for setup, value in zip(exposure_us, (307 >> 8, 307 & 0xFF), strict=True):  # "variable 2000" of dv-processing
        camera.control(setup, value.to_bytes(4, "big"))
    following.follow("usb", report(**camera.sensor_factors))
    assert sensor.adjustable["scan_us"] == pytest.approx(197.28 * 499 / 199)
    camera.attached()
    following.follow("usb", report(**camera.sensor_factors))
    assert sensor.adjustable["scan_us"] == pytest.approx(197.28)
