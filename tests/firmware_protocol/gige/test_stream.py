"""Events into a camera, blocks and packets out: exact, each with one fate, whatever is lost on the way."""

import numpy as np
import pytest
from gige_host import Host, steady
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol.events import EdgeKind, empty_edges
from firmware_protocol.gige.gvcp import Command, Resend
from firmware_protocol.gige.gvsp import BLOCK_OCTETS, Block, BlockAssembly, removed
from firmware_protocol.gige.registers import ACQUISITION_STOP, COLUMNS, INVERTED, ROWS, Erc


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


def test_blocks_of_a_busy_stream_are_full():
    host = Host()
    host.start()
    host.camera.offer(steady(60_000))
    sizes = [len(outgoing.block.data) for outgoing in host.blocks()]
    assert min(sizes[:-1]) > BLOCK_OCTETS - 16


@pytest.mark.parametrize("step_us", [0, 1, 700, 20_000, 3_000_000])
def test_events_come_out_as_they_went_in(step_us):
    host = Host()
    host.start()
    events = steady(30_000 if step_us < 1000 else 200, start_us=5, step_us=step_us)
    host.camera.offer(events)
    host.camera.advance(int(events["t"][-1]) + 2000)
    seen, _ = host.collect()
    assert seen.tobytes() == events.tobytes()
    counters = host.camera.counters
    assert (counters.offered, counters.delivered, counters.queued) == (len(events), len(events), 0)


def test_time_is_zero_at_the_start_of_the_acquisition():
    host = Host()
    host.camera.advance(123_456_789_000)
    host.start()
    events = steady(100, start_us=123_456_789_010)
    host.camera.offer(events)
    host.camera.advance(123_456_799_010)
    assert host.collect()[0]["t"][0] == 10
    assert host.camera.epoch_us == 123_456_789_000


def test_blocks_begin_anew_so_that_a_lost_one_harms_only_itself():
    host = Host()
    host.start()
    host.camera.offer(steady(40_000))
    host.camera.advance(50_000)
    blocks = [outgoing.block for outgoing in host.blocks()]
    assert len(blocks) > 3
    assert max(len(block.data) for block in blocks) <= BLOCK_OCTETS
    for block in blocks:
        kinds = np.frombuffer(block.data[:8], "<u2") >> 12
        assert kinds[0] == 8
        assert kinds[kinds != 8][:2].tolist() == [6, 0]


def test_a_silence_is_told_by_blocks_of_time():
    host = Host()
    host.start()
    for second in range(1, 40):
        host.camera.advance(second * 1_000_000)
        assert len(host.collect()[0]) == 0
    host.camera.offer(steady(1, start_us=39_500_000))
    host.camera.advance(39_600_000)
    assert host.collect()[0]["t"].tolist() == [39_500_000]
    assert host.assembly.lost == 0


def test_a_silence_is_told_each_second_since_decoders_lose_the_time_after_eight():
    host = Host()
    host.start()
    for second in range(1, 10):
        host.camera.advance(second * 1_000_000)
        assert len(list(host.blocks())) == 1


@settings(max_examples=60, deadline=None)
@given(
    gaps=st.lists(st.integers(0, 30_000_000), min_size=1, max_size=40),
    turns=st.integers(1, 7),
    block_us=st.sampled_from([1, 1000, 100_000]),
)
def test_any_gaps_and_any_turns_give_the_same_events(gaps, turns, block_us):
    host = Host(block_us=block_us)
    host.start()
    events = steady(len(gaps))
    events["t"] = np.cumsum(gaps)
    seen = []
    for part in np.array_split(events, turns):
        host.camera.offer(part)
        seen.append(host.collect()[0])
    host.camera.advance(int(events["t"][-1]) + block_us)
    seen.append(host.collect()[0])
    assert np.concatenate(seen).tobytes() == events.tobytes()


def test_triggers_come_in_order_of_time():
    host = Host()
    host.start()
    edges = empty_edges(2)
    edges["t"], edges["kind"] = [50, 70], [EdgeKind.RISING, EdgeKind.FALLING]
    host.camera.offer_edges(edges)
    host.camera.offer(steady(100, step_us=1))
    host.camera.advance(5000)
    seen, told = host.collect()
    assert len(seen) == 100
    assert told[["t", "kind"]].tolist() == [(50, EdgeKind.RISING), (70, EdgeKind.FALLING)]
    assert host.camera.counters.edges.delivered == 2


def test_an_edge_that_comes_late_is_reported_with_the_time_that_its_words_have():
    host = Host()
    host.camera.advance(100)
    host.start()
    host.camera.offer(steady(50, start_us=110, step_us=10))
    host.camera.advance(5000)
    host.collect()
    edges = empty_edges(2)
    edges["t"], edges["kind"] = [400, 4000], EdgeKind.RISING
    host.camera.offer_edges(edges)
    host.camera.advance(9000)
    (outgoing,) = host.blocks()
    _, received = host.decoder.decode(outgoing.block.data)
    assert received["t"].tolist() == [500, 3900]
    assert outgoing.edges["t"].tolist() == [600, 4000]


def test_events_before_the_start_in_the_silence_and_after_the_stop_are_counted():
    host = Host(start_delay_us=1000)
    host.camera.offer(steady(10))
    host.camera.advance(100)
    host.start()
    host.camera.offer(steady(2000, start_us=100))
    host.camera.advance(2100)
    assert len(host.collect()[0]) == 1000
    host.camera.offer(steady(7, start_us=3000))
    host.write(ACQUISITION_STOP, 1)
    counters = host.camera.counters
    assert (counters.not_running, counters.delivered, counters.flushed) == (1010, 1000, 7)
    assert counters.accounted == counters.offered == 2017


def test_a_full_camera_drops_and_counts():
    host = Host(capacity=100)
    host.start()
    host.camera.offer(steady(150))
    assert (host.camera.room_events, host.camera.counters.dropped_fifo) == (0, 50)


def test_edges_that_wait_have_a_bound():
    host = Host()
    host.start()
    edges = empty_edges(70_000)
    edges["t"], edges["kind"] = np.arange(70_000), EdgeKind.RISING
    host.camera.offer_edges(edges)
    counts = host.camera.counters.edges
    assert (counts.queued, counts.dropped_fifo, counts.balanced) == (65_536, 4464, True)


def _write_range(host, registers, ranges):
    host.write(registers.on, 1)
    host.write(registers.count, len(ranges))
    for number, (offset, size) in enumerate(ranges):
        for address, value in ((registers.selector, number), (registers.offset, 0), (registers.size, size)):
            assert host.write(address, value) == 0
        assert host.write(registers.offset, offset) == 0


@pytest.mark.parametrize("inverted", [0, 1])
def test_ranges_of_rows_and_columns_select(inverted):
    host = Host()
    host.start()
    _write_range(host, ROWS, [(100, 50), (600, 120)])
    _write_range(host, COLUMNS, [(0, 640)])
    host.write(INVERTED, inverted)
    events = steady(20_000)
    host.camera.offer(events)
    host.camera.advance(30_000)
    rows = ((events["y"] >= 100) & (events["y"] < 150)) | (events["y"] >= 600)
    wanted = (rows & (events["x"] < 640)) != bool(inverted)
    assert host.collect()[0].tobytes() == events[wanted].tobytes()
    assert host.camera.counters.not_selected == np.count_nonzero(~wanted)


@pytest.mark.parametrize("pieces", [1, 2, 33])
def test_rate_control_lets_by_the_first_of_each_period(pieces):
    host = Host()
    host.start()
    for address, value in ((Erc.PERIOD_US, 100), (Erc.EVENTS, 30), (Erc.ON, 1)):
        assert host.write(address, value) == 0
    events = steady(1000)
    for part in np.array_split(events, pieces):
        host.camera.offer(part)
    host.camera.advance(3000)
    assert host.collect()[0].tobytes() == events[events["t"] % 100 < 30].tobytes()
    assert host.camera.counters.dropped_rate == 700


def test_packets_come_again_while_their_block_is_kept():
    host = Host()
    host.start()
    host.camera.offer(steady(5000))
    host.camera.advance(9000)
    block = next(host.blocks()).block
    host.camera.obey(Resend(block.number, 0, 3))
    again = [host.camera.next_extra() for _ in range(5)]
    assert [one.data[2:] for one in again[:4]] == [block.packet(k)[2:] for k in range(4)]
    assert {one.data[:2] for one in again[:4]} == {b"\x01\x00"}
    assert again[4] is None
    host.camera.obey(Resend(10_000, 0, 3))
    assert host.camera.next_extra().data[:2] == b"\x80\x12"


@pytest.mark.parametrize("flood", [Resend(1, 1, 1), Resend(9999, 1, 1)])
def test_a_flood_of_requests_to_send_again_has_a_bound_and_the_first_are_served(flood):
    host = Host()
    host.start()
    host.camera.offer(steady(5000))
    host.camera.advance(9000)
    block = next(host.blocks()).block
    host.camera.obey(Resend(block.number, 0, 3))
    for _ in range(6000):
        host.camera.obey(flood)
    again = []
    while (extra := host.camera.next_extra()) is not None:
        again.append(extra.data)
    assert [one[2:] for one in again[:4]] == [block.packet(k)[2:] for k in range(4)]
    assert len(again) == 4096


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


def test_a_request_to_send_again_is_for_the_machine_in_control():
    host = Host()
    host.start()
    asked = bytes(4) + (0).to_bytes(4, "big") + (1).to_bytes(4, "big") + (1).to_bytes(8, "big")
    assert host.send(Command.PACKETRESEND, asked, ("10.9.9.9", 5), flags=0x11)[0] == 0x8006
    assert host.send(Command.PACKETRESEND, asked, ("127.0.0.1", 5), flags=0x11)[0] == 0
    assert host.send(Command.PACKETRESEND, asked, ("127.0.0.1", 5), flags=0x10) is None


@settings(max_examples=40, deadline=None)
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
