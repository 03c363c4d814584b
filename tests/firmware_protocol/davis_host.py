"""A host for tests: the control requests that drivers send, and a reader that decodes what comes back."""

from __future__ import annotations

import struct

import numpy as np

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.device import Davis346
from firmware_protocol.events import EVENT
from firmware_protocol.usb.device import SetupPacket

OUT, IN = 0x40, 0xC0

Writes = list[tuple[int, int, int]]

STOP: Writes = [
    (1, 3, 0),
    (2, 4, 0),
    (3, 2, 0),
    (3, 3, 0),
    (3, 4, 0),
    (4, 0, 0),
    (0, 0, 0),
    (0, 1, 0),
    (9, 0, 0),
    (0, 3, 0),
]
SENSORS: Writes = [(1, 3, 1), (2, 4, 1), (3, 2, 1), (3, 3, 1), (3, 4, 1), (4, 0, 1)]
RUN: Writes = [(0, 3, 1), (9, 0, 1), (0, 1, 1), (0, 0, 1), (1, 3, 1)]


def events_of(*rows):
    """Events from (t, x, y, on) tuples."""
    return np.array(list(rows), EVENT)


def steady(n, start_us=0, step_us=1, seed=0):
    """`n` events, one each `step_us`, at random pixels of a 346 x 260 array."""
    rng = np.random.default_rng(seed)
    events = np.zeros(n, EVENT)
    events["t"] = start_us + np.arange(n) * step_us
    events["x"], events["y"] = rng.integers(0, 346, n), rng.integers(0, 260, n)
    events["on"] = rng.integers(0, 2, n)
    return events


class Host:
    """Configures a camera and does what drivers do."""

    def __init__(self, camera: Davis346, turned: bool = False) -> None:
        self.camera = camera
        self.turned = turned
        self.new_decoder()
        camera.attached()
        self.control(0x00, 9, 1, 0, b"")

    def new_decoder(self):
        self.decoder = Decoder(self.camera.settings.size, self.turned)

    def control(self, kind, request, value, index, data=b"", length=None):
        setup = SetupPacket(kind, request, value, index, len(data) if length is None else length)
        return self.camera.control(setup, data)

    def write(self, module, parameter, value):
        self.control(OUT, 0xBF, module, parameter, struct.pack(">I", value))

    def write_all(self, writes):
        for entry in writes:
            self.write(*entry)

    def multi_write(self, writes):
        self.control(OUT, 0xC2, len(writes), 0, b"".join(struct.pack(">BBI", *w) for w in writes))

    def read(self, module, parameter):
        answer = self.control(IN, 0xBF, module, parameter, length=4)
        assert len(answer) == 4
        return int.from_bytes(answer, "big")

    def clear_halt(self):
        self.control(0x02, 1, 0, 0x82)

    def reset_timestamps(self):
        self.multi_write([(0, 2, 1), (0, 2, 0)])

    def transfers(self, max_bytes=8192):
        """Take all there is, reporting each transfer as sent."""
        taken = []
        while (transfer := self.camera.read(2, max_bytes)) is not None:
            self.camera.sent(transfer)
            taken.append(transfer)
        return taken

    def data(self, max_bytes=8192):
        return b"".join(t.data for t in self.transfers(max_bytes))

    def decoded(self, max_bytes=8192):
        """Take all there is and decode it."""
        return self.decoder.feed(self.data(max_bytes))
