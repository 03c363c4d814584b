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
from typing import Any, NamedTuple

from msgspec import Meta

from emulator.rig.top_level import TOP_LEVEL
from emulator.sensor.presets import PRESETS
from emulator.tables.typed_table import RigFile, field_types, item_type, kinds_of, table_type
from firmware_protocol.bounds import bounds_of

PAGE = Path(__file__).with_name("rigs.md")
MARKER = "<!-- from here on written by docs/rig_reference.py -->"

COMMON = 4
"""Kinds that must have a key with one meaning for it to stand once, before the kinds."""

_LARGEST = (1 << 63) - 1
_PLAIN: dict[Any, str] = {float: "number", int: "integer", bool: "true or false", str: "text", RigFile: "file"}


def page() -> str:
    """Return the page with its tables as they should be."""
    return PAGE.read_text(encoding="utf-8").partition(MARKER)[0] + MARKER + "\n\n" + reference() + "\n"


class Row(NamedTuple):
    """A row of a table: one key, or several with one meaning."""

    keys: tuple[str, ...]
    values: tuple[str, ...]
    meaning: str


def reference() -> str:
    """Return a section for each place of a rig file where tables may stand; places with the same tables share one."""
    places: dict[tuple[type, ...], list[str]] = {}
    for name, key in TOP_LEVEL.items():
        for title, classes in _within(f"[{name}]" if key.is_list else name, tuple(key.kinds().values())):
            titles = places.setdefault(classes, [])
            if title not in titles:
                titles.append(title)
    return "\n\n".join([_overview(), *(_section(classes, titles) for classes, titles in places.items()), _presets()])


def _overview() -> str:
    """Return the section of the top-level keys."""
    lines = ["## Top-level keys", "", "|key|meaning|", "|---|---|"]
    for name, key in TOP_LEVEL.items():
        title = f"[[{name}]]" if key.is_list else f"[{name}]" if key.kinds() else name
        lines.append(f"|`{title}`|{key.meaning}{' Needed.' if key.needed else ''}|")
    return "\n".join(lines)


def _within(path: str, classes: tuple[type, ...]) -> Iterator[tuple[str, tuple[type, ...]]]:
    """Yield the title of a place and the types of its tables, and those of the places within it."""
    if classes:
        yield f"[{path}]", classes
    for cls in classes:
        for name, annotation in field_types(cls).items():
            yield from _within(_inner_path(path, name, annotation), _tables(annotation))


def _inner_path(path: str, name: str, annotation: Any) -> str:
    """Return the path of a table within another: one within [[links]] is [links.its_name]."""
    inside = f"{path.strip('[]')}.{name}"
    return f"[{inside}]" if item_type(annotation) else inside


def _tables(annotation: Any) -> tuple[type, ...]:
    """Return the types of the tables that a key may hold; none for a plain value."""
    content = item_type(annotation) or annotation
    if kinds := kinds_of(content):
        return tuple(kinds.values())
    table = table_type(content)
    return (table,) if table else ()


def _section(classes: tuple[type, ...], titles: list[str]) -> str:
    """Return the section of the tables that may stand in some places."""
    place = titles[0].strip("[]")
    has_kinds = len(classes) > 1
    common = _common_rows(classes) if has_kinds else {}
    texts = [] if has_kinds else [_summary(classes[0])]
    if titles[1:]:
        texts.append(f"Also `{'`, `'.join(titles[1:])}`.")
    lines = _table(place, list(common.values()) if has_kinds else _rows(classes[0]))
    if has_kinds:
        for cls in classes:
            lines += _lines_of_kind(place, cls, common)
    if lines:
        lines = ["|key|value|meaning|", "|---|---|---|", *lines]
    parts = [f"## `{titles[0]}`", " ".join(texts), "\n".join(lines)]
    return "\n\n".join(part for part in parts if part)


def _lines_of_kind(place: str, cls: Any, common: dict[str, Row]) -> list[str]:
    """Return the lines of one kind: its name, what it has of the common keys and of tables, and its own keys."""
    distinct = []
    parts = []
    for row in _rows(cls):
        key, value = row.keys[0], row.values[0]
        if key not in common or row.meaning != common[key].meaning:
            distinct.append(row)
        else:
            text = value if value.startswith("`") else f"`{value}`"
            parts.append(f"`{key}`" if value == common[key].values[0] else f"`{key} = {text[1:]}")
    inner = {name: annotation for name, annotation in field_types(cls).items() if _tables(annotation)}
    parts += [f"`[{_inner_path(place, name, annotation)}]`" for name, annotation in inner.items()]
    name = f'<h3 id="{place}-{cls.kind}"><code>kind = "{cls.kind}"</code></h3>'
    return [f"|{name}|{', '.join(parts)}|{_summary(cls)}|", *_table(f"{place}-{cls.kind}", distinct)]


def _common_rows(classes: tuple[type, ...]) -> dict[str, Row]:
    """Return the keys that several kinds of a table have with one meaning, with their most frequent default."""
    common = {}
    of_meaning: dict[tuple[str, str], list[str]] = {}
    for cls in classes:
        for row in _rows(cls):
            of_meaning.setdefault((row.keys[0], row.meaning), []).append(row.values[0])
    for (key, meaning), values in of_meaning.items():
        if len(values) >= COMMON:
            frequent = max(values, key=values.count)
            common[key] = Row((key,), (frequent if values.count(frequent) > 1 else "by kind",), meaning)
    return common


def _rows(cls: type) -> list[Row]:
    """Return a row for each key of a table type that holds a plain value."""
    texts = meanings(cls)
    types = field_types(cls)
    bounds = bounds_of(cls)
    plain = [field for field in dataclasses.fields(cls) if not _tables(types[field.name])]
    return [Row((f.name,), (_value(f, types[f.name], bounds.get(f.name)),), texts.get(f.name, "")) for f in plain]


def _table(place: str, rows: list[Row]) -> list[str]:
    """Return lines of a table; neighbours with one meaning have one line."""
    merged: list[Row] = []
    for row in rows:
        if merged and row.meaning == merged[-1].meaning:
            before = merged.pop()
            row = Row(before.keys + row.keys, before.values + row.values, row.meaning)
        merged.append(row)
    return [
        f"|{''.join(_heading(place, key) for key in row.keys)}|{'; '.join(dict.fromkeys(row.values))}|{row.meaning}|"
        for row in merged
    ]


def _heading(place: str, key: str) -> str:
    """Return a key as a heading in its cell: the search of the site finds headings, and an address can end in it."""
    return f'<h4 id="{place}-{key}"><code>{key}</code></h4>'


def _summary(cls: type) -> str:
    return (inspect.getdoc(cls) or "").partition("\n\n")[0].replace("\n", " ")


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
    # A sentence begins with a capital, but for a symbol or a name such as `w` or `cameraID`.
    return {
        name: re.sub(r"^(a(?= )|[a-z](?=[a-z]+\b))", lambda m: m[0].upper(), described)
        for name, described in texts.items()
    }


def _value(field: dataclasses.Field[Any], annotation: Any, bounds: Meta | None) -> str:
    """Return the default of a key, which shows its type too, and its bounds; the type in words where it does not."""
    default = field.default
    if default is None or default is dataclasses.MISSING:
        parts = [_words(annotation)]
        if default is field.default_factory:
            parts.append("needed")
    elif choices := _choices(annotation):
        parts = [f"`{_toml(choice)}`" for choice in sorted(choices, key=lambda choice: choice != default)]
    elif default == () or annotation is RigFile:
        parts = [_words(annotation)]
    else:
        parts = [f"`{_toml(default)}`"]
    if bounds:
        parts.append(_range(bounds))
    return ", ".join(parts)


def _range(bounds: Meta) -> str:
    """Return bounds as an interval, or as a relation where one side is open."""
    if bounds.ge is not None and bounds.le is not None and bounds.le != _LARGEST:
        return f"{_short(bounds.ge)}…{_short(bounds.le)}"
    relations = {">": bounds.gt, "≥": bounds.ge, "≤": bounds.le}
    return ", ".join(
        f"{sign}&nbsp;{_short(bound)}" for sign, bound in relations.items() if bound not in (None, _LARGEST)
    )


def _short(number: float) -> str:
    """Return a number, 1e6 for a million."""
    mantissa, _, exponent = f"{number:.0e}".partition("e")
    short = f"{mantissa}e{int(exponent)}"
    return short if number >= 1e6 and float(short) == number else f"{number:.10g}"


def _choices(annotation: Any) -> tuple[Any, ...]:
    return typing.get_args(annotation) if typing.get_origin(annotation) is typing.Literal else ()


def _words(annotation: Any) -> str:
    """Return a type in words, as it is written in TOML."""
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return " or ".join(f"`{_toml(choice)}`" for choice in args)
    if origin is tuple and args[-1] is Ellipsis:
        return f"list of {_words(args[0])}"
    if origin is tuple:
        return f"list of {len(args)}: {_words(args[0])}"
    if origin is dict:
        return "table"
    return _words(next(arg for arg in args if arg is not type(None)))  # a key that may be left out


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value).replace("'", '"')


def _presets() -> str:
    """Return a table of what the presets differ in."""
    names = {id(preset): name for name, preset in PRESETS.items()}  # of two names of one preset that of its unit
    rows = {names[id(preset)]: _plain(dataclasses.asdict(preset)) for preset in PRESETS.values()}
    keys = [key for key in next(iter(rows.values())) if len({str(row[key]) for row in rows.values()}) > 1]
    lines = ["## Presets", "", f"|key|{'|'.join(rows)}|", f"|---|{'---|' * len(rows)}"]
    lines += [f"|`{key}`|{'|'.join(_cell(row[key]) for row in rows.values())}|" for key in keys]
    return "\n".join(lines)


def _cell(value: float | str) -> str:
    return f"{value:g}" if isinstance(value, float) else _toml(value).strip('"')


def _plain(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested table as one level, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat.update(_plain(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value})
    return flat


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
