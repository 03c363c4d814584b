"""Requests that no driver sends, to a board of Prophesee's between its events: nothing harms it."""

import os
import struct
from contextlib import suppress

import gen31_host
import genx320_host
import numpy as np
import pytest
from evk4_requests import DATA, Host, events_of

from firmware_protocol.gen31.device import Gen31, Gen31Settings
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.usb.device import SetupPacket, Stall

REQUESTS = int(os.environ.get("EVSTIM_HOSTILE_REQUESTS", "3000"))
GEN31 = [*range(0, 0x20, 4), 0x1A0, *range(0x200, 0x250, 4), *range(0x34C, 0x368, 4), *range(0x400, 0x450, 4)]
GEN31 += [*range(0x500, 0x540, 4), *range(0x800, 0x810, 4), 0x1FFC, 0x2000]
GENX320 = [address for address, _ in (*genx320_host.OPEN, *genx320_host.START)]
GENX320 += [*range(0x0, 0x50, 4), *range(0x400, 0x490, 4), *range(0x2000, 0x2028, 4), *range(0x3000, 0x3028, 4)]
GENX320 += [*range(0x6000, 0x6040, 4), *range(0x7000, 0x7048, 4), *range(0x9000, 0x9180, 4), 0xB8, 0xC000, 0xC008]
GENX320 += [0xC00C, 0xC0C4, 0xD000, 0xD0C4, *range(0xE000, 0xE020, 4), 0xF008, 0xFFFC, 0x1_0000]
BOARDS = {
    "gen31": (lambda: Gen31(Gen31Settings(start_delay_us=0, fifo_bytes=4096)), gen31_host.START, GEN31),
    "genx320": (lambda: Genx320(Genx320Settings(start_delay_us=0, fifo_bytes=4096)), genx320_host.START, GENX320),
}
PROPERTIES = [0x71, 0x72, 0x79, 0x7A, 0x1_0000, 0x1_0001, 0x1_0003, 0x1_0102, 0x4001_0102, 0x55, 0x56, 0x8000_0000]


def hostile_request(rng, addresses):
    """A frame of registers, with a size or without, mostly; else any property with any payload and any size."""
    address = (*addresses, 3, 0xFFFF_FFFC)[int(rng.integers(len(addresses) + 2))]
    values = (0, 1, 3, 5, 0x2B, 0x300, 0xC_1107, int(rng.integers(1 << 32)), 1 << int(rng.integers(32)), 0xFFFF_FFFF)
    words = [address, *[values[int(rng.integers(len(values)))]] * int(rng.choice((1, 1, 1, 2, 40)))]
    kind = rng.random()
    if kind < 0.5:
        return struct.pack(f"<III{len(words)}I", 0x4001_0102, 4 + 4 * len(words), int(rng.integers(3)) // 2, *words)
    if kind < 0.7:
        return struct.pack("<3I", 0x56, *words[:2])
    if kind < 0.8:
        return struct.pack("<5I", 0x1_0102, 12, int(rng.integers(3)), address, int(rng.integers(300)))
    payload = rng.bytes(int(rng.choice([0, 1, 4, 8, 12, 13, 1016])))
    size = len(payload) if rng.random() < 0.8 else int(rng.integers(1 << 32))
    return struct.pack("<II", int(rng.choice(PROPERTIES)), size) + payload


@pytest.mark.parametrize("board", BOARDS)
def test_hostile_requests_harm_nothing(board):
    make, start, addresses = BOARDS[board]
    rng, camera = np.random.default_rng(7), make()
    host = Host(camera)
    for k in range(REQUESTS):
        if k % 100 == 0:
            host.write(*start)
        if rng.random() < 0.1:
            setup = SetupPacket(*(int(rng.integers(1 << bits)) for bits in (8, 8, 16, 16, 16)))
            with suppress(Stall):
                assert len(camera.control(setup, b"" if setup.is_in else rng.bytes(setup.length % 64))) <= setup.length
            camera.control(SetupPacket(0x00, 9, 1, 0, 0), b"")
        camera.write(2, hostile_request(rng, addresses))
        answer = camera.read(2, 1024)
        assert 8 <= len(answer.data) <= 1024
        camera.sent(answer)
        x, y = k % 320, k // 7 % 320
        camera.offer(events_of((100 * k, x, y, True), (100 * k + 50, x, y, False)))
        transfer = camera.read(DATA, 512)
        if transfer is not None:
            (camera.sent if k % 5 else camera.lost)(transfer)
    assert camera.counters.balanced
    assert camera.counters.offered == 2 * REQUESTS
    assert camera.counters.delivered > 0
