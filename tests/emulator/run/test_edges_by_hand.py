"""Edges and clock resets that a running session is asked for."""

import sys
from pathlib import Path

import pytest

from emulator.rig.loading import parse_rig
from emulator.run.control import FaultInjection
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.events import EdgeKind
from transports.link.feed import Feed, Timing
from transports.link.rings import EventRing

sys.path.insert(0, str(Path(__file__).parents[2] / "firmware_protocol"))
from davis_host import RUN, Host

RIG = """
[scene]
kind = "checkerboard"
[[links]]
kind = "loopback"
name = "a"
[[links]]
kind = "loopback"
name = "b"
"""


class Session:
    def __init__(self):
        self.happened = []

    def order(self, link, order):
        self.happened.append((link, order.kind))


def asked(**message):
    session = Session()
    desk = FaultInjection(parse_rig(RIG, "my.toml", "my"), session, None)
    return desk.answer({"request": "trigger", **message}, None), session.happened


def test_an_edge_comes_to_every_link_or_to_the_one_named():
    assert asked(kind="pulse") == ({"links": ["a", "b"]}, [("a", EdgeKind.PULSE), ("b", EdgeKind.PULSE)])
    assert asked(kind="falling", link="b") == ({"links": ["b"]}, [("b", EdgeKind.FALLING)])
    assert asked(kind="reset", link="a") == ({"links": ["a"]}, [("a", None)])


@pytest.mark.parametrize(
    ("message", "told"),
    [({"kind": "level"}, "known are pulse"), ({"kind": "pulse", "link": "c"}, "there is a, b"), ({}, "known requests")],
)
def test_what_is_wrong_is_said_and_nothing_happens(message, told):
    answer, happened = asked(**message)
    assert told in answer["error"]
    assert happened == []


@pytest.fixture
def fed():
    camera = Davis346(Davis346Settings(start_delay_us=0))
    host, ring = Host(camera), EventRing()
    host.write_all([*RUN, (4, 1, 1), (4, 2, 1), (4, 3, 0), (4, 0, 1)])
    feed = Feed(camera, ring, Timing())

    def go(until_us):
        ring.publish(until_us)
        feed.feed(until_us, 1 << 16)

    return feed, host, go


def test_an_edge_happens_where_device_time_is_and_is_not_late(fed):
    feed, host, go = fed
    go(5000)
    feed.happen(EdgeKind.RISING)
    go(9000)
    assert [(e["t"], e["kind"]) for e in host.decoded().edges] == [(5000, EdgeKind.RISING)]
    assert (feed.edge_report().taken, feed.edge_report().late) == (1, 0)


def test_a_reset_starts_device_time_anew(fed):
    feed, host, go = fed
    go(5000)
    feed.happen(None)
    go(6000)
    feed.happen(EdgeKind.FALLING)
    go(9000)
    decoded = host.decoded()
    assert len(decoded.resets) == 1
    assert decoded.edges["t"].tolist() == [1000]
