"""What biases written by an unmodified neuromorphic_drivers do, measured from the events that it gets.

The light is known in closed form, see `known_ramp`. The driver gets the events over GigE Vision on the loopback
interface, so nothing of the camera's own is used to read them.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.guest.gige_run import RigRun
from tests.guest.known_ramp import apart_us, expected_us, save_frames
from tests.guest.test_gige import where_libusb_starts

CLIENT = Path(__file__).with_name("clients") / "nd_gige_biases.py"
SECONDS = 2.0
THRESHOLD, REFRACTORY_US = 0.2, 2000.0
ROUNDING_US = 2
ON_SLOPE, OFF_SLOPE, OFF_SLOPE_ABOVE = 0.0143, 0.01, 0.0136  # of the preset, but for the second, which the rig sets
LARGEST = 1.0  # logarithm of a threshold over the factory's, beyond which it rises no more
RIG = """
title = "light whose logarithm goes up and down on straight lines"
[scene]
kind = "video"
path = "triangle.npy"
frames_per_s = 2.0
floor = 1e-6
[camera]
model = "triton2"
[camera.bias_slopes]
diff_off = 0.01
[camera.sensor]
width = 16
height = 12
threshold_on = {threshold}
threshold_off = {threshold}
refractory_us = {refractory_us}
mismatch = 0.0
corner_hz_at_reference = inf
corner_max_hz = inf
dark_current_relative = 1e-6
[camera.sensor.noise]
rms = 0.0
[camera.sensor.background]
hz = 0.0
hot_share = 0.0
[run]
step_us = 1000
max_late_ms = 0
[[links]]
kind = "gige"
host = "{host}"
"""

pytestmark = [pytest.mark.guest, pytest.mark.socket]


@pytest.fixture
def run(tmp_path, address):
    save_frames(tmp_path / "triangle.npy", 16, 12, (16, 12))
    run = RigRun(tmp_path, RIG.format(threshold=THRESHOLD, refractory_us=REFRACTORY_US, host=address))
    yield run
    run.kill()


def of_biases(exponent):
    return expected_us(THRESHOLD * math.exp(exponent), REFRACTORY_US)


@pytest.mark.long
def test_thresholds_and_refractory_period_follow_what_the_driver_writes(tmp_path, run, address, driver_pythons):
    sets = [{}, {"diff_on": 100, "diff_off": -35}, {"diff_on": -85, "diff_off": 60}, {"refr": -10}]
    asked = [str(driver_pythons["nd"]), str(CLIENT), address, str(SECONDS), str(tmp_path / "seen.npz")]
    command = [*where_libusb_starts(), *asked, *map(json.dumps, sets)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    run.stop()
    with np.load(tmp_path / "seen.npz") as seen:
        measured = [[apart_us(seen[str(k)], on=on) for on in (True, False)] for k in range(len(sets))]
    expected = [
        [expected_us(THRESHOLD, REFRACTORY_US)] * 2,
        [of_biases(LARGEST), of_biases(OFF_SLOPE * -35)],
        [of_biases(ON_SLOPE * -85), of_biases(OFF_SLOPE_ABOVE * 60)],
        [expected_us(THRESHOLD, 2 * REFRACTORY_US)] * 2,
    ]
    deviation = np.abs(np.divide(measured, expected) - 1).max()
    sys.stdout.write(f"largest deviation {deviation:.2%}\n")
    assert np.allclose(measured, expected, rtol=0.01, atol=ROUNDING_US), (measured, expected)
