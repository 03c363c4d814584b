"""Triggers on a port of their own, and LZ4, read by dv_processing.io.NetworkReader."""

import asyncio
import socket
import time
from contextlib import closing

import dv_processing as dv
import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.run.assembly import link_setups
from evstim.testing.link_contract import event_stream
from firmware_protocol.device.plain_device import PlainDevice
from tests.free_ports import free_port
from tests.transports.network_streams.stream_readers import DvReader
from tests.transports.opened_links import opened
from transports.link.deliveries import Deliveries
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING

pytestmark = pytest.mark.socket


def triggers_of(reader, count):
    """Return (us, type) of `count` triggers."""
    have, until = [], time.monotonic() + 120
    while len(have) < count:
        assert time.monotonic() < until, have
        batch = reader.getNextTriggerBatch()
        have += [(one.timestamp, one.type) for one in batch or ()]
        time.sleep(0.001)
    return have


RISING, FALLING = dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE, dv.TriggerType.EXTERNAL_SIGNAL_FALLING_EDGE


@pytest.mark.parametrize(("compression", "kind", "changes"), [
    ("none", "pulse", [(0, RISING), (200, FALLING)]),
    ("none", "rising", [(0, RISING)]),
    ("lz4", "falling", [(0, FALLING)]),
])  # fmt: skip
def test_triggers_come_on_their_own_port(compression, kind, changes):
    port, events = free_port(), event_stream(20_000)
    link = opened(
        f'kind = "tcp"\nport = 0\ntrigger_port = {port}\ncompression = "{compression}"',
        f'[trigger]\nperiod_ms = 0.5\npulse_us = 200\nkind = "{kind}"',
    )
    with closing(DvReader(link)) as reader:
        triggers = dv.io.NetworkReader("127.0.0.1", port)
        assert triggers.isTriggerStreamAvailable()
        assert not triggers.isEventStreamAvailable()
        assert triggers.getCameraName() == "DAVIS346"
        link.start(FREE_RUNNING)
        link.push_all(events, 60_000)
        np.testing.assert_array_equal(reader.read(len(events)), events)
        told = triggers_of(triggers, 119)
        report = link.stop(10.0)
    assert told[:119] == [(500 * k + after_us, change) for k in range(1, 120) for after_us, change in changes][:119]
    assert report.delivered == len(events)
    assert report.camera.edges.delivered == 120 * len(changes) - (kind == "pulse")  # the last one ends after the run
    assert report.counts["triggers: clients"] == 1


def test_without_a_client_for_them_triggers_are_ignored_and_events_go_on():
    link = opened(f'kind = "tcp"\nport = 0\ntrigger_port = {free_port()}', "[trigger]\nperiod_ms = 7.0")
    events = event_stream(20_000)
    with closing(DvReader(link)) as reader:
        link.start(FREE_RUNNING)
        link.push_all(events, 60_000)
        np.testing.assert_array_equal(reader.read(len(events)), events)
        report = link.stop(10.0)
    assert report.delivered == len(events)
    assert report.camera.edges.ignored >= 8
    assert report.camera.edges.delivered == 0


def test_the_camera_takes_edges_while_a_client_for_them_is_there():
    """It comes after 20 ms of device time and leaves after 40 ms; edges before and after are ignored, not lost."""
    port = free_port()
    link = opened(f'kind = "tcp"\nport = 0\ntrigger_port = {port}', "[trigger]\nperiod_ms = 1.0")
    parts = (event_stream(6000, start_us) for start_us in range(0, 20_000_000, 20_000))
    with closing(DvReader(link)):
        link.start(FREE_RUNNING)
        link.push_all(next(parts), 20_000)
        assert edges_when(link, lambda edges: edges.ignored >= 19).delivered == 0
        triggers = dv.io.NetworkReader("127.0.0.1", port)
        while not link.listen().counts.get("triggers: clients"):
            time.sleep(0.01)
        link.push_all(next(parts), 40_000)
        told = triggers_of(triggers, 38)
        rises = [t for t, _ in told[::2]]
        assert rises == list(range(rises[0], rises[0] + 1000 * len(rises), 1000))
        assert told == [change for t in rises for change in ((t, RISING), (t + 100, FALLING))][: len(told)]
        during = link.listen().camera.edges
        assert during.ignored * 1000 == rises[0] - 1000
        del triggers
        while link.listen().camera.edges.ignored == during.ignored:  # until the end of `parts`: 20 s of device time
            link.push_all(part := next(parts), int(part["t"][-1]) + 1)
            time.sleep(0.01)
        report = link.stop(10.0)
    assert report.camera.edges.delivered >= len(told)


def edges_when(link, told):
    """Return what the camera says of its edges once `told` holds for it."""
    until = time.monotonic() + 120
    while not (link.listen().camera and told(link.report.camera.edges)):
        assert time.monotonic() < until, link.report
        time.sleep(0.01)
    return link.report.camera.edges


@pytest.mark.long
def test_a_client_of_triggers_that_sleeps_does_not_hold_up_events():
    port, events = free_port(), event_stream(300_000)
    link = opened(f'kind = "tcp"\nport = 0\ntrigger_port = {port}', "[trigger]\nperiod_ms = 0.2")
    with socket.create_connection(("127.0.0.1", port)), closing(DvReader(link)) as reader:
        link.start(FREE_RUNNING)
        link.push_all(events, 900_000)
        np.testing.assert_array_equal(reader.read(len(events)), events)
        report = link.stop(10.0)
    assert report.delivered == len(events)


@pytest.mark.parametrize(("table", "message"), [
    ('format = "caer"\ncompression = "lz4"', 'compression is of the format "dv"'),
    ('format = "display"\ntrigger_port = 5', 'trigger_port is of the format "dv"'),
    ("trigger_port = 7777", "give it another one"),
    ("trigger_port = 70000", "trigger_port must be"),
    ("[links.pictures]\nlight_share = 0.5", 'pictures is of the formats "event_image" and "display"'),
    ('format = "display"\n[links.pictures]\noff_colour = [0, 0, 256]', "off_colour must be red, green, blue"),
    ('format = "event_image"\n[links.pictures]\nchannels = ["onn"]', "channels"),
])  # fmt: skip
def test_a_table_that_cannot_be_is_refused(table, message):
    with pytest.raises(RigError, match=message):
        opened(f'kind = "tcp"\n{table}')


def test_a_missing_lz4_is_told_when_the_link_opens(monkeypatch):
    monkeypatch.setattr("transports.network_streams.tcp.find_spec", lambda name: None)
    table = 'kind = "tcp"\ncompression = "lz4"\nport = 0\n'
    (setup,) = link_setups(parse_rig(f'[scene]\nkind = "checkerboard"\n[[links]]\n{table}', "a.toml", "a"))
    endpoint = setup.endpoint.build(PlainDevice(), Deliveries(setup.ring, MonotonicClock()))
    with pytest.raises(OSError, match=r"compression needs lz4: pip install '\.\[files\]'"):
        asyncio.run(endpoint.start())
