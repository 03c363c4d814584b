"""Which faults which link can have, and how a table becomes one: from a rig, or from `evstim fault`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Protocol

from emulator.tables.typed_table import Path, TableError, convert_kind, unknown
from transports.can_bus.parameters import CanParameters
from transports.faults.can_kinds import CAN_FAULTS, ErrorFrames
from transports.faults.kinds import SERIAL_FAULTS, Fault
from transports.faults.usb_kinds import USB_FAULTS
from transports.serial_line.parameters import SerialParameters
from transports.usb.usbip.parameters import UsbipLink

__all__ = ["FAULTS", "convert_fault", "faults_of"]

FAULTS: Mapping[str, type[Fault]] = {**SERIAL_FAULTS, **CAN_FAULTS, **USB_FAULTS}
"""All kinds of faults."""
_OWN_BUSES = ("served", "virtual")
"""Interfaces that carry an error frame that is given to them; a controller makes its own."""


class _Link(Protocol):
    @property
    def name(self) -> str: ...


def faults_of(link: object) -> Mapping[str, type[Fault]]:
    """Return the faults that a link of these parameters can have, by kind."""
    if isinstance(link, SerialParameters):
        return SERIAL_FAULTS
    if isinstance(link, UsbipLink):
        return USB_FAULTS
    if not isinstance(link, CanParameters):
        return {}
    own = link.interface in _OWN_BUSES
    return {kind: fault for kind, fault in CAN_FAULTS.items() if own or fault is not ErrorFrames}


def convert_fault(table: object, links: Sequence[_Link], path: Path) -> Fault:
    """Return a table as a fault of one of `links`, whose name it then has; raises TableError."""
    fault = convert_kind(table, FAULTS, path)
    able = [link.name for link in links if fault.kind in faults_of(link)]
    if not fault.link and len(able) == 1:
        return dataclasses.replace(fault, link=able[0])
    if fault.link in able:
        return fault
    if not able:
        raise TableError(f"no link of this rig can have a fault of kind {fault.kind!r}", (*path, "kind"))
    if not fault.link:
        raise TableError(f"'link' is missing: {', '.join(able)} can all have {fault.kind!r}", (*path, "kind"))
    if fault.link not in [link.name for link in links]:
        raise TableError(unknown(fault.link, [link.name for link in links]), (*path, "link"))
    raise TableError(
        f"link {fault.link!r} cannot have a fault of kind {fault.kind!r}; {', '.join(able)} can", (*path, "link")
    )
