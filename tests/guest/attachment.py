"""The camera's cable: `usbip attach` and `usbip detach` in the guest."""

import json
import sys
from pathlib import Path

from tests.guest.machine import HOST_ADDRESS

__all__ = ["DAVIS_FX2", "DAVIS_FX3", "DVXPLORER", "EVK4", "Attachment", "remote_cameras", "usb_bus"]

BUS_PROGRAM = str(Path(__file__).parent / "clients" / "bus.py")
DAVIS_FX2 = ("152a", "841b")
DAVIS_FX3 = ("152a", "841a")
DVXPLORER = ("152a", "8419")
EVK4 = ("04b4", "00f5")


def usb_bus(guest, cameras, timeout_s=120.0, model=DAVIS_FX3, *, on_cable=False):
    """Wait until the guest's bus shows this many cameras of a model and return it; raises RuntimeError in vain.

    `on_cable`: they hang on the guest's own controller, and not on USB/IP.
    """
    argv = [sys.executable, BUS_PROGRAM, *model, str(cameras), str(timeout_s), *(["cable"] if on_cable else [])]
    return json.loads(guest.check(argv, timeout_s + 10))


def remote_cameras(guest, tcp_port):
    """Ask what the host exports, in the words of `usbip list`."""
    return guest.check(["usbip", "--tcp-port", str(tcp_port), "list", "-r", HOST_ADDRESS])


class Attachment:
    """A camera of the host on the guest's USB bus, from the moment that the kernel knows it until it is unplugged."""

    def __init__(self, guest, tcp_port, busid="1-1", model=DAVIS_FX3):
        self._guest = guest
        self._model = model
        self._tool = ["usbip", "--tcp-port", str(tcp_port)]
        self._busid = busid

    def __enter__(self):
        self._guest.check([*self._tool, "attach", "-r", HOST_ADDRESS, "-b", self._busid])
        seen = usb_bus(self._guest, cameras=1, model=self._model)
        self.device = seen["devices"][0]
        self._port = seen["ports"][0]
        return self

    def __exit__(self, kind, error, at):
        # After an unplugging there is nothing left to detach: the outcome shows on the bus.
        self._guest.run(["usbip", "detach", "-p", str(self._port)])
        usb_bus(self._guest, cameras=0, model=self._model)
