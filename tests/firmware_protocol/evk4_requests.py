"""A host of the EVK4 in a few lines, byte for byte as the reference draws its requests."""

import struct

import numpy as np

from firmware_protocol.usb.device import SetupPacket
from tests.made_events import events_of as events_of

REQUESTS, ANSWERS, DATA = 2, 2, 1
START = ((0xB000, 0x2F9), (0x9028, 0), (0x9008, 0x645), (0x002C, 0x0022_C724), (0x0004, 0xF000_5442))
STOP = ((0x0004, 0xF000_5042), (0x002C, 0x0022_C324), (0x9028, 2), (0x9008, 0x644), (0xB000, 0x2F8))


class Host:
    """Holds a camera, configured."""

    def __init__(self, camera):
        self.camera = camera
        camera.attached()
        camera.control(SetupPacket(0x00, 9, 1, 0, 0), b"")

    def ask(self, hexadecimal):
        """Send a request and return its answer, both in hexadecimal digits."""
        self.camera.write(REQUESTS, bytes.fromhex(hexadecimal))
        transfer = self.camera.read(ANSWERS, 1024)
        assert transfer is not None
        self.camera.sent(transfer)
        return transfer.data.hex(" ", 4)

    def write(self, *registers):
        """Write registers, one request each."""
        for address, value in registers:
            answer = self.ask(struct.pack("<5I", 0x4001_0102, 12, 0, address, value).hex())
            assert answer == struct.pack("<4I", 0x4001_0102, 8, 0, address).hex(" ", 4)

    def register(self, address):
        """Read a register."""
        answer = bytes.fromhex(self.ask(struct.pack("<5I", 0x1_0102, 12, 0, address, 1).hex()))
        assert answer[:16] == struct.pack("<4I", 0x1_0102, 12, 0, address)
        return int.from_bytes(answer[16:], "little")

    def words(self, max_bytes=131_072):
        """Take all that the camera sends and return its words."""
        data = b""
        while (transfer := self.camera.read(DATA, max_bytes)) is not None:
            self.camera.sent(transfer)
            data += transfer.data
        return np.frombuffer(data, "<u2").tolist()


def on_board(camera, settings, opening, start):
    """Return `opened`, `running`: a camera and its host after `opening`, and after entries and `start` too."""

    def opened(**changes):
        made = camera(settings(**{"start_delay_us": 0, **changes}))
        host = Host(made)
        host.write(*opening)
        return made, host

    def running(*entries, **changes):
        made, host = opened(**changes)
        host.write(*entries, *start)
        return made, host

    return opened, running
