"""Paths from SPICE kernels, beside the closed form that the kernels were made of."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from emulator.rig.loading import RigError, load_rig
from emulator.rig.remarks import open_files
from emulator.scene.bodies.table import BodiesParameters
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import SpicePath
from emulator.trajectory.pose import TrajectoryError

spice = pytest.importorskip("spiceypy", reason="needs the extra `spice`")
pytestmark = pytest.mark.system  # a path is read in a child process

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
RATE = np.radians(1.0)
SPIN_FK = """KPL/FK
\\begindata
FRAME_SPINCAM = -900000
FRAME_-900000_NAME = 'SPINCAM'
FRAME_-900000_CLASS = 3
FRAME_-900000_CLASS_ID = -900000
FRAME_-900000_CENTER = -900
CK_-900000_SCLK = -900
CK_-900000_SPK = -900
\\begintext
"""
SCLK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID = ( @2020-01-01/00:00:00 )
SCLK_DATA_TYPE_900 = ( 1 )
SCLK01_TIME_SYSTEM_900 = ( 1 )
SCLK01_N_FIELDS_900 = ( 2 )
SCLK01_MODULI_900 = ( 4294967296 65536 )
SCLK01_OFFSETS_900 = ( 0 0 )
SCLK01_OUTPUT_DELIM_900 = ( 1 )
SCLK_PARTITION_START_900 = ( 0.0 )
SCLK_PARTITION_END_900 = ( 2.8E14 )
SCLK01_COEFFICIENTS_900 = ( 0.0 6.3E8 1.0 )
\\begintext
"""
START_S = 631152069.184  # 2020-01-01T12:00:00 UTC less the periodic term of TDB
FROM_KM, SPEED_KM_S = np.array([-1000.0, 200.0, 50.0]), np.array([6.0, 0.5, -0.25])


@pytest.fixture
def kernels(tmp_path):
    (tmp_path / "made.tls").write_text(LSK)
    (tmp_path / "made.tf").write_text(FK)
    ets = START_S + np.arange(-100.0, 401.0, 100.0)
    states = [[*(FROM_KM + SPEED_KM_S * (et - START_S)), *SPEED_KM_S] for et in ets]
    handle = spice.spkopn(str(tmp_path / "made.bsp"), "made", 0)
    spice.spkw13(handle, -900, 10, "J2000", ets[0], ets[-1], "fly-by", 3, len(ets), states, ets)
    spice.spkw13(handle, 10, 0, "J2000", ets[0], ets[-1], "at rest", 3, len(ets), np.zeros((len(ets), 6)), ets)
    spice.spkcls(handle)
    return tuple(str(tmp_path / name) for name in ("made.tls", "made.tf", "made.bsp"))


def fly_by(kernels, **changed):
    keys = {"observer": "-900", "target": "SUN", "start_utc": "2020-01-01T12:00:00", "duration_s": 300.0}
    return build_trajectory(SpicePath(kernels=kernels, **(keys | changed)))  # type: ignore[arg-type]


def test_places_are_those_of_the_closed_form(kernels, start_s):
    path, offset_s = fly_by(kernels), start_s - START_S
    for t_s in np.random.default_rng(1).uniform(0, 300, 20):
        expected_m = 1e3 * (FROM_KM + SPEED_KM_S * (t_s + offset_s))
        pose = path.pose(round(t_s * 1e9))
        assert np.linalg.norm(pose.position_m - expected_m) < 0.2
        sight = -expected_m / np.linalg.norm(expected_m)
        assert np.linalg.norm(pose.world_from_body[:, 2] - sight) < np.radians(1 / 3600)


def test_the_frame_of_the_camera_is_that_of_spice(kernels):
    pose = fly_by(kernels, camera_frame="TESTCAM").pose(10**9)
    spice.furnsh(kernels[1])
    expected = spice.pxform("TESTCAM", "J2000", START_S)
    spice.kclear()
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
def test_what_the_kernels_lack_is_named(kernels, changed, message):
    with pytest.raises(TrajectoryError, match=message):
        fly_by(kernels, **changed)


def test_a_missing_or_damaged_kernel_is_named(kernels, tmp_path):
    with pytest.raises(TrajectoryError, match=r"none\.bsp is missing"):
        fly_by((*kernels, str(tmp_path / "none.bsp")))
    Path(kernels[2]).write_bytes(b"DAF/SPK " + b"\xff" * 2000)
    with pytest.raises(TrajectoryError, match="SPICE"):
        fly_by(kernels)


def test_a_kernel_that_ends_spice_by_a_signal_is_refused_by_name(kernels):
    """Two changed octets: the segment's data count as Chebyshev polynomials, of which each has 65536 coefficients."""
    data = bytearray(Path(kernels[2]).read_bytes())
    summary = data.index(np.array([-900, 10], "<i4").tobytes())  # target, observer, frame, type, first and last word
    last_word = int.from_bytes(data[summary + 20 : summary + 24], "little")
    data[summary + 12], data[8 * last_word - 9] = 2, 0x40
    Path(kernels[2]).write_bytes(data)
    with pytest.raises(TrajectoryError, match=r"made\.bsp: its reader ended by SIGSEGV: the file is damaged"):
        fly_by(kernels)


MU_KM3_S2, AXIS_KM, ECCENTRICITY = 4902.8, 1938.0, 0.05
PERIOD_S = 2 * np.pi * (AXIS_KM**3 / MU_KM3_S2) ** 0.5


def conic_km(t_s):
    """Place on an orbit in the plane of x and y, by Kepler's equation; its pericentre at time 0 on x."""
    mean = 2 * np.pi * t_s / PERIOD_S
    e = brentq(lambda e: e - ECCENTRICITY * np.sin(e) - mean, mean - 1, mean + 1, xtol=1e-14)
    across = AXIS_KM * (1 - ECCENTRICITY**2) ** 0.5
    return np.array([AXIS_KM * (np.cos(e) - ECCENTRICITY), across * np.sin(e), 0.0])


@pytest.fixture
def start_s(kernels):
    """Seconds of SPICE at time 0 of the paths."""
    spice.furnsh(kernels[0])
    start_s = float(spice.str2et("2020-01-01T12:00:00"))
    spice.kclear()
    return start_s


def test_an_orbit_is_that_of_keplers_equation(kernels, start_s, tmp_path):
    """SPICE propagates two bodies from one state (SPK type 5), from pericentre; the path lasts a revolution."""
    place = conic_km(0.0)
    speed = (MU_KM3_S2 * (2 / place[0] - 1 / AXIS_KM)) ** 0.5
    spk = spice.spkopn(str(tmp_path / "orbit.bsp"), "made", 0)
    span = start_s - 1, start_s + PERIOD_S + 1
    spice.spkw05(spk, -901, 301, "J2000", *span, "orbit", MU_KM3_S2, 1, [[*place, 0, speed, 0]], [start_s])
    spice.spkcls(spk)
    kernels = (kernels[0], str(tmp_path / "orbit.bsp"))
    path = fly_by(kernels, observer="-901", target="MOON", duration_s=PERIOD_S, up=(0.0, 0.0, 1.0))
    for t_s in np.random.default_rng(2).uniform(0, PERIOD_S, 20):
        pose, expected_m = path.pose(round(t_s * 1e9)), 1e3 * conic_km(t_s)
        assert np.linalg.norm(pose.position_m - expected_m) < 0.2
        assert np.linalg.norm(np.cross(pose.world_from_body[:, 2], expected_m)) < np.radians(0.2 / 3600) * 2e6
        pull = path.motion(round(t_s * 1e9)).acceleration_m_s2
        toward = -MU_KM3_S2 * 1e9 * expected_m / np.linalg.norm(expected_m) ** 3
        np.testing.assert_allclose(pull, toward, atol=0.02)  # of a cubic between instants


def test_a_camera_turns_as_its_kernel(kernels, start_s, tmp_path):
    """Attitudes a hundred seconds apart and the rate between them (CK type 3), on a clock of the spacecraft."""
    (tmp_path / "clock.tsc").write_text(SCLK)
    (tmp_path / "spin.tf").write_text(SPIN_FK)
    for kernel in (kernels[0], str(tmp_path / "clock.tsc")):
        spice.furnsh(kernel)
    ets = start_s + np.arange(-100.0, 401.0, 100.0)
    ticks = [spice.sce2c(-900, et) for et in ets]
    turns = [spice.m2q(spice.rotate(RATE * (et - start_s), 3)) for et in ets]
    ck = spice.ckopn(str(tmp_path / "spin.bc"), "made", 0)
    spice.ckw03(
        ck, ticks[0], ticks[-1], -900000, "J2000", True, "spin", 6, ticks, turns, [[0, 0, RATE]] * 6, 1, ticks[:1]
    )
    spice.ckcls(ck)
    spice.kclear()
    files = tuple(str(tmp_path / name) for name in ("clock.tsc", "spin.tf", "spin.bc"))
    path = fly_by((*kernels, *files), camera_frame="SPINCAM")
    for t_s in np.random.default_rng(3).uniform(0, 300, 20):
        found, angle = path.pose(round(t_s * 1e9)).world_from_body, RATE * t_s
        expected = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        np.testing.assert_allclose(found, expected, atol=np.radians(0.5 / 3600))
    np.testing.assert_allclose(path.motion(10**11).turn_rad_s, [0, 0, RATE], atol=1e-6)


def test_light_time_is_that_of_the_target(kernels, start_s):
    """The Sun's place sees the body where the light left it."""
    path = fly_by(kernels, observer="SUN", target="-900", aberration="CN", duration_s=250.0)
    offset_s = start_s - START_S
    for t_s in (0.0, 100.0, 250.0):
        light_s = 0.0
        for _ in range(10):
            seen_km = FROM_KM + SPEED_KM_S * (t_s + offset_s - light_s)
            light_s = np.linalg.norm(seen_km) / 299_792.458
        found = path.pose(round(t_s * 1e9)).position_m
        assert np.linalg.norm(found + 1e3 * seen_km) < 0.2
        assert np.linalg.norm(found + 1e3 * (FROM_KM + SPEED_KM_S * t_s)) > 5


def test_a_path_that_jumps_is_refused(kernels, start_s, tmp_path):
    """Two places a kilometre apart, each for half of the time."""
    spk = spice.spkopn(str(tmp_path / "jump.bsp"), "made", 0)
    for k, begin_s in enumerate((start_s - 100, start_s + 50)):
        ets, states = [begin_s, begin_s + 150], [[1000.0 + k, 0, 0, 0, 0, 0]] * 2
        spice.spkw13(spk, -902, 10, "J2000", *ets, f"part {k}", 1, 2, states, ets)
    spice.spkcls(spk)
    with pytest.raises(TrajectoryError, match="cannot be followed"):
        fly_by((kernels[0], str(tmp_path / "jump.bsp")), observer="-902", duration_s=100.0)


def test_the_example_passes_eros_as_near_did(tmp_path):
    folder = shutil.copytree(Path(__file__).parents[3] / "examples" / "spice", tmp_path / "spice")
    runpy.run_path(str(folder / "make_kernels.py"))["make"](folder)
    rig = load_rig(folder / "flyby.toml")
    assert [(one.key, one.is_read) for one in open_files(rig)][:2] == [("scene.camera.kernels", True)] * 2
    assert isinstance(rig.scene, BodiesParameters)
    path = build_trajectory(rig.scene.camera)
    closest = path.pose(1800 * 10**9)
    assert np.linalg.norm(closest.position_m) == pytest.approx(3_827_000, abs=0.2)
    assert closest.world_from_body[:, 2] @ closest.position_m == pytest.approx(-3_827_000, abs=0.2)
    assert np.linalg.norm(path.motion(1800 * 10**9).velocity_m_s) == pytest.approx(965, abs=1e-3)
    (folder / "near.tls").unlink()
    with pytest.raises(RigError, match=r"scene\.camera\.kernels.*near\.tls"):
        open_files(rig)


def test_without_spiceypy_the_extra_is_named(kernels, tmp_path, monkeypatch):
    (tmp_path / "spiceypy.py").write_text("raise ImportError(name='spiceypy')")
    monkeypatch.syspath_prepend(tmp_path)  # which the child process inherits
    with pytest.raises(TrajectoryError, match=r"needs spiceypy: pip install '\.\[spice\]'"):
        fly_by(kernels)
