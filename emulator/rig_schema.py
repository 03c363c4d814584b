"""The JSON Schema of rig files, made from the types that load them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from emulator.rig import LINKS, SCENES, Camera, Run
from emulator.sensor.presets import PRESETS

__all__ = ["rig_schema"]


def rig_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a rig file as a table."""
    kinds = {**SCENES, **LINKS}
    _, components = msgspec.json.schema_components([Camera, Run, *kinds.values()], ref_template="#/$defs/{name}")
    for definition in components.values():
        definition["additionalProperties"] = False
    for kind, parameters in kinds.items():
        components[parameters.__name__] = _with_kind(components[parameters.__name__], kind)
    components["SensorParameters"].pop("required", None)  # a rig gives what differs from the preset
    components["Camera"]["properties"]["model"]["enum"] = list(PRESETS)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "evstim rig",
        "type": "object",
        "additionalProperties": False,
        "required": ["scene"],
        "properties": {
            "title": {"type": "string", "description": "What this rig shows, in one sentence."},
            "scene": _one_of(SCENES),
            "camera": {"$ref": "#/$defs/Camera"},
            "run": {"$ref": "#/$defs/Run"},
            "links": {"type": "array", "items": _one_of(LINKS)},
        },
        "$defs": components,
    }


def _with_kind(definition: dict[str, Any], kind: str) -> dict[str, Any]:
    properties = {"kind": {"const": kind}, **definition["properties"]}
    return {**definition, "properties": properties, "required": ["kind", *definition.get("required", [])]}


def _one_of(kinds: Mapping[str, type]) -> dict[str, Any]:
    return {"oneOf": [{"$ref": f"#/$defs/{parameters.__name__}"} for parameters in kinds.values()]}
