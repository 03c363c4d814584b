"""Free ports for a rig that runs beside others on one machine: in a test, in a campaign."""

from __future__ import annotations

import dataclasses
import socket
from pathlib import Path

from emulator.rig.link_kinds import LINKS
from emulator.rig.loading import Rig
from emulator.scene.kind import SceneParameters
from emulator.trajectory.parameters import LivePath
from transports.link.kind import LinkParameters

__all__ = ["free_loopback_address", "on_a_free_pose_port", "on_free_ports", "pose_port"]


def on_free_ports(rig: Rig, folder: Path) -> Rig:
    """Return the rig with ports that nobody else has: TCP port 0, and symbolic links of serial lines in `folder`."""
    return dataclasses.replace(rig, links=tuple(_on_free_port(link, folder) for link in rig.links))


def pose_port(rig: Rig) -> int | None:
    """Return the UDP port at which a rig's camera takes poses; None where its path is in the rig."""
    path = _live_path(rig.scene)
    return path.port if path else None


def on_a_free_pose_port(rig: Rig) -> Rig:
    """Return the rig whose camera takes poses at a UDP port that nobody else has; others as they are."""
    if not (path := _live_path(rig.scene)):
        return rig
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind((path.host, 0))
        path = dataclasses.replace(path, port=free.getsockname()[1])
    return dataclasses.replace(rig, scene=dataclasses.replace(rig.scene, **{"camera": path}))


def _live_path(scene: SceneParameters) -> LivePath | None:
    path = getattr(scene, "camera", None)
    return path if isinstance(path, LivePath) else None


def _on_free_port(link: LinkParameters, folder: Path) -> LinkParameters:
    changed: dict[str, object] = {}
    if LINKS[link.kind].listens_on(link) is not None:
        changed["port"] = 0
    if getattr(link, "symlink", ""):
        changed["symlink"] = str(folder / f"{link.name}.tty")
    return dataclasses.replace(link, **changed) if changed else link


def free_loopback_address(udp_port: int) -> str:
    """Return an address of this machine alone on which nobody has a UDP port; raises OSError where there is none."""
    for last in range(1, 255):
        address = f"127.0.0.{last}"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((address, udp_port))
            except OSError:
                continue
            return address
    raise OSError(f"UDP port {udp_port} is taken on every loopback address")
