"""A link's process that may not be kept waiting."""

import multiprocessing
import os
from functools import partial

import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from transports.link.endpoint import LinkFactory
from transports.link.loop import Stop, run_link
from transports.link.process import LinkSetup
from transports.link.report import LinkReport
from transports.link.rings import EventRing
from transports.usb.kind import LoopbackLink
from transports.usb.loopback import LoopbackEndpoint

LOOPBACK = LinkFactory(LoopbackEndpoint, LoopbackLink())


def reported(monkeypatch, priority, refuse=False):
    """Run a link that is told to stop at once; return what it asked the machine for, and its last report."""
    asked = []

    def ask(process, policy, parameters):
        asked.append((process, policy, parameters.sched_priority))
        if refuse:
            raise PermissionError(1, "no")

    monkeypatch.setattr(os, "sched_setscheduler", ask)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    ours, theirs = multiprocessing.Pipe()
    ours.send(Stop(0.0))
    camera = partial(Davis346, Davis346Settings())
    run_link(LinkSetup("a", EventRing(16), camera, LOOPBACK, fifo_priority=priority), theirs)
    while True:  # its changes come on the same connection
        report = ours.recv()
        if isinstance(report, LinkReport) and report.final:
            return asked, report


@pytest.mark.parametrize(("priority", "expected"), [(0, []), (50, [(0, os.SCHED_FIFO, 50)])])
def test_a_link_asks_for_its_priority_where_one_is_wanted(monkeypatch, priority, expected):
    asked, report = reported(monkeypatch, priority)
    assert asked == expected
    assert report.error is None


def test_a_refusal_says_what_to_do(monkeypatch):
    _, report = reported(monkeypatch, 50, refuse=True)
    assert "rtprio" in report.error
