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
        "usb_gadget": "transports.usb.functionfs.kind:USB_GADGET",
        "loopback": "transports.usb.loopback_kind:LOOPBACK",
        "serial": "transports.serial_line.kind:SERIAL",
        "gige": "transports.gige.kind:GIGE",
        "file": "transports.file.kind:FILE",
        "tcp": "transports.network_streams.kind:TCP",
        "udp": "transports.network_streams.kind:UDP",
        "udp_packets": "transports.udp_packets.kind:UDP_PACKETS",
        "ros2": "transports.ros2.kind:ROS2",
        "can": "transports.can_bus.kind:CAN",
    },
)
"""Kinds of links by the name that rigs write."""
