"""The whole life of an EVK4, told at random, in both of its formats."""

from hypothesis import settings
from treuzell_life import Life

from firmware_protocol.evt.evt2 import Evt2Decoder


class LifeInEvt21(Life):
    """The same, of a camera whose host chose EVT2.1."""

    OPENED = ((0x7000, 0x0007_0003), *Life.OPENED[1:])

    @staticmethod
    def DECODER():
        return Evt2Decoder("evt21-legacy")


TestLife, TestLifeInEvt21 = Life.TestCase, LifeInEvt21.TestCase
TestLife.settings = TestLifeInEvt21.settings = settings(stateful_step_count=25)
