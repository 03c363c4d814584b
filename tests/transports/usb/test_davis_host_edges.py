"""A driver of our own asks for edges, and gets those since the timestamp reset, each once."""

import numpy as np

from firmware_protocol.davis346 import Davis346, Davis346Settings
from firmware_protocol.events import EDGE, EdgeKind
from transports.link.pacing import FakeClock
from transports.usb.cameras import receive
from transports.usb.davis_host import DavisHost
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost


def edges(*times):
    made = np.zeros(len(times), EDGE)
    made["t"], made["kind"] = times, EdgeKind.RISING
    return made


def started(*, wants_edges):
    camera = Davis346(Davis346Settings(start_delay_us=0))
    host = DavisHost(DirectHost(camera))
    host.start(StreamSettings(edges=wants_edges))
    return camera, host


def read_all(host):
    while host.read(0.0) is not None:
        pass


def test_edges_are_taken_once():
    camera, host = started(wants_edges=True)
    camera.offer_edges(edges(10, 20))
    camera.advance(100)
    read_all(host)
    assert [(int(e["t"]), int(e["kind"])) for e in host.take_edges()] == [
        (10, EdgeKind.RISING), (11, EdgeKind.PULSE), (20, EdgeKind.RISING), (21, EdgeKind.PULSE),
    ]  # fmt: skip
    assert len(host.take_edges()) == 0
    camera.offer_edges(edges(200))
    camera.advance(300)
    assert len(host.stop()) == 0
    assert host.take_edges()["t"].tolist() == []


def test_who_does_not_ask_keeps_none():
    camera, host = started(wants_edges=False)
    camera.offer_edges(edges(10))
    camera.advance(100)
    read_all(host)
    assert len(host.take_edges()) == 0
    assert camera.counters.edges.ignored == 1


def test_a_receiver_counts_them():
    camera = Davis346(Davis346Settings(start_delay_us=0))
    host = DavisHost(DirectHost(camera))
    camera.offer_edges(edges(10))
    steps = iter([50, 100, 150])

    def goes_on(_):
        now = next(steps, None)
        camera.advance(now or 0)
        return now is not None

    assert receive(host, goes_on, FakeClock()).edges == 2
