"""Event cameras for space, simulated: light in, events out, over the links of a real camera.

    evstim.Sensor                   numpy pictures in, events out
    evstim.events_from_frames       an array of frames in, events out, in one call
    evstim.run                      a whole rig: scene, sensor, camera and links; its events while it runs
    evstim.SerialReceiver, ...      the ground side of a link: bytes in, events out

Every name is imported on its first use, so `import evstim` alone loads neither numpy nor the compiled kernels.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emulator.light import MachineLacks as MachineLacks
    from emulator.light import Scene as Scene
    from emulator.light import SceneError as SceneError
    from emulator.optics.lens import LensParameters as LensParameters
    from emulator.playback.recording import RecordingParameters as RecordingParameters
    from emulator.rig.loading import Rig as Rig
    from emulator.rig.loading import RigError as RigError
    from emulator.rig.loading import load_rig as load_rig
    from emulator.rig.loading import parse_rig as parse_rig
    from emulator.rig.loading import shipped_rigs as shipped_rigs
    from emulator.rig.tables import Camera as Camera
    from emulator.rig.tables import LoopbackLink as LoopbackLink
    from emulator.rig.tables import Run as RunParameters
    from emulator.rig.trigger_table import Trigger as Trigger
    from emulator.run.link_process import LinkFailed as LinkFailed
    from emulator.run.scene_assembly import build_scene as build_scene
    from emulator.run.session import RunResult as RunResult
    from emulator.scene.bodies.table import BodiesParameters as BodiesParameters
    from emulator.scene.checkerboard.table import CheckerboardParameters as CheckerboardParameters
    from emulator.scene.stars.table import StarsParameters as StarsParameters
    from emulator.scene.terrain.table import TerrainParameters as TerrainParameters
    from emulator.scene.video.video import VideoParameters as VideoParameters
    from emulator.sensor.presets import PRESETS as PRESETS
    from emulator.sensor.presets import SensorParameters as SensorParameters
    from emulator.trajectory.conventions import from_basilisk as attitude_from_basilisk
    from emulator.trajectory.conventions import from_opengl as attitude_from_opengl
    from emulator.trajectory.conventions import from_scalar_last as attitude_from_scalar_last
    from emulator.trajectory.conventions import from_spice as attitude_from_spice
    from evstim.frames import events_from_frames as events_from_frames
    from evstim.frames import events_from_video as events_from_video
    from evstim.reconstruction import reconstruct as reconstruct
    from evstim.running import LiveRun as LiveRun
    from evstim.running import run as run
    from evstim.sensor import Sensor as Sensor
    from firmware_protocol.edges import EDGE as EDGE
    from firmware_protocol.events import EVENT as EVENT
    from firmware_protocol.packets.profile import Profile as Profile
    from firmware_protocol.receiver.can import CanReceiver as CanReceiver
    from firmware_protocol.receiver.can import CanReceiverSettings as CanReceiverSettings
    from firmware_protocol.receiver.clock_estimator import ClockEstimate as ClockEstimate
    from firmware_protocol.receiver.clock_estimator import ClockEstimator as ClockEstimator
    from firmware_protocol.receiver.davis import DavisReceiver as DavisReceiver
    from firmware_protocol.receiver.serial import SerialReceiver as SerialReceiver
    from transports.can_bus.parameters import CanParameters as CanParameters
    from transports.link.record import load_record as load_record
    from transports.serial_line.parameters import SerialParameters as SerialParameters
    from transports.usb.usbip.parameters import UsbipLink as UsbipLink

_SOURCES = {
    "EDGE": "firmware_protocol.edges",
    "EVENT": "firmware_protocol.events",
    "PRESETS": "emulator.sensor.presets",
    "BodiesParameters": "emulator.scene.bodies.table",
    "Camera": "emulator.rig.tables",
    "CanParameters": "transports.can_bus.parameters",
    "CanReceiver": "firmware_protocol.receiver.can",
    "CanReceiverSettings": "firmware_protocol.receiver.can",
    "CheckerboardParameters": "emulator.scene.checkerboard.table",
    "ClockEstimate": "firmware_protocol.receiver.clock_estimator",
    "ClockEstimator": "firmware_protocol.receiver.clock_estimator",
    "DavisReceiver": "firmware_protocol.receiver.davis",
    "LensParameters": "emulator.optics.lens",
    "LinkFailed": "emulator.run.link_process",
    "LiveRun": "evstim.running",
    "LoopbackLink": "emulator.rig.tables",
    "MachineLacks": "emulator.light",
    "Profile": "firmware_protocol.packets.profile",
    "RecordingParameters": "emulator.playback.recording",
    "Rig": "emulator.rig.loading",
    "RigError": "emulator.rig.loading",
    "RunParameters": "emulator.rig.tables:Run",
    "RunResult": "emulator.run.session",
    "Scene": "emulator.light",
    "SceneError": "emulator.light",
    "Sensor": "evstim.sensor",
    "SensorParameters": "emulator.sensor.presets",
    "SerialParameters": "transports.serial_line.parameters",
    "SerialReceiver": "firmware_protocol.receiver.serial",
    "StarsParameters": "emulator.scene.stars.table",
    "TerrainParameters": "emulator.scene.terrain.table",
    "Trigger": "emulator.rig.trigger_table",
    "UsbipLink": "transports.usb.usbip.parameters",
    "VideoParameters": "emulator.scene.video.video",
    "attitude_from_basilisk": "emulator.trajectory.conventions:from_basilisk",
    "attitude_from_opengl": "emulator.trajectory.conventions:from_opengl",
    "attitude_from_scalar_last": "emulator.trajectory.conventions:from_scalar_last",
    "attitude_from_spice": "emulator.trajectory.conventions:from_spice",
    "build_scene": "emulator.run.scene_assembly",
    "events_from_frames": "evstim.frames",
    "events_from_video": "evstim.frames",
    "load_record": "transports.link.record",
    "load_rig": "emulator.rig.loading",
    "parse_rig": "emulator.rig.loading",
    "reconstruct": "evstim.reconstruction",
    "run": "evstim.running",
    "shipped_rigs": "emulator.rig.loading",
}
"""Public name -> "module", or "module:name there" where the two names differ."""

__all__ = list(_SOURCES)  # noqa: PLE0604: the imports above tell the same names to type checkers


def __getattr__(name: str) -> Any:
    """Import a public name on its first use."""
    if name not in _SOURCES:
        raise AttributeError(f"module 'evstim' has no attribute {name!r}")
    module, _, there = _SOURCES[name].partition(":")
    value = getattr(import_module(module), there or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})
