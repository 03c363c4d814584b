"""Assembly of a run from its rig: scene, sensor, inertial unit, trigger, devices and links.

Scenes in units of radiance are seen through the camera's lens; the others have their own light, relative to the
sensor's reference. The modules of a scene, a camera, a link, an inertial unit and a plan are imported only for a rig
that has them.

The trigger of a rig gives the edges on the camera's input. They reach each link and the session through rings:

    [trigger]  source = "can"      SYNC on that link's bus     -> EdgeSink -> a ring for each link (and the session's)
               period_ms = 10.0    no bus: every 10 ms         -> each link makes the same edges by itself
               [[trigger.edges]]   no bus: at given times      -> the same

The rings are shared memory, made before the links' processes start and passed to them.

A camera without electronics has no host that sets registers. Its frames and inertial unit have a driver's default
settings of a DAVIS346: frames of 4 ms every 40 ms with a global shutter, and all of the inertial unit at 1 kHz.
Beside a link with a host on USB the settings of that host apply, because there is one chip.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emulator.light import OtherLight, Scene, SceneFrames
from emulator.plan.step_control import ControlledSteps, FixedSteps, RefinementModel, StepSource
from emulator.rig.kinds import CAMERA_MODELS, IMU_DRIVERS, IMU_UNITS, LINKS, SCENES, UsbSettings, usb_model
from emulator.rig.loading import Rig, RigError, carries_second, second_rig
from emulator.rig.tables import Run, Trigger
from emulator.run.camera import CameraView, ReadingSource, ReadingSources
from emulator.run.session import Schedule, Session
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import EventSource, Sensor, own_pixels
from firmware_protocol.device.clock import ClockSettings
from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.device.plain_device import PlainDevice
from firmware_protocol.frames import FrameSettings
from firmware_protocol.imu_samples import IMU_SAMPLE
from firmware_protocol.recordings.part import Facts
from firmware_protocol.usb.device import UsbCamera
from transports.faults.script import FaultPlan
from transports.link.deliveries import RecorderFactory
from transports.link.edges import EdgeRing, EdgeSink, EdgeSource, ListedEdges, PeriodicEdges
from transports.link.endpoint import Endpoint, LinkFactory
from transports.link.feed import Timing
from transports.link.kind import CameraFacts, LinkKind, LinkParameters, Wiring
from transports.link.pacing import Clock
from transports.link.process import LinkSetup
from transports.link.rings import EventRing, ReadingRing
from transports.registry import imported

if TYPE_CHECKING:
    from emulator.plan.plan import LineLoad, Plan
    from emulator.run.imu import Carried, Gravity
    from emulator.run.truth.source import RunTruth
    from emulator.sensor.parameters import ImuParameters


def build_scene(rig: Rig, size: tuple[int, int] | None = None) -> Scene:
    """Return the rig's scene at `size` = (width, height) pixels, by default its camera's; raises SceneError."""
    size = size or rig.camera.size
    kind, lens = SCENES[rig.scene.kind], rig.camera.lens
    chip, threads = CAMERA_MODELS[rig.camera.model].chip, rig.run.threads
    build = partial(SCENES.imported(kind.name, kind.build), rig.scene, **({"threads": threads} if kind.threads else {}))
    if kind.gl:
        from emulator.gl.context import selected_painter

        if selected_painter(rig.run.painter) == "gl":
            build = partial(SCENES.imported(kind.name, kind.gl), rig.scene)
    if kind.lens == "none":
        scene: Scene = build(size)
        return scene
    from emulator.optics.glare import veiled
    from emulator.optics.through import Through

    seen = veiled(build(size, lens, chip) if kind.lens == "own" else Through(lens, chip, size, build, threads), lens)
    return drawn_seldom(seen, rig.run)


_LEAST_PX = 16  # a side: smaller frames are drawn in no time
_EACH_IS_DRAWN = "each light frame of this scene, path or method is drawn"


def drawn_seldom(scene: Scene, run: Run) -> Scene:
    """Return a scene whose light frames between exact drawings follow the motion of its surfaces, where that is right.

    Each frame is drawn where poses come from outside, for straight lines between frames, with a tolerance of
    times unless the rig gives a period, and where the period is no longer than a step.
    """
    period_us = run.drawing_us or (0 if not run.tolerance_us else run.step_us)
    is_plain = run.method != "hermite" or 0 < period_us <= run.step_us or min(scene.size) < _LEAST_PX
    if is_plain or not scene.is_known_ahead:
        if run.drawing_us > run.step_us:
            logging.getLogger(__name__).warning("run.drawing_us is not used: %s", _EACH_IS_DRAWN)
        return scene
    from emulator.scene.between import LightBetween

    return LightBetween(scene, run.step_us * 1000, period_us * 1000, run.threads)


class TriggerPaths:
    """The rings of one run's trigger, to the rig's links by name; with `lockstep_us` above 0 it drives the run."""

    def __init__(self, trigger: Trigger | None, links: Sequence[str], seed: int, lockstep_us: int = 0) -> None:
        self._trigger = trigger
        self._seed = seed
        self._lockstep_us = lockstep_us
        has_bus = trigger is not None and bool(trigger.source)
        self._rings = {name: EdgeRing() for name in links} if has_bus else {}
        self._syncs = EdgeRing() if has_bus and lockstep_us else None

    def timing(self, link: str, clock: ClockSettings | None, truth: Path | None) -> Timing:
        """Return the clock and trigger settings of the link `link`."""
        trigger, is_source = self._trigger, self._is_source(link)
        return Timing(
            edges=self._edges(link),
            holdback_us=trigger.holdback_us if trigger is not None and trigger.source else 0,
            clock=clock,
            seed=self._seed,
            truth=truth if clock is not None else None,
            send_period_us=round(trigger.send_period_ms * 1000) if trigger is not None else 0,
            syncs=self._syncs if is_source else None,
        )

    def sink(self, link: str, run: EventRing) -> EdgeSink | None:
        """Return the sink for SYNCs on the bus of `link`, which is fed from `run`; None where they are not used."""
        if self._trigger is None or not self._is_source(link):
            return None
        # The session's ring comes last: when it has an edge, every link has it too.
        rings = [*self._rings.values(), *([] if self._syncs is None else [self._syncs])]
        return EdgeSink(rings, run, self._trigger.timing(self._seed), self._lockstep_us)

    def _edges(self, link: str) -> EdgeSource | None:
        if self._trigger is None:
            return None
        if self._trigger.period_ms:
            return PeriodicEdges(round(self._trigger.period_ms * 1000), self._trigger.timing(self._seed))
        if self._trigger.edges:
            return ListedEdges([edges.train() for edges in self._trigger.edges], self._trigger.channel)
        return self._rings.get(link)

    def _is_source(self, link: str) -> bool:
        return self._trigger is not None and self._trigger.source == link


_EXPOSURE_NS, _INTERVAL_NS = 4_000_000, 40_000_000


def initial_readings(rig: Rig) -> Mapping[ReadingKind, tuple[int, ...]]:
    """Return the settings of each kind of readings at the start, as `TakesReadings.reading_settings`."""
    has_host = any(LINKS[link.kind].serves == "usb" and not carries_second(rig, link.name) for link in rig.links)
    return {kind: () if has_host else settings for kind, settings in _driver_settings(rig).items()}


def _pulse_us(rig: Rig) -> int:
    return Trigger.pulse_us if rig.trigger is None else rig.trigger.pulse_us


def _driver_settings(rig: Rig) -> Mapping[ReadingKind, tuple[int, ...]]:
    settings = {}
    if rig.camera.frames is not None:
        width, height = rig.camera.size
        frames = FrameSettings(
            run=True, exposure_ns=_EXPOSURE_NS, interval_ns=_INTERVAL_NS, last_column=width - 1, last_row=height - 1
        )
        settings[ReadingKind.FRAMES] = dataclasses.astuple(frames)
    if rig.camera.imu is not None:
        unit = IMU_UNITS[rig.camera.imu.unit]
        settings[ReadingKind.IMU] = dataclasses.astuple(imported(IMU_DRIVERS[unit])(unit))
    return settings


log = logging.getLogger("evstim")

_IMU_RING = 16384  # samples, 16 s of them
_DRAIN_S = 1.0
_DRAIN_UNPACED_S = 10.0  # a run that waits for its links loses nothing, also where a link still compiles its coders


def build_session(
    rig: Rig,
    scene: Scene,
    setups: Sequence[LinkSetup[Any]],
    clock: Clock,
    truth: RunTruth | None = None,
    *,
    has_host: bool = True,
) -> Session:
    """Return a session of the rig; with a tolerance, its plan selects the effects, and the steps are controlled.

    `truth` records the truth beside the events; raises OSError where its file cannot be written. Without a host, frames
    and samples have a driver's default settings.
    """
    parameters, frames = planned_sensor(rig, scene), build_frames(rig, scene)
    steps = build_steps(rig, frames, parameters)
    if truth is None:
        sensor = build_sensor(rig, parameters)
    else:
        from emulator.run.truth.source import TruthSensor

        sensor = build_sensor(rig, parameters, TruthSensor)
        truth.begin(sensor, scene)
    first_setups = [setup for setup in setups if not carries_second(rig, setup.name)]
    settings = None if has_host else _driver_settings(rig)
    readings = ReadingSources(reading_sources(rig, scene, sensor), first_setups, settings)
    session = Session(frames, sensor, steps, setups, clock, readings)
    if rig.second_camera is not None:
        second = second_rig(rig)
        same = second.camera.model == rig.camera.model
        session.join(_second_view(second, parameters if same else second.camera.sensor, setups))
    return session


def planned_sensor(rig: Rig, scene: Scene) -> SensorParameters:
    """Return the rig's sensor; with a tolerance, without the effects that the plan of the run leaves out."""
    return plan_of(rig, scene).sensor if rig.run.tolerance_us else rig.camera.sensor


def plan_of(rig: Rig, scene: Scene) -> Plan:
    """Return the plan of the rig's run, from a probe of its scene."""
    from emulator.plan.plan import make_plan
    from emulator.plan.scene_probe import probe

    return make_plan(rig, probe(scene, rig.camera.sensor, rig.run.step_us * 1000, rig.run.seconds or 10.0))


def is_drawn_here(rig: Rig) -> bool:
    """Return whether the light of a rig is drawn by evstim, not by another program or played from a recording."""
    return rig.scene.kind != "external" and not SCENES[rig.scene.kind].events


def loads_of(rig: Rig, scene: Scene | None = None) -> list[LineLoad]:
    """Return the loads of the lines that have a limit, with the share that they carry of a scene that is drawn here."""
    if all(type(link).carries_hz is LinkParameters.carries_hz for link in rig.links):  # no line has a limit
        return []
    from emulator.plan.plan import line_loads

    loads = line_loads(rig)
    if not loads or scene is None or not is_drawn_here(rig):
        return loads
    return line_loads(rig, plan_of(rig, scene).probe.events_per_s)


def build_steps(rig: Rig, frames: SceneFrames, sensor: SensorParameters) -> StepSource:
    """Return the steps of the rig on its frames: controlled with a tolerance, else of one length."""
    first_ns = rig.run.step_us * 1000
    if not rig.run.tolerance_us:
        return FixedSteps(first_ns)
    from emulator.plan.plan import limits

    threshold = min(sensor.threshold_on, sensor.threshold_off)
    refinement = None if frames.last.at is None else RefinementModel(threshold)
    dark = at_temperature(sensor).dark_current_relative
    return ControlledSteps(limits(rig), dark, first_ns, refinement)


def _second_view(rig: Rig, parameters: SensorParameters, setups: Sequence[LinkSetup[Any]]) -> CameraView:
    names = [link.name for link in rig.links]
    scene, sensor = build_scene(rig), build_sensor(rig, parameters)
    second_setups = [setup for setup in setups if setup.name in names]
    readings = ReadingSources(reading_sources(rig, scene, sensor), second_setups)
    return CameraView(build_frames(rig, scene), sensor, readings, names)


def reading_sources(rig: Rig, scene: Scene, sensor: EventSource | None = None) -> list[ReadingSource]:
    """Return the sources of readings of the rig's camera; they disturb the events of `sensor`, where it allows this."""
    sources = _frame_sources(rig, sensor)
    if rig.camera.imu is not None:
        from emulator.run.imu import ImuSource, ImuUnit

        sources.append(ImuSource(ImuUnit(rig.camera.imu, carried(rig, rig.camera.imu, scene), rig.run.seed)))
    return sources


def carried(rig: Rig, imu: ImuParameters, scene: Scene) -> Carried:
    """Return path, gravity and time of the inertial unit; on a bench where the scene's camera has no path."""
    from emulator.run.imu import EARTH_IN_THE_PICTURE, Carried, Gravity
    from emulator.trajectory.building import HasCameraPath
    from emulator.trajectory.pose import Fixed, Timescale

    inner = scene
    while isinstance(inner, OtherLight):
        inner = inner.scene
    gravity = Gravity(np.array(imu.gravity_m_s2 or (0.0, 0.0, 0.0)), imu.gm_m3_s2)
    is_given = imu.gravity_m_s2 is not None or imu.gm_m3_s2 > 0
    if not isinstance(inner, HasCameraPath):
        return Carried(Fixed(), gravity if is_given else EARTH_IN_THE_PICTURE, Timescale())
    return Carried(inner.camera_path, gravity if is_given else _gravity_of(rig), inner.path_time)


def _gravity_of(rig: Rig) -> Gravity:
    """Return the gravity that the scene implies."""
    from emulator.run.imu import MOON_BELOW, WEIGHTLESS
    from emulator.scene.terrain.table import TerrainParameters
    from emulator.trajectory.live import GivenPath
    from emulator.trajectory.parameters import OrbitPath

    if isinstance(rig.scene, TerrainParameters):
        return MOON_BELOW
    path = getattr(rig.scene, "camera", None)
    path = path.table if isinstance(path, GivenPath) else path
    return dataclasses.replace(WEIGHTLESS, gm_m3_s2=path.gm_m3_s2) if isinstance(path, OrbitPath) else WEIGHTLESS


def _frame_sources(rig: Rig, sensor: EventSource | None = None) -> list[ReadingSource]:
    frames = rig.camera.frames
    if frames is None:
        return []
    from emulator.sensor.frames import FrameSource

    disturb = None
    if frames.kicks.share and sensor is not None:
        disturb = sensor.with_kicks(frames.kicks)
        if disturb is None:
            log.warning("row kicks are left out: this source of events cannot be disturbed by the reading of frames")
    return [FrameSource(frames, rig.run.seed, rig.camera.size, disturb)]


def _reading_rings(rig: Rig, kind: LinkKind[Any]) -> tuple[ReadingRing, ...]:
    """Return new rings for a link whose device has a use for readings."""
    if not _has_readings(kind):
        return ()
    imu = () if rig.camera.imu is None else (ReadingRing(ReadingKind.IMU, IMU_SAMPLE, _IMU_RING),)
    rings = (*ReadingSources.new_rings(_frame_sources(rig)), *imu)
    if kind.serves == "plain":  # its settings hold from the start, not from the first poll of its process
        settings = initial_readings(rig)
        for ring in rings:
            ring.write_settings(settings[ring.kind])
    return rings


def _has_readings(kind: LinkKind[Any]) -> bool:
    return kind.serves == "usb" or kind.has_readings


def build_sensor(rig: Rig, parameters: SensorParameters, kind: type[Sensor] = Sensor) -> EventSource:
    """Return the rig's sensor, of `parameters`, or the recording in its place.

    Raises RigError when the rig's pixels lack a required effect, SceneError when a recording cannot be used.
    """
    if events := SCENES[rig.scene.kind].events:
        source: EventSource = SCENES.imported(rig.scene.kind, events)(rig.scene, parameters)
        return source
    try:
        return kind(parameters, rig.run.seed, partial(own_pixels, threads=rig.run.threads))
    except ValueError as error:
        raise RigError(f"{rig.name}: {error}") from error


def build_frames(rig: Rig, scene: Scene) -> SceneFrames:
    """Return the scene's light frames with the parts that the rig's method uses; a tolerance refines single pixels."""
    refines = scene.refines or rig.run.tolerance_us > 0
    return SceneFrames(scene, with_rate=rig.run.method == "hermite", with_pixel_light=refines)


def schedule(rig: Rig) -> Schedule:
    """Return the schedule of the rig's run."""
    run = rig.run
    return Schedule(
        lead_ns=run.lead_us * 1000,
        duration_ns=round(run.seconds * 1e9) or None,
        paced=run.pace == "realtime",
        drain_s=_DRAIN_S if run.pace == "realtime" else _DRAIN_UNPACED_S,
        lockstep_ns=run.lockstep_us * 1000,
        max_late_us=run.max_late_ms * 1000,
        max_late_share=run.max_late_share,
    )


def record_paths(rig: Rig, record: Path | None) -> list[Path | None]:
    """Return the record file of each link: `record`, with the link's name in it when there are several."""
    if record is None or len(rig.links) == 1:
        return [record] * len(rig.links)
    from transports.recording.format import with_addition  # few runs record

    return [with_addition(record, link.name) for link in rig.links]


def link_setups(
    rig: Rig, record: Path | None = None, truth: Path | None = None, fault_log: Path | None = None
) -> list[LinkSetup[Any]]:
    """Return the set-up of each link's process; the files record delivered events, their times, and faults."""
    triggers = TriggerPaths(rig.trigger, [link.name for link in rig.links], rig.run.seed, rig.run.lockstep_us)
    paths = zip(rig.links, record_paths(rig, record), record_paths(rig, truth), strict=True)
    setups = [
        _link_setup(rig, link, path, triggers, triggers.timing(link.name, rig.camera.clock, shown), fault_log)
        for link, path, shown in paths
    ]
    setups = setups if rig.second_camera is None else _wired(rig.second_camera.links, setups)
    run = rig.run
    return [dataclasses.replace(setup, fifo_priority=run.fifo_priority, restart=run.restart_links) for setup in setups]


def _wired(slaves: Sequence[str], setups: Sequence[LinkSetup[Any]]) -> list[LinkSetup[Any]]:
    """Return the links with the cable between the cameras: the first link of the first camera is the master's end.

    The first camera's clock is the master: each link of the second one receives its resets. Raises RigError where the
    first camera has no link.
    """
    cables = {name: EdgeRing() for name in slaves}
    master = next((setup.name for setup in setups if setup.name not in cables), None)
    if master is None:
        raise RigError("second_camera: the first camera needs a link too, as the master of the clocks")

    def at_the_cable(setup: LinkSetup[Any]) -> LinkSetup[Any]:
        out = tuple(cables.values()) if setup.name == master else ()
        timing = dataclasses.replace(setup.timing, sync_out=out, sync_in=cables.get(setup.name))
        return dataclasses.replace(setup, timing=timing)

    return [at_the_cable(setup) for setup in setups]


def _link_setup(
    rig: Rig, link: LinkParameters, record: Path | None, triggers: TriggerPaths, timing: Timing, fault_log: Path | None
) -> LinkSetup[Any]:
    ring, kind = EventRing(), LINKS[link.kind]
    is_master = not carries_second(rig, link.name)
    rig = rig if is_master else dataclasses.replace(second_rig(rig), trigger=rig.trigger)
    facts = _facts(rig, kind)
    camera = CameraFacts(rig.camera.model, rig.camera.size, streams=facts.streams, imu_unit=facts.imu_unit)
    faults = tuple(fault for fault in rig.faults if fault.link == link.name)
    plan = FaultPlan(link.name, faults, rig.run.seed, fault_log)
    wiring = Wiring(plan, triggers.sink(link.name, ring), camera)
    made_by = LINKS.imported(kind.name, kind.endpoint)
    is_endpoint = isinstance(made_by, type) and issubclass(made_by, Endpoint)
    endpoint = LinkFactory(made_by, link, wiring) if is_endpoint else made_by(link, wiring)
    setup = LinkSetup(
        link.name, ring, _device(rig, link, kind, is_master), endpoint, _recorder(record), timing=timing, facts=facts
    )
    return dataclasses.replace(setup, readings=_reading_rings(rig, kind))


def _recorder(path: Path | None) -> RecorderFactory | None:
    """Return the recorder of a link's file; its module is imported only for a run that has one."""
    if path is None:
        return None
    from transports.recording.live import FileRecorder

    return FileRecorder(path)


def _facts(rig: Rig, kind: LinkKind[Any]) -> Facts:
    """Return the camera's facts for the link's recording."""
    facts = Facts(rig.camera.size, f"{rig.camera.model.upper()}_{rig.camera.serial}")
    if not _has_readings(kind):
        return facts
    tables = {"frames": rig.camera.frames, "imu": rig.camera.imu}
    streams = facts.streams | {name for name, table in tables.items() if table is not None}
    unit = facts.imu_unit if rig.camera.imu is None else IMU_UNITS[rig.camera.imu.unit]
    return dataclasses.replace(facts, streams=streams, imu_unit=unit)


def _device(rig: Rig, link: LinkParameters, kind: LinkKind[Any], is_master: bool) -> Callable[[], Any]:
    if kind.serves == "plain":
        readings = initial_readings(rig) if kind.has_readings else {}
        return partial(PlainDevice, readings=readings, pulse_us=_pulse_us(rig))
    if kind.serves == "gige":
        gige = CAMERA_MODELS[rig.camera.model].gige
        if gige is None:
            raise RigError(f"{rig.name}: a {rig.camera.model} is no GigE Vision device")
        return gige(rig.camera, link, _pulse_us(rig))
    return _instrument(rig, link) if kind.serves == "instrument" else _usb_camera(rig, kind, is_master)


def _instrument(rig: Rig, link: Any) -> Callable[[], EventDevice]:
    from firmware_protocol.instrument.instrument import Instrument

    biases_of = CAMERA_MODELS[rig.camera.model].commanded_biases
    biases = None if biases_of is None else biases_of(rig.camera)
    return partial(Instrument, rig.camera.size, link.instrument, biases)


def _usb_camera(rig: Rig, kind: LinkKind[Any], is_master: bool) -> Callable[[], UsbCamera]:
    usb = usb_model(rig.camera, kind)
    if usb is None:
        raise RigError(f"{rig.name}: there is no USB model for a {rig.camera.model} yet")
    delay_ms = rig.camera.start_delay_ms if kind.usb_model is None else 0.0
    return usb.device(rig.camera, UsbSettings(delay_ms, _pulse_us(rig), is_master))
