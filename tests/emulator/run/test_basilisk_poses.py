"""Poses from Basilisk's updates, against its own library's figures."""

import sys
from pathlib import Path

import numpy as np
import pytest

from emulator.geometry.attitude import matrix_of
from emulator.run.basilisk import pose_of
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import BasiliskPath
from emulator.trajectory.pose import TrajectoryError
from firmware_protocol.vizard import Update

sys.path.insert(0, str(Path(__file__).parents[2] / "firmware_protocol" / "vizard"))

from wire_writer import bsk_update, update


def test_a_camera_as_basilisk_places_it():
    """The matrix and the place are by Basilisk's RigidBodyKinematics, from sigma_BN and the scenario's sigma_CB."""
    pose = pose_of(BasiliskPath(camera=1, origin="eros"), Update(bsk_update()))
    world_from_camera = [
        [0.8244082318701929, 0.272341453454606, -0.4961665042653469],
        [0.5649033582586673, -0.45035225724476025, 0.6914239222232832],
        [-0.0351463092335676, -0.8503016977078087, -0.5251207097634565],
    ]
    assert matrix_of(pose.q_world_from_body) == pytest.approx(np.array(world_from_camera), abs=1e-12)
    assert pose.position_m == pytest.approx([90207.46769193135, -150346.0511425824, 96221.9722893931], abs=1e-4)


def test_a_celestial_body_as_basilisk_turns_it():
    pose = pose_of(BasiliskPath(body="eros", origin="eros"), Update(bsk_update()))
    assert not pose.position_m.any()
    body_from_n = matrix_of(pose.q_world_from_body).T
    assert body_from_n[0] == pytest.approx([-0.025314061929947923, 0.87822537297269265, -0.47757658290119481])
    assert body_from_n[2] == pytest.approx([0.93649500017231824, 0.18798019199464927, 0.29604148707555239])


def test_a_camera_on_a_turned_spacecraft():
    """Figures that Basilisk's MRP2C gave for sigma_BN and sigma_CB = (0.05, 0.15, -0.25)."""
    data = update(
        0.0,
        [("craft", [1000.0, 2000.0, 3000.0], [0.1, -0.2, 0.3])],
        cameras=[(2, "craft", [0.1, 0.2, 0.3], [0.554285714285714, 0.371428571428571, -0.737142857142857])],
    )
    pose = pose_of(BasiliskPath(camera=2), Update(data))
    assert pose.q_world_from_body == pytest.approx([0.955636, 0.232708, 0.042751, 0.175439], abs=1e-6)
    assert pose.position_m == pytest.approx([999.733118, 1999.953770, 3000.258141], abs=1e-6)
    assert pose.world_from_body[:, 2] == pytest.approx([0.163360, -0.429769, 0.888039], abs=1e-6)


def test_the_switching_point_of_mrps_looks_straight_down():
    data = update(0.0, [("craft", [0.0, 0.0, 5.0], [1.0, 0.0, 0.0])])
    pose = pose_of(BasiliskPath(spacecraft="craft"), Update(data))
    assert pose.q_world_from_body == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-12)
    assert pose.position_m[2] == 5.0


@pytest.mark.parametrize(
    ("path", "data", "why"),
    [
        (
            BasiliskPath(camera=7),
            bsk_update(),
            "simulated time 0.04 s: there is no camera 7 in the update; there are: 1",
        ),
        (BasiliskPath(spacecraft="moth"), bsk_update(), "no spacecraft 'moth'"),
        (BasiliskPath(camera=1, origin="moon"), bsk_update(), "no celestial body 'moon'"),
        (BasiliskPath(body="b"), update(0.0, (), [("b", [0.0] * 3, [1.0] * 9)]), "'b' is no rotation"),
        (BasiliskPath(body="b"), update(0.0, (), [("b", [0.0] * 3, [1e300] * 9)]), "'b' is no rotation"),
        (BasiliskPath(spacecraft="s"), update(0.0, [("s", [1e300, 0.0, 0.0], [0.0] * 3)]), "three finite metres"),
        (BasiliskPath(spacecraft="s"), update(0.0, [("s", [0.0] * 3, [float("nan")] * 3)]), "must be finite"),
        (BasiliskPath(spacecraft="s"), update(0.0, [("s", [0.0] * 3, [1e300] * 3)]), "too large for an attitude"),
    ],
)
def test_what_cannot_be_used_is_named(path, data, why):
    with pytest.raises(TrajectoryError, match=why):
        pose_of(path, Update(data))


@pytest.mark.parametrize(
    "keys", [{}, {"camera": 1, "body": "eros"}, {"camera": 1, "q_world_from_body": (2.0, 0, 0, 0)}]
)
def test_a_path_names_one_thing(keys):
    with pytest.raises(ValueError, match=r"one of camera|unit quaternion"):
        BasiliskPath(**keys)


def test_without_a_simulation_the_path_stays_where_the_rig_says():
    path = build_trajectory(BasiliskPath(camera=1, position_m=(1.0, 2.0, 3.0)))
    assert list(path.pose(10**12).position_m) == [1.0, 2.0, 3.0]
    assert path.bounds.speed_m_s == path.bounds.turn_rad_s == float("inf")
