"""A host that starts a DAVIS346, takes nothing of what it sends for three seconds, and leaves it running."""

import time

from firmware_protocol.usb.device import SetupPacket
from transports.usb.pyusb_host import PyusbHost

REGISTER = 0xBF
RUN = ((0, 3), (9, 0), (0, 1), (0, 0), (1, 3))  # chip, USB, timestamps, multiplexer, sensor


def main():
    host = PyusbHost.find(0x152A, 0x841A)
    host.configure()
    for module, parameter in RUN:
        host.control_out(SetupPacket(0x40, REGISTER, module, parameter, 4), bytes((0, 0, 0, 1)))
    time.sleep(3.0)


if __name__ == "__main__":
    main()
