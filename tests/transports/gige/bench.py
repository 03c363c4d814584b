"""A GigE Vision camera on its sockets, on a clock that the test moves, and a host beside it."""

import asyncio
from functools import partial

import numpy as np

from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2 import Triton2
from firmware_protocol.imx636.triton2_registers import Triton2Settings
from tests.made_events import steady
from transports.faults.script import FaultPlan
from transports.gige.endpoint import GigeEndpoint
from transports.gige.host import GigeHost
from transports.gige.kind import GigeLink
from transports.link.endpoint import LinkFactory
from transports.link.kind import Wiring
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing

TICK_NS = 500_000
GAP_US = 10


class Bench:
    """A link on a clock that the test moves, and a host that shares the test's thread with it."""

    def __init__(self, faults=(), **more):
        self.clock = FakeClock(1_000_000_000)
        self.ring = EventRing(200_000)
        wiring = Wiring(FaultPlan("gige", scripted=tuple(faults), seed=1))
        factory = LinkFactory(GigeEndpoint, GigeLink(**{"port": 0, **more}), wiring)
        camera = partial(Triton2, Triton2Settings(start_delay_us=0))
        self.link = Link(LinkSetup("gige", self.ring, camera, factory), self.clock)
        self.loop = asyncio.new_event_loop()
        self.loop.run_until_complete(self.link.endpoint.start())
        self.host, port = self.link.endpoint.report().address.split(":")
        self.port = int(port)
        self.events = []

    def connect(self):
        """Take the camera."""
        return _PunctualHost(self.host, self.port, now_ns=self.clock.now_ns)

    def run(self, events, host=None, turns=400):
        """Play events, and let the host read as they come."""
        self.ring.start(FREE_RUNNING)
        for part in np.array_split(events, 50):
            self.ring.push(part)
            self.ring.publish(int(part["t"][-1]))
            self.turn(host)
        self.ring.publish(int(events["t"][-1]) + 5000)
        for _ in range(turns):
            self.turn(host)

    def turn(self, host=None):
        self.clock.advance(TICK_NS)
        self.link.tick()
        if host is not None:
            self.events.append(host.read(0.001))

    def close(self):
        self.loop.run_until_complete(self.link.close())
        self.loop.close()
        return self.link.report(final=True)


class _PunctualHost(GigeHost):
    """A host whose requests have all reached the link when it has read: its clock is faster than the machine's."""

    def read(self, timeout_s):
        events = super().read(timeout_s)
        self.read_register(Register.PRIVILEGE)
        return events


class Refusing:
    """A socket that has no room for every third datagram, or run of datagrams, when it comes for the first time."""

    def __init__(self):
        self.refusals = self._calls = 0

    def take_the_place_of(self, stream):
        self._socket, stream._socket = stream._socket, self

    def __getattr__(self, name):
        return getattr(self._socket, name)

    def sendto(self, data, to):
        self._refuse()
        return self._socket.sendto(data, to)

    def sendmsg(self, *how):
        self._refuse()
        return self._socket.sendmsg(*how)

    def _refuse(self):
        self._calls += 1
        if self._calls % 3 == 0:
            self.refusals += 1
            raise BlockingIOError


def stream(count):
    return steady(count, 1, GAP_US, size=(1280, 720))
