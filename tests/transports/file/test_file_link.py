"""A link that is a file: the contract of links, and the file's own events."""

import dataclasses
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkFailed, LinkProcess
from evstim.testing.link_contract import LinkContract, NoReader, event_stream
from firmware_protocol.events import make_edges
from tests.transports.recording.test_files import read_all, read_until_damage
from tests.transports.recording.test_live import waited
from transports.file import FileLink
from transports.link.edges import EdgeRing
from transports.link.feed import Timing
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("forked_readers")]

RIG = '[scene]\nkind = "checkerboard"\n[[links]]\nkind = "file"\n'


class TestFileLink(LinkContract):
    """What every link promises."""

    @pytest.fixture(autouse=True)
    def path(self, tmp_path):
        self.parameters = FileLink(str(tmp_path / "a.aedat4"))

    def reader(self, link):
        return NoReader()


def opened(path, rig=RIG, **changes):
    loaded = parse_rig(f'{rig}path = "{path}"\n', "a.toml", "a")
    (setup,) = link_setups(loaded)
    link = LinkProcess(dataclasses.replace(setup, **changes), MonotonicClock())
    link.wait_ready()
    return link


@pytest.mark.parametrize("name", ["a.aedat4", "a.raw"])
def test_the_file_holds_every_event(name, tmp_path):
    events = event_stream(200_000)
    link = opened(tmp_path / name)
    link.start(FREE_RUNNING)
    link.push_all(events, 600_000)
    report = link.stop(60.0)
    assert (report.delivered, report.dropped, report.dropped_in_device, report.error) == (200_000, 0, 0, None)
    assert report.file_troubles == ()
    np.testing.assert_array_equal(read_all(tmp_path / name)[1], events)


def test_the_file_of_a_paced_run_has_its_date(tmp_path):
    link = opened(tmp_path / "a.aedat4")
    link.start(MonotonicClock().now_ns() + 10_000_000)
    link.push(event_stream(1000), 3000)
    assert link.stop(60.0).delivered == 1000
    recording, events, _ = read_all(tmp_path / "a.aedat4")
    np.testing.assert_array_equal(events, event_stream(1000))
    assert abs(recording.facts.unix_us * 1e-6 - os.stat(tmp_path / "a.aedat4").st_mtime) < 60
    assert recording.facts.camera.upper().startswith("DAVIS346")


def test_a_killed_writer_stops_the_file_and_not_the_link(tmp_path):
    link = opened(tmp_path / "a.aedat4")
    link.start(FREE_RUNNING)
    events = event_stream(2000)
    link.push_all(events[:1000], 2999)
    assert waited(lambda: link.listen().delivered == 1000)
    (writer,) = children(link.pid)
    os.kill(writer, signal.SIGKILL)
    assert waited(lambda: link.listen().state == "stopped")
    link.push_all(events[1000:], 6000)
    report = link.stop(10.0)
    assert report.error is None
    assert report.delivered + report.dropped + report.dropped_in_device == 2000
    assert "its writer was killed" in report.file_troubles[0]


@pytest.mark.long
def test_a_link_that_is_started_again_begins_another_file(tmp_path):
    """What the first process handed over is in a finished file, which nobody writes over."""
    link = opened(tmp_path / "a.aedat4", restart=True)
    link.start(FREE_RUNNING)
    events = event_stream(2000)
    link.push_all(events[:1000], 2999)
    assert waited(lambda: link.listen().delivered == 1000)
    time.sleep(1.1)  # a process that ends sooner is not started again
    os.kill(link.pid, signal.SIGKILL)
    assert waited(lambda: link.listen().state == "restarting")
    link.push_all(events[1000:], 6000)
    assert waited(lambda: link.listen().delivered == 1000)
    report = link.stop(60.0)
    paths = [tmp_path / "a.aedat4", tmp_path / "a-restart1.aedat4"]
    assert [one.paths for one in report.recordings] == [(str(path),) for path in paths]
    assert [one.closed for one in report.recordings] == [False, True]
    assert "not closed, as its link died" in report.recordings[0].lines[0]
    assert waited(lambda: len(read_until_damage(paths[0])[0]) == 1000)
    np.testing.assert_array_equal(read_all(paths[0])[1], events[:1000])
    np.testing.assert_array_equal(read_all(paths[1])[1], events[1000:])


def children(pid):
    told = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(child) for text in told for child in text.split()]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("", "path is missing"),
        ('path = "a.mp4"', "none of the suffixes"),
        ('path = "a.raw"\nformat = "evt9"', "format 'evt9' is not known here"),
        ('path = "a.es"\nformat = "aedat2"\n[camera]\nmodel = "imx636"', "numbers 1024 x 512 pixels"),
    ],
)
def test_a_wrong_table_is_told_with_its_line(line, words):
    with pytest.raises(RigError, match=words) as refused:
        parse_rig(f"{RIG}{line}\n", "a.toml", "a")
    assert "line" in str(refused.value)


def test_a_file_that_cannot_be_opened_ends_the_start(tmp_path):
    with pytest.raises(LinkFailed, match="No such file"):
        opened(tmp_path / "gone" / "a.aedat4")


def test_edges_are_in_the_file(tmp_path):
    ring = EdgeRing()
    edges = make_edges([100, 200, 300], [2, 3, 2])
    ring.push(edges)
    link = opened(tmp_path / "a.aedat4", timing=Timing(edges=ring))
    link.start(FREE_RUNNING)
    link.push_all(event_stream(500), 2000)
    assert link.stop(60.0).edges_balanced
    assert read_all(tmp_path / "a.aedat4")[2]["t"].tolist() == [100, 200, 300]
