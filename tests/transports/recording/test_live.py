"""Recordings that are written while a run lasts: exact, and whatever dies, the camera goes on."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Facts, Part
from tests.made_events import events_at
from tests.transports.recording.samples import SIZE, sample_edges, sample_events
from tests.transports.recording.test_files import DATED, read_all, read_until_damage
from transports.recording.format import FORMATS
from transports.recording.live import LiveRecorder, open_recorder
from transports.recording.record import Recorder

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("forked_readers")]

FACTS = Facts(SIZE, "DAVIS346_00000346")
EVENTS = sample_events()
LIVE = [name for name, form in FORMATS.items() if form.live]
UNIX_US = 1_700_000_000_123_000


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A writer on a busy machine has a minute to finish its file, not the seconds of a run."""
    monkeypatch.setattr("transports.recording.live._CLOSE_S", 60.0)


def waited(check, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not check() and time.monotonic() < deadline:
        time.sleep(0.02)
    return check()


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["aedat4", "evt3", "dsec", "ros2"])
def test_what_was_appended_is_in_the_file(name, tmp_path):
    edges = sample_edges(EVENTS)
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    recorder = LiveRecorder(path, FORMATS[name], FACTS)
    for start in range(0, len(EVENTS), 37):
        part = EVENTS[start : start + 37]
        own = edges[(edges["t"] >= part["t"][0]) & (edges["t"] <= part["t"][-1])]
        recorder.append(Part(part, edges=own), unix_us=UNIX_US)
    recorder.close()
    assert recorder.trouble == ""
    assert recorder.summary.written["events"] == len(EVENTS)
    recording, events, read = read_all(path)
    np.testing.assert_array_equal(events, EVENTS)
    assert recording.facts.unix_us == (UNIX_US if name in DATED else 0)
    assert len(read) in (0, len(edges))


@pytest.mark.sampled
@pytest.mark.parametrize("name", LIVE)
def test_a_killed_writer_leaves_what_it_wrote_and_is_told(name, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    recorder = LiveRecorder(path, FORMATS[name], FACTS)
    events = sample_events(300_000, seed=8)
    for start in range(0, len(events), 1000):
        recorder.append(Part(events[start : start + 1000]), unix_us=None)
    assert waited(lambda: recorder.room == (1 << 27) // EVENT.itemsize)
    most_lost = {"dsec": 300_000}.get(name, 20_000)
    assert waited(lambda: len(read_until_damage(path)[0]) >= len(events) - most_lost)  # the writer is busy yet
    os.kill(recorder._writer.pid, signal.SIGKILL)
    recorder.close()
    recorder.append(Part(events[:10]), unix_us=None)
    assert "its writer was killed" in recorder.trouble
    assert recorder.missing == {"events": 10}
    read, trouble = read_until_damage(path)
    lost = len(events) - len(read)
    np.testing.assert_array_equal(read[:-1], events[: max(0, len(read) - 1)])
    assert lost <= most_lost, trouble


FEEDER = """
import os, sys
from pathlib import Path
import numpy as np
from firmware_protocol.events import EVENT
from transports.recording.format import FORMATS
from transports.recording.live import LiveRecorder
from transports.recording.part import Facts, Part
recorder = LiveRecorder(Path(sys.argv[1]), FORMATS["aedat4"], Facts((346, 260)))
events = np.zeros(5000, EVENT)
events["t"] = np.arange(5000)
recorder.append(Part(events))
while recorder._writer._queue.waiting_bytes: pass
os.kill(os.getpid(), 9)
"""


def test_a_killed_feeder_leaves_a_finished_file(tmp_path):
    """The process of a link dies: its writer sees the end of its input and finishes the file with its table."""
    path = tmp_path / "a.aedat4"
    done = subprocess.run([sys.executable, "-c", FEEDER, path], cwd=os.getcwd(), check=False, timeout=60)
    assert done.returncode == -signal.SIGKILL
    finished = FORMATS["aedat4"].imported("firmware_protocol.recordings.aedat4:Aedat4Head")
    assert waited(lambda: path.stat().st_size > 0)
    assert waited(lambda: finished(path.read_bytes()).table_at > 0)
    assert read_all(path)[1]["t"].tolist() == list(range(5000))


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["aedat4", "evt3", "evt2", "evt21", "dat", "es", "csv", "aedat2", "aedat31"])
def test_a_full_disk_stops_the_record_alone(name, tmp_path):
    (tmp_path / "full").symlink_to("/dev/full")
    recorder = LiveRecorder(tmp_path / "full", FORMATS[name], FACTS)
    events = sample_events(100_000)
    for start in range(0, len(events), 1000):
        recorder.append(Part(events[start : start + 1000]))
    recorder.close()
    assert recorder.trouble == f"record stopped: No space left on device ({tmp_path / 'full'})"


@pytest.mark.parametrize("name", ["dsec", "ros1", "ros2"])
def test_a_folder_that_is_not_there_is_told_at_once(name, tmp_path):
    with pytest.raises(OSError, match=r"No such file|does not exist|unable"):
        LiveRecorder(tmp_path / "gone" / "a", FORMATS[name], FACTS)


def test_events_that_come_faster_than_they_can_be_written_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr("transports.recording.live._CAPACITY_BYTES", 13 * 5000)
    recorder = LiveRecorder(tmp_path / "a.aedat4", FORMATS["aedat4"], FACTS)
    os.kill(recorder._writer.pid, signal.SIGSTOP)
    for k in range(300):
        recorder.append(Part(events_at(range(1000 * k, 1000 * k + 1000))), unix_us=UNIX_US)
    os.kill(recorder._writer.pid, signal.SIGCONT)
    recorder.close()
    assert recorder.missing["events"] > 100_000
    assert f"lacks {recorder.missing['events']} events: they came faster" in recorder.trouble
    assert len(read_all(tmp_path / "a.aedat4")[1]) == 300_000 - recorder.missing["events"]


def test_a_run_that_is_not_paced_waits_and_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("transports.recording.live._CAPACITY_BYTES", 13 * 5000)
    recorder = LiveRecorder(tmp_path / "a.raw", FORMATS["evt3"], FACTS)
    for k in range(300):
        recorder.append(Part(events_at(range(1000 * k, 1000 * k + 1000))))
    recorder.close()
    assert (recorder.missing, recorder.trouble) == ({}, "")
    assert read_all(tmp_path / "a.raw")[1]["t"].tolist() == list(range(300_000))


def test_the_suffix_decides_who_writes(tmp_path):
    arrays = open_recorder(tmp_path / "a.npz", FACTS)
    assert isinstance(arrays, Recorder)
    arrays.close()
    assert np.load(tmp_path / "a.npz")["size"].tolist() == [346, 260]
    with pytest.raises(OSError, match="none of the suffixes"):
        open_recorder(tmp_path / "a.mp4", FACTS)
