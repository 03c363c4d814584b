"""From a rig to the parts of a run."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.light import Scene
from emulator.plan.plan import limits, make_plan
from emulator.plan.scene_probe import probe
from emulator.plan.step_control import ControlledSteps, FixedSteps, RefinementModel, StepSource
from emulator.rig.camera_models import CAMERA_MODELS, IMU_UNITS, UsbSettings
from emulator.rig.link_kinds import LINKS
from emulator.rig.loading import Rig, RigError, Run
from emulator.rig.scene_kinds import SCENES
from emulator.run.frames import Pictures
from emulator.run.inertial import imu_source
from emulator.run.plain_camera import asked_readings, plain_camera
from emulator.run.readings import ReadingSource, ReadingSources
from emulator.run.scene_assembly import build_scene
from emulator.run.session import Schedule, Session
from emulator.run.stereo import SecondView, carries_second, second_rig, wired
from emulator.run.triggers import TriggerPaths
from emulator.sensor.aps.source import FrameSource
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.event_source import EventSource
from emulator.sensor.gpu.array import GpuArray
from emulator.sensor.other_simulators import OTHER_SIMULATORS
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import MakePixels, Sensor
from emulator.tables.registry import imported
from firmware_protocol.gige.settings import GigeSettings
from firmware_protocol.gige.triton2 import Triton2
from firmware_protocol.imu_samples import IMU_SAMPLE
from firmware_protocol.instrument.biases import Imx636Biases
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.plain_device import PlainDevice
from firmware_protocol.readings import ReadingKind
from firmware_protocol.usb.device import UsbCamera
from transports.faults.script import FaultPlan
from transports.link.feed import Timing
from transports.link.kind import CameraFacts, LinkKind, LinkParameters, Wiring
from transports.link.pacing import Clock
from transports.link.process import LinkSetup
from transports.link.reading_ring import ReadingRing
from transports.link.ring import EventRing
from transports.recording.format import with_addition
from transports.recording.part import Facts

if TYPE_CHECKING:
    from emulator.run.truth.output import TruthFile

__all__ = [
    "build_pictures",
    "build_sensor",
    "build_session",
    "link_setups",
    "reading_sources",
    "record_paths",
    "schedule",
]


log = logging.getLogger("evstim")

_IMU_RING = 16384  # samples, 16 s of them
_DRAIN_S = 1.0
_DRAIN_UNPACED_S = 10.0  # a run that waits for its links loses nothing, also where a link still compiles its coders


def build_session(
    rig: Rig, scene: Scene, setups: Sequence[LinkSetup[Any]], clock: Clock, truth: TruthFile | None = None
) -> Session:
    """Return a session of the rig: with a tolerance, of what its plan keeps, in controlled steps.

    `truth` takes down what is true beside the events; raises OSError where its file cannot be written.
    """
    run, parameters = rig.run, rig.camera.sensor
    pictures = build_pictures(rig, scene)
    steps: StepSource = FixedSteps(run.step_us * 1000)
    if run.tolerance_us:
        parameters = make_plan(rig, probe(scene, parameters, run.step_us * 1000, run.seconds or 10.0)).sensor
        dark = at_temperature(parameters).dark_current_relative
        refines = pictures.pixel_light is not None and run.pixels == "cpu"
        refinement = None if not refines else RefinementModel(min(parameters.threshold_on, parameters.threshold_off))
        steps = ControlledSteps(limits(rig, scene.motion_bound_px_s), dark, run.step_us * 1000, refinement)
    sensor = build_sensor(rig, parameters) if truth is None else _with_truth(rig, parameters, scene, truth)
    own = [setup for setup in setups if not carries_second(rig, setup.name)]
    readings = ReadingSources(reading_sources(rig, scene, sensor), own)
    session = Session(pictures, sensor, steps, setups, clock, readings)
    if rig.second_camera is not None:
        session.join(_second_view(second_rig(rig), parameters, setups))
    return session


def _second_view(rig: Rig, parameters: SensorParameters, setups: Sequence[LinkSetup[Any]]) -> SecondView:
    names = [link.name for link in rig.links]
    scene, sensor = build_scene(rig), build_sensor(rig, parameters)
    own = [setup for setup in setups if setup.name in names]
    readings = ReadingSources(reading_sources(rig, scene, sensor), own)
    return SecondView(build_pictures(rig, scene), sensor, readings, names)


def reading_sources(rig: Rig, scene: Scene, sensor: EventSource | None = None) -> list[ReadingSource]:
    """Return what the rig's camera reads beside events; it disturbs those of `sensor`, where this can be disturbed."""
    imu = imu_source(rig, scene)
    return [*_frame_sources(rig, sensor), *([] if imu is None else [imu])]


def _frame_sources(rig: Rig, sensor: EventSource | None = None) -> list[ReadingSource]:
    frames = rig.camera.frames
    if frames is None:
        return []
    disturb = None
    if frames.kicks.share and sensor is not None:
        if isinstance(sensor, Sensor) and sensor.with_kicks(frames.kicks):
            disturb = sensor.disturb
        else:
            log.warning("row kicks are left out: this source of events cannot be disturbed by the reading of frames")
    return [FrameSource(frames, rig.run.seed, rig.camera.size, disturb)]


def _reading_rings(rig: Rig, kind: LinkKind[Any]) -> tuple[ReadingRing, ...]:
    """Return new rings for a link whose device has a use for readings."""
    if not _has_readings(kind):
        return ()
    imu = () if rig.camera.imu is None else (ReadingRing(ReadingKind.IMU, IMU_SAMPLE, _IMU_RING),)
    rings = (*ReadingSources.new_rings(_frame_sources(rig)), *imu)
    if kind.serves == "plain":  # what it asks holds from the start, not from its process's first look
        asked = asked_readings(rig)
        for ring in rings:
            ring.tell(asked[ring.kind])
    return rings


def _has_readings(kind: LinkKind[Any]) -> bool:
    return kind.serves == "usb" or kind.has_readings


def _with_truth(rig: Rig, parameters: SensorParameters, scene: Scene, truth: TruthFile) -> EventSource:
    from emulator.sensor.origins import TracedSensor

    return truth.source(build_sensor(rig, parameters, TracedSensor), scene)


def build_sensor(rig: Rig, parameters: SensorParameters, kind: type[Sensor] = Sensor) -> EventSource:
    """Return the rig's sensor, of `parameters`, or the recording in its place.

    Raises RigError when the rig's method lacks an effect that is asked for, SceneError when a recording cannot be used.
    """
    if events := SCENES[rig.scene.kind].events:
        source: EventSource = imported(events)(rig.scene, parameters)
        return source
    try:
        return kind(parameters, rig.run.seed, _pixels(rig.run))
    except ValueError as error:
        asked = f"method = {rig.run.method!r}" if rig.run.pixels == "cpu" else f"pixels = {rig.run.pixels!r}"
        raise RigError(f"{rig.name}: run.{asked}: {error}") from error


def _pixels(run: Run) -> MakePixels:
    if run.pixels == "gpu":
        return GpuArray
    return OTHER_SIMULATORS.get(run.method) or partial(PixelArray, threads=run.threads)


def build_pictures(rig: Rig, scene: Scene) -> Pictures:
    """Return the scene's pictures, as the rig's method wants them; undersampled steps are refined for a tolerance."""
    return Pictures(scene, with_rate=rig.run.method == "hermite", halving=rig.run.tolerance_us > 0)


def schedule(rig: Rig) -> Schedule:
    """Return how the rig's run goes through time."""
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
    """Return where each link records: the file asked for, with the link's name in it when there are several."""
    if record is None or len(rig.links) == 1:
        return [record] * len(rig.links)
    return [with_addition(record, link.name) for link in rig.links]


def link_setups(
    rig: Rig, record: Path | None = None, truth: Path | None = None, fault_log: Path | None = None
) -> list[LinkSetup[Any]]:
    """Return what each link's process needs; the files are for what was delivered, and when, and what faults did."""
    triggers = TriggerPaths(rig.trigger, [link.name for link in rig.links], rig.run.seed, rig.run.lockstep_us)
    paths = zip(rig.links, record_paths(rig, record), record_paths(rig, truth), strict=True)
    setups = [
        _link_setup(rig, link, path, triggers, triggers.timing(link.name, rig.camera.clock, shown), fault_log)
        for link, path, shown in paths
    ]
    setups = setups if rig.second_camera is None else wired(rig.second_camera.links, setups)
    run = rig.run
    return [dataclasses.replace(setup, fifo_priority=run.fifo_priority, restart=run.restart_links) for setup in setups]


def _link_setup(
    rig: Rig, link: LinkParameters, record: Path | None, triggers: TriggerPaths, timing: Timing, fault_log: Path | None
) -> LinkSetup[Any]:
    ring, kind = EventRing(), LINKS[link.kind]
    is_master = not carries_second(rig, link.name)
    rig = rig if is_master else dataclasses.replace(second_rig(rig), trigger=rig.trigger)
    facts = _facts(rig, kind)
    camera = CameraFacts(rig.camera.model, rig.camera.size, streams=facts.streams, imu_unit=facts.imu_unit)
    endpoint = kind.endpoint(link, Wiring(_faults(rig, link, fault_log), triggers.sink(link.name, ring), camera))
    setup = LinkSetup(
        link.name, ring, _device(rig, link, kind, is_master), endpoint, record, timing=timing, facts=facts
    )
    return dataclasses.replace(setup, readings=_reading_rings(rig, kind))


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
        return plain_camera(rig) if kind.has_readings else PlainDevice
    if kind.serves == "gige":
        return _gige_camera(rig, link)
    return _instrument(rig, link) if kind.serves == "instrument" else _usb_camera(rig, kind, is_master)


def _faults(rig: Rig, link: LinkParameters, log: Path | None) -> FaultPlan:
    return FaultPlan(link.name, tuple(f for f in rig.faults if f.link == link.name), rig.run.seed, log)


def _instrument(rig: Rig, link: Any) -> Callable[[], Instrument]:
    biases = Imx636Biases(rig.camera.bias_model) if CAMERA_MODELS[rig.camera.model].is_imx636 else None
    return partial(Instrument, rig.camera.size, link.instrument, biases)


def _gige_camera(rig: Rig, link: Any) -> Callable[[], Triton2]:
    settings = GigeSettings(
        size=rig.camera.size,
        address=link.host,
        serial=rig.camera.serial,
        start_delay_us=round(rig.camera.start_delay_ms * 1000),
        block_us=link.block_us,
        biases=rig.camera.bias_model,
    )
    return partial(Triton2, settings)


def _usb_camera(rig: Rig, kind: LinkKind[Any], is_master: bool) -> Callable[[], UsbCamera]:
    model = CAMERA_MODELS[kind.usb_model or rig.camera.model]
    if model.usb is None:
        raise RigError(f"{rig.name}: there is no USB model for a {rig.camera.model} yet")
    delay_ms = rig.camera.start_delay_ms if kind.start_delay else 0.0
    pulse_us = None if rig.trigger is None else rig.trigger.pulse_us
    return model.usb.device(rig.camera, UsbSettings(delay_ms, pulse_us, is_master))
