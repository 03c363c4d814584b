"""A camera's whole life, told at random: every event, edge, frame line and sample has exactly one fate."""

import numpy as np
from camera_life import Fx3Life
from davis_host import RUN, Host
from davis_strategies import STEPS_US
from hypothesis import settings, stateful
from hypothesis import strategies as st

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.frames import LineKind, line_record

STREAMS = [(1, 3), (2, 4), (3, 2), (3, 3), (3, 4), (4, 0)]
OTHERS = [(0, 4), (2, 5), (2, 7), (2, 12), (3, 5), (1, 41), (1, 52), (5, 11)]
FRAME_KINDS = [LineKind.START, *[LineKind.RESET] * 3, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END]
FRAME_KINDS += [*[LineKind.SIGNAL] * 3, LineKind.END]


def frame(number, start_us, line_us):
    """A frame of 3 columns and 2 rows whose samples and exposure tell its number."""
    lines = np.zeros(len(FRAME_KINDS), line_record(346))
    lines["t"], lines["kind"] = start_us + line_us * np.arange(len(FRAME_KINDS)), FRAME_KINDS
    lines["exposure"], lines["roi"], lines["length"] = number, (4, 5, 6, 6), 2
    lines["samples"][:, :2] = number % 1024
    return lines


class Life(Fx3Life):
    """A DAVIS346 with frames."""

    RUN, SCALES = RUN, (0x20, 0xE5, 0x83)

    def __init__(self):
        super().__init__(Davis346(Davis346Settings(fifo_bytes=1024, start_delay_us=100, frames=True, imu_unit=1)))
        self.host.write_all(RUN)
        self.frames = 0

    def new_host(self):
        return Host(self.camera)

    @stateful.rule(line_us=STEPS_US)
    def offer_frame(self, line_us):
        self.frames += 1
        self.camera.offer_readings(ReadingKind.FRAMES, frame(self.frames, self.t_us + 1, line_us))

    @stateful.rule(stream=st.sampled_from(STREAMS), on=st.booleans())
    def switch_stream(self, stream, on):
        self.host.write(*stream, int(on))

    @stateful.rule(key=st.sampled_from(OTHERS), value=st.sampled_from([0, 1, 255, 0xFFFFFFFF]))
    def write_any(self, key, value):
        self.host.write(*key, value)

    def check(self, decoded):
        for read in decoded.frames:
            assert set(np.unique([read.reset, read.signal]).tolist()) == {read.exposure_cycles % 1024}


Life.TestCase.settings = settings(stateful_step_count=40)
test_any_life_of_a_camera_balances = Life.TestCase
