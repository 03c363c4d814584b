"""Rig files: what to run, as TOML, with units in the keys; typed and frozen once loaded.

    title = "what this rig shows"
    [scene]          kind = "checkerboard" | "bodies" | "terrain" | ..., and that scene's own keys
    [camera]         model = a preset's name, serial, ...
    [camera.sensor]  any figure of the preset, changed for this rig
    [camera.clock]   how the camera's own clock goes wrong
    [trigger]        what is connected to the camera's external input
    [run]            step_us, seed, seconds, pace, lead_us
    [[faults]]       what goes wrong on a link, and when
    [[links]]        kind = "usbip" | "loopback" | "serial" | "can", and that link's own keys; any number of them

Every key is a field of a dataclass in `emulator.rig.tables` or in the room that owns the thing. A mistake raises
RigError, which tells the file, the line, the key, what is wrong and what would be right.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from emulator.playback.recording import RecordingParameters
from emulator.rig.fault_tables import convert_fault
from emulator.rig.tables import Camera, LoopbackLink, Run
from emulator.rig.text import line_of
from emulator.rig.trigger_table import Trigger
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.scene.stars.table import StarsParameters
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.video.video import VideoParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.tables.files import beside
from emulator.tables.typed_table import Path as KeyPath
from emulator.tables.typed_table import TableError, convert, convert_kind, unknown
from firmware_protocol.can_frames.identifiers import Identifiers
from firmware_protocol.can_frames.raw_events import RAW_LIMIT_PX
from transports.can_bus.parameters import CanParameters
from transports.faults.kinds import Fault
from transports.serial_line.parameters import SerialParameters
from transports.usb.usbip.parameters import UsbipLink

__all__ = [
    "LINKS",
    "SCENES",
    "Camera",
    "LoopbackLink",
    "Rig",
    "RigError",
    "Run",
    "Trigger",
    "UsbipLink",
    "find_rig",
    "load_rig",
    "parse_rig",
    "shipped_rigs",
]

T = TypeVar("T")


class RigError(Exception):
    """A rig file cannot be used; the message is for its author."""


SceneParameters = (
    CheckerboardParameters
    | BodiesParameters
    | TerrainParameters
    | StarsParameters
    | VideoParameters
    | RecordingParameters
)
LinkParameters = UsbipLink | LoopbackLink | SerialParameters | CanParameters

SCENES: Mapping[str, type[SceneParameters]] = {
    "checkerboard": CheckerboardParameters,
    "bodies": BodiesParameters,
    "terrain": TerrainParameters,
    "stars": StarsParameters,
    "video": VideoParameters,
    "recording": RecordingParameters,
}
_BUSES = ("can",)
"""Kinds of link that hear a SYNC."""

LINKS: Mapping[str, type[LinkParameters]] = {
    "usbip": UsbipLink,
    "loopback": LoopbackLink,
    "serial": SerialParameters,
    "can": CanParameters,
}


@dataclass(frozen=True)
class Rig:
    """One bench set-up."""

    name: str
    title: str
    scene: SceneParameters
    camera: Camera = field(default_factory=Camera)
    run: Run = field(default_factory=Run)
    links: tuple[LinkParameters, ...] = ()
    trigger: Trigger | None = None
    faults: tuple[Fault, ...] = ()


def shipped_rigs() -> dict[str, Path]:
    """Return the rigs that come with evstim, by name."""
    root = Path(__file__).parents[2]
    installed = root / "evstim" / "rigs"
    folder = installed if installed.is_dir() else root / "rigs"  # the second in a checkout
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def find_rig(rig: str) -> Path:
    """Return the file of a rig given by path or by the name of a shipped one; raises RigError."""
    path = Path(rig)
    if path.suffix == ".toml" or path.exists():
        if path.is_file():
            return path
        raise RigError(f"{rig}: no such file")
    shipped = shipped_rigs()
    if rig in shipped:
        return shipped[rig]
    raise RigError(f"{unknown(rig, list(shipped))}; or give the path of a .toml file")


def load_rig(rig: str) -> Rig:
    """Load a rig by path or name; raises RigError."""
    path = find_rig(rig)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"{path}: cannot be read: {error}") from error
    return parse_rig(text, str(path), path.stem)


def parse_rig(text: str, file: str, name: str) -> Rig:
    """Make a rig of TOML text; `file` is for messages. Raises RigError."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RigError(f"{file}: not valid TOML: {error}") from error
    try:
        return beside(_rig(table, name), Path(file).parent)
    except TableError as error:
        line = line_of(text, error.path)
        at = f"{file}, line {line}" if line else file
        key = _dotted(error.path)
        raise RigError(f"{at}: {key}: {error}" if key else f"{at}: {error}") from error


def _dotted(path: KeyPath) -> str:
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def _rig(table: dict[str, Any], name: str) -> Rig:
    known = ["title", "scene", "camera", "trigger", "run", "links", "faults"]
    for key in table:
        if key not in known:
            raise TableError(unknown(key, known), (key,))
    title = table.get("title", name)
    if not isinstance(title, str):
        raise TableError(f"expected text, got {title!r}", ("title",))
    if "scene" not in table:
        raise TableError("a rig needs a [scene] table", ())
    camera = _camera(table.get("camera", {}))
    links = _links(table.get("links", []), camera)
    run = convert(table.get("run", {}), Run, ("run",))
    trigger = _trigger(table["trigger"], links) if "trigger" in table else None
    if run.pace == "lockstep" and not (trigger and trigger.source):
        raise TableError(
            "lockstep needs a bus that drives it: give [trigger] source = the name of a CAN link", ("run", "pace")
        )
    scene = convert_kind(table["scene"], SCENES, ("scene",))
    return Rig(name, title, scene, camera, run, links, trigger, _faults(table.get("faults", []), links))


def _faults(tables: object, links: tuple[LinkParameters, ...]) -> tuple[Fault, ...]:
    if not isinstance(tables, list):
        raise TableError("expected [[faults]] tables", ("faults",))
    return tuple(convert_fault(table, links, ("faults", i)) for i, table in enumerate(tables))


def _trigger(table: object, links: tuple[LinkParameters, ...]) -> Trigger:
    trigger = convert(table, Trigger, ("trigger",))
    buses = [link.name for link in links if any(isinstance(link, LINKS[kind]) for kind in _BUSES if kind in LINKS)]
    if trigger.source and trigger.source not in buses:
        there = ", ".join(buses) or "none in this rig"
        raise TableError(
            f'{trigger.source!r} is not a link with a bus (kind = "can"); there is {there}', ("trigger", "source")
        )
    return trigger


def _camera(table: object) -> Camera:
    path = ("camera",)
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    model = table.get("model", "davis346")
    if model not in PRESETS:
        raise TableError(unknown(str(model), list(PRESETS)), (*path, "model"))
    own = {k: v for k, v in table.items() if k != "sensor"}
    camera = convert(own, Camera, path)
    return dataclasses.replace(camera, sensor=_sensor(table.get("sensor", {}), PRESETS[model]))


def _sensor(table: object, preset: SensorParameters) -> SensorParameters:
    """Lay the rig's own figures over the preset's, table by table."""
    path = ("camera", "sensor")
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    merged = dataclasses.asdict(preset)
    for key, value in table.items():
        is_part = isinstance(merged.get(key), dict) and isinstance(value, dict)
        merged[key] = {**merged[key], **value} if is_part else value
    return convert(merged, SensorParameters, path)


def _links(tables: object, camera: Camera) -> tuple[LinkParameters, ...]:
    if not isinstance(tables, list):
        raise TableError("expected [[links]] tables", ("links",))
    links = tuple(convert_kind(_with_identifiers(table), LINKS, ("links", i)) for i, table in enumerate(tables))
    for i, link in enumerate(links):
        if link.name in [other.name for other in links[:i]]:
            raise TableError(f"name {link.name!r} is taken by an earlier link; give each its own", ("links", i))
        if isinstance(link, UsbipLink):
            _check_usb(link, links[:i], camera, i)
        if isinstance(link, SerialParameters | CanParameters):
            _check_instrument(link, camera, i)
    return links


def _with_identifiers(table: object) -> object:
    """Let the identifiers of a CAN link follow its node number where the rig does not give them."""
    if not isinstance(table, dict) or table.get("kind") != "can":
        return table
    node, own = table.get("node", CanParameters.node), table.get("identifiers", {})
    if not isinstance(node, int) or not 1 <= node <= 127 or not isinstance(own, dict):
        return table  # refused where its type is checked
    return {**table, "identifiers": {**Identifiers.of_node(node).by_name, **own}}


def _check_instrument(link: SerialParameters | CanParameters, camera: Camera, index: int) -> None:
    try:
        link.instrument.selection(camera.size)
    except ValueError as error:
        raise TableError(str(error), ("links", index, "instrument", "region")) from error
    if isinstance(link, CanParameters) and link.carriage == "raw" and max(camera.size) > RAW_LIMIT_PX:
        raise TableError(
            f"raw frames number {RAW_LIMIT_PX} columns and rows, not {camera.size[0]}x{camera.size[1]}; "
            'use carriage = "isotp" or "cfp"',
            ("links", index, "carriage"),
        )


def _check_usb(link: UsbipLink, earlier: tuple[LinkParameters, ...], camera: Camera, index: int) -> None:
    if camera.model != "davis346" or (camera.sensor.width, camera.sensor.height) != (346, 260):
        raise TableError(
            f"there is no USB model for a {camera.model} of {camera.sensor.width}x{camera.sensor.height} pixels yet; "
            'use model = "davis346" with its 346x260 pixels, or kind = "loopback"',
            ("links", index, "kind"),
        )
    taken = [(other.host, other.port) for other in earlier if isinstance(other, UsbipLink) and other.port]
    if (link.host, link.port) in taken:
        raise TableError(f"port {link.port} is taken by an earlier link; give each its own", ("links", index, "port"))
