"""The contract of links over GigE Vision, read by our own host."""

import numpy as np
import pytest

from emulator.rig.tables import Camera
from evstim.testing.link_contract import LinkContract
from transports.gige.host import GigeHost
from transports.gige.kind import GigeLink
from transports.link.pacing import MonotonicClock

pytestmark = [pytest.mark.system, pytest.mark.socket]

_MOST_SILENCES = 60  # reads of a second without an event


class StreamReader:
    """Reads so many events and leaves."""

    def __init__(self, address):
        host, _, port = address.rpartition(":")
        self._host = GigeHost(host, int(port), now_ns=MonotonicClock().now_ns)
        self._host.start()
        self._held = []

    def read(self, count):
        silences = 0
        while sum(map(len, self._held)) < count:
            self._held.append(self._host.read(1.0))
            silences = 0 if len(self._held[-1]) else silences + 1
            assert silences < _MOST_SILENCES, f"{sum(map(len, self._held))} of {count} events have come, then none"
        events = np.concatenate(self._held)
        self._held = [events[count:]]
        return events[:count]

    def close(self):
        self._host.close()


class TestGige(LinkContract):
    parameters = GigeLink(port=0, mbit_s=100.0)
    camera = Camera(model="triton2", start_delay_ms=0.0)
    many, some = 20_000, 5000

    def reader(self, link):
        return StreamReader(link.report.address)
