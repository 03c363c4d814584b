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
    from emulator.rig.tables import Camera, Trigger
    from emulator.rig.tables import Run as RunParameters
    from emulator.run.assembly import build_scene
    from emulator.run.link_process import LinkFailed
    from emulator.run.outcome import RunResult
    from emulator.scene.bodies.table import BodiesParameters
    from emulator.scene.checkerboard.table import CheckerboardParameters
    from emulator.scene.stars.table import StarsParameters
    from emulator.scene.terrain.table import TerrainParameters
    from emulator.scene.video.video import VideoParameters
    from emulator.sensor.presets import PRESETS, SensorParameters
    from emulator.trajectory.pose import from_basilisk as attitude_from_basilisk
    from emulator.trajectory.pose import from_opengl as attitude_from_opengl
    from emulator.trajectory.pose import from_scalar_last as attitude_from_scalar_last
    from emulator.trajectory.pose import from_spice as attitude_from_spice
    from evstim.frames import events_from_frames, events_from_video, reconstruct
    from evstim.running import LiveRun, run
    from evstim.sensor import Sensor
    from firmware_protocol.events import EDGE, EVENT
    from firmware_protocol.packets.profile import Profile
    from firmware_protocol.receiver.can import CanReceiver, CanReceiverSettings
    from firmware_protocol.receiver.clock_estimator import ClockEstimate, ClockEstimator, DavisReceiver
    from firmware_protocol.receiver.instrument import SerialReceiver
    from transports.can_bus.kind import CanParameters
    from transports.recording.record import load_record
    from transports.serial_line.kind import SerialParameters
    from transports.usb.loopback import LoopbackLink
    from transports.usb.usbip.kind import UsbipLink

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
    "EDGE": "firmware_protocol.events",
    "EVENT": "firmware_protocol.events",
    "PRESETS": "emulator.sensor.presets",
    "BodiesParameters": "emulator.scene.bodies.table",
    "Camera": "emulator.rig.tables",
    "CanParameters": "transports.can_bus.kind",
    "CanReceiver": "firmware_protocol.receiver.can",
    "CanReceiverSettings": "firmware_protocol.receiver.can",
    "CheckerboardParameters": "emulator.scene.checkerboard.table",
    "ClockEstimate": "firmware_protocol.receiver.clock_estimator",
    "ClockEstimator": "firmware_protocol.receiver.clock_estimator",
    "DavisReceiver": "firmware_protocol.receiver.clock_estimator",
    "LensParameters": "emulator.optics.lens",
    "LinkFailed": "emulator.run.link_process",
    "LiveRun": "evstim.running",
    "LoopbackLink": "transports.usb.loopback",
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
    "SerialParameters": "transports.serial_line.kind",
    "SerialReceiver": "firmware_protocol.receiver.instrument",
    "StarsParameters": "emulator.scene.stars.table",
    "TerrainParameters": "emulator.scene.terrain.table",
    "Trigger": "emulator.rig.tables",
    "UsbipLink": "transports.usb.usbip.kind",
    "VideoParameters": "emulator.scene.video.video",
    "attitude_from_basilisk": "emulator.trajectory.pose:from_basilisk",
    "attitude_from_opengl": "emulator.trajectory.pose:from_opengl",
    "attitude_from_scalar_last": "emulator.trajectory.pose:from_scalar_last",
    "attitude_from_spice": "emulator.trajectory.pose:from_spice",
    "build_scene": "emulator.run.assembly",
    "events_from_frames": "evstim.frames",
    "events_from_video": "evstim.frames",
    "load_record": "transports.recording.record",
    "load_rig": "emulator.rig.loading",
    "parse_rig": "emulator.rig.loading",
    "reconstruct": "evstim.frames",
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
