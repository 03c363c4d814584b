"""What the stars scene draws into arrays that it knows, and which parts of them it says have changed."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.optics.lens import LensParameters
from emulator.photometry.reflectance import Sun
from emulator.rig.kinds import CAMERA_MODELS
from emulator.scene.stars.stars import StarField
from emulator.scene.stars.table import MovingPoint, StarsParameters
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from emulator.trajectory.parameters import Keyframe, KeyframePath, SpinPath

SIZE = (192, 144)
LENS = LensParameters(field_of_view_deg=20.0, blur_px=0.6, f_number=1.4)
STEP_NS = 5_000_000
PATH = KeyframePath((Keyframe(0.0, (-2000.0, 19000.0, -1500.0)), Keyframe(2.0, (2000.0, 19000.0, -1500.0))))
SKY = StarsParameters(
    faintest_v=6.0,
    sky_w_m2_sr=1e-7,
    camera=SpinPath(pole=(0, 0, 1), tilt_deg=-90, precession_deg_s=-4.0),
    sun=Sun(direction=(0, -1, 0.2)),
    points=(MovingPoint(radius_m=1.0, albedo=0.4, path=PATH),),
)


@pytest.fixture
def scene():
    with StarField(SKY, SIZE, LENS, CAMERA_MODELS["davis346"].chip) as stars:
        yield stars


def pictures():
    return tuple(np.full(SIZE[::-1], np.nan, np.float32) for _ in range(2))


def drawn_afresh(scene, t_ns):
    arrays = pictures()
    scene.light_and_rate(t_ns, *arrays)
    return arrays


def test_pictures_in_the_same_arrays_are_those_in_new_ones(scene):
    arrays = pictures()
    with StarField(SKY, SIZE, LENS, CAMERA_MODELS["davis346"].chip) as other:
        for k in range(30):
            scene.light_and_rate(k * STEP_NS, *arrays)
            for mine, fresh in zip(arrays, drawn_afresh(other, k * STEP_NS), strict=True):
                np.testing.assert_array_equal(mine, fresh)


def test_all_changes_lie_in_the_boxes_and_little_else(scene):
    arrays = pictures()
    scene.light_and_rate(0, *arrays)
    assert scene.changed is None
    for k in range(1, 30):
        before = [part.copy() for part in arrays]
        scene.light_and_rate(k * STEP_NS, *arrays)
        told = np.zeros(SIZE[::-1], bool)
        for first_row, last_row, first_column, last_column in scene.changed.boxes:
            told[first_row:last_row, first_column:last_column] = True
        assert scene.changed.bounds == (0, SIZE[1], 0, SIZE[0])
        changed = (arrays[0] != before[0]) | (arrays[1] != before[1])
        assert changed.sum() > 200
        assert not changed[~told].any()
        assert told.mean() < 0.5


@pytest.mark.parametrize("preset", ["davis346", "imx636"])
def test_a_sensor_that_is_told_gives_the_events_of_the_full_pass(preset):
    sky = dataclasses.replace(SKY, faintest_v=3.0)  # few stars: blocks between them rest
    parameters = dataclasses.replace(PRESETS[preset], width=SIZE[0], height=SIZE[1])
    told, full = Sensor(parameters, 1), Sensor(parameters, 1)
    arrays, scene = pictures(), StarField(sky, SIZE, LENS, CAMERA_MODELS["davis346"].chip)
    scene.light_and_rate(0, *arrays)
    for sensor in (told, full):
        sensor.reset(LightFrame(0, arrays[0]))
    events, skipped = 0, 0
    for k in range(1, 200):
        scene.light_and_rate(k * STEP_NS, *arrays)
        full.pixels.wake()
        found = [
            sensor.expose(LightFrame(k * STEP_NS, arrays[0], arrays[1], None, changed))
            for sensor, changed in ((told, scene.changed), (full, None))
        ]
        assert np.array_equal(*found)
        events += len(found[0])
        skipped += int((told.pixels._workers.idle.until_ns > 0).sum())
    assert events > 500
    assert skipped > 0
    assert np.array_equal(told.pixels.state.fields, full.pixels.state.fields, equal_nan=True)
