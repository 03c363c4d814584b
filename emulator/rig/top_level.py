"""The top-level keys of a rig file, from which the loader, the rig reference and the JSON Schema here derive.

A key is read when it is first needed, so a key may use the value of another one, such as the links that of the camera.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import msgspec

from emulator.rig.kinds import (
    CAMERA_MODELS,
    LINKS,
    SCENES,
    CameraModel,
    UsbSettings,
    convert_fault,
    gige_models,
    usb_sizes,
)
from emulator.rig.tables import Camera, Run, SecondCamera, Trigger, Verdict
from emulator.scene.kind import SceneParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.tables.toml_text import KeyPath
from emulator.tables.typed_table import TableError, convert, field_types, item_type, kinds_of, split_kind, table_type
from firmware_protocol.bounds import bounds_of
from firmware_protocol.prophesee.biases import BiasSlopes
from transports.faults.kinds import FAULTS, Fault
from transports.link.kind import CameraFacts, LinkParameters, Unsuitable
from transports.registry import PluginError, Registry, unknown

R = TypeVar("R")
_LINK_NAME = re.compile(r"\w[\w.-]{0,63}", re.ASCII)


class _Values(dict[str, Any]):
    """Values of the top-level keys by name, each read from the file's `table` when it is first needed."""

    def __init__(self, table: Mapping[str, Any]) -> None:
        super().__init__()
        self._table = table

    def __missing__(self, name: str) -> Any:
        key = TOP_LEVEL[name]
        content = self._table.get(name, key.absent)
        self[name] = value = None if content is None else key.read(content, self)
        return value


@dataclass(frozen=True)
class TopLevelKey:
    """One top-level key of a rig file.

    Attributes
    ----------
    meaning : one sentence for readers of the schema and the reference.
    read : function of the key's content in the file and of the values of the other keys; raises TableError.
    kinds : returns the types that a table of this key may have, by the kind that it names; by "" where it names none;
        empty for a key that is no table.
    is_list : whether there may be any number of such tables: [[links]].
    absent : content that is read where the file lacks the key; None: the value is None.
    needed : whether every rig must have it.
    """

    meaning: str
    read: Callable[[Any, Mapping[str, Any]], Any]
    kinds: Callable[[], Mapping[str, type]] = dict
    is_list: bool = False
    absent: object = None
    needed: bool = False

    @property
    def has_kinds(self) -> bool:
        """True when a table of this key has a `kind`."""
        return any(self.kinds())


def values_of(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of every top-level key of a rig file, by name; raises TableError."""
    for name in table:
        if name not in TOP_LEVEL:
            raise TableError(unknown(name, list(TOP_LEVEL)), (name,))
    for name, key in TOP_LEVEL.items():
        if key.needed and name not in table:
            raise TableError(f"a rig needs a [{name}] table", ())
    values = _Values(table)
    return {name: values[name] for name in TOP_LEVEL}


def _title(title: object, _: Mapping[str, Any]) -> str:
    if not isinstance(title, str):
        raise TableError(f"expected text, got {title!r}", ("title",))
    return title


def _scene(table: object, rig: Mapping[str, Any]) -> SceneParameters:
    kind, keys = _of_kind(table, SCENES, ("scene",))
    if rig["run"].painter == "gl" and not kind.gl:
        able = " and ".join(f'"{name}"' for name, scene in SCENES.usable().items() if scene.gl)
        message = f'a scene of kind "{kind.name}" has no GL painter, only kinds {able} have one: leave painter out'
        raise TableError(message, ("run", "painter"))
    return convert(keys, kind.parameters, ("scene",))


def _camera(table: object, _: Mapping[str, Any]) -> Camera:
    path = ("camera",)
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    model = table.get("model", Camera.model)
    if not isinstance(model, str) or model not in CAMERA_MODELS:
        raise TableError(unknown(str(model), list(CAMERA_MODELS)), (*path, "model"))
    record = _record(CAMERA_MODELS, model, (*path, "model"))
    keys = {key: value for key, value in table.items() if key != "sensor"}
    camera = convert(_with_slopes(keys, record), Camera, path)
    units = {
        name: p for name, p in PRESETS.items() if (p.width, p.height) == (record.sensor.width, record.sensor.height)
    }
    if camera.preset and camera.preset not in units:
        raise TableError(unknown(camera.preset, list(units)), (*path, "preset"))
    preset = units[camera.preset] if camera.preset else record.sensor
    camera = dataclasses.replace(camera, sensor=_sensor(table.get("sensor", {}), preset))
    if camera.bias_slopes is not None and record.bias_slopes is None:
        able = " or ".join(name for name, other in CAMERA_MODELS.usable().items() if other.bias_slopes is not None)
        raise TableError(f"biases of a {model} have no slopes: leave it out, or take {able}", (*path, "bias_slopes"))
    if record.usb is not None:
        imu_units = record.usb.imu_units
        if camera.imu is not None and imu_units is not None and camera.imu.unit not in imu_units:
            able = " or ".join(f'"{unit}"' for unit in imu_units)
            raise TableError(f"a {camera.model} has unit = {able}, got {camera.imu.unit!r}", (*path, "imu", "unit"))
        try:
            record.usb.device(camera, UsbSettings(camera.start_delay_ms))
        except ValueError as error:
            raise TableError(str(error), (*path, "serial")) from error
    return camera


def _with_slopes(table: dict[str, Any], model: CameraModel) -> dict[str, Any]:
    """Return the table of a camera with the slopes of the model's biases that it leaves out."""
    slopes = table.get("bias_slopes", {})
    if model.bias_slopes in (None, BiasSlopes()) or not isinstance(slopes, dict):
        return table
    return {**table, "bias_slopes": dataclasses.asdict(model.bias_slopes) | slopes}


def _sensor(table: object, preset: SensorParameters) -> SensorParameters:
    """Return the preset with the parameters that the rig replaces, table by table."""
    path = ("camera", "sensor")
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    merged = dataclasses.asdict(preset)
    for key, value in table.items():
        is_part = isinstance(merged.get(key), dict) and isinstance(value, dict)
        merged[key] = {**merged[key], **value} if is_part else value
    return convert(merged, SensorParameters, path)


def _second_camera(table: object, rig: Mapping[str, Any]) -> SecondCamera:
    second = convert(table, SecondCamera, ("second_camera",))
    names = [link.name for link in rig["links"]]
    for name in second.links:
        if name not in names:
            raise TableError(unknown(name, names), ("second_camera", "links"))
    if set(second.links) == set(names):
        raise TableError("the first camera needs a link too", ("second_camera", "links"))
    if second.model:
        try:
            _camera({"model": second.model, "serial": second.serial}, rig)
        except TableError as error:
            raise TableError(str(error), ("second_camera", *error.path[1:])) from error
        if rig["run"].tolerance_us and second.model != rig["camera"].model:
            message = "with run.tolerance_us, which selects steps for one sensor, both cameras need the same model"
            raise TableError(message, ("second_camera", "model"))
    return second


def _trigger(table: object, rig: Mapping[str, Any]) -> Trigger:
    trigger = convert(table, Trigger, ("trigger",))
    buses = [link.name for link in rig["links"] if LINKS[link.kind].has_sync]
    if trigger.source and trigger.source not in buses:
        names = ", ".join(buses) or "none in this rig"
        raise TableError(
            f'{trigger.source!r} is not a link with a bus (kind = "can"); there is {names}', ("trigger", "source")
        )
    return trigger


def _run(table: object, rig: Mapping[str, Any]) -> Run:
    run = convert(table, Run, ("run",))
    if run.pace == "lockstep" and not (rig["trigger"] and rig["trigger"].source):
        raise TableError(
            "lockstep needs a bus that drives it: give [trigger] source = the name of a CAN link", ("run", "pace")
        )
    return run


def _links(tables: object, rig: Mapping[str, Any]) -> tuple[LinkParameters, ...]:
    if not isinstance(tables, list):
        raise TableError("expected [[links]] tables", ("links",))
    links = tuple(_link(table, rig["camera"], ("links", i)) for i, table in enumerate(tables))
    for i, link in enumerate(links):
        _check_apart(link, links[:i], ("links", i))
    return links


def _link(table: object, camera: Camera, path: KeyPath) -> LinkParameters:
    kind, keys = _of_kind(table, LINKS, path)
    link: LinkParameters = convert(kind.parameters.complete(keys), kind.parameters, path)
    if not _LINK_NAME.fullmatch(link.name):
        message = f"{link.name!r} cannot be part of a file's name: take 1 to 64 of the letters A-Z a-z 0-9 . _ -"
        raise TableError(f"{message}, the first no dot or hyphen", (*path, "name"))
    model = CAMERA_MODELS[camera.model]
    usb_size = None if model.usb is None else model.usb.size
    facts = CameraFacts(camera.model, camera.size, usb_size, model.gige is not None, usb_sizes, gige_models)
    try:
        kind.check(link, facts)
    except Unsuitable as error:
        raise TableError(str(error), (*path, *error.key)) from error
    return link


def _check_apart(link: LinkParameters, earlier: tuple[LinkParameters, ...], path: KeyPath) -> None:
    """Raise TableError for a link that has the name or the port of an earlier one."""
    if link.name in [other.name for other in earlier]:
        raise TableError(f"name {link.name!r} is taken by an earlier link; give each its own", path)
    place = link.listens_on()
    if place is not None and place in [other.listens_on() for other in earlier]:
        raise TableError(f"port {place[1]} is taken by an earlier link; give each its own", (*path, "port"))


def _faults(tables: object, rig: Mapping[str, Any]) -> tuple[Fault, ...]:
    if not isinstance(tables, list):
        raise TableError("expected [[faults]] tables", ("faults",))
    return tuple(convert_fault(table, rig["links"], ("faults", i)) for i, table in enumerate(tables))


def _of_kind(table: object, kinds: Registry[R], path: KeyPath) -> tuple[R, dict[str, Any]]:
    """Return the record that a table's `kind` names, and its other keys; raises TableError."""
    kind, keys = split_kind(table, kinds, path)
    return _record(kinds, kind, (*path, "kind")), keys


def _record(records: Registry[R], name: str, path: KeyPath) -> R:
    """Return the record that the key at `path` names; raises TableError for one of a broken package."""
    try:
        return records[name]
    except PluginError as error:
        raise TableError(str(error), path) from error


def _one(cls: type) -> Callable[[], Mapping[str, type]]:
    return lambda: {"": cls}


def _parameters(kinds: Registry[Any]) -> Callable[[], Mapping[str, type]]:
    return lambda: {name: kind.parameters for name, kind in kinds.usable().items()}


TOP_LEVEL: Mapping[str, TopLevelKey] = {
    "title": TopLevelKey("Title of the rig, one sentence; left out: the file's name.", _title),
    "scene": TopLevelKey("Scene that the camera sees.", _scene, _parameters(SCENES), needed=True),
    "camera": TopLevelKey("The emulated camera, its sensor and its lens.", _camera, _one(Camera), absent={}),
    "second_camera": TopLevelKey(
        "A camera beside the first one, on its clock; left out: none.", _second_camera, _one(SecondCamera)
    ),
    "trigger": TopLevelKey("Source of edges at the camera's external input; left out: none.", _trigger, _one(Trigger)),
    "run": TopLevelKey("Time and method of the run.", _run, _one(Run), absent={}),
    "verdict": TopLevelKey(
        "Limits of a good run.", lambda table, _: convert(table, Verdict, ("verdict",)), _one(Verdict), absent={}
    ),
    "links": TopLevelKey("Links that carry the events, any number of them.", _links, _parameters(LINKS), True, []),
    "faults": TopLevelKey("Faults of links, and their times.", _faults, FAULTS.usable, True, []),
}
"""Top-level keys by name, in the order of the reference; each is a field of `emulator.rig.loading.Rig`."""


def rig_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a rig file as a table."""
    definitions: dict[str, Any] = {}
    properties = {name: _top_level(key, definitions) for name, key in TOP_LEVEL.items()}
    definitions["SensorParameters"].pop("required", None)  # a rig gives the differences from the preset
    definitions["Camera"]["properties"]["model"]["enum"] = list(CAMERA_MODELS)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "evstim rig",
        "type": "object",
        "additionalProperties": False,
        "required": [name for name, key in TOP_LEVEL.items() if key.needed],
        "properties": properties,
        "$defs": definitions,
    }


def _top_level(key: TopLevelKey, definitions: dict[str, Any]) -> dict[str, Any]:
    kinds = key.kinds()
    if not kinds:
        return {"type": "string", "description": key.meaning}
    table = _one_of(kinds, definitions) if key.has_kinds else _table(kinds[""], definitions)
    return {"description": key.meaning, **({"type": "array", "items": table} if key.is_list else table)}


def _one_of(kinds: Mapping[str, type], definitions: dict[str, Any]) -> dict[str, Any]:
    return {"oneOf": [_table(cls, definitions, kind) for kind, cls in kinds.items()]}


def _table(cls: type, definitions: dict[str, Any], kind: str = "") -> dict[str, str]:
    """Define a table, once, and return the reference to it."""
    if cls.__name__ not in definitions:
        definitions[cls.__name__] = {}  # before its fields, so that a table within itself ends
        definitions[cls.__name__].update(_definition(cls, definitions, kind))
    return {"$ref": f"#/$defs/{cls.__name__}"}


def _definition(cls: type, definitions: dict[str, Any], kind: str) -> dict[str, Any]:
    types, bounds = field_types(cls), bounds_of(cls)
    bounded = {name: Annotated[types[name], limits] for name, limits in bounds.items()}
    properties = {f.name: _field(f, {**types, **bounded}[f.name], definitions) for f in dataclasses.fields(cls)}
    required = [f.name for f in dataclasses.fields(cls) if f.default is f.default_factory is dataclasses.MISSING]
    if kind:
        properties, required = {"kind": {"const": kind}, **properties}, ["kind", *required]
    return {
        "title": cls.__name__,
        "description": inspect.getdoc(cls) or "",
        "type": "object",
        "properties": properties,
        **({"required": required} if required else {}),
        "additionalProperties": False,
    }


def _field(field: dataclasses.Field[Any], annotation: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if item := item_type(annotation):
        return {"type": "array", "items": _field(field, item, definitions)}
    if kinds := kinds_of(annotation):
        return _one_of(kinds, definitions)
    if table := table_type(annotation):
        return _table(table, definitions)
    plain = msgspec.json.schema(annotation)
    return plain if field.default is dataclasses.MISSING else {**plain, "default": field.default}
