"""A serial line with faults, end to end on a pty: what is lost is known, and nothing else is lost."""

import asyncio
import json
import time
from contextlib import suppress

import numpy as np
import pytest
import serial
from line_bench import ORIGIN_NS, PATIENCE_S, Bench, stream

from firmware_protocol.instrument.settings import InstrumentSettings
from transports.faults.line import (
    BitFlips,
    Burst,
    InsertedBytes,
    LostBytes,
    Overrun,
    Stall,
    StuckLine,
    Unplugged,
    WrongBaud,
)
from transports.faults.script import FaultPlan
from transports.link.deliveries import digest_of
from transports.recording.record import load_record

PROFILES = ["ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss", "fprime"]
COUNT = 8_000
KINDS = [
    BitFlips(at_s=0.05, for_s=0.1, rate=1e-5, count=0),
    InsertedBytes(at_s=0.05, rate=1e-3, count=3),
    LostBytes(at_s=0.05, rate=1e-3, count=3),
    Burst(at_s=0.05, length=300),
    Overrun(at_s=0.05, late_us=2000, rate=1e-3, count=2),
    StuckLine(at_s=0.05, for_s=0.02),
    StuckLine(at_s=0.05, for_s=0.02, level="high"),
    WrongBaud(at_s=0.05, for_s=0.01, ratio=1.9),
    WrongBaud(at_s=0.05, for_s=0.01, ratio=0.7),
]


def damaged(bench, faults, count=COUNT, **settings):
    """Run events over a line with these faults; return the bench and the final report."""
    b = bench(faults=FaultPlan("serial", tuple(faults), 1, settings.pop("log", None)), **settings)
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(count), count * 20)
    b.run(count * 20 // 500 + 60)
    b.read_until(b.link.report().delivered)
    return b, b.link.report()


def assert_known(b, report, sent=COUNT):
    """Every event has one fate, and what came is what the link says came, bit by bit."""
    lost = sum(fault.events_lost for fault in report.faults)
    assert len(b.events) == report.delivered == sent - lost
    assert digest_of(b.events) == report.digest
    assert report.dropped == lost
    assert report.camera.delivered == sent
    assert report.counts["false_messages"] == 0


@pytest.mark.parametrize("fault", KINDS, ids=lambda fault: f"{fault.kind}-{fault.for_s}")
def test_what_a_fault_destroyed_is_known_to_the_event(bench, fault):
    b, report = damaged(bench, [fault])
    assert_known(b, report)
    (did,) = report.faults
    assert did.hits > 0
    assert did.touched > 0
    assert did.events_lost > 0
    assert did.began_us == pytest.approx(50_000, abs=500)
    assert did.ended_us is not None
    assert b.receiver.faults > 0


@pytest.mark.parametrize("fault", [BitFlips, LostBytes])
def test_one_bad_bit_or_lost_byte_costs_at_most_two_messages(bench, fault):
    """On a line as in the decoders, which tests/firmware_protocol/test_link_damage.py damages for every profile."""
    faults = [fault(at_s=0.01 * n + 0.0137, rate=0.003) for n in range(18)]
    b, report = damaged(bench, faults)
    assert_known(b, report)
    assert all(each.hits == 1 for each in report.faults)
    assert 0 < b.receiver.counts["messages_missing"] <= 2 * len(faults)
    assert sum(each.events_lost for each in report.faults) > 0


@pytest.mark.sampled
@pytest.mark.parametrize("profile", PROFILES)
def test_faults_that_begin_and_end_within_messages_are_known_too(bench, profile):
    """On a line so slow that a message takes many ticks."""
    faults = [
        BitFlips(at_s=0.02 + 0.0107 * n, rate=0.002 * (1 + n % 3), count=1)
        if n % 2
        else StuckLine(at_s=0.01 * n + 0.02, for_s=0.0006)
        for n in range(30)
    ]
    b = bench(faults=FaultPlan("serial", tuple(faults), 1), profile=profile, baud=500_000)
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(4000, every_us=100), 400_000)
    b.run(1000)
    b.read_until(b.link.report().delivered)
    report = b.link.report()
    assert_known(b, report, 4000)
    assert sum(each.events_lost for each in report.faults) > 100


def test_a_stall_loses_nothing_that_the_camera_does_not_declare(bench):
    settings = InstrumentSettings(housekeeping_s=0, queue_ms=20, when_full="drop_oldest")
    b, report = damaged(bench, [Stall(at_s=0.05, for_s=0.06)], settings=settings)
    dropped = report.camera.dropped_in_device
    assert dropped > 0
    assert report.delivered + dropped == COUNT
    assert b.receiver.counts["events_dropped"] == dropped
    assert b.receiver.faults == 0
    assert report.counts["held_back"] > 0


@pytest.mark.parametrize("profile", PROFILES)
def test_all_at_once_still_balances(bench, profile):
    b, report = damaged(bench, [*KINDS, Stall(at_s=0.06, for_s=0.01)], profile=profile)
    assert_known(b, report)
    assert len(report.faults) == len(KINDS) + 1


def test_the_same_seed_damages_the_same_bytes(bench, tmp_path):
    fault = BitFlips(at_s=0.02, for_s=0.1, rate=1e-5, count=0)
    logs = [tmp_path / "a.jsonl", tmp_path / "b.jsonl"]
    for log in logs:
        damaged(bench, [fault], log=log)[0].close()
    first, second = (log.read_text() for log in logs)
    assert first == second
    assert '"struck"' in first


def test_the_log_tells_what_was_done_and_when(bench, tmp_path):
    log = tmp_path / "faults.jsonl"
    b, report = damaged(bench, [LostBytes(at_s=0.05)], log=log, record=tmp_path / "sent.npz")
    b.close()
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["what"] for line in lines] == ["began", "struck", "ended", "lost"]
    assert all((line["link"], line["fault"], line["kind"]) == ("serial", 1, "lost_bytes") for line in lines)
    assert [line["t_us"] for line in lines] == sorted(line["t_us"] for line in lines)
    assert lines[3]["events"] == report.faults[0].events_lost
    assert np.array_equal(load_record(tmp_path / "sent.npz")[0], b.events)


async def test_a_port_that_is_pulled_out_comes_back(tmp_path):
    b = Bench(faults=FaultPlan("serial", (Unplugged(at_s=0.05, for_s=0.1),)), symlink=str(tmp_path / "camera"))

    def read_on(deadline):
        while time.monotonic() < deadline:
            b.port.read(1)

    async def until(condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline
            with suppress(serial.SerialException):  # its port is gone
                b.run(1)
            await asyncio.sleep(0.0005)

    await b.open()
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(100_000), 2_000_000)
    b.run(95)
    assert b.link.endpoint.state.startswith("3000000 baud")
    await until(lambda: "is gone" in b.link.endpoint.state)
    first = len(b.events)
    assert 2000 < first == b.link.report().delivered
    with pytest.raises(serial.SerialException):  # after what the kernel still holds
        read_on(time.monotonic() + PATIENCE_S)
    await until(lambda: b.link.report().counts["reconnections"] == 1)
    assert b.link.report().faults[0].ended_us == pytest.approx(150_000, abs=1000)
    b.port.close()
    b.plug()
    b.run(100)
    b.read_until(b.link.report().delivered)
    assert len(b.events) > first
    assert digest_of(b.events) == b.link.report().digest
    b.port.close()
    await b.link.close()


def test_a_reader_that_leaves_takes_what_is_under_way_with_it(bench):
    b = bench(faults=FaultPlan("serial", (StuckLine(at_s=0.0, for_s=10.0),)))
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(1000), 20_000)
    b.run(60)
    b.port.close()
    b.port = None
    b.run(1, read=False)
    assert b.link.report().faults[0].events_lost > 0
    asyncio.run(b.link.close())
    b.closed = True
    report = b.link.report(final=True)
    assert report.delivered == 0
    assert report.dropped + report.dropped_in_device == 1000
    assert report.faults[0].events_lost > 0
