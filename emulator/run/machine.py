"""Examination of this machine, needs of a rig beyond evstim's base dependencies, and free ports.

Each finding has the exact command that adds the missing part, and `needed_for`: no part is needed by every rig. Free
ports are for a rig that runs beside others on one machine, in a test or in a campaign.
"""

from __future__ import annotations

import ctypes.util
import dataclasses
import os
import resource
import shutil
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from emulator.gl.context import PACKAGES, WANTED, probe, renderers, selected_painter
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.scene.kind import SceneParameters
from emulator.trajectory.parameters import LivePath
from firmware_protocol.compiled import NO_FOLDER, cache_folder
from firmware_protocol.gige.gvcp import GVCP_PORT
from transports.needs import PYTHON_PACKAGES, UDC, VCAN, VHCI, Finding, Need, package

_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
_UDP_BUFFER = 1 << 24
_STATUS = Path("/proc/self/status")
_CAP_SYS_NICE = 23
_NICE_LIMIT = 40  # of RLIMIT_NICE, for nice -20
_PRIORITY_FIX = (
    """printf '%s - nice -20\\n%s - rtprio 50\\n' "$USER" "$USER" | sudo tee /etc/security/limits.d/evstim.conf"""
    "  # and log in again; in a container --cap-add SYS_NICE"
)
_SBIN = "/usr/sbin:/sbin"
_UDEV_FIX = (
    """echo 'SUBSYSTEM=="usb", ATTR{idVendor}=="152a|04b4|31f7|1409", MODE="0666"' """
    "| sudo tee /etc/udev/rules.d/65-event-camera.rules "
    "&& sudo udevadm control --reload && sudo udevadm trigger"
)


def examine() -> list[Finding]:
    """Examine everything; takes about a second, most of it for opening GL."""
    looks: list[Callable[[], Finding]] = [
        egl, _usbip_tool, VHCI.look, UDC.look, VCAN.look, _libusb, _usb_permission, _gvcp, _udp_buffer,
        _priority, _cores, kernel_cache,
    ]  # fmt: skip
    return [look() for look in (*looks, *(package(name).look for name in PYTHON_PACKAGES))]


def egl() -> Finding:
    """Look for OpenGL by EGL."""
    report = probe()
    use = 'run.painter = "gl"; nothing else needs GL'
    available = renderers()
    if report.available:
        names = list(available)
        with suppress(ValueError):
            names.remove(report.renderer)  # once
        also = f"; also there: {', '.join(names)}" if len(available) > 1 else ""
        return Finding("EGL", f"{report.renderer}, OpenGL {report.version}{also}", use)
    fix = f"unset {WANTED}" if available else f"apt-get install {PACKAGES}"
    return Finding("EGL", report.reason, use, fix)


def _usbip_tool() -> Finding:
    path = shutil.which("usbip") or shutil.which("usbip", path=_SBIN)
    use = "attaching the camera to this machine's own USB bus"
    return Finding("usbip", path or "the tool is not installed", use, None if path else "apt-get install usbip")


def _gvcp() -> Finding:
    """Check whether a GigE Vision camera can listen on the port that drivers use."""
    use = "GigE Vision cameras on 127.0.0.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
        try:
            tried.bind(("127.0.0.1", GVCP_PORT))
        except OSError as error:
            detail = f"UDP port {GVCP_PORT} cannot be used: {error.strerror}"
            fix = f"ss -lunp 'sport = :{GVCP_PORT}'  # its owner; or another address of the link: host = \"127.0.0.2\""
            return Finding("GVCP", detail, use, fix)
    return Finding("GVCP", f"UDP port {GVCP_PORT} is free", use)


def _udp_buffer() -> Finding:
    """Check the size of the kernel's buffer for a receiver that is not read for a moment."""
    use = "receivers of GigE Vision streams, at most 16 MiB each"
    limit_bytes = int(_RMEM_MAX.read_text()) if _RMEM_MAX.exists() else 0
    fix = None if limit_bytes >= _UDP_BUFFER else f"sysctl -w net.core.rmem_max={_UDP_BUFFER}"
    return Finding("UDP buffer", f"net.core.rmem_max = {limit_bytes}", use, fix)


def _priority() -> Finding:
    """Check whether the process that answers hosts may run at a high priority."""
    use = "answers of GigE Vision cameras within a driver's 25 ms on a busy machine"
    capabilities = next((line for line in _STATUS.read_text().splitlines() if line.startswith("CapEff:")), "CapEff: 0")
    if int(capabilities.split()[1], 16) >> _CAP_SYS_NICE & 1:
        return Finding("priority", "CAP_SYS_NICE", use)
    nice = resource.getrlimit(resource.RLIMIT_NICE)[0]
    if nice >= _NICE_LIMIT or nice == resource.RLIM_INFINITY:
        return Finding("priority", "this user may run at nice -20", use)
    return Finding("priority", "this user may not run at nice -20", use, _PRIORITY_FIX)


def _libusb() -> Finding:
    path = ctypes.util.find_library("usb-1.0")
    fix = None if path else "apt-get install libusb-1.0-0"
    return Finding("libusb", path or "not found", "`evstim listen` on the real USB bus", fix)


def _usb_permission() -> Finding:
    bus = Path("/dev/bus/usb")
    use = "opening USB cameras on this machine"
    if not bus.is_dir():
        return Finding("USB permission", "no /dev/bus/usb: this machine has no USB host", use, "modprobe vhci-hcd")
    nodes = [node for node in bus.rglob("*") if node.is_char_device()]
    closed = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if not closed:
        return Finding("USB permission", f"all {len(nodes)} device nodes can be opened", use)
    return Finding("USB permission", f"{len(closed)} of {len(nodes)} device nodes cannot be opened", use, _UDEV_FIX)


def _cores() -> Finding:
    count = len(os.sched_getaffinity(0))
    use = "the session and each link in a process of its own"
    fix = None if count >= 2 else "taskset -p ffff $$  # or a machine with two cores"
    return Finding("cores", str(count), use, fix)


def kernel_cache() -> Finding:
    """Look for the folder in which this user's compiled kernels are stored."""
    from emulator.sensor.pixels.crossings import unpack

    use = "kernels that are compiled once, not in each process"
    if not hasattr(unpack, "_cache"):
        return Finding("kernel cache", "no folder, as NUMBA_DISABLE_JIT is set", use)
    if (folder := cache_folder(unpack)) is None:
        return Finding("kernel cache", NO_FOLDER, use, "export XDG_CACHE_HOME=/a/folder/of/yours")
    place = f"{folder}, and so beside each module" if folder.name == "__pycache__" else str(folder.parent)
    return Finding("kernel cache", place, use)


def on_free_ports(rig: Rig, folder: Path) -> Rig:
    """Return the rig with free ports: TCP port 0, and symbolic links of serial lines in `folder`."""
    links = []
    for link in rig.links:
        port = {} if link.listens_on() is None else {"port": 0}
        line = {"symlink": str(folder / f"{link.name}.tty")} if getattr(link, "symlink", "") else {}
        links.append(dataclasses.replace(link, **port, **line))
    return dataclasses.replace(rig, links=tuple(links))


def pose_port(rig: Rig) -> int | None:
    """Return the UDP port at which a rig's camera takes poses; None where its path is in the rig."""
    path = _live_path(rig.scene)
    return path.port if path else None


def on_a_free_pose_port(rig: Rig) -> Rig:
    """Return the rig whose camera receives poses at a free UDP port; others as they are."""
    if not (path := _live_path(rig.scene)):
        return rig
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind((path.host, 0))
        path = dataclasses.replace(path, port=free.getsockname()[1])
    return dataclasses.replace(rig, scene=dataclasses.replace(rig.scene, **{"camera": path}))


def _live_path(scene: SceneParameters) -> LivePath | None:
    path = getattr(scene, "camera", None)
    return path if isinstance(path, LivePath) else None


def free_loopback_address(udp_port: int) -> str:
    """Return a loopback address on which a UDP port is free; raises OSError where there is none."""
    for last in range(1, 255):
        address = f"127.0.0.{last}"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((address, udp_port))
            except OSError:
                continue
            return address
    raise OSError(f"UDP port {udp_port} is taken on every loopback address")


GL = Need("OpenGL 4.3 by EGL", egl)
"""The need of the GL painter."""


def needs_of(rig: Rig) -> tuple[Need, ...]:
    """Return the needs of the scene, the links and the painter of a rig, each once."""
    scene = SCENES[rig.scene.kind]
    needs = [*scene.needs(rig.scene), *(need for link in rig.links for need in link.needs())]
    if scene.gl and selected_painter(rig.run.painter) == "gl":
        needs.append(GL)
    return tuple({need.name: need for need in needs}.values())
