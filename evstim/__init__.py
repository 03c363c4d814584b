"""Event cameras for space, simulated: light in, events out, over the links of a real camera.

    evstim.Sensor                   light frames in, events out
    evstim.events_from_frames       an array of frames in, events out, in one call
    evstim.run                      a whole rig: scene, sensor, camera and links; its events while it runs
    evstim.Simulation               a rig in step with your program, which gives the poses
    evstim.dataset                  sequences of a rig with sampled parameters, with their truth
    evstim.representations          events as arrays for networks: counts, voxel grids, time surfaces
    evstim.read_events              a recording in any format that is written: its events
    evstim.SerialReceiver, ...      the ground side of a link: bytes in, events out
    evstim.Rig                      a rig made in Python, of the parts below
    evstim.__version__              the version that is installed

The parts of a rig have the names of their kinds: `UsbipLink`, `SerialLink` and `CanLink` for the kinds "usbip",
"serial" and "can" of [[links]]; `BodiesScene` and `StarsScene` for those of [scene]; `BitFlips` and `UsbStall` for
those of [[faults]]; `OrbitPath` and `SpinPath` for those of a path.

Every name is imported on its first use, so `import evstim` alone loads neither numpy nor the compiled kernels.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emulator.campaign.dataset import Dataset, TruthSequence, dataset
    from emulator.campaign.loading import CampaignError
    from emulator.light import MachineLacks, Scene, SceneError
    from emulator.optics.lens import LensParameters
    from emulator.photometry.reflectance import Glossy, Hapke, Lambert, LommelSeeliger, LunarLambert, Sun
    from emulator.playback.recording import RecordingParameters as RecordingScene
    from emulator.rig.loading import Rig, RigError, load_rig, parse_rig, shipped_rigs
    from emulator.rig.tables import Camera, SecondCamera, Trigger, TriggerEdges, Verdict
    from emulator.rig.tables import Run as RunParameters
    from emulator.run.assembly import build_scene
    from emulator.run.link_process import LinkFailed
    from emulator.run.outcome import RunResult, RunStatus
    from emulator.run.simulation import SceneTruth, Simulation, SimulationState, SimulationStep
    from emulator.scene.bodies.table import Bare, Clouds, Regolith
    from emulator.scene.bodies.table import BodiesParameters as BodiesScene
    from emulator.scene.bodies.table import BodyTable as Body
    from emulator.scene.checkerboard.table import CheckerboardParameters as CheckerboardScene
    from emulator.scene.external.table import ExternalParameters as ExternalScene
    from emulator.scene.stars.skies import DrawnField
    from emulator.scene.stars.table import MovingPoint
    from emulator.scene.stars.table import StarsParameters as StarsScene
    from emulator.scene.terrain.table import Heightmap, Ridge
    from emulator.scene.terrain.table import TerrainParameters as TerrainScene
    from emulator.scene.video.ros2_images import Ros2ImageParameters as Ros2Scene
    from emulator.scene.video.video import VideoParameters as VideoScene
    from emulator.sensor.parameters import (
        BackgroundParameters,
        ComparatorParameters,
        DefectParameters,
        FrameParameters,
        ImagerParameters,
        ImuParameters,
        JitterParameters,
        KickParameters,
        NoiseParameters,
        RadiationParameters,
        ResetParameters,
        TemperatureParameters,
    )
    from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters
    from emulator.trajectory.laws import Gate
    from emulator.trajectory.parameters import (
        BasiliskPath,
        DescentPath,
        FilePath,
        FixedPath,
        Keyframe,
        KeyframePath,
        LivePath,
        OrbitPath,
        SpicePath,
        SpinPath,
    )
    from emulator.trajectory.pose import Pose
    from emulator.trajectory.pose import from_basilisk as attitude_from_basilisk
    from emulator.trajectory.pose import from_opengl as attitude_from_opengl
    from emulator.trajectory.pose import from_scalar_last as attitude_from_scalar_last
    from emulator.trajectory.pose import from_spice as attitude_from_spice
    from evstim import representations
    from evstim.deliveries import Delivery
    from evstim.frames import events_from_frames, events_from_video, reconstruct
    from evstim.running import LiveRun, run
    from evstim.sensor import Sensor, SensorOptions
    from firmware_protocol.can_frames.canopen import SelectorSettings
    from firmware_protocol.can_frames.dbc import Identifiers
    from firmware_protocol.device.clock import ClockSettings, ClockStep
    from firmware_protocol.events import EDGE, EVENT
    from firmware_protocol.instrument.settings import InstrumentSettings
    from firmware_protocol.network_streams.coders import PictureSettings
    from firmware_protocol.packets.profile import Profile
    from firmware_protocol.prophesee.biases import BiasSlopes
    from firmware_protocol.receiver.can import CanReceiver, CanReceiverSettings
    from firmware_protocol.receiver.clock_estimator import ClockEstimate, ClockEstimator
    from firmware_protocol.receiver.instrument import DavisReceiver, SerialReceiver
    from firmware_protocol.recordings.part import IMU, Frame
    from transports.can_bus.kind import CanLink
    from transports.faults.bus import (
        BabblingIdiot,
        BusOff,
        ChangedFrames,
        DeadBus,
        ErrorFrames,
        LostFrames,
        ReorderedFrames,
        RepeatedFrames,
    )
    from transports.faults.datagrams import LateDatagrams, LostDatagrams, RepeatedDatagrams
    from transports.faults.line import (
        BitFlips,
        Burst,
        InsertedBytes,
        LostBytes,
        Overrun,
        Stall,
        StuckLine,
        Unplugged,
        WrongBaud,
    )
    from transports.faults.usb import (
        ControlStall,
        EmptyTransfers,
        FifoOverflow,
        RegisterFlip,
        ShortTransfers,
        SlowControl,
        UsbSilence,
        UsbStall,
        UsbUnplugged,
        WrongVersion,
    )
    from transports.faults.words import (
        MissedWraps,
        OddBytes,
        RepeatedEvents,
        StaleData,
        TimeAhead,
        TimeBack,
        TimeFrozen,
    )
    from transports.file import FileLink
    from transports.gige.kind import GigeLink
    from transports.gige.packet_faults import IpChange, LinkDown, LostHeartbeat, RefusedResends
    from transports.network_streams.kind import TcpLink, UdpLink
    from transports.recording.files import iter_events, read_events
    from transports.recording.part import RecordingError
    from transports.recording.record import load_record
    from transports.ros2.kind import Ros2Link
    from transports.serial_line.kind import SerialLink
    from transports.udp_packets.kind import UdpPacketsLink
    from transports.usb.kind import LoopbackLink, UsbGadgetLink, UsbipLink

__all__ = [
    "EDGE", "EVENT", "IMU", "PRESETS", "BabblingIdiot", "BackgroundParameters", "Bare", "BasiliskPath", "BiasSlopes",
    "BitFlips", "BodiesScene", "Body", "Burst", "BusOff", "Camera", "CampaignError", "CanLink", "CanReceiver",
    "CanReceiverSettings", "ChangedFrames", "CheckerboardScene", "ClockEstimate", "ClockEstimator", "ClockSettings",
    "ClockStep", "Clouds", "ComparatorParameters", "ControlStall", "Dataset", "DavisReceiver", "DeadBus",
    "DefectParameters", "Delivery", "DescentPath", "DrawnField", "EmptyTransfers", "ErrorFrames", "ExternalScene",
    "FifoOverflow", "FileLink", "FilePath", "FixedPath", "Frame", "FrameParameters", "Gate", "GigeLink", "Glossy",
    "Hapke", "Heightmap", "Identifiers", "ImagerParameters", "ImuParameters", "InsertedBytes", "InstrumentSettings",
    "IpChange", "JitterParameters", "Keyframe", "KeyframePath", "KickParameters", "Lambert", "LateDatagrams",
    "LensParameters", "LinkDown", "LinkFailed", "LivePath", "LiveRun", "LommelSeeliger", "LoopbackLink", "LostBytes",
    "LostDatagrams", "LostFrames", "LostHeartbeat", "LunarLambert", "MachineLacks", "MissedWraps", "MovingPoint",
    "NoiseParameters", "OddBytes", "OrbitPath", "Overrun", "PictureSettings", "Pose", "Profile", "RadiationParameters",
    "ReadoutParameters", "RecordingError", "RecordingScene", "RefusedResends", "RegisterFlip", "Regolith",
    "ReorderedFrames", "RepeatedDatagrams", "RepeatedEvents", "RepeatedFrames", "ResetParameters", "Ridge", "Rig",
    "RigError", "Ros2Link", "Ros2Scene", "RunParameters", "RunResult", "RunStatus", "Scene", "SceneError", "SceneTruth",
    "SecondCamera", "SelectorSettings", "Sensor", "SensorOptions", "SensorParameters", "SerialLink", "SerialReceiver",
    "ShortTransfers", "Simulation", "SimulationState", "SimulationStep", "SlowControl", "SpicePath", "SpinPath",
    "StaleData", "Stall", "StarsScene", "StuckLine", "Sun", "TcpLink", "TemperatureParameters", "TerrainScene",
    "TimeAhead", "TimeBack", "TimeFrozen", "Trigger", "TriggerEdges", "TruthSequence", "UdpLink", "UdpPacketsLink",
    "Unplugged", "UsbGadgetLink", "UsbSilence", "UsbStall", "UsbUnplugged", "UsbipLink", "Verdict", "VideoScene",
    "WrongBaud", "WrongVersion", "attitude_from_basilisk", "attitude_from_opengl", "attitude_from_scalar_last",
    "attitude_from_spice", "build_scene", "dataset", "events_from_frames", "events_from_video", "iter_events",
    "load_record", "load_rig", "parse_rig", "read_events", "reconstruct", "representations", "run", "shipped_rigs",
]  # fmt: skip

__version__: str

if not TYPE_CHECKING:  # else a type checker would take any name for one of ours

    def __getattr__(name: str) -> Any:
        """Import a public name on its first use."""
        if name == "__version__":
            value = import_module("importlib.metadata").version("evstim")
        elif name in __all__:
            module, attribute = _sources()[name]
            is_module = module == __name__
            value = import_module(f"{module}.{attribute}") if is_module else getattr(import_module(module), attribute)
        else:
            raise AttributeError(f"module 'evstim' has no attribute {name!r}")
        globals()[name] = value
        return value


@cache
def _sources() -> dict[str, tuple[str, str]]:
    """Return the module of each public name and its name there: read from the imports for type checkers, above."""
    import ast  # loaded with the first public name
    from pathlib import Path

    module = ast.parse(Path(__file__).read_text(encoding="utf-8"))
    block = next(node for node in module.body if isinstance(node, ast.If))
    imports = (node for node in block.body if isinstance(node, ast.ImportFrom))
    return {alias.asname or alias.name: (node.module or "", alias.name) for node in imports for alias in node.names}


def __dir__() -> list[str]:
    """Return the public names, loaded or not, and those that every module has."""
    return sorted({"__version__", *__all__, *(name for name in globals() if name.startswith("__"))})
