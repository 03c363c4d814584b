"""The whole life of a GenX320, told at random."""

from genx320_host import START, STOP
from hypothesis import settings
from treuzell_life import Life

from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.genx320.device import Genx320, Genx320Settings


class LifeOfGenx320(Life):
    """A GenX320 in EVT2.1."""

    OPENED, STARTED, STOPPED = (), START, STOP
    INTERRUPTIONS = (*STOP, (0x001C, 1), (0x9008, 0x195), (0x9028, 0), (0x0000, 0xC02), (0x7044, 0), (0x7044, 1))

    @staticmethod
    def new_camera():
        return Genx320(Genx320Settings(fifo_bytes=1024, start_delay_us=100))

    def start(self):
        self.host.write((0x7044, 2))
        super().start()

    @staticmethod
    def DECODER():
        return Evt2Decoder("evt21")


TestLife = LifeOfGenx320.TestCase
TestLife.settings = settings(stateful_step_count=25, max_examples=30)
