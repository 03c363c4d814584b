"""The contract of links as tests: every event has one fate, arrives in order and at its time, and processes may die.

A link runs in its own process, fed as a run feeds it, with the author's reader at its far end. Subclass and let pytest
collect the class:

    class TestBeacon(LinkContract):
        parameters = BeaconLink(port=0)

        def reader(self, link):
            return BeaconReader(link.report.address)
"""

from __future__ import annotations

import dataclasses
import os
import pickle
import signal
from collections.abc import Iterator
from contextlib import closing
from typing import ClassVar, Protocol

import numpy as np
import pytest

from emulator.rig.kinds import LINKS, SCENES, faults_of
from emulator.rig.loading import Rig
from emulator.rig.tables import Camera
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkProcess
from firmware_protocol.events import Events, make_events
from transports.link.deliveries import digest_of
from transports.link.kind import LinkParameters
from transports.link.loop import InjectFault
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING, EventRing

_RING_EVENTS = 20_000
_LEAD_NS = 200_000_000  # a busy machine runs the link that much later than the command of the reader was sent
_SPACING_US = 3


class Reader(Protocol):
    """The program at a link's far end; it must be there, and be noticed by the link, when it has been made."""

    def read(self, count: int) -> Events | None:
        """Return the next `count` events in device time; None where the link reads itself."""
        ...

    def close(self) -> None:
        """Go away."""


class NoReader:
    """The reader of a link that reads itself."""

    def read(self, count: int) -> None:
        """Return None: the link reads itself."""

    def close(self) -> None:
        """Do nothing: there is no reader to go away."""


def event_stream(count: int, start_us: int = 0, size: tuple[int, int] = (346, 260)) -> Events:
    """Return (count,) EVENT, 3 us apart from `start_us`, at random places of a sensor of `size` = (width, height)."""
    rng = np.random.default_rng(start_us)
    x = rng.integers(0, size[0], count)
    y = rng.integers(0, size[1], count)
    return make_events(start_us + np.arange(count) * _SPACING_US, x, y, rng.integers(0, 2, count))


class LinkContract:
    """Behaviour that every link has.

    Attributes
    ----------
    parameters : the link's table in a rig, on any free port. Its queue must hold the events of a slow reader.
    camera : the rig's camera; of a larger one, 346 x 260 pixels are used.
    many, some : events sent as fast as the link takes them, and at their own time. Fewer suit a slow link.
    """

    parameters: LinkParameters
    camera: ClassVar[Camera] = Camera(start_delay_ms=0.0)
    many = 100_000
    some = 10_000

    def reader(self, link: LinkProcess) -> Reader:
        """Return a reader that is connected to `link`, which is open."""
        raise NotImplementedError("a contract of a link needs the program that reads it")

    @pytest.fixture
    def link(self) -> Iterator[LinkProcess]:
        """Yield the link, open in its own process."""
        rig = Rig(
            "contract",
            "The contract of a link.",
            SCENES["checkerboard"].parameters(),
            self.camera,
            links=(self.parameters,),
        )
        (setup,) = link_setups(rig)
        link = LinkProcess(dataclasses.replace(setup, ring=EventRing(_RING_EVENTS)), MonotonicClock())
        link.wait_ready()
        yield link
        link.stop(0.0)

    @pytest.fixture
    def connected(self, link: LinkProcess) -> Iterator[Reader]:
        """Yield a reader of the link."""
        with closing(self.reader(link)) as reader:
            yield reader

    def _stream(self, count: int) -> Events:
        width, height = self.camera.size
        return event_stream(count, size=(min(width, 346), min(height, 260)))

    def test_its_kind_is_registered(self) -> None:
        """A rig can name the link, and its table can go to another process."""
        assert LINKS[self.parameters.kind].parameters is type(self.parameters)
        assert pickle.loads(pickle.dumps(self.parameters)) == self.parameters

    def test_every_event_arrives_in_order(self, link: LinkProcess, connected: Reader) -> None:
        """No event is lost without cause, and the digest is that of the events sent."""
        events = self._stream(self.many)
        link.start(FREE_RUNNING)
        link.push_all(events, self.many * _SPACING_US)
        received = connected.read(len(events))
        report = link.stop(60.0)
        assert (report.delivered, report.dropped, report.dropped_in_device) == (self.many, 0, 0)
        assert report.digest == digest_of(events)
        assert received is None or np.array_equal(received, events)

    def test_a_paced_link_sends_events_at_their_time(self, link: LinkProcess, connected: Reader) -> None:
        """No event leaves before its own time."""
        events = self._stream(self.some)
        link.start(MonotonicClock().now_ns() + _LEAD_NS)
        link.push(events, self.some * _SPACING_US)
        connected.read(len(events))
        report = link.stop(60.0)
        assert report.delivered == self.some
        assert report.latency.p50 is not None
        assert report.latency.p50 >= 0

    def test_what_is_not_read_by_the_end_has_a_fate_too(self, link: LinkProcess) -> None:
        """Events that no reader takes are counted."""
        link.start(FREE_RUNNING)
        link.push(self._stream(5000), 15_000)
        report = link.stop(0.5)
        assert report.delivered + report.dropped + report.dropped_in_device == 5000
        assert report.final

    def test_a_full_link_does_not_hold_up_a_run_that_is_to_stop(self, link: LinkProcess, connected: Reader) -> None:
        """A session that stops does not wait for a ring that no reader empties."""
        goes_on = iter([True] * 5 + [False] * 100)
        link.push_all(self._stream(50_000), 150_000, lambda: next(goes_on))  # not started, so it takes nothing
        report = link.stop(0.2)
        assert report.delivered + report.dropped + report.dropped_in_device == 50_000
        assert report.dropped > 0

    def test_every_fault_of_its_kind_begins_and_the_ledger_balances(self, link: LinkProcess, connected: Reader) -> None:
        """Each fault that the kind names can be injected, and the events that it destroys are counted."""
        kinds = faults_of(self.parameters)
        link.start(FREE_RUNNING)
        for fault in kinds.values():
            link.order(InjectFault(fault()))
        link.push_all(self._stream(self.some), self.some * _SPACING_US)
        report = link.stop(1.0)
        assert report.error is None
        assert [record.kind for record in report.faults] == list(kinds)
        assert report.delivered + report.dropped + report.dropped_in_device == self.some

    def test_the_death_of_its_process_is_reported(self, link: LinkProcess) -> None:
        """A process that was killed is an error in the report, not silence and not the end of the run."""
        assert link.pid is not None
        os.kill(link.pid, signal.SIGKILL)
        clock = MonotonicClock()
        while not link.gone:
            link.listen()
            clock.sleep_until(clock.now_ns() + 1_000_000)
        assert link.report.state == "died"
        assert "ended" in str(link.stop(0.0).error)
