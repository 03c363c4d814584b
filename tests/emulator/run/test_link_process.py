"""The session's end of a link: hosts come and go while its process runs. The contract of links: tests/evstim."""

import os
from functools import partial

import numpy as np
import pytest

from emulator.run.link_process import LinkProcess
from evstim.testing.link_contract import event_stream
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from transports.link.pacing import LINK_NICE, MonotonicClock
from transports.link.process import LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.usb.davis_host import DavisHost
from transports.usb.kind import UsbipLink
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.endpoint import UsbipFactory


def attached(link):
    host, _, port = link.report.address.rpartition(":")
    camera = DavisHost(UsbipHost.attach(host, int(port), "1-1", timeout_s=60.0))
    camera.start()
    return camera


def read(camera, count):
    batches, have = [], 0
    while have < count:
        batches.append(camera.read(60.0))
        have += len(batches[-1])
    return np.concatenate(batches)


@pytest.mark.socket
def test_hosts_come_and_go():
    camera = partial(Davis346, Davis346Settings(start_delay_us=0))
    setup = LinkSetup("usbip", EventRing(), camera, UsbipFactory(UsbipLink(port=0)))
    link = LinkProcess(setup, MonotonicClock())
    link.wait_ready()
    link.start(FREE_RUNNING)
    now_us = 0
    for _ in range(3):
        host = attached(link)
        events = event_stream(2000, now_us)
        now_us += 6000
        link.push_all(events, now_us)
        received = read(host, len(events))
        assert np.array_equal(received["x"], events["x"])
        assert np.array_equal(np.diff(received["t"]), np.diff(events["t"]))
        host.close()
    report = link.stop(1.0)
    assert report.delivered == 6000
    assert report.dropped == report.dropped_in_device == 0


@pytest.mark.socket
def test_a_link_runs_in_a_session_of_its_own_and_before_the_session_that_feeds_it():
    setup = LinkSetup("usbip", EventRing(), partial(Davis346, Davis346Settings()), UsbipFactory(UsbipLink(port=0)))
    link = LinkProcess(setup, MonotonicClock())
    try:
        link.wait_ready()
        assert os.getsid(link.pid) == link.pid
        if os.geteuid() == 0:
            assert os.getpriority(os.PRIO_PROCESS, link.pid) == LINK_NICE
    finally:
        link.stop(0.0)
