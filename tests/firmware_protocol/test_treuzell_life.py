"""The whole life of each camera on one of Prophesee's boards, told at random.

Every event and edge has exactly one fate, and the words say the events.
"""

from functools import partial

import gen31_host
import genx320_host
import numpy as np
from camera_life import CameraLife
from evk4_requests import DATA, START, STOP, Host
from hypothesis import settings, stateful
from hypothesis import strategies as st

from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.gen31.device import Gen31, Gen31Settings
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings


class Life(CameraLife):
    """A camera under any sequence of events, edges, time, requests and reads: an EVK4 in EVT3."""

    AREA, EDGE_KINDS = (40, 3), 2
    OPENED, STARTED, STOPPED = ((0x7000, 0x0007_0001), (0x7004, 1 << 10)), START, STOP
    INTERRUPTIONS = (*STOP, (0x40_0004, 1), (0x9008, 0x645), (0x9028, 0), (0x0004, 0xF000_5442))
    DECODER = Evt3Decoder
    CAMERA, SETTINGS = Evk4, Evk4Settings

    def __init__(self):
        super().__init__(self.CAMERA(self.SETTINGS(fifo_bytes=1024, start_delay_us=100)))
        self.host = Host(self.camera)
        self.start()

    def start(self):
        self.host.write(*self.OPENED, *self.STARTED)
        self.decoder = self.DECODER()
        self.said, self.heard = ([], []), ([], [])

    @stateful.rule(data=st.data())
    def interrupt(self, data):
        self.host.write(data.draw(st.sampled_from(self.INTERRUPTIONS)))
        self.host.write(*self.STOPPED)
        self.start()

    @stateful.rule(max_bytes=st.sampled_from([1, 2, 5, 64, 512, 4096]), times=st.integers(1, 6), good=st.booleans())
    def read(self, max_bytes, times, good):
        for _ in range(times):
            transfer = self.camera.read(DATA, max_bytes)
            if transfer is None:
                return
            assert 0 < len(transfer.data) <= max_bytes
            (self.camera.sent if good else self.camera.lost)(transfer)
            self.hear(transfer)
            for k in range(2):
                assert self.heard[k][: len(self.said[k])] == self.said[k]

    def hear(self, transfer):
        """Take note of what a transfer says, and of what its words say."""
        heard = self.decoder.decode(transfer.data)
        for k, said in enumerate((transfer.events, transfer.edges)):
            own = said.copy()
            own["t"] -= np.uint64(transfer.epoch_us)
            self.said[k].extend(own.tolist())
            self.heard[k].extend(heard[k].tolist())

    @stateful.rule()
    def read_all(self):
        """When nothing is left, what transfers say that they complete is what was heard."""
        while (transfer := self.camera.read(DATA, 4096)) is not None:
            self.camera.sent(transfer)
            self.hear(transfer)
        assert self.said == self.heard

    @stateful.rule()
    def unplug(self):
        self.camera.detached()
        self.host = Host(self.camera)
        self.start()

    @stateful.invariant()
    def room_is_not_negative(self):
        assert self.camera.room_events >= 0


class LifeInEvt21(Life):
    """The same, of a camera whose host chose EVT2.1."""

    OPENED = ((0x7000, 0x0007_0003), *Life.OPENED[1:])
    DECODER = partial(Evt2Decoder, "evt21-legacy")


class LifeOfGenx320(Life):
    """A GenX320 in EVT2.1."""

    OPENED, STARTED, STOPPED = ((0x7044, 2),), genx320_host.START, genx320_host.STOP
    INTERRUPTIONS = (*STOPPED, (0x001C, 1), (0x9008, 0x195), (0x9028, 0), (0x0000, 0xC02), (0x7044, 0), (0x7044, 1))
    DECODER = partial(Evt2Decoder, "evt21")
    CAMERA, SETTINGS = Genx320, Genx320Settings


class LifeOfGen31(Life):
    """A Gen 3.1."""

    OPENED, STARTED, STOPPED = ((0x01A0, 1),), gen31_host.START, gen31_host.STOP
    INTERRUPTIONS = (*STOPPED, *STARTED, (0x0248, 0xC9), (0x0204, 0x23), (0x0500, 0), (0x01A0, 0))
    CAMERA, SETTINGS = Gen31, Gen31Settings


TestLife, TestLifeInEvt21 = Life.TestCase, LifeInEvt21.TestCase
TestLifeOfGenx320, TestLifeOfGen31 = LifeOfGenx320.TestCase, LifeOfGen31.TestCase
TestLife.settings = TestLifeInEvt21.settings = settings(stateful_step_count=25)
TestLifeOfGenx320.settings = TestLifeOfGen31.settings = settings(stateful_step_count=25, max_examples=30)
