"""The whole life of a GenX320, told at random, and requests that no driver sends."""

import os
import struct

import numpy as np
from genx320_host import DATA, OPEN, START, STOP, events_of
from hypothesis import settings
from treuzell_life import Life

from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.usb.device import SetupPacket, Stall

REQUESTS = int(os.environ.get("EVSTIM_HOSTILE_REQUESTS", "3000"))


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

ADDRESSES = [address for address, _ in (*OPEN, *START)]
ADDRESSES += [*range(0x0, 0x50, 4), *range(0x400, 0x490, 4), *range(0x2000, 0x2028, 4), *range(0x3000, 0x3028, 4)]
ADDRESSES += [*range(0x6000, 0x6040, 4), *range(0x7000, 0x7048, 4), *range(0x9000, 0x9180, 4), 0xB8, 0xC000, 0xC008]
ADDRESSES += [0xC00C, 0xC0C4, 0xD000, 0xD0C4, *range(0xE000, 0xE020, 4), 0xF008, 0xFFFC, 0x1_0000, 0x3, 0xFFFF_FFFC]
PROPERTIES = [0x71, 0x72, 0x79, 0x7A, 0x1_0000, 0x1_0001, 0x1_0003, 0x1_0102, 0x4001_0102, 0x55, 0x56, 0x8000_0000]


def pick(rng, values):
    return values[int(rng.integers(len(values)))]


def hostile_request(rng):
    """A frame of a register, mostly; else any property with any payload, cut or with a wrong size."""
    value = pick(rng, (0, 1, 3, 5, int(rng.integers(1 << 32)), 1 << int(rng.integers(32)), 0xFFFF_FFFF))
    words = [pick(rng, ADDRESSES), *([value] * pick(rng, (1, 1, 1, 2, 40)))]
    kind = rng.random()
    if kind < 0.7:
        return struct.pack(f"<III{len(words)}I", 0x4001_0102, 4 + 4 * len(words), 0, *words)
    if kind < 0.8:
        return struct.pack("<5I", 0x1_0102, 12, int(rng.integers(2)), words[0], int(rng.integers(300)))
    payload = rng.bytes(pick(rng, (0, 1, 4, 8, 12, 13, 1016)))
    size = len(payload) if rng.random() < 0.8 else int(rng.integers(1 << 32))
    return struct.pack("<II", pick(rng, PROPERTIES), size) + payload


def hostile_setup(rng):
    return SetupPacket(*(int(rng.integers(1 << bits)) for bits in (8, 8, 16, 16, 16)))


def attack(camera, rng, k):
    """Send one request, take its answer, and let events pass."""
    if rng.random() < 0.1:
        try:
            setup = hostile_setup(rng)
            assert len(camera.control(setup, b"" if setup.is_in else rng.bytes(setup.length % 64))) <= setup.length
        except Stall:
            pass
        camera.control(SetupPacket(0x00, 9, 1, 0, 0), b"")
    camera.write(2, hostile_request(rng))
    answer = camera.read(2, 1024)
    assert answer is not None
    assert 8 <= len(answer.data) <= 1024
    camera.sent(answer)
    t_us = 100 * k
    camera.offer(events_of((t_us, k % 320, k // 7 % 320, True), (t_us + 50, k % 320, k // 7 % 320, False)))
    transfer = camera.read(DATA, 512)
    if transfer is not None:
        (camera.sent if k % 5 else camera.lost)(transfer)


def test_hostile_requests_harm_nothing():
    rng, camera = np.random.default_rng(7), Genx320(Genx320Settings(start_delay_us=0, fifo_bytes=4096))
    camera.attached()
    camera.control(SetupPacket(0x00, 9, 1, 0, 0), b"")
    for k in range(REQUESTS):
        if k % 100 == 0:
            for entry in START:
                camera.write_register(*entry)
        attack(camera, rng, k)
        if k % 50 == 0:
            assert camera.counters.balanced
    assert camera.counters.balanced
    assert camera.counters.offered == 2 * REQUESTS
    assert camera.counters.delivered > 0
