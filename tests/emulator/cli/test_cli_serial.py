"""`evstim listen serial`: a camera on a pty, read and told what to do from the command line."""

import asyncio
import json
import threading
from functools import partial

import numpy as np
import pytest

from emulator.cli.app import _main
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from tests.made_events import steady
from transports.link.deliveries import digest_of
from transports.link.pacing import MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.recording.record import load_record
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.kind import SerialLink


def stream(count):
    return steady(count, step_us=10)


class Camera:
    """A link in a thread that sends its events when it has done so many telecommands, the first of which starts it.

    Nothing is lost, for its run is not paced; what answers the telecommands is on the line before the events.
    """

    def __init__(self, events, telecommands):
        ring = EventRing()
        device = partial(Instrument, (346, 260), InstrumentSettings(autostart=False, housekeeping_s=0))
        self._telecommands = telecommands
        self._link = Link(LinkSetup("serial", ring, device, SerialFactory(SerialLink())), MonotonicClock())
        self._ring, self._events, self._ends = ring, events, False
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))
        self._thread.start()
        self._ready.wait()

    async def _run(self):
        await self._link.endpoint.start()
        self.path = self._link.endpoint.report().address
        self._ready.set()
        while self._link.report().counts.get("telecommands", 0) < self._telecommands and not self._ends:
            self._link.tick()
            await asyncio.sleep(0.001)
        self._ring.start(FREE_RUNNING)
        self._ring.push(self._events)
        self._ring.publish(int(self._events["t"][-1]))
        while not self._ends:
            self._link.tick()
            await asyncio.sleep(0.001)
        await self._link.close()

    def stop(self):
        self._ends = True
        self._thread.join()


@pytest.fixture
def camera_after(at_end):
    def make(telecommands):
        made = Camera(stream(3000), telecommands)
        at_end.callback(made.stop)
        return made

    return make


def test_a_camera_is_started_read_and_recorded(camera_after, tmp_path, capsys):
    record, camera = tmp_path / "came.npz", camera_after(telecommands=3)
    arguments = ["--start", "--ping", "--housekeeping", "--events", "3000", "--record", str(record), "--json"]
    assert _main(["listen", "serial", camera.path, *arguments]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["events"] == 3000
    assert said["faults"] == 0
    assert said["digest"] == digest_of(stream(3000))
    assert said["housekeeping"]["events"]["offered"] >= 0
    assert {"Start: completion good", "pong"} <= set(said["answer_texts"])
    assert np.array_equal(load_record(record)[0], stream(3000))


def test_people_are_told_in_words(camera_after, capsys):
    assert _main(["listen", "serial", camera_after(telecommands=1).path, "--start", "--events", "3000"]) == 0
    out = capsys.readouterr().out
    assert "3000 events and 0 edges" in out
    assert "no fault" in out


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["/dev/ttyNOWHERE0"], 3, "is it plugged in"),
        (["pty"], 2, "give the path that"),
        (["/dev/x", "--tick", "7"], 2, "tick 7 us is none of"),
        (["/dev/x", "--baud", "1"], 2, "baud must be"),
        (["/dev/x", "--profile", "morse"], 2, "profile"),
        (["/dev/x", "--record", "/nowhere/at/all.npz"], 2, "does not exist"),
    ],
)
def test_mistakes_are_told(arguments, code, message, json_of):
    assert message in json_of(code, "listen", "serial", *arguments)["error"]
