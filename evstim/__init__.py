"""Event cameras for space, simulated: light in, events out, over the links of a real camera.

    evstim.Sensor                   numpy pictures in, events out
    evstim.events_from_frames       an array of frames in, events out, in one call
    evstim.run                      a whole rig: scene, sensor, camera and links; its events while it runs
    evstim.SerialReceiver, ...      the ground side of a link: bytes in, events out
    evstim.__version__              the version that is installed

Every name is imported on its first use, so `import evstim` alone loads neither numpy nor the compiled kernels.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emulator.light import MachineLacks, Scene, SceneError
    from emulator.optics.lens import LensParameters
    from emulator.playback.recording import RecordingParameters
    from emulator.rig.loading import Rig, RigError, load_rig, parse_rig, shipped_rigs
    from emulator.rig.tables import Camera
    from emulator.rig.tables import Run as RunParameters
    from emulator.rig.trigger_table import Trigger
    from emulator.run.link_process import LinkFailed
    from emulator.run.outcome import RunResult
    from emulator.run.scene_assembly import build_scene
    from emulator.scene.bodies.table import BodiesParameters
    from emulator.scene.checkerboard.table import CheckerboardParameters
    from emulator.scene.stars.table import StarsParameters
    from emulator.scene.terrain.table import TerrainParameters
    from emulator.scene.video.video import VideoParameters
    from emulator.sensor.presets import PRESETS, SensorParameters
    from emulator.trajectory.conventions import from_basilisk as attitude_from_basilisk
    from emulator.trajectory.conventions import from_opengl as attitude_from_opengl
    from emulator.trajectory.conventions import from_scalar_last as attitude_from_scalar_last
    from emulator.trajectory.conventions import from_spice as attitude_from_spice
    from evstim.frames import events_from_frames, events_from_video
    from evstim.reconstruction import reconstruct
    from evstim.running import LiveRun, run
    from evstim.sensor import Sensor
    from firmware_protocol.edges import EDGE
    from firmware_protocol.events import EVENT
    from firmware_protocol.packets.profile import Profile
    from firmware_protocol.receiver.can import CanReceiver, CanReceiverSettings
    from firmware_protocol.receiver.clock_estimator import ClockEstimate, ClockEstimator
    from firmware_protocol.receiver.davis import DavisReceiver
    from firmware_protocol.receiver.serial import SerialReceiver
    from transports.can_bus.parameters import CanParameters
    from transports.recording.record import load_record
    from transports.serial_line.parameters import SerialParameters
    from transports.usb.loopback_kind import LoopbackLink
    from transports.usb.usbip.parameters import UsbipLink

__all__ = [
    "EDGE",
    "EVENT",
    "PRESETS",
    "BodiesParameters",
    "Camera",
    "CanParameters",
    "CanReceiver",
    "CanReceiverSettings",
    "CheckerboardParameters",
    "ClockEstimate",
    "ClockEstimator",
    "DavisReceiver",
    "LensParameters",
    "LinkFailed",
    "LiveRun",
    "LoopbackLink",
    "MachineLacks",
    "Profile",
    "RecordingParameters",
    "Rig",
    "RigError",
    "RunParameters",
    "RunResult",
    "Scene",
    "SceneError",
    "Sensor",
    "SensorParameters",
    "SerialParameters",
    "SerialReceiver",
    "StarsParameters",
    "TerrainParameters",
    "Trigger",
    "UsbipLink",
    "VideoParameters",
    "attitude_from_basilisk",
    "attitude_from_opengl",
    "attitude_from_scalar_last",
    "attitude_from_spice",
    "build_scene",
    "events_from_frames",
    "events_from_video",
    "load_record",
    "load_rig",
    "parse_rig",
    "reconstruct",
    "run",
    "shipped_rigs",
]

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
    "LoopbackLink": "transports.usb.loopback_kind",
    "MachineLacks": "emulator.light",
    "Profile": "firmware_protocol.packets.profile",
    "RecordingParameters": "emulator.playback.recording",
    "Rig": "emulator.rig.loading",
    "RigError": "emulator.rig.loading",
    "RunParameters": "emulator.rig.tables:Run",
    "RunResult": "emulator.run.outcome",
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
    "load_record": "transports.recording.record",
    "load_rig": "emulator.rig.loading",
    "parse_rig": "emulator.rig.loading",
    "reconstruct": "evstim.reconstruction",
    "run": "evstim.running",
    "shipped_rigs": "emulator.rig.loading",
}
"""Public name -> "module", or "module:name there" where the two names differ."""

__version__: str

if not TYPE_CHECKING:  # else a type checker would take any name for one of ours

    def __getattr__(name: str) -> Any:
        """Import a public name on its first use."""
        if name == "__version__":
            value = import_module("importlib.metadata").version("evstim")
        elif name in _SOURCES:
            module, _, there = _SOURCES[name].partition(":")
            value = getattr(import_module(module), there or name)
        else:
            raise AttributeError(f"module 'evstim' has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not, and those that every module has."""
    return sorted({"__version__", *__all__, *(name for name in globals() if name.startswith("__"))})
