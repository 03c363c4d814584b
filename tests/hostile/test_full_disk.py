"""Files that a run or a listener writes, when the disk is full: they stop and say so, and everything else goes on."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from emulator.cli.app import _main
from emulator.cli.checks import check_output
from emulator.cli.output import Failure
from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Part
from tests.made_events import events_at
from transports.faults.line import BitFlips
from transports.faults.script import FaultPlan, Faults
from transports.output_file import OutputFile
from transports.recording.record import Recorder

FULL = "/dev/full"
NO_SPACE = "No space left on device"
EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]


@pytest.fixture
def full(tmp_path):
    """A folder in which every file is full from the start: links to the device that always is."""

    def link(name):
        (tmp_path / name).symlink_to(FULL)
        return tmp_path / name

    return link


@pytest.fixture
def tiny(disk_of):
    return disk_of("256k")


def events(count, start_us=0):
    return events_at(start_us + np.arange(count))


def test_a_record_stops_and_keeps_what_it_had(tiny):
    recorder = Recorder(tiny / "a.npz")
    for k in range(40):
        recorder.append(Part(events(1000, 1000 * k)))
    recorder.close()
    assert recorder.trouble.startswith(f"record stopped: {NO_SPACE}")
    assert not (tiny / "a.npz").exists()
    kept = (tiny / "a.npz.part").read_bytes()
    whole = np.frombuffer(kept[: len(kept) // EVENT.itemsize * EVENT.itemsize], EVENT)
    assert np.array_equal(whole["t"], np.arange(len(whole)))
    assert len(whole) > 5000


def test_a_record_for_which_the_archive_has_no_room_is_kept_as_it_is(tiny):
    recorder = Recorder(tiny / "a.npz")
    recorder.append(Part(events(12_000)))  # 156 kB, twice
    recorder.close()
    assert NO_SPACE in recorder.trouble
    assert [path.name for path in sorted(tiny.iterdir())] == ["a.npz.edges.part", "a.npz.imu.part", "a.npz.part"]
    assert (tiny / "a.npz.part").stat().st_size == 12_000 * EVENT.itemsize


def test_the_truth_of_a_clock_stops(full):
    truth = OutputFile(full("truth.csv"), "truth")
    for k in range(2000):
        truth.write(f"{k},{k},0.500\n".encode())
    truth.close()
    assert truth.trouble.startswith(f"truth stopped: {NO_SPACE}")


def test_a_fault_log_stops_and_the_fault_goes_on(full):
    class Stage:
        hits, touched, over = 3, 4, False

    faults = Faults(FaultPlan("a", (BitFlips(link="a", at_s=0.0),), log=full("faults.log")), lambda *_: Stage())
    faults.advance(1000)
    faults.close()
    (record,) = faults.records
    assert (record.hits, record.ended_us) == (3, 1000)
    assert record.log_trouble.startswith(f"fault log stopped: {NO_SPACE}")


@pytest.mark.long
@pytest.mark.system
@pytest.mark.socket
def test_a_run_whose_disk_is_full_goes_on_and_says_so(tiny, tmp_path):
    rig = tmp_path / "a.toml"
    rig.write_text('[scene]\nkind = "checkerboard"\n[run]\nmax_late_ms = 0\n[[links]]\nkind = "loopback"\n')
    arguments = ["run", rig, "--seconds", "1", "--pace", "free", "--json", "--record", tiny / "a.npz"]
    done = subprocess.run([*EVSTIM, *arguments], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    (link,) = summary["links"].values()
    assert summary["balanced"]
    assert summary["sim_seconds"] == 1
    assert link["error"] is None
    assert [trouble[: len("record stopped: ") + len(NO_SPACE)] for trouble in link["file_troubles"]] == [
        f"record stopped: {NO_SPACE}"
    ]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: folder / "a.csv", "must end in .npz"),
        (lambda folder: folder / "gone" / "a.npz", "does not exist"),
        (lambda folder: folder, "must end in .npz"),
        (lambda folder: (folder / "d.npz").mkdir() or folder / "d.npz", "is a folder"),
        (lambda folder: os.mkfifo(folder / "p.npz") or folder / "p.npz", "No such device"),
    ],
)
def test_a_path_that_cannot_be_written_is_told_before_the_run(tmp_path, make, message):
    with pytest.raises(Failure, match=message):
        check_output("--record", make(tmp_path), ".npz")


@pytest.mark.system
def test_a_truth_that_cannot_begin_names_the_file_the_room_and_what_to_do(tiny, capsys):
    with pytest.raises(OSError, match=NO_SPACE):
        (tiny / "other").write_bytes(bytes(1 << 20))
    assert _main(["run", "loopback", "--seconds", "0.01", "--truth", str(tiny / "t.h5")]) == 3
    printed = " ".join(capsys.readouterr().err.split())
    assert f"--truth: {tiny / 't.h5'}: {NO_SPACE}: 0.0 MB free; free more, or name a file on another disk" in printed
