"""The registry of kinds of links: the built-in ones, and those of installed packages (group "evstim.links")."""

from __future__ import annotations

from typing import Any

from emulator.tables.registry import Registry
from transports.link.kind import LinkKind

__all__ = ["LINKS"]

LINKS: Registry[LinkKind[Any]] = Registry(
    "evstim.links",
    LinkKind,
    {
        "usbip": "transports.usb.usbip.kind:USBIP",
        "loopback": "transports.usb.loopback_kind:LOOPBACK",
        "serial": "transports.serial_line.kind:SERIAL",
        "can": "transports.can_bus.kind:CAN",
    },
)
"""Kinds of links by the name that rigs write."""
