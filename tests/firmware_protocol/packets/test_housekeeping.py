"""Housekeeping and time reports: golden octets, round trips, refusals."""

from dataclasses import astuple, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.housekeeping import (
    EdgeCounts,
    EventCounts,
    Housekeeping,
    LinkCounts,
    Mode,
    TimeReport,
    TimeStatus,
)

U16, U32, U64 = (st.integers(0, 2**bits - 1) for bits in (16, 32, 64))
REPORTS = st.builds(
    Housekeeping,
    t_us=U64,
    region=st.tuples(U16, U16, U16, U16),
    mode=st.sampled_from(Mode),
    time_status=st.sampled_from(TimeStatus),
    offered_hz=U32,
    sent_hz=U32,
    temperature_centi_c=st.integers(-(2**15), 2**15 - 1),
    tick_us=U16,
    rate_limit_hz=U32,
    events=st.builds(EventCounts, *[U64] * 10),
    edges=st.builds(EdgeCounts, *[U64] * 4),
    link=st.builds(LinkCounts, *[U16] * 4),
)

EXAMPLE = Housekeeping(
    t_us=0x0102030405,
    region=(1, 2, 346, 260),
    mode=Mode.STREAMING,
    time_status=TimeStatus.SYNCHRONISED,
    offered_hz=300_000,
    sent_hz=100_000,
    temperature_centi_c=-1250,
    tick_us=100,
    rate_limit_hz=100_000,
    events=EventCounts(*range(1, 11)),
    edges=EdgeCounts(11, 12, 13, 14),
    link=LinkCounts(15, 16, 17, 18),
)
HEAD = "01 01 02 00 00 00 00 01 02 03 04 05 00 04 93 e0 00 01 86 a0 fb 1e 00 64 00 01 00 02 01 5a 01 04 00 01 86 a0"


def test_golden_octets():
    octets = EXAMPLE.encode()
    assert octets[:36] == bytes.fromhex(HEAD)
    assert octets[36:148] == b"".join(n.to_bytes(8, "big") for n in range(1, 15))
    assert octets[148:] == b"".join(n.to_bytes(2, "big") for n in range(15, 19))
    assert len(octets) == 156


@given(REPORTS)
def test_reports_round_trip(report):
    assert Housekeeping.parse(report.encode()) == report


def test_link_counts_run_modulo_65536():
    report = replace(EXAMPLE, link=LinkCounts(65_537, 0, 0, 0))
    assert astuple(Housekeeping.parse(report.encode()).link) == (1, 0, 0, 0)


@pytest.mark.parametrize("wrong", [{"t_us": -1}, {"tick_us": 65_536}, {"temperature_centi_c": 40_000}])
def test_numbers_that_do_not_fit_are_refused(wrong):
    with pytest.raises(ValueError, match="housekeeping"):
        replace(EXAMPLE, **wrong).encode()


@pytest.mark.parametrize(("at", "value"), [(0, 2), (1, 2), (2, 4), (3, 1)])
def test_another_structure_mode_or_status_is_refused(at, value):
    octets = bytearray(EXAMPLE.encode())
    octets[at] = value
    with pytest.raises(PacketError, match="structure"):
        Housekeeping.parse(bytes(octets))


@given(st.binary(max_size=200))
def test_hostile_octets_are_refused(octets):
    with pytest.raises(PacketError):
        Housekeeping.parse(octets)


def test_time_reports():
    octets = TimeReport(1_500_000, TimeStatus.SET).encode()
    assert octets == bytes.fromhex("2f 00 00 00 01 80 00 00 01")
    assert TimeReport.parse(octets) == TimeReport(1_500_000, TimeStatus.SET)


@pytest.mark.parametrize(
    "octets", ["", "2f 00 00 00 01 80 00 00", "2f 00 00 00 01 80 00 00 04", "2e 00 00 00 01 80 00 00 01"]
)
def test_malformed_time_reports_are_refused(octets):
    with pytest.raises(PacketError):
        TimeReport.parse(bytes.fromhex(octets))
