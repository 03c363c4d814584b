"""An instrument on a real pty with a real reader: what was sent is what came, whatever happens to the line."""

import asyncio
import socket
import threading
import time

import numpy as np
import pytest
from line_bench import ORIGIN_NS, PATIENCE_S, TICK_NS, Bench, stream

from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.telecommands import Ping, SetTick, Start, Stop
from transports.link.deliveries import digest_of
from transports.link.rings import FREE_RUNNING
from transports.recording.record import load_record

PROFILES = ["ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss", "fprime"]


@pytest.mark.parametrize("profile", PROFILES)
def test_every_event_that_is_sent_is_received(bench, profile, tmp_path):
    b = bench(profile=profile, record=tmp_path / "sent.npz")
    b.plug()
    b.ring.start(ORIGIN_NS)
    sent = stream(10_000)
    b.give(sent, 200_000)
    b.run(420)
    b.read_until(10_000)
    report = b.link.report()
    assert report.delivered == 10_000
    assert report.camera.accounted == 10_000
    assert report.digest == digest_of(b.events)
    assert np.array_equal(np.sort(b.events, order=["t", "y", "x"]), np.sort(sent, order=["t", "y", "x"]))
    assert b.receiver.faults == 0
    b.close()
    assert np.array_equal(load_record(tmp_path / "sent.npz")[0], b.events)


def test_a_run_that_is_not_paced_loses_nothing_on_a_narrow_line(bench):
    b = bench(baud=1_000_000)
    b.plug()
    b.ring.start(FREE_RUNNING)
    b.give(stream(30_000, every_us=10), 300_000)
    while not b.link.idle:
        b.run(1)
    b.read_until(30_000)
    assert b.link.report().delivered == 30_000
    assert b.link.report().use.share > 0.98


def test_a_narrow_line_sheds_and_says_what(bench):
    b = bench(baud=115_200, settings=InstrumentSettings(queue_ms=20, housekeeping_s=0))
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(50_000), 1_000_000)
    b.run(2200)
    report = b.link.report()
    b.read_until(report.delivered)
    c = report.camera
    assert c.dropped_late > 40_000
    assert c.accounted == c.offered == 50_000
    assert b.receiver.counts["events_dropped"] <= c.dropped_late
    assert report.use.share > 0.98
    assert report.latency.p99 < 200_000


def test_nobody_at_the_line_means_not_running(bench):
    b = bench()
    b.ring.start(ORIGIN_NS)
    b.give(stream(100), 2000)
    b.run(10, read=False)
    report = b.link.report()
    assert report.camera.not_running == report.dropped_in_device == 100
    assert report.state.startswith("waiting for a reader of /dev/pts")
    assert report.attach_command == f"evstim listen serial {report.address} --baud 3000000"
    b.plug()
    assert b.link.report().attach_command == ""


def test_readers_come_and_go_and_nothing_old_is_left(bench):
    b = bench(baud=115_200)
    b.ring.start(ORIGIN_NS)
    for _ in range(3):
        b.plug()
        now_us = b.link._device.now_us + 1
        b.give(stream(500, 2, now_us), now_us + 1000)
        b.run(4)
        b.port.close()
        b.run(2, read=False)
    c = b.link.report().camera
    assert c.accounted == c.offered == 1500
    assert c.queued == 0
    assert c.lost_on_link > 0
    assert c.flushed > 0
    assert b.receiver.counts.get("bad_blocks", 0) == 0


def test_a_reader_that_does_not_read_never_blocks_the_tick(bench):
    b = bench(settings=InstrumentSettings(queue_ms=20, housekeeping_s=0))
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(100_000, every_us=8), 800_000)
    b.run(1600, read=False)  # it would not come back
    report = b.link.report()
    assert report.counts["held_back"] > 0
    assert report.camera.dropped_late > 0
    b.run(100)
    b.read_until(b.link.report().delivered)
    assert b.link.report().camera.accounted == 100_000


def test_the_last_bytes_reach_a_reader_that_is_late(bench, monkeypatch):
    monkeypatch.setattr("transports.serial_line.endpoint._CLOSE_S", PATIENCE_S)
    b = bench()
    b.plug()
    b.ring.start(ORIGIN_NS)
    b.give(stream(3000), 60_000)
    b.run(140, read=False)
    assert b.link.report().delivered == 3000
    closing = threading.Thread(target=lambda: asyncio.run(b.link.close()))
    closing.start()
    b.read_until(3000)
    closing.join()
    b.port.close()
    b.closed = True


def test_telecommands_are_done_and_answered(bench):
    b = bench(settings=InstrumentSettings(autostart=False, housekeeping_s=0))
    b.plug()
    b.ring.start(ORIGIN_NS)
    assert b.tell(Ping())[:2] == ["Ping: acceptance good", "pong"]
    assert b.tell(SetTick(100)) == ["SetTick: acceptance good", "SetTick: completion good"]
    b.tell(Start())
    now_us = b.link._device.now_us + 1
    b.give(stream(10, 50, now_us), now_us + 1000)
    b.run(10)
    b.read_until(10)
    assert (b.events["t"] % 100 == 0).all()
    b.tell(Stop())
    assert not b.link._device.streaming
    assert b.link.report().counts["telecommands"] == 4


def test_noise_on_the_way_in_is_counted_and_does_no_harm(bench):
    b = bench()
    b.plug()
    b.port.write(np.random.default_rng(1).integers(0, 256, 5000, np.uint8).tobytes())
    b.port.write(b"\0")  # the frame behind noise would be lost with it
    b.run(20)
    assert b.tell(Ping())[:2] == ["Ping: acceptance good", "pong"]
    assert b.link.report().counts["damaged_frames"] > 0


@pytest.mark.socket
def test_a_port_that_vanishes_and_returns_is_reported_and_used_again():
    asyncio.run(_vanish_and_return())


async def _vanish_and_return():
    def accept():
        peer, _ = server.accept()
        peer.setblocking(False)
        return peer

    async def ticks(count):
        for _ in range(count):
            b.clock.advance(TICK_NS)
            b.link.tick()
            await asyncio.sleep(0)

    async def until(condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline
            await ticks(1)
            await asyncio.sleep(0.001)

    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    b = Bench(port=f"socket://127.0.0.1:{port}")
    await b.open()
    peer = accept()
    await ticks(1)
    b.ring.start(ORIGIN_NS)
    b.give(stream(1000, 2), 2000)
    await ticks(60)
    assert b.link.report().delivered == 1000
    server.close()
    peer.close()
    await until(lambda: "is gone" in b.link.report().state)
    b.give(stream(10, 2, 10_000_000), 10_000_100)
    b.clock.advance(11_000_000_000)
    await ticks(5)
    assert b.link.report().camera.not_running == 10
    server = socket.create_server(("127.0.0.1", port))
    await until(lambda: b.link.report().counts["reconnections"] == 1)
    peer = accept()
    await ticks(1)
    now_us = b.link._device.now_us + 1
    b.give(stream(100, 2, now_us), now_us + 1000)
    await until(lambda: b.link.report().delivered == 1100)
    await b.link.close()
    report = b.link.report(final=True)
    assert report.camera.accounted == 1110
    peer.close()
    server.close()
