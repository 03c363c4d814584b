"""The model of the wire, and the choice between two buses."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.canopen import BusSelector, SelectorSettings
from firmware_protocol.can_frames.frame import BitRates, Frame, frame_bits
from firmware_protocol.can_frames.socketcand import Wire

RATES = BitRates(1_000_000)
MS = 1_000_000


def lasts_ns(frame):
    return RATES.duration_ns(frame_bits(frame))


def test_the_lowest_identifier_goes_first_but_interrupts_nobody():
    wire = Wire(RATES)
    low, high, sync = Frame(0x1A2, bytes(8)), Frame(0x700, bytes(8)), Frame(0x080)
    wire.offer(0, high, 0)
    assert wire.advance(10_000) == []
    wire.offer(1, low, 10_000)
    wire.offer(2, sync, 20_000)
    carried = wire.advance(10 * MS)
    assert [c.frame for c in carried] == [high, sync, low]
    assert carried[1].begin_ns == carried[0].end_ns == lasts_ns(high)
    assert wire.busy_ns == sum(map(lasts_ns, (low, high, sync)))


def test_a_sync_waits_for_one_frame_at_most_on_a_full_bus():
    wire = Wire(RATES)
    events = Frame(0x1A2, bytes(8))
    for _ in range(1000):
        wire.offer(0, events, 0)
    waits = []
    for offered_ns in range(MS, 100 * MS, 777_777):
        wire.advance(offered_ns)
        wire.offer(1, Frame(0x080), offered_ns)
        waits += [c.begin_ns - offered_ns for c in wire.advance(offered_ns + 300_000) if c.node == 1]
    assert len(waits) == 128
    assert min(waits) >= 0
    assert max(waits) <= lasts_ns(events)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 0x7FF), st.integers(0, 300_000)), max_size=40))
def test_frames_of_a_node_keep_their_order_and_never_overlap(offers):
    wire = Wire(RATES)
    now_ns, carried, sent = 0, [], {}
    for node, identifier, wait_ns in offers:
        now_ns += wait_ns
        carried += wire.advance(now_ns)
        frame = Frame(identifier, bytes([len(sent.setdefault(node, []))]))
        sent[node].append(frame)
        wire.offer(node, frame, now_ns)
    carried += wire.advance(now_ns + 10**9)
    assert all(a.end_ns <= b.begin_ns for a, b in pairwise(carried))
    assert {node: [c.frame for c in carried if c.node == node] for node in sent} == sent


def test_who_leaves_sends_no_more():
    wire = Wire(RATES)
    wire.offer(0, Frame(1), 0)
    wire.offer(0, Frame(2), 0)
    wire.advance(1)
    wire.forget(0)
    assert wire.waiting(0) == 0
    assert [c.frame.identifier for c in wire.advance(MS)] == [1]


def test_a_silent_master_is_looked_for_on_the_other_bus():
    selector = BusSelector(SelectorSettings(heartbeat_ms=100, toggle_ms=50, toggles=3), 0)
    assert not selector.poll(99 * MS)
    selector.heartbeat(0, 99 * MS)
    assert not selector.poll(198 * MS)
    assert selector.poll(199 * MS)
    assert selector.active == 1
    selector.heartbeat(1, 200 * MS)
    assert not selector.poll(299 * MS)
    assert selector.turns == 1


def test_after_turns_in_vain_it_rests_on_the_default_bus():
    selector = BusSelector(SelectorSettings(default=1, heartbeat_ms=100, toggle_ms=50, toggles=3), 0)
    active = []
    for ms in range(0, 1000, 10):
        selector.poll(ms * MS)
        active.append(selector.active)
    assert [a for a, b in zip(active, [None, *active], strict=False) if a != b] == [1, 0, 1, 0, 1]
    assert selector._deadline_ns is None
    selector.heartbeat(0, 1000 * MS)
    assert selector._deadline_ns is None
    selector.heartbeat(1, 1000 * MS)
    assert selector._deadline_ns is not None
    assert selector.poll(1100 * MS)
