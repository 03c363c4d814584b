"""Frozen classes keep the arrays, lists and mappings that they are given: later changes do not act."""

import dataclasses
import types
import typing

import numpy as np
import pytest

import evstim
from firmware_protocol.recordings.part import IMU

SHARED = (tuple, np.ndarray, dict, typing.get_origin(typing.Mapping[str, int]))
EXAMPLES = {
    "BasiliskPath": {"camera": 1},
    "BodiesScene": {"bodies": (evstim.Body(shape="globe"),)},
    "CanLink": {"channel": "vcan0"},
    "ClockStep": {"at_s": 1.0, "by_us": 1.0},
    "FilePath": {"path": "a.csv"},
    "Frame": {"t_us": 1, "exposure_begin_us": 0, "exposure_end_us": 2, "pixels": np.zeros((2, 3), np.uint8)},
    "Heightmap": {"path": "a.tif"},
    "Keyframe": {"t_s": 0.0, "position_m": (1.0, 2.0, 3.0)},
    "OrbitPath": {"gm_m3_s2": 4e5, "semi_major_axis_m": 5e4},
    "Pose": {"position_m": np.zeros(3), "q_world_from_body": np.array([1.0, 0.0, 0.0, 0.0])},
    "Rig": {"name": "a", "title": "b", "scene": evstim.CheckerboardScene()},
    "SceneTruth": {name: np.zeros((2, 3)) for name in ("depth", "flow", "labels")},
    "SecondCamera": {"links": ("a",)},
    "SimulationStep": {
        "t_us": 1, "events": np.zeros(3, evstim.EVENT), "light": np.zeros((2, 3), np.float32),
        "imu": np.zeros(1, IMU), "frames": (), "truth": None,
    },
    "SpicePath": {"kernels": ("a.bsp",), "observer": "1", "target": "2", "start_utc": "2004-06-11T19:00:00"},
    "Trigger": {"edges": (evstim.TriggerEdges(1.0),)},
    "TruthSequence": {
        "index": 0, "seed": 1, "values": {"a": 1}, "arrays": {"light": np.zeros(3)}, "names": (), "digest": "",
    },
}  # fmt: skip
RUN = {"sim_seconds": 1.0, "wall_seconds": 1.0, "frames": 1, "lateness": None}
EXAMPLES["RunStatus"] = RUN | {"read_out": 0, "links": {}}
EXAMPLES["RunResult"] = RUN | {"steps": 1, "ledger": None}
NOT_GIVEN = {"SimulationState"}  # its content is bytes


def members(annotation):
    """Yield the classes that an annotation allows."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, typing.Annotated):
        for inner in typing.get_args(annotation):
            yield from members(inner)
    else:
        yield typing.get_origin(annotation) or annotation


def fields():
    """Yield name and field of each public frozen class that may be given something that can change."""
    for name in evstim.__all__:
        cls = getattr(evstim, name)
        if dataclasses.is_dataclass(cls) and isinstance(cls, type):
            hints = typing.get_type_hints(cls)
            for field in dataclasses.fields(cls):
                if field.init and any(member in SHARED for member in members(hints[field.name])):
                    yield pytest.param(name, field.name, id=f"{name}.{field.name}")


def changeable(value):
    """Return a value as lists, dicts and arrays that can be written to."""
    match value:
        case np.ndarray():
            return value.copy()
        case dict():
            return {key: changeable(item) for key, item in value.items()}
        case tuple() if value and all(isinstance(item, int | float) for item in value):
            return np.array(value)
        case tuple():
            return list(value)
        case None:
            return np.array([1.0, 2.0, 3.0])
    return value


def change(value):
    if isinstance(value, np.ndarray):
        value.view(np.uint8)[...] = 7
    elif isinstance(value, dict):
        for item in value.values():
            change(item) if isinstance(item, np.ndarray | dict) else None
        value["later"] = 1
    else:
        value.append("later")


def flat(value):
    """Return a value that can be compared, and fail for an array that can be written to."""
    if isinstance(value, np.ndarray):
        assert not value.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            value[...] = 0
        return value.tolist()
    if isinstance(value, dict):
        return {key: flat(item) for key, item in value.items()}
    assert not isinstance(value, list)
    return value


@pytest.mark.parametrize(("name", "field"), [*fields()])
def test_what_is_given_may_change_afterwards(name, field):
    cls = getattr(evstim, name)
    assert cls.__dataclass_params__.frozen
    if name in NOT_GIVEN:
        return
    arguments = EXAMPLES.get(name, {})
    given = changeable(getattr(cls(**arguments), field))
    try:
        made = cls(**arguments | {field: given})
    except ValueError:  # three numbers are none of this field
        given = np.array([1.0, 2.0])
        made = cls(**arguments | {field: given})
    before = flat(getattr(made, field))
    change(given)
    assert flat(getattr(made, field)) == before


def test_the_test_finds_the_classes():
    found = {param.values[0] for param in fields()}
    assert {"Pose", "Keyframe", "FixedPath", "Delivery", "Frame", "SimulationStep", "Rig", "CanLink", "Sun"} <= found


def test_lists_in_lists_and_numbers_of_numpy():
    pixels = [[1, 2], np.array([3, 4])]
    table = evstim.DefectParameters(hot_pixels=pixels)
    pixels[0][0] = 9
    assert table.hot_pixels == ((1, 2), (3, 4))
    run = evstim.RunParameters(step_us=np.int64(500), seconds=np.float32(0.5))
    assert [type(run.step_us), type(run.seconds)] == [int, float]
    assert evstim.FixedPath(position_m=np.arange(3)).position_m == (0, 1, 2)
    frame = evstim.Frame(np.int64(5), 0, 9, np.zeros((2, 3), np.uint8))
    assert (type(frame.t_us), frame.t_us) == (int, 5)


@pytest.mark.parametrize("made", [lambda a: a, lambda a: a[::2], lambda a: a.view()])
def test_a_read_only_view_of_the_caller_s_memory_is_copied(made):
    memory = np.zeros(6)
    view = made(memory)[:3]
    view.flags.writeable = False
    pose = evstim.Pose(view, [1, 0, 0, 0])
    truth = evstim.SceneTruth(depth=view)
    memory[:] = 5
    assert pose.position_m.tolist() == truth.depth.tolist() == [0, 0, 0]


def test_a_frame_of_light_may_be_drawn_over_by_its_owner():
    def events(renewed):
        light = np.full((48, 64), 0.3, np.float32)
        sensor = evstim.Sensor("davis346", seed=1, width=64, height=48)
        sensor.reset(renewed(light), 0)
        parts = []
        for step in range(1, 6):
            light[:, 10:30] *= 1.4
            parts.append(sensor.expose(renewed(light), step * 1_000_000))
            light[:, 10:30] += 0.0
        return np.concatenate([*parts, sensor.finish()])

    np.testing.assert_array_equal(events(lambda light: light), events(np.copy))
