"""Tables of trajectories in a rig: one frozen dataclass for each `kind`.

For a camera's path `look_at_m` turns the boresight to a point of the world, and `up` is the direction that is up in the
picture; without `look_at_m` the attitude is the path's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from emulator.tables.typed_table import NO_FILE, RigFile
from emulator.trajectory.laws import LANDING, Checked, Gate
from emulator.trajectory.laws import OrbitPath as OrbitPath
from transports.network import check_allow

_Triple = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]
_Port = Annotated[int, Meta(ge=0, le=65535)]
_Wait = Annotated[float, Meta(ge=0, le=60_000)]
_UP: _Triple = (0.0, 0.0, 1.0)
_AS_THE_WORLD: _Quaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FixedPath(Checked):
    """A fixed pose.

    Attributes
    ----------
    position_m : in the world.
    q_world_from_body : attitude, scalar first; a camera's axes are x right, y down, z along the boresight.
    look_at_m : a point to look at instead.
    up : direction that is up in the image then.
    """

    kind: ClassVar[str] = "fixed"
    position_m: _Triple = (0.0, 0.0, 0.0)
    q_world_from_body: _Quaternion = _AS_THE_WORLD
    look_at_m: _Triple | None = None
    up: _Triple = _UP


@dataclass(frozen=True)
class Keyframe(Checked):
    """One pose of a path.

    Attributes
    ----------
    t_s : time.
    position_m : in the world.
    q_world_from_body : attitude, scalar first.
    """

    t_s: float
    position_m: _Triple
    q_world_from_body: _Quaternion = _AS_THE_WORLD


@dataclass(frozen=True)
class KeyframePath(Checked):
    """A smooth path through poses at given times.

    Attributes
    ----------
    keyframes : in order of time.
    look_at_m : a point to look at instead of the keyframes' attitudes.
    up : direction that is up in the image then.
    """

    kind: ClassVar[str] = "keyframes"
    keyframes: tuple[Keyframe, ...] = ()
    look_at_m: _Triple | None = None
    up: _Triple = _UP


@dataclass(frozen=True)
class SpinPath(Checked):
    """A rotation about +Z at a fixed place; with a tilt that axis precesses about the angular momentum.

    Attributes
    ----------
    position_m : in the world.
    pole : direction of the angular momentum in the world.
    spin_deg_s : rate of turning about +Z, right-handed.
    start_deg : angle at time zero.
    tilt_deg : of +Z against the momentum.
    precession_deg_s : rate of +Z about the momentum.
    """

    kind: ClassVar[str] = "spin"
    position_m: _Triple = (0.0, 0.0, 0.0)
    pole: _Triple = _UP
    spin_deg_s: float = 0.0
    start_deg: float = 0.0
    tilt_deg: float = 0.0
    precession_deg_s: float = 0.0


@dataclass(frozen=True)
class DescentPath(Checked):
    """A landing in phases above a world with z up.

    Attributes
    ----------
    gates : moments between phases, in order of time; the default is a lunar landing's last three minutes.
    heading_deg : direction of flight: 0 along +y, 90 along +x.
    site_m : landing site.
    """

    kind: ClassVar[str] = "descent"
    gates: tuple[Gate, ...] = LANDING
    heading_deg: float = 0.0
    site_m: _Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FilePath(Checked):
    """A path read from files.

    Attributes
    ----------
    path : a table (`.csv`), a CCSDS orbit file (`.oem`) or a PANGU flight file (`.fli`), beside the rig file.
    attitude_path : A CCSDS attitude file (`.aem`) with the attitudes to the places of `path`; empty for none.
    period_s : time between two poses of a flight file, which holds no times.
    axes : axes of the file's camera: it looks along +z with y down ("opencv"), or along -z with y up ("opengl").
    look_at_m : a point to look at instead of the file's attitudes.
    up : direction that is up in the image then.
    """

    kind: ClassVar[str] = "file"
    path: RigFile = NO_FILE
    attitude_path: RigFile = NO_FILE
    period_s: Annotated[float, Meta(gt=0)] = 0.04
    axes: Literal["opencv", "opengl"] = "opencv"
    look_at_m: _Triple | None = None
    up: _Triple = _UP

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path:
            raise ValueError("path is missing: name a .csv, .oem or .fli file")


@dataclass(frozen=True)
class LivePath(Checked):
    """Poses that come from outside while the run goes on, one UDP datagram each.

    Attributes
    ----------
    host, port
        Address to listen on. Paths of a scene with one host and port share it: number 0 is the camera, 1 the first
        body.
    allow
        Addresses and networks that may send poses, for instance ["192.168.1.5"]; needed when `host` is not this machine
        alone.
    position_m, q_world_from_body : the pose until one comes.
    hold_ms : time for which the last motion is continued when no newer pose comes.
    ahead_ms : most time by which a pose may be stamped beyond its arrival; others are refused.
    """

    kind: ClassVar[str] = "live"
    host: str = "127.0.0.1"
    port: _Port = 10364
    allow: tuple[str, ...] = ()
    position_m: _Triple = (0.0, 0.0, 0.0)
    q_world_from_body: _Quaternion = _AS_THE_WORLD
    hold_ms: _Wait = 100.0
    ahead_ms: _Wait = 1000.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_allow(self.host, self.allow)


@dataclass(frozen=True)
class BasiliskPath(Checked):
    """The path of a camera, spacecraft or celestial body in a Basilisk simulation, for `evstim vizard`.

    Attributes
    ----------
    camera
        cameraID of the camera.
    spacecraft : name of the spacecraft.
    body : name of the celestial body.
    origin : name of the celestial body at the world's origin; empty: the origin of Basilisk's inertial frame.
    position_m, q_world_from_body
        The pose until the simulation gives one. Detail is chosen for it, so give the nearest point of the flight.
    """

    kind: ClassVar[str] = "basilisk"
    camera: int | None = None
    spacecraft: str = ""
    body: str = ""
    origin: str = ""
    position_m: _Triple = (0.0, 0.0, 0.0)
    q_world_from_body: _Quaternion = _AS_THE_WORLD

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.camera is not None) + bool(self.spacecraft) + bool(self.body) != 1:
            raise ValueError("give one of camera, spacecraft and body: its object in the simulation")


@dataclass(frozen=True)
class SpicePath(Checked):
    """A camera's path from SPICE kernels; the world is `frame` with the target at its origin.

    Attributes
    ----------
    kernels : SPK, CK, FK, LSK, SCLK and PCK files beside the rig file, in the order of loading.
    observer, target : NAIF names or ids, for instance "-82" and "MOON".
    frame : axes of the world, for instance "J2000" or "IAU_MOON".
    camera_frame : frame of the camera; empty: it looks at the target.
    start_utc : time 0, for instance "2004-06-11T19:00:00".
    duration_s : length of the path, which the kernels must cover.
    aberration : correction of the target's place, as SPICE names it.
    up : direction that is up in the image where the camera looks at the target.
    """

    kind: ClassVar[str] = "spice"
    kernels: tuple[RigFile, ...] = ()
    observer: str = ""
    target: str = ""
    frame: str = "J2000"
    camera_frame: str = ""
    start_utc: str = ""
    duration_s: Annotated[float, Meta(ge=1e-3, le=1e9)] = 1.0
    aberration: Literal["NONE", "LT", "LT+S", "CN", "CN+S"] = "NONE"
    up: _Triple = _UP

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("kernels", "observer", "target", "frame", "start_utc"):
            if not getattr(self, name):
                raise ValueError(f"{name} is missing")


TrajectoryParameters = (
    FixedPath | KeyframePath | OrbitPath | SpinPath | DescentPath | FilePath | LivePath | BasiliskPath | SpicePath
)
"""Any of them, as the type of a key in a scene's table."""
