"""`evstim gadget up` and `evstim gadget down`: the USB gadget that a link `usb_gadget` runs its camera in."""

from __future__ import annotations

import pwd
from dataclasses import dataclass
from typing import Literal

from cyclopts import App, Parameter

from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, Json, failing, print_result
from emulator.rig.kinds import CAMERA_MODELS, UsbSettings, usb_sizes
from emulator.rig.tables import Camera
from firmware_protocol.usb.descriptors import DescriptorSet
from transports.usb.functionfs.gadget import Gadget, GadgetError, Places, controller_of


@Parameter(name="*")
@dataclass(frozen=True)
class UsbCameraOptions:
    """Camera that USB hosts find, as in the rig's table [camera].

    Attributes
    ----------
    model
        Camera model.
    serial
        Serial number.
    speed
        Highest USB speed.
    """

    model: str = Camera.model
    serial: str = Camera.serial
    speed: Literal["super", "high"] = Camera.speed


def up(
    *,
    name: str = "evstim",
    udc: str = "",
    user: str | None = None,
    plug: UsbCameraOptions = UsbCameraOptions(),
    json: Json = False,
) -> int:
    """Make the gadget, so that `evstim run` need not be root; hosts find it when a rig with a link usb_gadget runs.

    Parts that a killed program left are replaced. Needs root.

    Parameters
    ----------
    name
        Name of the gadget, as the link's key `gadget` has it.
    udc
        USB device controller, as /sys/class/udc names it; may be left out where there is one.
    user
        User who may run the camera, beside root.
    """
    descriptors = _descriptors(plug)
    gadget = _gadget(name)
    try:
        user_id = None if user is None else pwd.getpwnam(user).pw_uid
    except KeyError as error:
        raise Failure(f"this machine has no user {user!r}", WRONG_USE) from error
    with failing(LACKING, GadgetError):
        controller = controller_of(udc, Places())
        gadget.make(descriptors, user_id)
    line = f"gadget {name} is ready for {controller}; its files are in {gadget.mount}"
    print_result(json, {"gadget": name, "udc": controller, "mount": gadget.mount}, [line])
    return GOOD


def down(*, name: str = "evstim", json: Json = False) -> int:
    """Remove the gadget, and parts that a killed program left. Needs root.

    Parameters
    ----------
    name
        Name of the gadget.
    """
    gadget = _gadget(name)
    was_there = gadget.exists
    with failing(LACKING, GadgetError):
        gadget.remove()
    line = f"gadget {name} is removed" if was_there else f"there is no gadget {name}"
    print_result(json, {"gadget": name, "removed": was_there}, [line])
    return GOOD


def _gadget(name: str) -> Gadget:
    with failing(WRONG_USE, ValueError):
        return Gadget(name)


def _descriptors(plug: UsbCameraOptions) -> DescriptorSet:
    """Return the descriptors that USB hosts read."""
    model = CAMERA_MODELS.get(plug.model)
    if model is None or model.usb is None:
        raise Failure(f"there is no USB camera {plug.model!r}; there are: {', '.join(usb_sizes())}", WRONG_USE)
    with failing(WRONG_USE, ValueError):
        camera = Camera(model=plug.model, serial=plug.serial, speed=plug.speed)
        device = model.usb.device(camera, UsbSettings(start_delay_ms=0.0))()
    return device.descriptors(device.identity.speed)


verbs = App(name="gadget")
verbs.command(up)
verbs.command(down)
