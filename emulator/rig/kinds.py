"""The registries of kinds of links and scenes, and the faults that each link can have.

A registry has the built-in kinds, and those of installed packages (groups "evstim.links" and "evstim.scenes"). A fault
is converted from a table of a rig, or of `evstim fault`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from emulator.scene.kind import SceneKind
from emulator.tables.registry import Registry
from emulator.tables.typed_table import KeyPath, TableError, convert_kind, unknown
from transports.faults.kinds import Fault
from transports.link.kind import LinkKind, LinkParameters

__all__ = ["LINKS", "SCENES", "assigned_fault", "convert_fault", "faults_of", "known_faults"]


LINKS: Registry[LinkKind[Any]] = Registry(
    "evstim.links",
    LinkKind,
    {
        "usbip": "transports.usb.kind:USBIP",
        "usb_gadget": "transports.usb.kind:USB_GADGET",
        "loopback": "transports.usb.kind:LOOPBACK",
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


SCENES: Registry[SceneKind] = Registry(
    "evstim.scenes",
    SceneKind,
    {
        "checkerboard": "emulator.scene.checkerboard.table:CHECKERBOARD",
        "bodies": "emulator.scene.bodies.table:BODIES",
        "terrain": "emulator.scene.terrain.table:TERRAIN",
        "stars": "emulator.scene.stars.table:STARS",
        "video": "emulator.scene.video.video:VIDEO",
        "ros2": "emulator.scene.video.ros2_images:ROS2_IMAGES",
        "recording": "emulator.playback.recording:RECORDING",
    },
)
"""Kinds of scenes by the name that rigs write."""


def known_faults() -> dict[str, type[Fault]]:
    """Return the types of all faults, by kind."""
    return {kind: fault for link in LINKS.usable().values() for kind, fault in link.faults.items()}


def faults_of(link: LinkParameters) -> Mapping[str, type[Fault]]:
    """Return the faults that a link of these parameters can have, by kind."""
    return LINKS[link.kind].possible_faults(link)


def convert_fault(table: object, links: Sequence[LinkParameters], path: KeyPath) -> Fault:
    """Return a table as a fault of one of `links`, whose name it then has; raises TableError."""
    return assigned_fault(convert_kind(table, known_faults(), path), links, path)


def assigned_fault(fault: Fault, links: Sequence[LinkParameters], path: KeyPath = ()) -> Fault:
    """Return a fault with the name of the link of `links` that has it; raises TableError, at `path`."""
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
