"""Blocks as packets, and their assembly at the host: exact, whatever is lost on the way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.gige.gvcp import Resend
from firmware_protocol.gige.gvsp import Block, BlockAssembly, removed


def test_golden_octets_of_a_block():
    block = Block(number=3, time_ns=5000, data=b"\x01\x80\x02\x60", packet_size=576)
    assert [block.packet(k).hex() for k in range(block.packets)] == [
        "0000" "0000" "81000000" "0000000000000003" "00000000"
        "00000001" "0000000000001388" "81100e30" "00000001" "0000fa00" "00000000" "00000000" "00000000",
        "0000" "0000" "83000000" "0000000000000003" "00000001" "01800260",
        "0000" "0000" "82000000" "0000000000000003" "00000002" "00000001" "00000004",
    ]  # fmt: skip


@pytest.mark.parametrize("packet_size", [576, 1400, 9000])
def test_every_packet_but_the_last_is_full(packet_size):
    block = Block(1, 0, bytes(range(250)) * 240, packet_size)
    payloads = [block.packet(k)[20:] for k in range(1, block.packets - 1)]
    assert {len(one) for one in payloads[:-1]} <= {packet_size - 48}
    assert b"".join(payloads) == block.data


def test_a_block_that_the_camera_keeps_no_more_is_given_up_at_once():
    gone, whole = Block(1, 0, bytes(2000), 576), Block(2, 0, bytes(20), 576)
    assembly = BlockAssembly()
    assembly.push(gone.packet(0), 0)
    for k in range(whole.packets):
        assert assembly.push(whole.packet(k), 0) == []
    assert assembly.push(removed(1, 1), 1) == [whole.data]
    assert assembly.lost == 1


def _whole(assembly, number, now_ns=0):
    block = Block(number, 0, b"\1\2" * number, 576)
    return [data for k in range(block.packets) for data in assembly.push(block.packet(k), now_ns)]


def test_a_block_of_which_nothing_came_is_asked_for():
    assembly = BlockAssembly()
    assert len(_whole(assembly, 1)) == 1
    assert _whole(assembly, 3) == []
    assert assembly.missing(20_000_000) == [Resend(2, 0, 1)]
    assert len(_whole(assembly, 2)) == 2


def test_blocks_that_wait_behind_a_gap_have_a_bound():
    assembly = BlockAssembly()
    assembly.push(Block(1, 0, bytes(2000), 576).packet(0), 0)
    seen = sum(len(_whole(assembly, number)) for number in range(2, 400))
    assert (seen, assembly.lost, assembly.waiting) == (398, 1, 0)


@given(seed=st.integers(0, 10**6), lost=st.floats(0, 0.3))
def test_blocks_are_put_together_from_packets_in_any_order_with_losses(seed, lost):
    draw = np.random.default_rng(seed)
    blocks = [Block(k + 1, 0, draw.bytes(2 * int(draw.integers(1, 3000))), 576) for k in range(12)]
    packets = [(block.number, k) for block in blocks for k in range(block.packets)]
    order = np.argsort(np.arange(len(packets)) + draw.uniform(0, 6, len(packets)))
    assembly, data, now_ns = BlockAssembly(), [], 0
    assembly.push(blocks[0].packet(0), 0)
    for place in order:
        number, k = packets[place]
        if draw.random() >= lost or (number, k) == packets[-1]:
            data += assembly.push(blocks[number - 1].packet(k), now_ns)
    while len(data) < len(blocks):
        now_ns += 20_000_000
        asked = assembly.missing(now_ns)
        assert asked, "nothing is asked for, and blocks are missing"
        for one in asked:
            for k in range(one.first, min(one.last + 1, blocks[one.block - 1].packets)):
                data += assembly.push(blocks[one.block - 1].packet(k), now_ns)
    assert data == [block.data for block in blocks]
    assert assembly.lost == 0


def test_a_block_whose_packets_do_not_come_again_is_given_up():
    blocks = [Block(k + 1, 0, bytes(2000), 576) for k in range(3)]
    assembly, data = BlockAssembly(), []
    for block in blocks:
        for k in range(block.packets):
            if (block.number, k) != (2, 2):
                data += assembly.push(block.packet(k), 0)
    assert len(data) == 1
    for turn in range(1, 8):
        assembly.missing(turn * 20_000_000)
        data += assembly.done(turn * 20_000_000)
    assert (len(data), assembly.lost, assembly.requested) == (2, 1, 5)


def test_the_end_of_the_last_block_is_asked_for_when_the_stream_is_over():
    block = Block(1, 0, bytes(2000), 576)
    assembly, data, now_ns = BlockAssembly(), [], 0
    for k in range(2):
        assembly.push(block.packet(k), 0)
    assert assembly.missing(20_000_000) == []
    for turn in range(2, block.packets):
        assert assembly.waiting == 1
        now_ns = turn * 20_000_000
        (asked,) = assembly.missing(now_ns, over=True)
        assert asked == Resend(1, turn, turn)
        data += assembly.push(block.packet(turn), now_ns)
    assert (data, assembly.waiting) == ([block.data], 0)


def test_hostile_packets_do_not_hurt_the_assembly():
    draw = np.random.default_rng(3)
    assembly = BlockAssembly()
    good = Block(5, 0, bytes(3000), 576)
    for k in range(5000):
        data = bytearray(good.packet(int(draw.integers(0, good.packets))))
        for _ in range(int(draw.integers(1, 4))):
            data[int(draw.integers(0, len(data)))] = int(draw.integers(0, 256))
        assembly.push(bytes(data[: int(draw.integers(0, len(data) + 1))]), k * 1000)
        assembly.missing(k * 1000)
    assert assembly.invalid > 0
