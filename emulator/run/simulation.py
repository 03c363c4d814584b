"""A rig in step with the program that runs it: the program gives poses, and gets events, light, samples and frames.

    program                                                thread
    step(20_000, camera=pose) --poses, end of the step---> paths of the scene; `Session` goes as far as the end
               SimulationStep <--events, light, frames---- and waits for the next step

Nothing depends on the time that the program takes, and the same poses and seed give the same bits each time, with
links or without, on any number of threads: the run is one that is not paced. In a step the light is drawn each
`run.step_us` of the rig and at the step's end; between two poses of a program the camera moves on a straight line and a
great circle. Without links there is no process and no socket.
"""

from __future__ import annotations

import atexit
import dataclasses
import io
import logging
import os
import pickle
import reprlib
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from emulator.geometry.camera import SceneGeometry, ScenePoses, Seen
from emulator.light import Light, Scene, SceneError
from emulator.rig.kinds import IMU_UNITS
from emulator.rig.loading import Rig, load_rig, with_options
from emulator.run import fill_standard_descriptors
from emulator.run.assembly import build_scene, build_session, link_setups, schedule
from emulator.run.kernels import parts_of, prepare, uncompiled
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.session import Session
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.live import GivenPath, SimulatedPath
from emulator.trajectory.parameters import FixedPath, LivePath, TrajectoryParameters
from emulator.trajectory.pose import Fixed, Pose, Timescale
from firmware_protocol.bounds import whole_number
from firmware_protocol.device.items import Reading, ReadingKind
from firmware_protocol.events import Events, Float32s, Kept, UInt16s, empty_edges, join_events
from firmware_protocol.recordings.part import Frame, ImuRecords
from transports import Closing
from transports.file import FileLink
from transports.link.deliveries import DeliveredParts
from transports.link.pacing import MonotonicClock

log = logging.getLogger(__name__)

LONGEST_US = 3_600_000_000
"""The longest step, us of stream time."""

_MOST_LISTED = 5  # differences
_LOOK_S = 0.1  # between two looks of a session that waits, whether it was stopped


@dataclass(frozen=True, eq=False, repr=False)
class SceneTruth(Kept):
    """The geometry of a scene at an instant, in read-only arrays; None for what the scene does not have.

    Attributes
    ----------
    poses : of the camera and of all bodies, in the world.
    depth : (height, width) float32, m along the boresight, infinite for the sky.
    flow : (height, width, 2) float32, motion of the visible points, px/s, to the right and down.
    labels : (height, width) uint16: 0 is the sky, k is names[k - 1].
    names : of the objects.
    """

    poses: ScenePoses | None = None
    depth: Float32s | None = None
    flow: Float32s | None = None
    labels: UInt16s | None = None
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class SimulationStep(Kept):
    """Output of a step of a `Simulation`, in read-only arrays.

    Attributes
    ----------
    t_us : end of the step, us of stream time.
    events : (n,) EVENT that the sensor has read out in the step, sorted by t.
    light : (height, width) float32 at the end of the step, relative to the sensor's reference.
    imu : (k,) IMU, samples of the inertial unit of a rig that has one.
    frames : frames of the active pixels that ended in the step, of a rig that has them.
    truth : geometry at the end of the step, where it was requested.
    """

    t_us: int
    events: Events
    light: Light
    imu: ImuRecords
    frames: tuple[Frame, ...]
    truth: SceneTruth | None


@dataclass(frozen=True, eq=False, repr=False)
class SimulationState(Kept):
    """State of a `Simulation` between two steps, for `Simulation.restore`, as often as it is needed; it can be pickled.

    Attributes
    ----------
    rig : with the seed of the run.
    bodies : those that take poses.
    evstim : version.
    t_us : end of the last step, us of stream time.
    content : pickle of all else, but for the scene and the paths.
    """

    rig: Rig
    bodies: tuple[str, ...]
    evstim: str
    t_us: int = field(default=0, compare=False)
    content: bytes = field(default=b"", compare=False)


class _Program:
    """Drive of a session by the program; see `emulator.run.pacing.SimulationDrive`."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.limit_ns, self.reached_ns = 0, -1
        self.stopping = self.ended = False

    def begin(self, light: Callable[[], Light], goes_on: Callable[[], bool]) -> None:
        """Begin at once: the first pose is there."""

    def take(self, events: Events) -> None:
        """Take no note of events."""

    def wait(self, t_ns: int, goes_on: Callable[[], bool]) -> int:
        """Wait for the next step of the program, in the session's thread."""
        with self.changed:
            if self.limit_ns <= t_ns:
                self.reached_ns = t_ns
                self.changed.notify_all()
            # The program may have gone back meanwhile.
            while self.limit_ns <= self.reached_ns and not self.stopping and goes_on():
                self.changed.wait(_LOOK_S)
        return self.limit_ns

    def go_to(self, t_ns: int) -> bool:
        """Let the session go on to `t_ns` and wait for it there; return False where it ends before."""
        with self.changed:
            self.limit_ns = t_ns
            self.changed.notify_all()
            self.changed.wait_for(lambda: self.reached_ns >= t_ns or self.ended)
            return self.reached_ns >= t_ns

    def end(self) -> None:
        """Note that the session has ended."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()


class Simulation(Closing):
    """A rig in step with this program. A context manager; `close` ends the run as well.

    The camera, and each body with a name that the rig moves or that `bodies` contains, follows the rig's path until
    `step` gives it a pose; from then on it stands still in a step without one. Where the rig's path comes from outside
    (kinds "live" and "basilisk") it stays at the pose of the rig's table until then.

    Parameters
    ----------
    rig : path of a rig file, name of a shipped rig, or a Rig. Its pace, duration and lockstep are not used.
    seed : seed of everything random. By default the rig's.
    links : True: the links of the rig are served as well, in step. False: no link, fault, trigger or second camera.
    record : file for what the links deliver, or without a link for the camera's output, in the format of its suffix.
    camera : pose of the camera at time 0. By default that of the rig.
    bodies : names of bodies that stand still in the rig and that `step` is to move; a mapping has poses for time 0.

    Raises
    ------
    RigError, SceneError
        The rig cannot be used.
    ValueError
        `seed` is out of its range, or the scene has no body of a name.
    LinkFailed
        A link cannot be opened.
    """

    def __init__(
        self,
        rig: str | Path | Rig,
        *,
        seed: int | None = None,
        links: bool = False,
        record: str | Path | None = None,
        camera: Pose | None = None,
        bodies: Collection[str] | Mapping[str, Pose] = (),
    ) -> None:
        fill_standard_descriptors()
        loaded = with_options(rig if isinstance(rig, Rig) else load_rig(str(rig)), seed=seed)
        run = dataclasses.replace(loaded.run, pace="free", lockstep_us=0, seconds=0.0)
        loaded = dataclasses.replace(loaded, run=run)
        if not links:
            loaded = dataclasses.replace(loaded, links=(), faults=(), trigger=None, second_camera=None)
        self._record = None if record is None else Path(record)
        if self._record is not None and not loaded.links:
            loaded, self._record = dataclasses.replace(loaded, links=(FileLink(path=str(record)),)), None
        self.rig, self._paths = _driven(loaded, bodies)
        named = tuple(sorted(name for name in self._paths if name is not None))
        comparable = dataclasses.replace(loaded, run=dataclasses.replace(run, threads=0))  # they change no event
        self._state = SimulationState(comparable, named, version("evstim"))
        self._process, self._closed_by = os.getpid(), ""
        self._time = Timescale(getattr(self.rig.scene, "time_scale", 1.0))
        for name, pose in self._checked(camera, bodies if isinstance(bodies, Mapping) else {}).items():
            self._paths[name].add(0, pose)
        imu = self.rig.camera.imu
        self._parts = DeliveredParts(0 if imu is None else IMU_UNITS[imu.unit])
        self._program = _Program()
        self._session: Session | None = None
        self._scene: Scene | None = None
        self._geometry: SceneGeometry | None = None
        self._status: RunStatus | None = None
        self._result: RunResult | None = None
        self._error: BaseException | None = None
        self._events: list[Events] = []
        self._readings: list[Reading] = []
        self._thread = threading.Thread(target=self._work, name=f"evstim {self.rig.name}", daemon=True)
        self._thread.start()
        atexit.register(self._stop)  # of a program that does not close it: links would not let it end
        try:
            if not self._program.go_to(0):
                self._refuse()
        except BaseException:
            self._stop()
            raise

    @property
    def t_us(self) -> int:
        """End of the last step, us of stream time."""
        return self._program.limit_ns // 1000

    @property
    def light(self) -> Light:
        """The light now, (height, width) float32, relative to the sensor's reference; a copy."""
        return self._running().light.copy()

    @property
    def addresses(self) -> Mapping[str, str | None]:
        """Address of each link by its name."""
        return {} if self._status is None else {name: link.address for name, link in self._status.links.items()}

    @property
    def result(self) -> RunResult:
        """Counts, ledger and link reports of the run; raises RuntimeError before its end."""
        if self._result is None:
            raise RuntimeError("the run has no result before the end of its `with` block, or `close`")
        return self._result

    def step(
        self, us: int, camera: Pose | None = None, bodies: Mapping[str, Pose] | None = None, *, truth: bool = False
    ) -> SimulationStep:
        """Go on by `us` of stream time, and return the output of this step.

        Parameters
        ----------
        us : length of the step, 1 to LONGEST_US.
        camera : pose of the camera in the world at the end of the step (x right, y down, z along the boresight).
        bodies : poses of bodies at the end of the step, in the world or in the frame that the body is fixed to.
        truth : True: with the geometry at the end of the step.

        Raises
        ------
        ValueError
            `us` is out of its range, or a pose is none, or for something without a path. Nothing has happened.
        SceneError
            The scene cannot be drawn with these poses; the run has ended.
        RuntimeError
            The run has ended.
        """
        session = self._running()
        us = whole_number("us", us)
        if not 1 <= us <= LONGEST_US:
            raise ValueError(f"a step of {us} us: it must be 1 to {LONGEST_US}; take several")
        poses = self._checked(camera, bodies or {})
        t0_ns, t1_ns = self._program.limit_ns, self._program.limit_ns + us * 1000
        with self._closing("within a step"):
            for name, path in self._paths.items():
                path.go_on(self._time.scene_ns(t0_ns), self._time.scene_ns(t1_ns), poses.get(name))
            self._events, self._readings = [], []
            if not self._program.go_to(t1_ns):
                self._refuse()
            part = self._parts.part(join_events(self._events), empty_edges(), self._readings, 0)
            geometry = self._look(t1_ns) if truth else None
            return SimulationStep(t1_ns // 1000, part.events, session.light, part.imu, part.frames, geometry)

    def save(self) -> SimulationState:
        """Return a copy of the whole state, so that a program can try what follows and come back.

        Raises RuntimeError where the run has links: what has left a camera does not come back.
        """
        session, content = self._alone(), io.BytesIO()
        pickler = pickle.Pickler(content, pickle.HIGHEST_PROTOCOL)
        numbers = {id(of): k for k, of in enumerate(self._shared)}
        pickler.persistent_id = lambda of: numbers.get(id(of))  # type: ignore[method-assign]
        pickler.dump((session.state(), [path.known for path in self._paths.values()], self._parts))
        return dataclasses.replace(self._state, t_us=self.t_us, content=content.getvalue())

    def restore(self, state: SimulationState) -> None:
        """Go to a state of this simulation, or of one of the same rig, seed, bodies and version of evstim.

        Raises ValueError where one of these differs, and RuntimeError where the run has links.
        """
        session = self._alone()
        if not isinstance(state, SimulationState):
            raise ValueError(f"a state is what `save` returns, got {type(state).__name__}")
        if differences := list(_differences(state, self._state)):
            raise ValueError(f"the state is of another simulation: {'; '.join(differences[:_MOST_LISTED])}")
        unpickler = pickle.Unpickler(io.BytesIO(state.content))
        unpickler.persistent_load = self._shared.__getitem__  # type: ignore[method-assign]
        of_session, of_paths, parts = unpickler.load()
        with self._closing("within `restore`"):
            session.restore(*of_session)
            self._parts = parts
            for path, poses in zip(self._paths.values(), of_paths, strict=True):
                path.known = poses
            self._program.limit_ns = self._program.reached_ns = session.t_ns

    def close(self) -> None:
        """End the run; a second call does nothing. Raises the error by which it ends."""
        was_ended = self._program.ended
        self._stop()
        if self._error is not None and not was_ended:
            raise self._error

    @property
    def _shared(self) -> list[object]:
        return [self._scene, *self._paths.values()]

    @contextmanager
    def _closing(self, place: str) -> Iterator[None]:
        """Close the simulation where an error, such as KeyboardInterrupt, ends the block: it would be half-way."""
        try:
            yield
        except BaseException as error:
            if not (self._program.ended or self._closed_by):
                self._closed_by = f"{type(error).__name__} {place} closed it: begin another one, and restore a state"
                log.warning("the simulation of %s: %s", self.rig.name, self._closed_by)
            self._stop()
            raise

    def _stop(self) -> None:
        if os.getpid() != self._process:  # a fork does not have the thread
            return
        atexit.unregister(self._stop)
        with self._program.changed:
            self._program.stopping = True  # also of a session that is not there yet
            if self._session is not None:
                self._session.stop()
            self._program.changed.notify_all()
        self._thread.join()

    def _running(self) -> Session:
        """Return the session; raises the reason where it has ended."""
        if os.getpid() != self._process:
            raise RuntimeError(
                f"the run of {self.rig.name} goes on in the process that this is a fork of: begin another Simulation "
                "here, and restore a pickled state"
            )
        if self._session is None or self._program.ended or self._closed_by:
            self._refuse()
        return self._session

    def _alone(self) -> Session:
        if self.rig.links:
            raise RuntimeError("a run with links or a record cannot be saved and restored: its events are out")
        return self._running()

    def _refuse(self) -> NoReturn:
        """Raise the reason for which the run has ended."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        if self._result is not None and self._result.scene_trouble:
            raise SceneError(self._result.scene_trouble)
        raise RuntimeError(f"the run of {self.rig.name} has ended" + f": {self._closed_by}" * bool(self._closed_by))

    def _checked(self, camera: Pose | None, bodies: Mapping[str, Pose]) -> dict[str | None, Pose]:
        """Return the poses by the name of a body, None for the camera; raises ValueError."""
        poses: dict[str | None, Pose] = {} if camera is None else {None: camera}
        poses.update(bodies.items())
        for name, pose in poses.items():
            target = "the camera" if name is None else f"body {name!r}"
            if not isinstance(pose, Pose):
                raise ValueError(f"{target}: a pose is an evstim.Pose, got {type(pose).__name__}")
            if name not in self._paths:
                movable = ", ".join(body or "the camera" for body in self._paths) or "nothing"
                raise ValueError(f"{target} takes no poses in {self.rig.name}, where {movable} does; see `bodies`")
        return poses

    def _look(self, t_ns: int) -> SceneTruth:
        assert self._scene is not None
        self._geometry = geometry = self._geometry or self._scene.geometry()
        if geometry is None:
            return SceneTruth()
        seen = Seen.of(*self._scene.size)
        geometry.look(t_ns, seen)
        layers: dict[str, Any] = {name: getattr(seen, name) for name in geometry.gives - {"poses"}}
        return SceneTruth(geometry.places(t_ns), names=tuple(geometry.names), **layers)

    def _work(self) -> None:
        """Run the session, in a thread, where the scene may hold a GL context."""
        try:
            prepare(uncompiled(parts_of(self.rig)))
            with build_scene(self.rig) as self._scene:
                setups = link_setups(self.rig, self._record)
                self._session = build_session(self.rig, self._scene, setups, MonotonicClock(), has_host=bool(setups))
                plan = dataclasses.replace(schedule(self.rig), simulation=self._program)
                self._result = self._session.run(plan, self._renew, self._take)
        except BaseException as error:  # noqa: BLE001 - raised again in the program's thread
            self._error = error
        self._program.end()

    def _renew(self, status: RunStatus) -> None:
        self._status = status

    def _take(self, events: Events) -> None:
        """Store the output of a part of a step, in the session's thread while the program waits."""
        self._events.append(events)
        for kind, records in self._session.last_readings if self._session is not None else ():
            parts = [records] if kind is ReadingKind.IMU else [records[k : k + 1] for k in range(len(records))]
            self._readings += [Reading(kind, part) for part in parts]


def _differences(first: Any, second: Any, place: str = "") -> Iterator[str]:
    """Yield where two dataclasses differ, with both values."""
    if first == second:
        return
    if not dataclasses.is_dataclass(first) or type(first) is not type(second):
        yield f"{place[1:]} is {reprlib.repr(first)}, here {reprlib.repr(second)}"
        return
    for name in (part.name for part in dataclasses.fields(first) if part.compare):
        yield from _differences(getattr(first, name), getattr(second, name), f"{place}.{name}")


def _driven(rig: Rig, bodies: Collection[str]) -> tuple[Rig, dict[str | None, SimulatedPath]]:
    """Return the rig with paths for a program's poses, and these: of bodies by name, of the camera by None."""
    scene: Any = rig.scene
    paths: dict[str | None, SimulatedPath] = {}
    if getattr(scene, "camera", None) is not None:
        scene = dataclasses.replace(scene, camera=_driven_path(None, scene.camera, paths))
    tables = getattr(scene, "bodies", ())
    if unknown := sorted({*bodies} - {table.name for table in tables}):
        names = ", ".join(filter(None, (table.name for table in tables))) or "none with a name"
        raise ValueError(f"bodies: {rig.name} has no body {unknown[0]!r}; it has {names}")
    named = {table.name: table.path for table in tables if table.name}
    moving = {name: path for name, path in named.items() if name in bodies or not isinstance(path, FixedPath)}
    driven = {name: _driven_path(name, path, paths) for name, path in moving.items()}
    if driven:
        bodies_table = [dataclasses.replace(table, path=driven.get(table.name, table.path)) for table in tables]
        scene = dataclasses.replace(scene, bodies=tuple(bodies_table))
    return dataclasses.replace(rig, scene=scene), paths


def _driven_path(name: str | None, table: TrajectoryParameters, paths: dict[str | None, SimulatedPath]) -> GivenPath:
    """Return a path for a program's poses, which begins as that of `table`, and add it to `paths`."""
    if isinstance(table, LivePath):  # without its port
        paths[name] = SimulatedPath(Fixed(Pose(np.array(table.position_m), np.array(table.q_world_from_body))))
    else:
        paths[name] = SimulatedPath(build_trajectory(table))
    return GivenPath(table, paths[name])
