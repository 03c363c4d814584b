"""The JSON Schema of rig files, made from the types that load them."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any

import msgspec

from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.top_level import TOP_LEVEL, TopLevelKey
from emulator.tables.typed_table import field_types, item_type, kinds_of, table_type

__all__ = ["rig_schema"]

_Definitions = dict[str, Any]


def rig_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a rig file as a table."""
    definitions: _Definitions = {}
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


def _top_level(key: TopLevelKey, definitions: _Definitions) -> dict[str, Any]:
    kinds = key.kinds()
    if not kinds:
        return {"type": "string", "description": key.meaning}
    table = _one_of(kinds, definitions) if key.has_kinds else _table(kinds[""], definitions)
    return {"description": key.meaning, **({"type": "array", "items": table} if key.is_list else table)}


def _one_of(kinds: Mapping[str, type], definitions: _Definitions) -> dict[str, Any]:
    return {"oneOf": [_table(cls, definitions, kind) for kind, cls in kinds.items()]}


def _table(cls: type, definitions: _Definitions, kind: str = "") -> dict[str, str]:
    """Define a table, once, and return the reference to it."""
    if cls.__name__ not in definitions:
        definitions[cls.__name__] = {}  # before its fields, so that a table within itself ends
        definitions[cls.__name__].update(_definition(cls, definitions, kind))
    return {"$ref": f"#/$defs/{cls.__name__}"}


def _definition(cls: type, definitions: _Definitions, kind: str) -> dict[str, Any]:
    types = field_types(cls)
    properties = {f.name: _field(f, types[f.name], definitions) for f in dataclasses.fields(cls)}
    required = [f.name for f in dataclasses.fields(cls) if not _is_optional(f)]
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


def _is_optional(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _field(field: dataclasses.Field[Any], annotation: Any, definitions: _Definitions) -> dict[str, Any]:
    if item := item_type(annotation):
        return {"type": "array", "items": _value(item, definitions)}
    if kinds_of(annotation) or table_type(annotation):
        return _value(annotation, definitions)
    plain = msgspec.json.schema(annotation)
    return plain if field.default is dataclasses.MISSING else {**plain, "default": field.default}


def _value(annotation: Any, definitions: _Definitions) -> dict[str, Any]:
    if kinds := kinds_of(annotation):
        return _one_of(kinds, definitions)
    return _table(table_type(annotation), definitions)
