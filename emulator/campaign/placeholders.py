"""Placeholders in the arguments of the program under test, such as {address} or {camera.sensor.threshold_on}."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emulator.campaign.tables import Settings
from emulator.rig.loading import Rig
from emulator.run.free_ports import pose_port
from emulator.tables.typed_table import TableError, unknown

__all__ = ["POSE_PORT", "addresses_as_placeholders", "check_placeholders", "filled"]

_PLACEHOLDER = re.compile(r"\{([A-Za-z_][\w.\[\]-]*)\}")
POSE_PORT = "port.poses"
_ALWAYS = ("index", "seed", "folder", "result", "python", "worker")


def filled(argv: Sequence[str], values: Mapping[str, Any]) -> list[str]:
    """Return arguments with each {NAME} replaced by its value, a table or a list as JSON."""
    return [_PLACEHOLDER.sub(lambda found: _text(values[found[1]]), argument) for argument in argv]


def _text(value: Any) -> str:
    return str(value) if isinstance(value, str | int | float | Path) else json.dumps(value)


def addresses_as_placeholders(addresses: Mapping[str, str | None]) -> dict[str, str]:
    """Return {address.NAME} and {port.NAME} of each link, and {address} and {port} where there is only one."""
    found: dict[str, str] = {}
    for name, address in addresses.items():
        port = (address or "").rpartition(":")[2]
        found |= {f"address.{name}": address or "", f"port.{name}": port}
        if len(addresses) == 1:
            found |= {"address": address or "", "port": port}
    return found


def check_placeholders(rig: Rig, settings: Settings, folder: Path) -> None:
    """Raise TableError for a placeholder that nothing fills, or a program that is not there, seen from `folder`."""
    if settings.program is None:
        return
    known = [*_ALWAYS, *(law.key for law in settings.parameters)]
    known += ["record"] if settings.record else []
    if settings.program.start == "with":
        known += addresses_as_placeholders({link.name: "" for link in rig.links})
        known += [POSE_PORT] if pose_port(rig) is not None else []
    _check_program(settings.program.argv[0], folder)
    for name in (name for argument in settings.program.argv for name in _PLACEHOLDER.findall(argument)):
        if name == "record" and not settings.record:
            raise TableError('{record} needs record = ".npz", or another suffix', ("program", "argv"))
        if name not in known:
            raise TableError(f"placeholder {unknown(name, known)}", ("program", "argv"))


def _check_program(name: str, folder: Path) -> None:
    if _PLACEHOLDER.search(name):
        return
    found = os.access(folder / name, os.X_OK) if "/" in name else shutil.which(name)
    if not found:
        raise TableError(f"there is no program {name!r} that can be run", ("program", "argv"))
