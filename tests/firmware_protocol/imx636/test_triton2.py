"""Events into a camera, blocks out: exact, each with one fate."""

import faery
import numpy as np
import pytest
from evt3_streams import by_evt3
from gige_host import Host, steady
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.evt.words import evt3_header
from firmware_protocol.gige.gvcp import Command, Resend
from firmware_protocol.gige.gvsp import BLOCK_OCTETS
from firmware_protocol.imx636.triton2 import with_reserved_words
from firmware_protocol.imx636.triton2_registers import ACQUISITION_STOP, COLUMNS, INVERTED, ROWS, Erc


def test_blocks_of_a_busy_stream_are_full():
    host = Host()
    host.start()
    host.camera.offer(steady(60_000))
    sizes = [len(outgoing.block.data) for outgoing in host.blocks()]
    assert min(sizes[:-1]) > BLOCK_OCTETS - 24  # a turn of the loop, and the padding of eight octets


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
        assert kinds[kinds != 8][:2].tolist() == [14, 6]


def test_a_block_has_the_reserved_words_of_the_real_camera():
    """A capture begins with 8E 8A FF E0: a time high, then "other" of subtype 0x0FF. Padding fills eight octets."""
    words = bytes.fromhex("8e8a 0160 0500 0428")
    assert with_reserved_words(words) == bytes.fromhex("8e8a ffe0 0160 0500 0428 9999 9999 9999")
    assert with_reserved_words(words[:6]) == bytes.fromhex("8e8a ffe0 0160 0500")


def by_faery(data, folder):
    path = folder / "a.raw"
    path.write_bytes(evt3_header((1280, 720)) + data)
    return np.concatenate(list(faery.events_stream_from_file(path)))


@pytest.mark.parametrize("reserved", [True, False])
def test_readers_skip_the_reserved_words(reserved, tmp_path):
    host = Host(reserved_words=reserved, block_us=1)
    host.start()
    data = []
    for part in np.array_split(steady(100_000), 60):
        host.camera.offer(part)
        data += [outgoing.block.data for outgoing in host.blocks()]
    words, events = np.frombuffer(b"".join(data), "<u2"), steady(100_000)
    assert [int((words == word).sum()) > 20 for word in (0xE0FF, 0x9999)] == [reserved, reserved]
    assert not reserved or all(len(block) % 8 == 0 for block in data)
    for seen in (Evt3Decoder().decode(b"".join(data))[0], by_evt3(b"".join(data)), by_faery(b"".join(data), tmp_path)):
        assert all((seen[name] == events[name]).all() for name in events.dtype.names)


def test_a_silence_is_told_each_second_since_decoders_lose_the_time_after_eight():
    host = Host()
    host.start()
    for second in range(1, 10):
        host.camera.advance(second * 1_000_000)
        assert len(list(host.blocks())) == 1


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
    edges = make_edges([50, 70], [EdgeKind.RISING, EdgeKind.FALLING])
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
    edges = make_edges([400, 4000], EdgeKind.RISING)
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
    edges = make_edges(np.arange(70_000), EdgeKind.RISING)
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


def test_a_request_to_send_again_is_for_the_machine_in_control():
    host = Host()
    host.start()
    asked = bytes(4) + (0).to_bytes(4, "big") + (1).to_bytes(4, "big") + (1).to_bytes(8, "big")
    assert host.send(Command.PACKETRESEND, asked, ("10.9.9.9", 5), flags=0x11)[0] == 0x8006
    assert host.send(Command.PACKETRESEND, asked, ("127.0.0.1", 5), flags=0x11)[0] == 0
    assert host.send(Command.PACKETRESEND, asked, ("127.0.0.1", 5), flags=0x10) is None
