"""What a rig says of a USB gadget."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from transports.usb.functionfs.gadget import check_name

__all__ = ["UsbGadgetLink"]


@dataclass(frozen=True)
class UsbGadgetLink:
    """The camera on a real USB cable: this machine has a USB device port, as a Raspberry Pi has (docs/cable.md).

    Attributes
    ----------
    udc
        The USB device controller, as /sys/class/udc names it; may be left out where there is one.
    gadget
        Name of the gadget. It is made when the run begins and removed when it ends, unless `evstim gadget up` made it.
    name
        What this rig calls the link: in reports, and where faults and triggers name it.
    """

    kind: ClassVar[str] = "usb_gadget"
    udc: str = ""
    gadget: str = "evstim"
    name: str = "usb_gadget"

    def __post_init__(self) -> None:
        check_name(self.gadget)
