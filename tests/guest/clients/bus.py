"""What the guest's kernel says of the USB bus, as one JSON object: the devices, and the USB/IP ports in use.

    bus.py VENDOR PRODUCT COUNT TIMEOUT     waits until COUNT devices VENDOR:PRODUCT are there, and as many ports in use
    bus.py VENDOR PRODUCT COUNT TIMEOUT cable           waits for the devices alone: they hang on no USB/IP port

Exit code 1 when time runs out first.
"""

import json
import sys
import time
from pathlib import Path

DEVICES = Path("/sys/bus/usb/devices")
CONTROLLERS = Path("/sys/devices/platform")
ATTRIBUTES = ("idVendor", "idProduct", "bcdDevice", "serial", "product", "manufacturer", "speed", "version")
PORT_FREE = "004"


def devices(vendor, product):
    found = []
    for path in DEVICES.iterdir():
        device = {name: attribute(path / name) for name in ATTRIBUTES}
        if (device["idVendor"], device["idProduct"]) == (vendor, product):
            found.append({"path": path.name, **device})
    return found


def attribute(path):
    try:
        return path.read_text().strip()
    except OSError:  # not every device has every attribute, and a device may leave while it is read
        return None


def ports():
    """The first controller's ports that are not free, from lines such as `ss  0015 006 005 00010002 000003 1-1`."""
    lines = (CONTROLLERS / "vhci_hcd.0" / "status").read_text().splitlines()[1:]
    return [int(line.split()[1]) for line in lines if line.split()[2] != PORT_FREE]


def main():
    vendor, product, count, timeout_s = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4])
    deadline = time.monotonic() + timeout_s
    on_cable = sys.argv[5:] == ["cable"]
    while True:
        seen = {"devices": devices(vendor, product), "ports": [] if on_cable else ports()}
        ready = len(seen["devices"]) == count and (on_cable or len(seen["ports"]) == count)
        if ready or time.monotonic() > deadline:
            break
        time.sleep(0.02)
    print(json.dumps(seen))
    sys.exit(not ready)


if __name__ == "__main__":
    main()
