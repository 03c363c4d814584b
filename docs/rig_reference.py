"""Write the tables of rigs.md from the types that load rigs: python docs/rig_reference.py (or make docs/rigs.md).

The page is kept in the repository, so that it can be read where no documentation is built; a test fails when it is
stale.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from emulator.rig.top_level import TOP_LEVEL, TopLevelKey
from emulator.sensor.presets import PRESETS
from emulator.tables.typed_table import RigFile, bounds_of, field_types, item_type, kinds_of, range_text, table_type

PAGE = Path(__file__).with_name("rigs.md")
MARKER = "<!-- from here on written by docs/rig_reference.py -->"

_PLAIN: dict[Any, str] = {float: "number", int: "integer", bool: "true or false", str: "text", RigFile: "file"}


def page() -> str:
    """Return the page with its tables as they should be."""
    return PAGE.read_text(encoding="utf-8").partition(MARKER)[0] + MARKER + "\n\n" + reference() + "\n"


def reference() -> str:
    """Return one section for each table of a rig file."""
    tables = [table for name, key in TOP_LEVEL.items() for table in _of_key(name, key)]
    places: dict[type, list[str]] = {}
    for title, cls in tables:
        if title not in places.setdefault(cls, []):
            places[cls].append(title)
    return "\n\n".join([_overview(), *(_section(cls, titles) for cls, titles in places.items()), _presets()])


def _overview() -> str:
    """Return the section of the top-level keys."""
    lines = ["## Top-level keys", "", "| key | type | needed | meaning |", "|---|---|---|---|"]
    return "\n".join([*lines, *(_overview_row(name, key) for name, key in TOP_LEVEL.items())])


def _overview_row(name: str, key: TopLevelKey) -> str:
    of_type = "tables" if key.is_list else "table" if key.kinds() else "text"
    header = {"tables": f"[[{name}]]", "table": f"[{name}]", "text": name}[of_type]
    kinds = ", by its `kind`" if key.has_kinds else ""
    return f"| `{header}` | {of_type}{kinds} | {'yes' if key.needed else 'no'} | {key.meaning} |"


def _of_key(name: str, key: TopLevelKey) -> Iterator[tuple[str, type]]:
    """Yield the title and the type of each table of a top-level key."""
    for kind, cls in key.kinds().items():
        yield from _within(f"[{name}]" if key.is_list else name, cls, kind)


def _within(path: str, cls: type, kind: str = "") -> Iterator[tuple[str, type]]:
    """Yield the title and the type of a table, and of those in it."""
    yield (f'[{path}] kind = "{kind}"' if kind else f"[{path}]"), cls
    inside = path.strip("[]")  # a table within [[links]] is [links.its_name]
    for name, of in field_types(cls).items():
        for at, table, its_kind in _tables(f"{inside}.{name}", of):
            yield from _within(at, table, its_kind)


def _tables(path: str, annotation: Any) -> Iterator[tuple[str, type, str]]:
    """Yield the place of a table, its type, and its kind: nothing for a plain value."""
    if item := item_type(annotation):
        path, annotation = f"[{path}]", item
    if kinds := kinds_of(annotation):
        yield from ((path, cls, kind) for kind, cls in kinds.items())
    elif table := table_type(annotation):
        yield path, table, ""


def _section(cls: type, titles: list[str]) -> str:
    """Return the section of a table type, which may stand in several places."""
    texts = meanings(cls)
    types = {name: of for name, of in field_types(cls).items() if not list(_tables("", of))}
    ranges = {name: f", {range_text(bounds)}" for name, bounds in bounds_of(cls).items()}
    also = f"Also `{'`, `'.join(titles[1:])}`. " if titles[1:] else ""
    lines = [f"## `{titles[0]}`", "", also + (inspect.getdoc(cls) or "").partition("\n\n")[0], ""]
    if types:
        lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
    rows = (f for f in dataclasses.fields(cls) if f.name in types)
    for f in rows:
        of = _words(types[f.name]) + ranges.get(f.name, "")
        lines.append(f"| {_heading(titles[0], f.name)} | {of} | {_default(f)} | {texts.get(f.name, '')} |")
    return "\n".join(lines).rstrip()


def _heading(title: str, key: str) -> str:
    """Return a key as a heading in its cell: the search of the site finds headings, and an address can end in it."""
    place = re.sub(r"[^a-z0-9_.]+", "-", title.replace(" kind = ", "-")).strip("-")
    return f'<h4 id="{place}-{key}"><code>{key}</code></h4>'


def meanings(cls: type) -> dict[str, str]:
    """Return the text on each key of a table type; bars would end a column."""
    texts = {name: text for base in reversed(cls.__mro__) for name, text in _attributes(base).items()}
    return {name: text.replace("|", "\\|") for name, text in texts.items()}


def _attributes(cls: type) -> dict[str, str]:
    """Read the Attributes section of a class docstring: names, then indented text or ` : text`."""
    text = (inspect.getdoc(cls) or "").partition("Attributes\n----------\n")[2]
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in text.splitlines():
        if re.match(r"[a-z0-9_]+(, [a-z0-9_]+)*( : .*)?$", line) and not line.startswith(" ") and line.strip():
            head, _, rest = line.partition(" : ")
            names = [name.strip() for name in head.split(",")]
            texts.update(dict.fromkeys(names, rest))
        elif line.strip():
            texts.update({name: f"{texts[name]} {line.strip()}".strip() for name in names})
    return texts


def _words(annotation: Any) -> str:
    """Return a type in words, as it is written in TOML."""
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return " or ".join(f'`"{arg}"`' if isinstance(arg, str) else f"`{arg}`" for arg in args)
    if origin is tuple and args[-1] is Ellipsis:
        return f"list of {_words(args[0])}"
    if origin is tuple:
        return f"list of {len(args)}: {_words(args[0])}"
    if origin is dict:
        return "table"
    return _words(next(arg for arg in args if arg is not type(None)))  # a key that may be left out


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING or field.default is None:
        return "needed" if field.default_factory is field.default else ""
    return f"`{_toml(field.default)}`"


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value).replace("'", '"')


def _presets() -> str:
    """Return a table of what the presets differ in."""
    rows = {name: _plain(dataclasses.asdict(preset)) for name, preset in PRESETS.items()}
    keys = [key for key in next(iter(rows.values())) if len({str(row[key]) for row in rows.values()}) > 1]
    lines = ["## Presets", "", "| | " + " | ".join(PRESETS) + " |", "|---|" + "---|" * len(PRESETS)]
    lines += [f"| `{key}` | " + " | ".join(_cell(row[key]) for row in rows.values()) + " |" for key in keys]
    return "\n".join(lines)


def _cell(value: float | str) -> str:
    return f"`{_toml(value)}`" if isinstance(value, str) else f"{value:g}"


def _plain(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested table as one level, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat.update(_plain(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value})
    return flat


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
