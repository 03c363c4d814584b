"""mkdocs hook: writes the rig reference from the types that load rigs, so that it cannot be wrong."""

from __future__ import annotations

import dataclasses
import inspect
import re
from typing import Any

from emulator.rig import LINKS, SCENES, Camera, Run
from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters

MARKER = "<!-- rig reference -->"


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the marker by the tables."""
    return markdown.replace(MARKER, reference()) if MARKER in markdown else markdown


def reference() -> str:
    """Return one section for each table of a rig file."""
    parts = [_section(f'[scene] kind = "{kind}"', cls) for kind, cls in SCENES.items()]
    parts.append(_section("[camera]", Camera, leave_out=("sensor",)))
    parts.append(_section("[camera.sensor]", SensorParameters, leave_out=("readout",)))
    parts.append(_section("[camera.sensor.readout]", ReadoutParameters))
    parts.append(_presets())
    parts.append(_section("[run]", Run))
    parts += [_section(f'[[links]] kind = "{kind}"', cls) for kind, cls in LINKS.items()]
    return "\n\n".join(parts)


def _section(title: str, cls: type, leave_out: tuple[str, ...] = ()) -> str:
    told = _attributes(cls)
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
    names = [f.name for f in dataclasses.fields(SensorParameters) if f.name != "readout"]
    lines = ["## Presets", "", "| | " + " | ".join(PRESETS) + " |", "|---|" + "---|" * len(PRESETS)]
    lines += [f"| `{n}` | " + " | ".join(f"{getattr(p, n):g}" for p in PRESETS.values()) + " |" for n in names]
    for n in ("event_ns", "row_ns"):
        lines.append(f"| `readout.{n}` | " + " | ".join(f"{getattr(p.readout, n):g}" for p in PRESETS.values()) + " |")
    return "\n".join(lines)
