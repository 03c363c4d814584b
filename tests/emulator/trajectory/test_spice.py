"""Paths from SPICE kernels, beside the closed form that the kernels were made of."""

from pathlib import Path

import numpy as np
import pytest

from emulator.tables.typed_table import beside
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import SpicePath
from emulator.trajectory.pose import Trajectory, TrajectoryError
from emulator.trajectory.spice import SpiceTrajectory

spice = pytest.importorskip("spiceypy")

LSK = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT = ( 32, @1999-JAN-1 33, @2006-JAN-1 34, @2009-JAN-1 35, @2012-JUL-1 36, @2015-JUL-1 37, @2017-JAN-1 )
\\begintext
"""
FK = """KPL/FK
\\begindata
FRAME_TESTCAM = 1400001
FRAME_1400001_NAME = 'TESTCAM'
FRAME_1400001_CLASS = 4
FRAME_1400001_CLASS_ID = 1400001
FRAME_1400001_CENTER = -900
TKFRAME_1400001_RELATIVE = 'J2000'
TKFRAME_1400001_SPEC = 'ANGLES'
TKFRAME_1400001_UNITS = 'DEGREES'
TKFRAME_1400001_ANGLES = ( 0, -30, 0 )
TKFRAME_1400001_AXES = ( 1, 3, 1 )
\\begintext
"""
START_S = 631152069.184  # 2020-01-01T12:00:00 UTC less the periodic term of TDB
FROM_KM, SPEED_KM_S = np.array([-1000.0, 200.0, 50.0]), np.array([6.0, 0.5, -0.25])


@pytest.fixture
def kernels(tmp_path: Path) -> tuple[str, ...]:
    (tmp_path / "made.tls").write_text(LSK)
    (tmp_path / "made.tf").write_text(FK)
    ets = START_S + np.arange(-100.0, 401.0, 100.0)
    states = [[*(FROM_KM + SPEED_KM_S * (et - START_S)), *SPEED_KM_S] for et in ets]
    handle = spice.spkopn(str(tmp_path / "made.bsp"), "made", 0)
    spice.spkw13(handle, -900, 10, "J2000", ets[0], ets[-1], "fly-by", 3, len(ets), states, ets)
    spice.spkcls(handle)
    return tuple(str(tmp_path / name) for name in ("made.tls", "made.tf", "made.bsp"))


def fly_by(kernels: tuple[str, ...], **changed: object) -> Trajectory:
    keys = {"observer": "-900", "target": "SUN", "start_utc": "2020-01-01T12:00:00", "duration_s": 300.0}
    return build_trajectory(SpicePath(kernels=kernels, **(keys | changed)))  # type: ignore[arg-type]


def test_places_are_within_a_metre_of_the_closed_form(kernels: tuple[str, ...]) -> None:
    path = fly_by(kernels)
    offset_s = spice.str2et("2020-01-01T12:00:00") - START_S
    for t_s in np.random.default_rng(1).uniform(0, 300, 20):
        expected_m = 1e3 * (FROM_KM + SPEED_KM_S * (t_s + offset_s))
        pose = path.pose(round(t_s * 1e9))
        assert np.linalg.norm(pose.position_m - expected_m) < 1
        sight = -expected_m / np.linalg.norm(expected_m)
        assert np.linalg.norm(pose.world_from_body[:, 2] - sight) < np.radians(1 / 3600)


def test_the_frame_of_the_camera_is_that_of_spice(kernels: tuple[str, ...]) -> None:
    pose = fly_by(kernels, camera_frame="TESTCAM").pose(10**9)
    expected = spice.pxform("TESTCAM", "J2000", START_S)
    assert abs(expected[0, 1]) == pytest.approx(0.5)
    np.testing.assert_allclose(pose.world_from_body, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"duration_s": 900.0}, "cover 2020-01-01T11:58"),
        ({"observer": "NOBODY"}, "NOBODY"),
        ({"frame": "NOWHERE"}, "NOWHERE"),
        ({"start_utc": "soon"}, "UNPARSEDTIME"),
    ],
)
def test_what_the_kernels_lack_is_named(kernels: tuple[str, ...], changed: dict[str, object], message: str) -> None:
    with pytest.raises(TrajectoryError, match=message):
        fly_by(kernels, **changed)


def test_a_missing_or_damaged_kernel_is_named(kernels: tuple[str, ...], tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"none\.bsp is missing"):
        fly_by((*kernels, str(tmp_path / "none.bsp")))
    Path(kernels[2]).write_bytes(b"DAF/SPK " + b"\xff" * 2000)
    with pytest.raises(TrajectoryError, match="SPICE"):
        fly_by(kernels)


def test_kernels_lie_beside_the_rig(kernels: tuple[str, ...], tmp_path: Path) -> None:
    p = SpicePath(kernels=("made.tls", "none.bsp"), observer="-900", target="SUN", start_utc="2020-01-01")  # type: ignore[arg-type]
    assert beside(p, tmp_path).kernels == (kernels[0], "none.bsp")


def test_two_sets_of_kernels_do_not_disturb_each_other(kernels: tuple[str, ...]) -> None:
    first = fly_by(kernels)
    before = first.pose(0).position_m
    assert isinstance(fly_by(kernels[:1] + kernels[2:], camera_frame="J2000"), SpiceTrajectory)
    np.testing.assert_array_equal(first.pose(0).position_m, before)
