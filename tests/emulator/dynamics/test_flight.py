"""A flight: poses in order, with their times, and no pose of numbers that are none."""

import math

import pytest

from emulator.dynamics.flight import FlightEnded, Mapping, Pace, fly
from firmware_protocol.pose_message import NOW, PoseMessage


class Body:
    """Moves by 1 m a step along x, until `breaks`."""

    def __init__(self, **outputs):
        self.outputs = {"x": 0.0, **outputs}
        self.given = []

    def step(self, t_s, step_s, inputs):
        self.outputs["x"] += 1
        self.given.append((t_s, inputs))


class Commands:
    names = ("thrust",)

    def at(self, t_s):
        return {"thrust": t_s}


MAPPING = Mapping(position_m=("x", 0.0, 5.0), step_s=0.5, body=2)


def flown(body, pace, mapping=MAPPING):
    sent = []
    told = fly(body, mapping, [Commands()], pace, sent.append)
    return told, [PoseMessage.parse(bytes(message)) for message in sent]


def test_each_step_is_a_pose_with_its_time():
    told, poses = flown(Body(), Pace(2.0, True, lambda _: True))
    assert [pose.t_ns for pose in poses] == [0, 500_000_000, 1_000_000_000, 1_500_000_000, 2_000_000_000]
    assert [pose.position_m for pose in poses] == [(float(k), 0.0, 5.0) for k in range(5)]
    assert [(pose.counter, pose.body) for pose in poses] == [(k, 2) for k in range(5)]
    assert (told.steps, told.t_s) == (4, 2.0)


def test_inputs_are_set_before_the_step():
    body = Body()
    flown(body, Pace(1.0, True, lambda _: True))
    assert body.given == [(0.0, {"thrust": 0.0}), (0.5, {"thrust": 0.5})]


def test_it_ends_when_the_pace_says_so_and_poses_hold_from_their_arrival():
    waited = []
    told, poses = flown(Body(), Pace(9.0, False, lambda t_s: waited.append(t_s) or t_s < 1.2))
    assert waited == [0.5, 1.0, 1.5]
    assert told.steps == 2
    assert {pose.t_ns for pose in poses} == {NOW}


@pytest.mark.parametrize(
    ("outputs", "mapping", "told"),
    [
        ({"x": math.nan}, MAPPING, "at 0 s the FMU gives x = nan: no pose"),
        ({"x": 1e16}, MAPPING, "more than 1e"),
        ({"w": 0.5}, Mapping(position_m=(0.0, 0.0, 0.0), q_world_from_body=("w", 0.0, 0.0, 0.0)), "unit quaternion"),
    ],
)
def test_numbers_that_are_no_pose(outputs, mapping, told):
    with pytest.raises(FlightEnded, match=told):
        flown(Body(**outputs), Pace(1.0, True, lambda _: True), mapping)


def test_a_quaternion_that_drifts_is_brought_to_unit_length():
    mapping = Mapping(position_m=(0.0, 0.0, 0.0), q_world_from_body=("w", 0.0, 0.0, 0.0))
    _, poses = flown(Body(w=1.005), Pace(0.5, True, lambda _: True), mapping)
    assert poses[0].q_world_from_body == (1.0, 0.0, 0.0, 0.0)
