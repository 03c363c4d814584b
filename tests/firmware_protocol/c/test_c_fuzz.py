"""Hostile bytes for the C library under sanitizers, and damage to sound streams. At length:

EVSTIM_C_BYTES=1e7 EVSTIM_C_FAULTS=1e6 python -m pytest tests/firmware_protocol/c/test_c_fuzz.py --timeout 0
"""

import os
import struct

import numpy as np
import pytest

from firmware_protocol.events import EVENT
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

SIZE = (346, 260)
BYTES = round(float(os.environ.get("EVSTIM_C_BYTES", "1e5")))
FAULTS = round(float(os.environ.get("EVSTIM_C_FAULTS", "2000")))
PROFILES = {"C": "ccsds-cobs", "S": "ccsds-slip", "K": "ccsds-kiss", "X": "csp-kiss"}
AWKWARD = np.array([0x00, 0x01, 0x02, 0xC0, 0xDB, 0xDC, 0xDD, 0xFF], np.uint8)
GROUP = 3
"""Frames, of which the one in the middle is damaged."""


def random_bytes(library, n, seed=0):
    """Give `n` random bytes to each decoder; return what was accepted where there is a checksum: packets, blocks."""
    rng = np.random.default_rng(seed)
    accepted = 0
    while n > 0:
        size = min(n, 100_000)
        data, few = rng.bytes(size), rng.choice(AWKWARD, size).tobytes()
        for mode in "cskd":
            library(mode, data)
            library(mode, few, piece=7)
        for mode in PROFILES:
            accepted += library(mode, data).counters[0] + library(mode, few, piece=7).counters[0]
        lengths = rng.integers(0, 90, size)[: size // 90]
        accepted += library("b", cut(data, lengths, lambda n: struct.pack("<QI", 5, n))).counters[0]
        accepted += from_frames(library, data, lengths % 10, rng)
        library("n", cut(data, lengths % 65, lambda n: struct.pack("<HBB", 0x1A2 + 0x100 * (n % 3), n > 8, n)))
        n -= size
    return accepted


def from_frames(library, data, lengths, rng):
    """Give random frames that look like ISO-TP's and CFP's; return how many packets were accepted."""
    kinds = iter(rng.choice([0x07, 0x10, 0x12, *range(0x20, 0x30), 0xFF], len(lengths)).tolist())
    isotp = cut(data, lengths, lambda n: struct.pack("<IBB", 0x4A2, n + 1, next(kinds)))
    numbers = iter(rng.choice([2, 3, *range(0, 32, 4), 1], len(lengths)).tolist())
    cfp = cut(data, lengths, lambda n: struct.pack("<IB", 1 << 13 | 10 << 7 | next(numbers), n))
    return sum(library(mode, records, piece=200).counters[0] for mode, records in (("I", isotp), ("F", cfp)))


def cut(data, lengths, head):
    """Return pieces of `data`, each with a head made of its length."""
    ends = np.cumsum(lengths)
    return b"".join(head(int(n)) + data[end - n : end] for n, end in zip(lengths, ends, strict=True))


class Sent:
    """Frames of a profile, each with a block whose first event's time is its own."""

    def __init__(self, name, groups, seed):
        rng = np.random.default_rng(seed)
        profile, self.frames, self.blocks = Profile(name), [], {}
        for i in range(groups * GROUP):
            events = np.zeros(int(rng.integers(1, 20)), EVENT)
            events["t"] = 5000 * i + np.sort(rng.integers(0, 4000, len(events)))
            events["x"], events["y"], events["on"] = rng.integers(0, [346, 260, 2], (len(events), 3)).T
            data, _ = BlockEncoder(SIZE, BlockSettings(mode=("rows", "flat", "bitmap")[i % 3])).encode(events)
            self.frames.append(profile.wrap(Message(MessageKind.EVENTS, data, 5000 * i)))
            self.blocks[5000 * i] = decode_block(data, 5000 * i).events

    def delivered(self, events):
        """Return which frames `events` are of; fails when they are anything else."""
        found, at = set(), 0
        while at < len(events):
            first = int(events["t"][at]) // 5000 * 5000
            block = self.blocks[first]
            assert np.array_equal(events[at : at + len(block)], block), f"a wrong event was accepted near {first} us"
            found.add(first // 5000)
            at += len(block)
        return found


def damage_one_in_three(library, mode, tries, seed=0):
    """Flip a bit, lose a byte or add one in the middle frame of each three; return frames lost by number a try."""
    groups, lost_by = min(tries, 1000), np.zeros(GROUP + 1, int)
    # The last three take no damage, so that their counts tell of every loss before them.
    sent, rng = Sent(PROFILES[mode], groups + 1, seed), np.random.default_rng(seed + 1)
    for _ in range(tries // groups):
        frames = list(sent.frames)
        kinds, places, values = rng.integers(0, 3, groups), rng.random(groups), rng.integers(0, 256, groups)
        for i, (kind, place, value) in enumerate(zip(kinds.tolist(), places.tolist(), values.tolist(), strict=True)):
            frame = frames[GROUP * i + 1]
            at = int(place * len(frame))
            new = (bytes([frame[at] ^ 1 << value % 8]), b"", bytes([frame[at], value]))[kind]
            frames[GROUP * i + 1] = frame[:at] + new + frame[at + 1 :]
        reply = library(mode, b"".join(frames))
        found = sent.delivered(reply.events)
        lost = [sum(GROUP * i + j not in found for j in range(GROUP)) for i in range(groups)]
        lost_by += np.bincount(lost, minlength=GROUP + 1)
        packets, missing, disordered = reply.counters[0], reply.counters[3], reply.counters[4]
        assert packets + missing == len(frames), "a loss was not counted"
        assert disordered == 0
    return lost_by.tolist()


def test_random_bytes_bring_no_crash_and_no_packet(library):
    assert random_bytes(library, BYTES) == 0


@pytest.mark.system
@pytest.mark.parametrize("mode", PROFILES)
def test_one_fault_costs_at_most_two_frames_and_is_counted(library, mode):
    lost_by = damage_one_in_three(library, mode, FAULTS)
    assert sum(lost_by) == FAULTS
    assert lost_by[1] > 0.75 * FAULTS
    assert lost_by[3] == 0
