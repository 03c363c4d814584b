"""The contract of links over GigE Vision, read by our own host."""

import numpy as np
import pytest

from evstim.testing.link_contract import LinkContract
from transports.gige.host import GigeHost
from transports.gige.kind import GigeLink
from transports.link.pacing import MonotonicClock

pytestmark = [pytest.mark.system, pytest.mark.socket]


class StreamReader:
    """Reads so many events and leaves."""

    def __init__(self, address):
        host, _, port = address.rpartition(":")
        self._host = GigeHost(host, int(port), now_ns=MonotonicClock().now_ns)
        self._host.start()
        self._held = []

    def read(self, count):
        while sum(map(len, self._held)) < count:
            self._held.append(self._host.read(1.0))
        events = np.concatenate(self._held)
        self._held = [events[count:]]
        return events[:count]

    def close(self):
        self._host.close()


class TestGige(LinkContract):
    parameters = GigeLink(port=0, mbit_s=100.0)
    many, some = 20_000, 5000

    def reader(self, link):
        return StreamReader(link.report.address)
