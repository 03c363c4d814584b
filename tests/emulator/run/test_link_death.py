"""A link that dies ends no run: its events get a fate, the others go on, and the summary is written."""

import json
import os
import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from emulator.run.link_process import LinkProcess
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from tests.made_events import events_at
from tests.waiting import until
from transports.link.endpoint import LinkFactory
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.kind import SerialLink
from transports.usb.kind import LoopbackLink
from transports.usb.loopback import LoopbackEndpoint

LOOPBACK = LinkFactory(LoopbackEndpoint, LoopbackLink())

pytestmark = pytest.mark.socket
RIG = """
title = "two loopback links"
[scene]
kind = "checkerboard"
[camera]
model = "davis346"
[run]
max_late_ms = 0
{more}
[[links]]
kind = "loopback"
name = "a"
[[links]]
kind = "loopback"
name = "b"
"""
_PROGRAM = (
    "import signal\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored by what a shell starts in the background
    "from emulator.cli import main; print(flush=True); main()"
)
_EVSTIM = [sys.executable, "-c", _PROGRAM, "run"]


def open_link(**more):
    camera = partial(Davis346, Davis346Settings(start_delay_us=0))
    link = LinkProcess(LinkSetup("loopback", EventRing(), camera, LOOPBACK, **more), MonotonicClock())
    link.wait_ready()
    link.start(FREE_RUNNING)
    return link


def push(link, count, start_us):
    link.push_all(events_at(start_us + np.arange(count)), start_us + count)


def delivered(link):
    return link.listen().delivered


def test_events_of_a_killed_link_are_delivered_or_dropped():
    link = open_link()
    push(link, 5000, 0)
    until(lambda: delivered(link) == 5000)
    os.kill(link._process.pid, signal.SIGKILL)
    until(lambda: link.listen().state == "died")
    push(link, 700, 10_000)
    report = link.stop(1.0)
    assert (report.delivered, report.dropped, report.dropped_in_device) == (5000, 700, 0)
    assert "exit code -9" in report.error


def open_serial_link(symlink, **more):
    """Return a link on a pty that `symlink` leads to."""
    factory = SerialFactory(SerialLink(symlink=str(symlink)))
    device = partial(Instrument, (346, 260), InstrumentSettings())
    link = LinkProcess(LinkSetup("serial", EventRing(), device, factory, **more), MonotonicClock())
    link.wait_ready()
    link.start(FREE_RUNNING)
    return link


@pytest.mark.long
@pytest.mark.system
def test_the_symlink_of_a_killed_serial_link_goes_and_that_of_a_live_one_stays(tmp_path):
    killed, other = open_serial_link(tmp_path / "killed"), open_serial_link(tmp_path / "other")
    os.kill(killed.pid, signal.SIGKILL)
    until(lambda: killed.listen().state == "died")
    assert not (tmp_path / "killed").is_symlink()
    assert (tmp_path / "other").exists()
    again = open_serial_link(tmp_path / "killed")
    killed.stop(1.0)
    assert (tmp_path / "killed").exists()
    for link in (again, other):
        link.stop(1.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.system
def test_a_link_that_is_to_be_restarted_goes_on_where_it_was():
    link = open_link(restart=True)
    push(link, 5000, 0)
    until(lambda: delivered(link) == 5000)
    link._began_ns -= 2 * 10**9  # one that dies within a second is not started again
    os.kill(link._process.pid, signal.SIGKILL)
    until(lambda: link.listen().state == "restarting")
    push(link, 700, 10_000)
    until(lambda: delivered(link) == 700)
    report = link.stop(1.0)
    assert (report.delivered, report.dropped, report.dropped_in_device) == (5700, 0, 0)
    assert "restarted" in report.error


def test_a_link_that_dies_at_once_is_not_started_for_ever():
    link = open_link(restart=True)
    link._began_ns = link._clock.now_ns()  # the time that it took to open does not count here
    os.kill(link._process.pid, signal.SIGKILL)
    until(lambda: link.listen().state == "died")
    assert link.gone
    link.stop(0.0)


class Running:
    """A run in a process group of its own, which ends with the test."""

    def __init__(self, tmp_path, more="", arguments=()):
        rig = tmp_path / "two.toml"
        rig.write_text(RIG.format(more=more))
        self._process = subprocess.Popen(
            [*_EVSTIM, str(rig), "--json", "--ready-file", str(tmp_path / "ready"), *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            start_new_session=True, text=True,
        )  # fmt: skip
        self.pid = self._process.pid
        self._process.stdout.readline()  # Python's own start, which a signal ends with a traceback, is over
        self._ready = tmp_path / "ready"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._process.poll() is None:
            os.killpg(self.pid, signal.SIGKILL)
        self._process.communicate()

    def links(self):
        """Return the processes of the links by their names; the session's other child is multiprocessing's tracker."""
        children = subprocess.run(["pgrep", "-P", str(self.pid), "-f", "spawn_main"], capture_output=True, text=True)
        return [int(pid) for pid in children.stdout.split()]

    def wait_started(self):
        until(lambda: self._ready.exists() or self._process.poll() is not None)
        until(lambda: len(self.links()) == 2 or self._process.poll() is not None)
        assert self._process.poll() is None, "the run ended before a link could be killed"

    def end(self):
        return self._process.communicate(timeout=300)

    def result(self):
        out, err = self.end()
        assert "Traceback" not in err, err
        return self._process.returncode, json.loads(out.splitlines()[-1])


def recorded(folder):
    """Return how many bytes of events each link has recorded so far."""
    parts = [folder / f"record-{name}.npz.part" for name in "ab"]
    return [part.stat().st_size if part.exists() else 0 for part in parts]


@pytest.mark.system
def test_the_other_link_goes_on_and_the_summary_is_written(tmp_path):
    with Running(tmp_path, arguments=["--record", str(tmp_path / "record.npz"), "--seconds", "0"]) as running:
        running.wait_started()
        until(lambda: all(recorded(tmp_path)))
        os.kill(running.links()[0], signal.SIGKILL)
        until(lambda: len(running.links()) == 1)
        before = recorded(tmp_path)
        until(lambda: max(now - then for now, then in zip(recorded(tmp_path), before, strict=True)) > 100_000)
        os.kill(running.pid, signal.SIGINT)
        code, summary = running.result()
    assert code == 1
    assert summary["balanced"]
    assert sorted(link["error"] is None for link in summary["links"].values()) == [False, True]


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_to_the_group_ends_the_run_cleanly(tmp_path, number):
    record = tmp_path / "record.npz"
    with Running(tmp_path, arguments=["--record", str(record)]) as running:
        running.wait_started()
        until(lambda: all(recorded(tmp_path)))
        os.killpg(running.pid, number)
        code, summary = running.result()
    assert code == 0
    assert summary["balanced"]
    for name, link in summary["events"]["links"].items():
        with np.load(tmp_path / f"record-{name}.npz") as file:
            assert len(file["events"]) == link["delivered"] > 0


@pytest.mark.system
def test_links_of_a_killed_session_end_without_a_word(tmp_path):
    with Running(tmp_path) as running:
        running.wait_started()
        links = running.links()
        os.kill(running.pid, signal.SIGKILL)
        _, err = running.end()
    until(lambda: not any(os.path.exists(f"/proc/{pid}") for pid in links))
    assert "Traceback" not in err, err


@pytest.mark.long
@pytest.mark.system
def test_an_unread_stderr_does_not_stop_the_run(tmp_path):
    rig = tmp_path / "two.toml"
    rig.write_text(RIG.format(more=""))
    code = (
        "import logging, sys, threading, time\n"
        "def chatter():\n"
        "    while True: logging.getLogger('emulator').warning('x' * 200); time.sleep(0.0005)\n"
        "threading.Thread(target=chatter, daemon=True).start()\n"
        "from emulator.cli import main; main()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, "run", str(rig), "--json", "--seconds", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert json.loads(process.stdout.readline())["balanced"]
        assert process.wait(300) == 0
