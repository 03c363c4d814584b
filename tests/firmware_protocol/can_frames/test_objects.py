"""CANopen's objects, the table of identifiers, and the DBC file, checked with cantools."""

from contextlib import suppress

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.canopen import (
    EMCY_OVERRUN,
    SYNC_LAST,
    Emergency,
    NmtCommand,
    NmtOrder,
    NodeState,
    ObjectError,
    TimeOfDay,
    next_sync,
    parse_heartbeat,
    parse_scet,
    parse_sync,
    scet,
)
from firmware_protocol.can_frames.dbc import Identifiers, dbc_text
from firmware_protocol.can_frames.frame import FollowUp
from firmware_protocol.can_frames.raw_events import (
    Epoch,
    pack_clock,
    pack_events,
    pack_fd_events,
    pack_marks,
    unpack_mark,
)
from firmware_protocol.events import EDGE, EVENT


def database(**more):
    return cantools.database.load_string(dbc_text(Identifiers(), **more), "dbc")


def test_golden_objects():
    assert bytes(NmtOrder(NmtCommand.START, 0x22)) == b"\x01\x22"
    assert bytes(TimeOfDay(ms=1, days=2)) == b"\x01\0\0\0\x02\0"
    assert bytes(Emergency(EMCY_OVERRUN, 258)) == b"\x10\x81\x11\x02\x01\0\0\0"
    assert bytes(Emergency(0)) == bytes(8)
    assert scet(1_500_000) == b"\0\0\0\x01\x80\0\0"
    assert [next_sync(1), next_sync(SYNC_LAST)] == [2, 1]
    assert [parse_sync(b""), parse_sync(b"\xf0")] == [None, 240]
    assert parse_heartbeat(b"\x7f") is NodeState.PRE_OPERATIONAL


@given(st.integers(0, (1 << 32) * 1_000_000 - 1))
def test_spacecraft_time_comes_back_to_the_microsecond(t_us):
    assert parse_scet(scet(t_us)) == t_us


@given(st.integers(0, 65535 * 86_400_000_000))
def test_time_of_day_comes_back_to_the_millisecond(t_us):
    days, ms = divmod(t_us // 1000, 86_400_000)
    assert TimeOfDay.parse(bytes(TimeOfDay(ms, days))).us == t_us // 1000 * 1000


@given(
    st.binary(max_size=9), st.sampled_from([NmtOrder.parse, parse_sync, parse_heartbeat, TimeOfDay.parse, parse_scet])
)
def test_foreign_bytes_are_read_or_refused(data, parse):
    with suppress(ObjectError):
        assert parse(data) is not data


def test_marks():
    edges = np.array([((1 << 33) + 5, 2, 0, 7)], EDGE)
    (data,) = pack_marks(edges)
    assert data == b"\x05\0\0\0\x02\0\x07\0"
    assert np.array_equal(unpack_mark(data, 1 << 33), edges)
    with pytest.raises(ObjectError):
        unpack_mark(data[:7], 0)


def test_clashing_identifiers_are_refused_by_both_names():
    with pytest.raises(ValueError, match=r"epoch and events have the same identifier 0x1a2"):
        Identifiers(epoch=0x1A2)
    with pytest.raises(ValueError, match="11 bits"):
        Identifiers(sync=0x800)
    assert Identifiers.of_node(0x22) == Identifiers()
    with pytest.raises(ValueError, match="node"):
        Identifiers.of_node(0)


def test_the_dbc_decodes_what_we_send():
    db = database()
    events = np.array([(0x12345, 345, 259, True), (0x12345 + 100, 1, 2, False)], EVENT)
    (data,), _ = pack_events(events, 1, 5)
    assert db.decode_message("events", data) == {
        **{"t": 0x2345, "seq": 5, "dt": 100},
        **{"x0": 345, "y0": 259, "on0": 1, "x1": 1, "y1": 2, "on1": 0},
    }
    assert db.decode_message("epoch", bytes(Epoch(77, 100, 3, 4))) == {
        "t": 77,
        "tick": "100 us",
        "sent": 3,
        "dropped": 4,
    }
    assert db.decode_message("scet", scet(3_500_000), scaling=True) == {"seconds": 3, "fraction": 0.5}
    assert db.decode_message("time", bytes(TimeOfDay(9, 8))) == {"ms": 9, "days": 8}
    assert db.decode_message("emcy", bytes(Emergency(EMCY_OVERRUN, 9)))["dropped"] == 9
    assert db.decode_message("nmt", bytes(NmtOrder(NmtCommand.STOP, 5))) == {"command": "stop", "node": 5}
    assert db.decode_message("heartbeat", b"\x05") == {"state": "operational"}
    (mark,) = pack_marks(np.array([(5, 2, 0, 7)], EDGE))
    assert db.decode_message("marks", mark) == {"t": 5, "kind": 2, "channel": 0, "seq": 7}


def test_the_dbc_decodes_a_follow_up():
    assert database().decode_message("follow_up", bytes(FollowUp(7, 1 << 40))) == {"counter": 7, "sent": 1 << 40}


def test_the_dbc_names_every_identifier():
    assert {m.name: m.frame_id for m in database().messages} == Identifiers().by_name


@pytest.mark.parametrize(("transport", "absent"), [("isotp", 4), ("cfp", 6)])
def test_the_dbc_of_blocks_has_no_raw_frames(transport, absent):
    db = database(transport=transport)
    names = {message.name for message in db.messages}
    assert not names & {"events", "epoch", "clock", "edges"}
    assert ("telemetry" in names) == (transport == "isotp")
    assert len(names) == len(Identifiers().by_name) - absent
    assert ("CFP 2" in dbc_text(Identifiers(), transport=transport)) == (transport == "cfp")


def test_the_dbc_of_isotp_in_fd_frames():
    db = database(fd=True, transport="isotp")
    for name in ("telemetry", "telecommand"):
        message = db.get_message_by_name(name)
        assert (message.length, message.is_fd) == (64, True)
    assert not db.get_message_by_name("heartbeat").is_fd


def test_the_dbc_decodes_a_clock_frame():
    assert database().decode_message("clock", pack_clock(1 << 50)) == {"t": 1 << 50}


def test_the_dbc_of_fd_frames():
    db = database(fd=True)
    events = np.array([(10 + i, i, 2 * i, True) for i in range(19)], EVENT)
    ((data, n),) = pack_fd_events(events, 1, 3, dropped=4)
    decoded = db.decode_message("events", data)
    assert db.get_message_by_name("events").is_fd
    assert n == 19
    assert {k: decoded[k] for k in ("t", "seq", "n", "dropped", "x18", "y18", "dt18")} == {
        **{"t": 10, "seq": 3, "n": 19, "dropped": 4},
        **{"x18": 18, "y18": 36, "dt18": 1},
    }
