"""USB gadget in configfs with one FunctionFS function, and its mounted FunctionFS: made, bound, and removed.

    /sys/kernel/config/usb_gadget/NAME/
        idVendor idProduct bcdDevice max_speed UDC
        strings/0x409/          manufacturer product serialnumber
        functions/ffs.NAME/     the function; its files are in the mount
        configs/c.1/            MaxPower bmAttributes; ffs.NAME -> the function
    /run/evstim/NAME/           the mount: ep0, and the endpoints after their descriptors were written

The kernel disconnects the controller from a gadget whose program has ended or was killed. So a gadget with a controller
is in use, and other remains of a killed program are made again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.usb.descriptors import DescriptorSet, Speed
from transports.usb.kind import check_name

_ENGLISH = "0x409"
_CONFIGURATION = "c.1"
_SPEED = {Speed.FULL: "full-speed", Speed.HIGH: "high-speed", Speed.SUPER: "super-speed"}
_TOOL_TIMEOUT_S = 30.0


class GadgetError(OSError):
    """Error: the machine cannot make, bind or remove the gadget; the message gives the remedy."""


@dataclass(frozen=True)
class Places:
    """Folders of the machine for gadgets."""

    gadgets: Path = Path("/sys/kernel/config/usb_gadget")
    controllers: Path = Path("/sys/class/udc")
    mounts: Path = Path("/run/evstim")


def mount_functionfs(name: str, mount: Path, owner: int | None) -> None:
    """Mount the function `name`, for the user with the id `owner` (None: root); raises GadgetError."""
    options = [] if owner is None else ["-o", f"uid={owner},mode=0700"]
    _tool(["mount", "-t", "functionfs", *options, name, str(mount)])


def _unmount(mount: Path) -> None:
    _tool(["umount", str(mount)])


def _tool(command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TOOL_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise GadgetError(f"cannot run {command[0]}: {error}") from error
    if done.returncode:
        raise GadgetError(f"{' '.join(command)}: {done.stderr.strip()}")


def controller_of(name: str, places: Places) -> str:
    """Return the USB device controller called `name`, or the only one where that is empty; raises GadgetError."""
    controllers = sorted(path.name for path in places.controllers.iterdir()) if places.controllers.is_dir() else []
    if not controllers:
        raise GadgetError(
            f"no USB device controller in {places.controllers}: this needs a board with one, switched to device mode "
            "(Raspberry Pi: dtoverlay=dwc2 in config.txt); for a trial, modprobe dummy_hcd"
        )
    if name and name not in controllers:
        raise GadgetError(f"no USB device controller {name!r}; there are: {', '.join(controllers)}")
    if not name and len(controllers) > 1:
        raise GadgetError(f"several USB device controllers, name one (udc): {', '.join(controllers)}")
    return name or controllers[0]


class Gadget:
    """USB gadget of a name, ValueError if folders cannot have it; nothing is done before a method is called.

    Parameters
    ----------
    name : name of the gadget, its function and the folder of its mount.
    places : folders of the machine.
    mount, unmount : functions that mount the function's files, and unmount them.
    """

    def __init__(
        self,
        name: str,
        places: Places | None = None,
        mount: Callable[[str, Path, int | None], None] = mount_functionfs,
        unmount: Callable[[Path], None] = _unmount,
    ) -> None:
        check_name(name)
        self.name = name
        self._places = places or Places()
        self._folder = self._places.gadgets / name
        self._function = self._folder / "functions" / f"ffs.{name}"
        self._configuration = self._folder / "configs" / _CONFIGURATION
        self._mount, self._unmount = mount, unmount

    @property
    def mount(self) -> Path:
        """Folder in which its FunctionFS is mounted."""
        return self._places.mounts / self.name

    @property
    def controller(self) -> str:
        """Controller to which it is bound; empty if there is none."""
        return _text(self._folder / "UDC")

    @property
    def exists(self) -> bool:
        """True if an entry of this name is in configfs."""
        return self._folder.is_dir()

    @property
    def is_ready(self) -> bool:
        """True if it is complete except for its controller."""
        return (self._configuration / self._function.name).is_symlink() and (self.mount / "ep0").exists()

    def suits(self, descriptors: DescriptorSet) -> bool:
        """Return True if a host would read the device of `descriptors`."""
        attributes = _attributes(descriptors)
        return all(_text(self._folder / path).lower() == value.lower() for path, value in attributes.items())

    def make(self, descriptors: DescriptorSet, owner: int | None = None) -> None:
        """Make it for the device of `descriptors`, in place of the remains of a killed program.

        Raises GadgetError if it is in use, was made by another program, or this user or machine cannot make gadgets.

        Parameters
        ----------
        descriptors : descriptors of the device, at its highest speed.
        owner : id of the user who may run the camera; None: root only.
        """
        self._require_root()
        self.remove()
        try:
            self._make(descriptors, owner)
        except GadgetError:
            with contextlib.suppress(OSError):
                self.remove()
            raise
        except OSError as error:
            with contextlib.suppress(OSError):
                self.remove()
            raise GadgetError(f"cannot make the gadget {self.name}: {error}") from error

    def bind(self, controller: str) -> None:
        """Connect it to a controller: from then on hosts see it. Raises GadgetError."""
        try:
            (self._folder / "UDC").write_text(controller)
        except OSError as error:
            raise GadgetError(self._why_unbound(controller, error)) from error

    def unbind(self) -> None:
        """Disconnect it: hosts see it unplugged. Does nothing if it is not bound; raises GadgetError."""
        try:
            if self.controller:
                (self._folder / "UDC").write_text("\n")
        except OSError as error:
            if error.errno != errno.ENODEV:
                raise GadgetError(f"cannot take the gadget {self.name} from its controller: {error}") from error

    def remove(self) -> None:
        """Remove it, or its remains; raises GadgetError if it is in use or was made by another program."""
        if self.exists:
            self._require_ours()
        try:
            self._remove()
        except OSError as error:
            raise GadgetError(f"cannot remove the gadget {self.name}: {error}") from error

    def _make(self, descriptors: DescriptorSet, owner: int | None) -> None:
        self._folder.mkdir()
        (self._folder / "strings" / _ENGLISH).mkdir(parents=True)
        self._function.mkdir(parents=True)
        self._configuration.mkdir(parents=True)
        for path, value in _attributes(descriptors).items():
            (self._folder / path).write_text(value)
        (self._configuration / self._function.name).symlink_to(self._function)
        self.mount.mkdir(parents=True, exist_ok=True)
        self._mount(self.name, self.mount, owner)
        if owner is not None:
            os.chown(self._folder / "UDC", owner, -1)

    def _remove(self) -> None:
        if (self.mount / "ep0").exists():
            self._unmount(self.mount)
        if self.mount.is_dir():
            self.mount.rmdir()
        link = self._configuration / self._function.name
        if link.is_symlink():
            link.unlink()
        strings = self._folder / "strings" / _ENGLISH
        for folder in (self._configuration, self._function, strings, self._folder):
            if folder.is_dir():
                folder.rmdir()

    def _require_root(self) -> None:
        if not self._places.gadgets.is_dir():
            raise GadgetError(
                f"no {self._places.gadgets}: `modprobe libcomposite`, and `mount -t configfs none /sys/kernel/config` "
                "where that is empty"
            )
        if not os.access(self._places.gadgets, os.W_OK):
            raise GadgetError(
                f"only root may make the gadget {self.name}: run as root, or let root prepare it for you with "
                "`evstim gadget up --user NAME`"
            )

    def _require_ours(self) -> None:
        """Raise GadgetError for a gadget that a program runs, or that another program made."""
        functions = self._folder / "functions"
        remaining = [path.name for path in functions.iterdir() if path != self._function] if functions.is_dir() else []
        if remaining:
            raise GadgetError(
                f"the name {self.name} is in use: that gadget has the function {remaining[0]}, which evstim does not "
                "make. Choose another name"
            )
        if self.controller:
            raise GadgetError(
                f"the gadget {self.name} is in use at {self.controller}: a program runs it. End that one, or choose "
                "another name"
            )

    def _why_unbound(self, controller: str, error: OSError) -> str:
        failure = f"cannot connect the gadget {self.name} to {controller}: {error.strerror}"
        holders = [
            path.name
            for path in self._places.gadgets.iterdir()
            if path != self._folder and _text(path / "UDC") == controller
        ]
        if holders:
            return f"{failure}; the gadget {holders[0]} has it: end its program, or write an empty line to its UDC"
        if error.errno == errno.EBUSY:
            return f"{failure}; a module has it (g_ether, g_serial ...): lsmod, and rmmod that one"
        return failure


def _attributes(descriptors: DescriptorSet) -> Mapping[str, str]:
    """Return the texts of the gadget's files, by their paths."""
    device, configuration = descriptors.device, descriptors.configuration
    named = zip(("manufacturer", "product", "serialnumber"), device.strings, strict=True)
    strings = {f"strings/{_ENGLISH}/{name}": descriptors.strings[index] for name, index in named if index}
    return {
        "idVendor": f"0x{device.vendor_id:04x}",
        "idProduct": f"0x{device.product_id:04x}",
        "bcdDevice": f"0x{device.bcd_device:04x}",
        "max_speed": _SPEED[device.speed],
        **strings,
        f"configs/{_CONFIGURATION}/MaxPower": str(configuration.max_power_ma),
        f"configs/{_CONFIGURATION}/bmAttributes": f"0x{configuration.attributes:x}",
    }


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
