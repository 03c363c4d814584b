"""From a rig to the parts of a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from emulator.light import Scene
from emulator.plan.plan import limits, make_plan
from emulator.plan.scene_probe import probe
from emulator.plan.step_control import ControlledSteps, FixedSteps, RefinementModel, StepSource
from emulator.playback.recording import RecordingParameters, load_recording
from emulator.playback.replay import Replay
from emulator.rig.loading import LinkParameters, LoopbackLink, Rig, RigError, Run, UsbipLink
from emulator.run.frames import Pictures
from emulator.run.session import Schedule, Session
from emulator.run.triggers import TriggerPaths
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.event_source import EventSource
from emulator.sensor.gpu.array import GpuArray
from emulator.sensor.other_simulators import OTHER_SIMULATORS
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import MakePixels, Sensor
from firmware_protocol.davis346 import Davis346, Davis346Settings, Layout
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.usb.device import Speed, UsbCamera
from transports.can_bus.endpoint import CanFactory
from transports.can_bus.parameters import CanParameters
from transports.faults.script import FaultPlan
from transports.link.endpoint import EndpointFactory
from transports.link.feed import Timing
from transports.link.pacing import Clock
from transports.link.process import LinkSetup
from transports.link.ring import EventRing
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.parameters import SerialParameters
from transports.usb.loopback import LoopbackFactory
from transports.usb.usbip.endpoint import UsbipFactory

__all__ = [
    "build_pictures",
    "build_sensor",
    "build_session",
    "link_setups",
    "record_paths",
    "schedule",
]


def build_session(rig: Rig, scene: Scene, setups: Sequence[LinkSetup[Any]], clock: Clock) -> Session:
    """Return a session of the rig: with a tolerance, of what its plan keeps, in controlled steps."""
    run, parameters = rig.run, rig.camera.sensor
    steps: StepSource = FixedSteps(run.step_us * 1000)
    if run.tolerance_us:
        parameters = make_plan(rig, probe(scene, parameters, run.step_us * 1000, run.seconds or 10.0)).sensor
        dark = at_temperature(parameters).dark_current_relative
        refines = scene.pixel_light is not None and run.pixels == "cpu"
        refinement = None if not refines else RefinementModel(min(parameters.threshold_on, parameters.threshold_off))
        steps = ControlledSteps(limits(rig, scene.motion_bound_px_s), dark, run.step_us * 1000, refinement)
    return Session(build_pictures(rig, scene), build_sensor(rig, parameters), steps, setups, clock)


def build_sensor(rig: Rig, parameters: SensorParameters) -> EventSource:
    """Return the rig's sensor, of `parameters`, or the recording in its place.

    Raises RigError when the rig's method lacks an effect that is asked for, SceneError when a recording cannot be used.
    """
    if isinstance(rig.scene, RecordingParameters):
        return _replay(rig.scene, parameters)
    try:
        return Sensor(parameters, rig.run.seed, _pixels(rig.run))
    except ValueError as error:
        asked = f"method = {rig.run.method!r}" if rig.run.pixels == "cpu" else f"pixels = {rig.run.pixels!r}"
        raise RigError(f"{rig.name}: run.{asked}: {error}") from error


def _pixels(run: Run) -> MakePixels:
    return GpuArray if run.pixels == "gpu" else OTHER_SIMULATORS.get(run.method, PixelArray)


def _replay(p: RecordingParameters, parameters: SensorParameters) -> Replay:
    recording = load_recording(Path(p.path), (parameters.width, parameters.height))
    return Replay(parameters, recording, time_scale=p.time_scale, loop=p.loop, through_readout=p.through_readout)


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
        lockstep_ns=run.lockstep_us * 1000,
        max_late_us=run.max_late_ms * 1000,
    )


def record_paths(rig: Rig, record: Path | None) -> list[Path | None]:
    """Return where each link records: the file asked for, with the link's name in it when there are several."""
    if record is None or len(rig.links) == 1:
        return [record] * len(rig.links)
    return [record.with_name(f"{record.stem}-{link.name}{record.suffix}") for link in rig.links]


def link_setups(
    rig: Rig, record: Path | None = None, truth: Path | None = None, fault_log: Path | None = None
) -> list[LinkSetup[Any]]:
    """Return what each link's process needs; the files are for what was delivered, and when, and what faults did."""
    triggers = TriggerPaths(rig.trigger, [link.name for link in rig.links], rig.run.seed, rig.run.lockstep_us)
    setups = [
        _link_setup(rig, link, path, triggers, triggers.timing(link.name, rig.camera.clock, shown), fault_log)
        for link, path, shown in zip(rig.links, record_paths(rig, record), record_paths(rig, truth), strict=True)
    ]
    run = rig.run
    return [dataclasses.replace(setup, fifo_priority=run.fifo_priority, restart=run.restart_links) for setup in setups]


def _link_setup(
    rig: Rig, link: LinkParameters, record: Path | None, triggers: TriggerPaths, timing: Timing, fault_log: Path | None
) -> LinkSetup[Any]:
    ring = EventRing()
    if isinstance(link, SerialParameters):
        line = SerialFactory(link, _faults(rig, link, fault_log))
        return LinkSetup(link.name, ring, _instrument(rig, link.instrument), line, record, timing=timing)
    if isinstance(link, CanParameters):
        endpoint = CanFactory(link, triggers.sink(link.name, ring), _faults(rig, link, fault_log))
        return LinkSetup(link.name, ring, _instrument(rig, link.instrument), endpoint, record, timing=timing)
    camera: Callable[[], UsbCamera] = partial(Davis346, _camera(rig, link))
    endpoint_on_usb = _usb_endpoint(link, _faults(rig, link, fault_log))
    return LinkSetup(link.name, ring, camera, endpoint_on_usb, record, timing=timing)


def _faults(rig: Rig, link: LinkParameters, log: Path | None) -> FaultPlan:
    return FaultPlan(link.name, tuple(f for f in rig.faults if f.link == link.name), rig.run.seed, log)


def _instrument(rig: Rig, settings: InstrumentSettings) -> Callable[[], Instrument]:
    size = (rig.camera.sensor.width, rig.camera.sensor.height)
    return partial(Instrument, size, settings)


def _camera(rig: Rig, link: UsbipLink | LoopbackLink) -> Davis346Settings:
    camera = rig.camera
    # The loopback host never loses its way at the start, so it need not wait.
    delay_ms = 0.0 if isinstance(link, LoopbackLink) else camera.start_delay_ms
    return Davis346Settings(
        serial=camera.serial,
        size=(camera.sensor.width, camera.sensor.height),
        speed=Speed[camera.speed.upper()],
        layout=Layout[camera.layout.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(delay_ms * 1000),
        pulse_us=rig.trigger.pulse_us if rig.trigger else Davis346Settings.pulse_us,
    )


def _usb_endpoint(link: UsbipLink | LoopbackLink, faults: FaultPlan) -> EndpointFactory[UsbCamera]:
    if isinstance(link, LoopbackLink):
        return LoopbackFactory()
    return UsbipFactory(link.host, link.port, link.busid, faults, link.allow)
