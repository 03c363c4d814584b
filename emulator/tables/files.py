"""Files that a rig names: found beside the rig file, whatever folder the command runs in.

A dataclass of a rig marks such a key by the type `RigFile`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NewType, TypeVar

from emulator.tables.typed_table import field_types

__all__ = ["NO_FILE", "RigFile", "beside"]

RigFile = NewType("RigFile", str)
"""A path, absolute or from the rig file's folder; or a name that is no file, such as that of a shipped shape."""

NO_FILE = RigFile("")

T = TypeVar("T")


def beside(value: T, folder: Path) -> T:
    """Return a dataclass, the ones in it too, with each file that lies in `folder` given by its whole path."""
    if isinstance(value, tuple):
        found = tuple(beside(one, folder) for one in value)
        return value if found == value else found  # type: ignore[return-value]
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    types = field_types(type(value))
    changed: dict[str, Any] = {}
    for name, annotation in types.items():
        old = getattr(value, name)
        is_file = annotation is RigFile and (folder / old).is_file()
        new = RigFile(str(folder / old)) if is_file else beside(old, folder)
        if new is not old:
            changed[name] = new
    return dataclasses.replace(value, **changed) if changed else value
