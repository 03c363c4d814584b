"""A run in step with a Basilisk simulation, which waits while the run computes.

    Basilisk                      evstim
    PING ------------------------> PONG
    SIM_UPDATE of time T --------> poses stored; the run goes to T, its events are handed to the links; OK
    REQUEST_IMAGE of a camera ---> the image of T
    ...
    closes the connection -------> the run ends

Stream time is simulated time less that of the first update, so the two clocks cannot drift apart. Every request gets a
reply, because Basilisk waits for it without a limit: an invalid request is refused with the reason, and Basilisk then
raises an error. When the run ends before the simulation, the update that waits is refused too.

Poses in the rig's world, from Basilisk's cameras, spacecraft and celestial bodies:

    q_world_from_camera = q(sigma_BN) q(sigma_CB)
    camera              = r_BN_N + R(q(sigma_BN)) r_CB_B
    world               = N, moved to the celestial body `origin`

The matrix [BN] turns coordinates of N into those of B, so the quaternion q(sigma_BN), of Hamilton's product, turns
those of B into those of N. The camera's frame C is that of evstim: z out along the boresight, x right, y down. On the
wire a camera's attitude has a third of a turn into Unity's axes added to sigma_CB, which is undone here.

Sources: CameraConfigMsg, the pages on vizInterface and `vizInterface.cpp` of AVSLab/basilisk; Schaub and Junkins,
Analytical Mechanics of Space Systems, section 3.5.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from emulator.geometry.attitude import Matrix, Quaternion, multiply
from emulator.light import Light
from emulator.rig.loading import Rig, RigError
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.live import GivenPath, SimulatedPath
from emulator.trajectory.parameters import BasiliskPath
from emulator.trajectory.pose import Pose, TrajectoryError, from_basilisk
from firmware_protocol import vizard
from firmware_protocol.events import Events, Floats
from transports.link.deliveries import LatencyHistogram
from transports.link.pacing import Clock
from transports.vizard import Server

_LOOK_MS = 50
_LAST_LOOKS = 20


@dataclass
class BasiliskCounters:
    """Counts of the requests of a simulation.

    Attributes
    ----------
    updates : states of the simulation that were used.
    images : images sent.
    no_images : requests for images of cameras that are not the rig's, answered with none.
    refused : requests that could not be used.
    last_refusal : why the last of them could not.
    answer : from an update's arrival to its reply, us.
    first_event : from an update's arrival until the first events after it have been handed to the links, us.
    """

    updates: int = 0
    images: int = 0
    no_images: int = 0
    refused: int = 0
    last_refusal: str = ""
    answer: LatencyHistogram = field(default_factory=LatencyHistogram)
    first_event: LatencyHistogram = field(default_factory=LatencyHistogram)


@dataclass(eq=False)
class BasiliskRun:
    """Drive of a run by the requests of a simulation.

    Attributes
    ----------
    server : where they come in.
    paths : paths whose poses the simulation gives.
    images : encodes a light frame as an image file.
    on_first : called with the first update that can be used.
    counters : counts of the requests.
    first_ns, last_ns : simulated times of the first and the last update; None before the first.
    """

    server: Server
    paths: Sequence[GivenPath]
    images: Callable[[Light], bytes]
    clock: Clock
    on_first: Callable[[vizard.Update], None] = lambda _: None
    counters: BasiliskCounters = field(default_factory=BasiliskCounters, init=False)
    first_ns: int | None = field(default=None, init=False)
    last_ns: int | None = field(default=None, init=False)
    _light: Callable[[], Light] | None = field(default=None, init=False)
    _waiting_since_ns: int | None = field(default=None, init=False)  # an update that has no reply yet
    _without_event: bool = field(default=False, init=False)  # and none of its events has gone out

    @property
    def limit_ns(self) -> int:
        """Stream time of the last update."""
        return 0 if self.first_ns is None or self.last_ns is None else self.last_ns - self.first_ns

    def begin(self, light: Callable[[], Light], goes_on: Callable[[], bool]) -> None:
        """Return when the first update has come; a simulation that disconnects before may connect again."""
        while self.first_ns is None and goes_on():
            self._serve_one()
            if self.server.peer_gone:
                self.server.forget_peer()
        self._light = light

    def wait(self, t_ns: int, goes_on: Callable[[], bool]) -> int:
        """Answer the update that the run has caught up with, and all requests until the next one has come."""
        while self.limit_ns <= t_ns and goes_on():
            self._answer_update()
            self._serve_one()
            if self.server.peer_gone:
                break
        return self.limit_ns

    def take(self, events: Events) -> None:
        """Measure the latency of events that have been handed to the links."""
        if len(events) and self._without_event and self._waiting_since_ns is not None:
            self._without_event = False
            self.counters.first_event.add(self._since_us(self._waiting_since_ns))

    def end(self, reason: str) -> None:
        """Refuse the update that waits, or comes within a second: the simulation would wait for its reply for ever."""
        for _ in range(_LAST_LOOKS):
            if self._waiting_since_ns is not None or self.first_ns is None or self.server.peer_gone:
                break
            self._serve_one()
        if self._waiting_since_ns is not None:
            self._waiting_since_ns = None
            self.server.send(vizard.refusal(reason))

    def _serve_one(self) -> None:
        parts = self.server.receive(_LOOK_MS)
        if parts is None:
            return
        try:
            self._serve(vizard.parse_request(parts))
        except (vizard.RequestError, vizard.UpdateError, TrajectoryError) as error:
            self.counters.refused += 1
            self.counters.last_refusal = str(error)
            self.server.send(vizard.refusal(str(error)))

    def _serve(self, request: vizard.Request) -> None:
        match request:
            case vizard.Ping():
                self.server.send(vizard.PONG)
            case vizard.InputRequest():
                self.server.send(vizard.INPUT_REPLY)
            case vizard.ImageRequest(camera):
                self._send_image(camera)
            case vizard.SimUpdate(data):
                self._take(vizard.Update(data))

    def _take(self, update: vizard.Update) -> None:
        if self.last_ns is not None and update.time_ns <= self.last_ns:
            raise TrajectoryError(
                f"simulated time went from {self.last_ns * 1e-9:g} s to {update.time_ns * 1e-9:g} s: restart evstim "
                "for a simulation that begins again"
            )
        poses = [pose_of(driven.table, update) for driven in self.paths]
        if self.first_ns is None:
            self.first_ns = update.time_ns
            self.on_first(update)
        self.last_ns = update.time_ns
        for driven, pose in zip(self.paths, poses, strict=True):
            driven.path.add(self.limit_ns, pose)
        self.counters.updates += 1
        self._waiting_since_ns, self._without_event = self.clock.now_ns(), True

    def _answer_update(self) -> None:
        if self._waiting_since_ns is None:
            return
        self.counters.answer.add(self._since_us(self._waiting_since_ns))
        self._waiting_since_ns = None
        self.server.send(vizard.OK)

    def _since_us(self, begun_ns: int) -> Floats:
        return np.array([(self.clock.now_ns() - begun_ns) / 1000])

    def _send_image(self, camera: int) -> None:
        if self._light is None or camera not in [driven.table.camera for driven in self.paths]:
            self.counters.no_images += 1
            self.server.send(vizard.NO_IMAGE)
            return
        self.server.send(vizard.image_reply(self.images(self._light())))
        self.counters.images += 1


T = TypeVar("T")

_FOCAL_WITHIN = 0.01


def connected(rig: Rig) -> tuple[Rig, tuple[GivenPath, ...]]:
    """Return the rig in step with a simulation, and its paths that the simulation drives; raises RigError."""
    if rig.run.lockstep_us:
        raise RigError(f"{rig.name}: run.lockstep_us: the simulation drives this run, so no bus can")
    if getattr(rig.scene, "time_scale", 1.0) != 1.0:
        raise RigError(f"{rig.name}: scene.time_scale: it must be 1, because the simulation gives the time")
    paths: list[GivenPath] = []
    scene = _connected(rig.scene, paths)
    if not paths:
        raise RigError(f'{rig.name}: no path is driven by Basilisk: give a path with kind = "basilisk"')
    run = dataclasses.replace(rig.run, pace="free")
    return dataclasses.replace(rig, scene=scene, run=run), tuple(paths)


def camera_differs(rig: Rig, camera: vizard.CameraState) -> str:
    """Return the difference of the rig's camera from Basilisk's in size or focal length; "" where there is none."""
    width, height = rig.camera.size
    own_px = rig.camera.lens.pinhole((width, height)).focal_px
    half = math.radians(camera.field_of_view_deg) / 2
    theirs_px = camera.size[1] / 2 / math.tan(half) if 0 < half < math.pi / 2 else math.nan
    if camera.size == (width, height) and abs(theirs_px / own_px - 1) < _FOCAL_WITHIN:
        return ""
    return (
        f"Basilisk's camera has {camera.size[0]} x {camera.size[1]} pixels and a focal length of {theirs_px:.1f} "
        f"pixels, the rig's {width} x {height} and {own_px:.1f}"
    )


def _connected(value: T, paths: list[GivenPath]) -> T:
    """Return a table of a rig with all Basilisk paths in it connected; they are added to `paths`."""
    if isinstance(value, BasiliskPath):
        paths.append(GivenPath(value, SimulatedPath(build_trajectory(value))))
        return paths[-1]  # type: ignore[return-value]
    if isinstance(value, tuple):
        return tuple(_connected(element, paths) for element in value)  # type: ignore[return-value]
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    names = [field.name for field in dataclasses.fields(value) if field.init]
    return dataclasses.replace(value, **{name: _connected(getattr(value, name), paths) for name in names})


_CAMERA_FROM_UNITY: Quaternion = np.array([0.5, -0.5, -0.5, 0.5])
_ROTATION_WITHIN = 1e-3
_LARGEST_MRP = 1e6  # of one part; within a millionth of a whole turn


def pose_of(path: BasiliskPath, update: vizard.Update) -> Pose:
    """Return the pose of the object that `path` names; raises TrajectoryError with the error in the update."""
    try:
        pose = _pose_in_n(path, update)
        origin_m = np.array(update.body(path.origin).position_m) if path.origin else np.zeros(3)
        return Pose(pose.position_m - origin_m, pose.q_world_from_body)
    except (vizard.UpdateError, ValueError) as error:
        raise TrajectoryError(f"simulated time {update.time_ns * 1e-9:g} s: {error}") from error


def _pose_in_n(path: BasiliskPath, update: vizard.Update) -> Pose:
    if path.camera is not None:
        camera = update.camera(path.camera)
        q_parent_from_camera = multiply(_from_mrp(camera.direction), _CAMERA_FROM_UNITY)
        mounted = Pose(np.array(camera.position_m), q_parent_from_camera)
        return _spacecraft(update, camera.parent).after(mounted)
    if path.spacecraft:
        return _spacecraft(update, path.spacecraft)
    body = update.body(path.body)
    return Pose(np.array(body.position_m), _from_matrix(np.reshape(body.rotation, (3, 3)), path.body))


def _spacecraft(update: vizard.Update, name: str) -> Pose:
    state = update.spacecraft(name)
    return Pose(np.array(state.position_m), _from_mrp(state.rotation))


def _from_mrp(sigma: tuple[float, ...]) -> Quaternion:
    if max(map(abs, sigma)) > _LARGEST_MRP:
        raise ValueError(f"the Modified Rodrigues Parameters {sigma} are too large for an attitude")
    return from_basilisk(sigma)


def _from_matrix(body_from_n: Matrix, name: str) -> Quaternion:
    # Loaded where it is used: it takes longer than the rest of a short run's imports.
    from scipy.spatial.transform import Rotation

    small = bool((np.abs(body_from_n) < 1 + _ROTATION_WITHIN).all())  # so that nothing below overflows
    off = np.abs(body_from_n @ body_from_n.T - np.eye(3)).max() if small else np.inf
    if off > _ROTATION_WITHIN or np.linalg.det(body_from_n) < 0:
        raise ValueError(f"the matrix of celestial body {name!r} is no rotation")
    return np.asarray(Rotation.from_matrix(body_from_n.T).as_quat(scalar_first=True))
