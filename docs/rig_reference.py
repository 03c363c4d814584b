"""mkdocs hook: writes the rig reference from the types that load rigs, so that it cannot be wrong."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import Any

from emulator.rig.fault_tables import known_faults
from emulator.rig.link_kinds import LINKS
from emulator.rig.loading import Camera, Run, Trigger
from emulator.rig.scene_kinds import SCENES
from emulator.sensor.presets import PRESETS
from emulator.tables.typed_table import field_types, item_type, kinds_of, table_type

MARKER = "<!-- rig reference -->"


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the marker by the tables."""
    return markdown.replace(MARKER, reference()) if MARKER in markdown else markdown


def reference() -> str:
    """Return one section for each table of a rig file."""
    parts = [section for name, kind in SCENES.items() for section in _sections("scene", kind.parameters, name)]
    parts += _sections("camera", Camera)
    parts.append(_presets())
    parts += _sections("trigger", Trigger)
    parts += _sections("run", Run)
    parts += [section for name, kind in LINKS.items() for section in _sections("[links]", kind.parameters, name)]
    parts += [section for kind, cls in known_faults().items() for section in _sections("[faults]", cls, kind)]
    return "\n\n".join(parts)


def _sections(path: str, cls: type, kind: str = "") -> list[str]:
    """Return the section of a table, and those of the tables in it."""
    types = field_types(cls)
    inside = path.strip("[]")  # a table within [[links]] is [links.its_name]
    tables = {name: list(_tables(f"{inside}.{name}", of)) for name, of in types.items()}
    title = f'[{path}] kind = "{kind}"' if kind else f"[{path}]"
    inner = [
        part for found in tables.values() for at, table, its_kind in found for part in _sections(at, table, its_kind)
    ]
    return [_section(title, cls, leave_out=[name for name, found in tables.items() if found]), *inner]


def _tables(path: str, annotation: Any) -> Iterator[tuple[str, type, str]]:
    """Yield where a table may stand, its type, and its kind: none for a plain value."""
    if item := item_type(annotation):
        path, annotation = f"[{path}]", item
    if kinds := kinds_of(annotation):
        yield from ((path, cls, kind) for kind, cls in kinds.items())
    elif table := table_type(annotation):
        yield path, table, ""


def _section(title: str, cls: type, leave_out: list[str]) -> str:
    told = {name: text for base in reversed(cls.__mro__) for name, text in _attributes(base).items()}
    lines = [f"## `{title}`", "", (inspect.getdoc(cls) or "").partition("\n\n")[0], ""]
    rows = [f for f in dataclasses.fields(cls) if f.name not in leave_out]
    if rows:
        lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
    lines += [f"| `{f.name}` | {_type(f)} | {_default(f)} | {told.get(f.name, '')} |" for f in rows]
    return "\n".join(lines)


def _attributes(cls: type) -> dict[str, str]:
    """Read the Attributes section of a class docstring: names, then indented text or ` : text`."""
    text = (inspect.getdoc(cls) or "").partition("Attributes\n----------\n")[2]
    told: dict[str, str] = {}
    names: list[str] = []
    for line in text.splitlines():
        if re.match(r"[a-z_, ]+( : .*)?$", line) and not line.startswith(" ") and line.strip():
            head, _, rest = line.partition(" : ")
            names = [name.strip() for name in head.split(",")]
            told.update(dict.fromkeys(names, rest))
        elif line.strip():
            told.update({name: f"{told[name]} {line.strip()}".strip() for name in names})
    return told


def _type(field: dataclasses.Field[Any]) -> str:
    name = field.type if isinstance(field.type, str) else getattr(field.type, "__name__", str(field.type))
    return name.replace("|", "or")


def _default(field: dataclasses.Field[Any]) -> str:
    return "" if field.default is dataclasses.MISSING else f"`{field.default!r}`".replace("'", '"')


def _presets() -> str:
    """Return a table of what the presets differ in."""
    rows = {name: _plain(dataclasses.asdict(preset)) for name, preset in PRESETS.items()}
    keys = [key for key in next(iter(rows.values())) if len({str(row[key]) for row in rows.values()}) > 1]
    lines = ["## Presets", "", "| | " + " | ".join(PRESETS) + " |", "|---|" + "---|" * len(PRESETS)]
    lines += [f"| `{key}` | " + " | ".join(f"{row[key]:g}" for row in rows.values()) + " |" for key in keys]
    return "\n".join(lines)


def _plain(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested table as one level, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat.update(_plain(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value})
    return flat
