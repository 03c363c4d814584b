"""A camera's whole life, told at random: every event, edge and sample has exactly one fate, and readers agree."""

from camera_life import Fx3Life
from dvxplorer_host import MEASURE, RUN, Host
from hypothesis import settings, stateful
from hypothesis import strategies as st

from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings

CHIP = [0x0B, 0x12, 0x1C, 0x1E, 0x3000, 0x3067, 0x3200, 0x3204, 0x3206, 0x3300, 0x3302, 0x3303, 0x3307, 0x3262]


class Life(Fx3Life):
    """A DVXplorer."""

    AREA, RUN, SCALES = (3, 480), RUN, (0x20, 0xEA, 0x83)

    def __init__(self):
        super().__init__(Dvxplorer(DvxplorerSettings(fifo_bytes=1024, start_delay_us=100, imu_unit=3)))
        self.host.write_all([*RUN, *MEASURE])

    def new_host(self):
        return Host(self.camera)

    @stateful.rule(address=st.sampled_from(CHIP), value=st.sampled_from([0, 1, 2, 0x10, 0x80, 255, 0xFFFFFFFF]))
    def write_chip(self, address, value):
        self.host.write(5, address, value)


Life.TestCase.settings = settings(stateful_step_count=40)
test_any_life_of_a_camera_balances = Life.TestCase
