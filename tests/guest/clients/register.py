"""Writes registers of a camera of iniVation that a driver holds, as a second program may: requests need no interface.

neuromorphic_drivers (0.18.2) has no setting for the external input and leaves its detector off, so on a real camera too
its triggers stay empty unless somebody else switches the detector on. usbfs takes a request as (linux/usbdevice_fs.h)

    u8 bmRequestType | u8 bRequest | u16 wValue | u16 wIndex | u16 wLength | u32 timeout_ms | void *data

with the ioctl USBDEVFS_CONTROL.
"""

import ctypes
import fcntl
import os
import struct
from pathlib import Path

USBDEVFS_CONTROL = 0xC0185500
REQUEST = struct.Struct("@BBHHHIP")
REGISTER = 0xBF
TIMEOUT_MS = 1000
CAMERAS = ("152a", "841a"), ("152a", "8419")  # DAVIS346, DVXplorer


def camera_node():
    """The device file of the first camera on the bus."""
    for device in Path("/sys/bus/usb/devices").iterdir():
        vendor, product = device / "idVendor", device / "idProduct"
        if vendor.exists() and (vendor.read_text().strip(), product.read_text().strip()) in CAMERAS:
            bus, number = (int((device / name).read_text()) for name in ("busnum", "devnum"))
            return Path(f"/dev/bus/usb/{bus:03}/{number:03}")
    raise FileNotFoundError("no camera on the bus")


def write_registers(module, addresses, value):
    """Write `value` to each of a module's parameters."""
    data = ctypes.create_string_buffer(value.to_bytes(4, "big"), 4)
    file = os.open(camera_node(), os.O_RDWR)
    try:
        for address in addresses:
            request = REQUEST.pack(0x40, REGISTER, module, address, 4, TIMEOUT_MS, ctypes.addressof(data))
            fcntl.ioctl(file, USBDEVFS_CONTROL, request)
    finally:
        os.close(file)
