"""Rig files: what to run, as TOML, with units in the keys; typed and frozen once loaded.

    title = "what this rig shows"
    [scene]          kind = "checkerboard" | "bodies" | "terrain" | ..., and that scene's own keys
    [camera]         model = a preset's name, serial, ...
    [camera.sensor]  any figure of the preset, changed for this rig
    [camera.clock]   how the camera's own clock goes wrong
    [second_camera]  a camera beside the first one, on its clock
    [trigger]        what is connected to the camera's external input
    [run]            step_us, seed, seconds, pace, lead_us
    [verdict]        what a run must keep to be good
    [[faults]]       what goes wrong on a link, and when
    [[links]]        kind = "usbip" | "loopback" | "serial" | "can", and that link's own keys; any number of them

Every key is a field of a dataclass in `emulator.rig.tables` or in the room that owns the thing. A mistake raises
RigError, which tells the file, the line, the key, what is wrong and what would be right.
"""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from emulator.rig.aliases import with_new_spellings
from emulator.rig.camera_models import CAMERA_MODELS, UsbSettings, gige_models, usb_sizes
from emulator.rig.fault_tables import convert_fault
from emulator.rig.link_kinds import LINKS
from emulator.rig.scene_kinds import SCENES
from emulator.rig.second_camera import SecondCamera
from emulator.rig.tables import Camera, Run
from emulator.rig.text import line_of
from emulator.rig.trigger_table import Trigger
from emulator.rig.verdict_table import Verdict
from emulator.scene.kind import SceneParameters
from emulator.sensor.presets import SensorParameters
from emulator.tables.files import beside
from emulator.tables.registry import PluginError, Record, Registry
from emulator.tables.text_file import TextFileError, read_text, shortened
from emulator.tables.typed_table import Path as KeyPath
from emulator.tables.typed_table import TableError, convert, split_kind, unknown
from transports.faults.kinds import Fault
from transports.link.kind import CameraFacts, LinkParameters, Unsuitable
from transports.usb.loopback_kind import LoopbackLink
from transports.usb.usbip.parameters import UsbipLink

__all__ = [
    "Camera",
    "LoopbackLink",
    "Rig",
    "RigError",
    "Run",
    "Trigger",
    "UsbipLink",
    "Verdict",
    "find_rig",
    "load_rig",
    "parse_rig",
    "read_rig",
    "rig_of_table",
    "shipped_rigs",
]

R = TypeVar("R", bound=Record)

_MOST_BYTES = 1 << 22  # the longest shipped rig has 4 KiB


class RigError(Exception):
    """A rig file cannot be used; the message is for its author."""


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
    verdict: Verdict = field(default_factory=Verdict)
    second_camera: SecondCamera | None = None


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
        if path.is_dir():
            raise RigError(f"{rig}: is a folder; give the path of a .toml file in it, or the name of a shipped rig")
        raise RigError(f"{rig}: no such file")
    shipped = shipped_rigs()
    if rig in shipped:
        return shipped[rig]
    raise RigError(f"{unknown(rig, list(shipped))}; or give the path of a .toml file")


def load_rig(rig: str) -> Rig:
    """Load a rig by path or name; raises RigError."""
    path = find_rig(rig)
    return parse_rig(read_rig(path), str(path), path.stem)


def read_rig(path: Path) -> str:
    """Return the text of a rig file; raises RigError."""
    try:
        return read_text(path, _MOST_BYTES)
    except TextFileError as error:
        raise RigError(f"{path}: {error}") from error


def rig_of_table(table: dict[str, Any], name: str, folder: Path) -> Rig:
    """Make a rig of the tables of a rig file that lies in `folder`; raises TableError."""
    return beside(_rig(table, name), folder)


def parse_rig(text: str, file: str, name: str) -> Rig:
    """Make a rig of TOML text; `file` is for messages. Raises RigError."""
    try:
        table = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or a number with more digits than Python converts
        raise RigError(f"{file}: not valid TOML: {shortened(error)}") from error
    except RecursionError as error:
        raise RigError(f"{file}: not valid TOML: its arrays or tables are nested too deeply") from error
    try:
        return rig_of_table(table, name, Path(file).parent)
    except TableError as error:
        line = line_of(text, error.path)
        at = f"{file}, line {line}" if line else file
        key = _dotted(error.path)[:200]
        raise RigError(f"{at}: {key}: {shortened(error)}" if key else f"{at}: {shortened(error)}") from error


def _dotted(path: KeyPath) -> str:
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def _rig(table: dict[str, Any], name: str) -> Rig:
    table = with_new_spellings(table)
    known = ["title", "scene", "camera", "trigger", "run", "links", "faults", "verdict", "second_camera"]
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
    kind, rest = _of_kind(table["scene"], SCENES, ("scene",))
    if run.painter == "gl" and not kind.gl:
        able = " and ".join(f'"{name}"' for name, one in SCENES.usable().items() if one.gl)
        message = f'a scene of kind "{kind.name}" has no GL painter, only kinds {able} have one: leave painter out'
        raise TableError(message, ("run", "painter"))
    scene = convert(rest, kind.parameters, ("scene",))
    faults = _faults(table.get("faults", []), links)
    verdict = convert(table.get("verdict", {}), Verdict, ("verdict",))
    second = _second(table["second_camera"], links) if "second_camera" in table else None
    return Rig(name, title, scene, camera, run, links, trigger, faults, verdict, second)


def _second(table: object, links: tuple[LinkParameters, ...]) -> SecondCamera:
    second = convert(table, SecondCamera, ("second_camera",))
    names = [link.name for link in links]
    for name in second.links:
        if name not in names:
            raise TableError(unknown(name, names), ("second_camera", "links"))
    if set(second.links) == set(names):
        raise TableError("the first camera needs a link too", ("second_camera", "links"))
    return second


def _faults(tables: object, links: tuple[LinkParameters, ...]) -> tuple[Fault, ...]:
    if not isinstance(tables, list):
        raise TableError("expected [[faults]] tables", ("faults",))
    return tuple(convert_fault(table, links, ("faults", i)) for i, table in enumerate(tables))


def _trigger(table: object, links: tuple[LinkParameters, ...]) -> Trigger:
    trigger = convert(table, Trigger, ("trigger",))
    buses = [link.name for link in links if LINKS[link.kind].has_sync]
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
    if model not in CAMERA_MODELS:
        raise TableError(unknown(str(model), list(CAMERA_MODELS)), (*path, "model"))
    own = {k: v for k, v in table.items() if k != "sensor"}
    camera = convert(own, Camera, path)
    camera = dataclasses.replace(camera, sensor=_sensor(table.get("sensor", {}), CAMERA_MODELS[model].sensor))
    if camera.bias_slopes is not None and not CAMERA_MODELS[model].is_imx636:
        able = " or ".join(name for name, one in CAMERA_MODELS.items() if one.is_imx636)
        raise TableError(f"biases of a {model} have no slopes: leave it out, or take {able}", (*path, "bias_slopes"))
    usb = CAMERA_MODELS[model].usb
    if usb is not None:
        try:
            usb.device(camera, UsbSettings(camera.start_delay_ms))
        except ValueError as error:
            raise TableError(str(error), (*path, "serial")) from error
    return camera


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
    links = tuple(_link(table, camera, ("links", i)) for i, table in enumerate(tables))
    for i, link in enumerate(links):
        _check_apart(link, links[:i], ("links", i))
    return links


def _link(table: object, camera: Camera, path: KeyPath) -> LinkParameters:
    kind, rest = _of_kind(table, LINKS, path)
    link: LinkParameters = convert(kind.complete(rest), kind.parameters, path)
    try:
        kind.check(link, CameraFacts(camera.model, camera.size, usb_sizes(), gige_models()))
    except Unsuitable as error:
        raise TableError(str(error), (*path, *error.key)) from error
    return link


def _check_apart(link: LinkParameters, earlier: tuple[LinkParameters, ...], path: KeyPath) -> None:
    """Raise TableError for a link that has the name or the port of an earlier one."""
    if link.name in [other.name for other in earlier]:
        raise TableError(f"name {link.name!r} is taken by an earlier link; give each its own", path)
    place = LINKS[link.kind].listens_on(link)
    if place is not None and place in [LINKS[other.kind].listens_on(other) for other in earlier]:
        raise TableError(f"port {place[1]} is taken by an earlier link; give each its own", (*path, "port"))


def _of_kind(table: object, kinds: Registry[R], path: KeyPath) -> tuple[R, dict[str, Any]]:
    """Return the record that a table's `kind` names, and its other keys; raises TableError."""
    kind, rest = split_kind(table, kinds, path)
    try:
        return kinds[kind], rest
    except PluginError as error:
        raise TableError(str(error), (*path, "kind")) from error
