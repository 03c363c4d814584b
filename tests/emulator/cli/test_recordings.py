"""`evstim record`, `convert`, `info` and `recover`, and `run --record` in the formats of others."""

import json
import os
import signal
import subprocess
import sys
import time

import dv_processing
import h5py
import numpy as np
import pytest

from emulator.cli.app import _main
from tests.made_events import events_at
from tests.npz_records import load_edges
from tests.transports.recording.samples import SIZE, sample_edges, sample_events, write
from tests.transports.recording.test_files import read_all, read_until_damage
from transports.recording.record import load_record

EVENTS = sample_events()
EDGES = sample_edges(EVENTS)
BOARD = '[scene]\nkind = "checkerboard"\n[run]\nmax_late_ms = 0\n'


@pytest.mark.usefixtures("reads_here")
@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("name", ["a.raw", "a.aedat2", "a.aedat31", "a.h5", "a.bag", "a.ros2", "a.npz"])
def test_a_conversion_there_and_back_keeps_every_event(name, tmp_path, json_of):
    write(tmp_path / "in.aedat4", "aedat4", EVENTS, EDGES)
    first = json_of(0, "convert", tmp_path / "in.aedat4", tmp_path / name)
    assert (first["events"], first["trouble"]) == (len(EVENTS), "")
    assert first["left_out"] == ({"edges": len(EDGES)} if name == "a.h5" else {})
    json_of(0, "convert", tmp_path / name, tmp_path / "back.aedat4", "--size", "346x260")
    np.testing.assert_array_equal(read_all(tmp_path / "back.aedat4")[1], EVENTS)


@pytest.mark.usefixtures("reads_here")
@pytest.mark.parametrize(("name", "left_out"), [("out.aedat4", {}), ("out.raw", {"frames": 1})])
def test_frames_of_a_camera_are_kept_or_left_out_and_told(name, left_out, tmp_path, json_of):
    parts = dv_processing.io.MonoCameraWriter.Config("DAVIS346_00000346")
    parts.addEventStream(SIZE)
    parts.addFrameStream(SIZE)
    writer, store = dv_processing.io.MonoCameraWriter(str(tmp_path / "in.aedat4"), parts), dv_processing.EventStore()
    for k in range(10):
        store.push_back(1000 * k, k, k, True)
    writer.writeEvents(store)
    writer.writeFrame(dv_processing.Frame(5000, np.zeros(SIZE[::-1], np.uint8)))
    del writer
    done = json_of(0, "convert", tmp_path / "in.aedat4", tmp_path / name)
    assert (done["events"], done["trouble"], done["left_out"]) == (10, "", left_out)


@pytest.mark.usefixtures("reads_here")
def test_info_tells_what_a_file_holds(tmp_path, capsys, json_of):
    write(tmp_path / "a.aedat4", "aedat4", EVENTS, EDGES)
    info = json_of(0, "info", tmp_path / "a.aedat4")
    assert (info["format"], info["size"], info["camera"]) == ("aedat4", [346, 260], "DAVIS346_00000346")
    assert (info["events"], info["on"], info["edges"]) == (len(EVENTS), int(EVENTS["on"].sum()), len(EDGES))
    assert (info["first_us"], info["last_us"]) == (int(EVENTS["t"][0]), int(EVENTS["t"][-1]))
    busiest = np.bincount((EVENTS["t"] // 100_000).astype(int)).max() * 10
    assert info["busiest_hz"] == busiest
    assert (info["extent"], info["steps_back"]) == ([346, 260], 0)
    assert _main(["info", str(tmp_path / "a.aedat4")]) == 0
    printed = capsys.readouterr().out
    assert "dv-processing" in printed
    assert "2023-11-14 22:13:20 UTC" in printed


def test_a_cut_file_is_recovered_to_its_last_whole_packet(tmp_path, json_of):
    write(tmp_path / "a.aedat4", "aedat4", EVENTS)
    whole = (tmp_path / "a.aedat4").read_bytes()
    (tmp_path / "cut.aedat4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RuntimeError, match="FileDataTable set but not present"):
        dv_processing.io.MonoCameraRecording(str(tmp_path / "cut.aedat4"))
    info = json_of(1, "info", tmp_path / "cut.aedat4")
    assert "evstim recover" in info["trouble"]
    assert json_of(0, "recover", tmp_path / "cut.aedat4", tmp_path / "saved.aedat4")["left_bytes"] < 200_000
    events, trouble = read_until_damage(tmp_path / "saved.aedat4")
    assert trouble == ""
    assert len(EVENTS) * 0.35 < len(events) < len(EVENTS) * 0.55
    np.testing.assert_array_equal(events, EVENTS[: len(events)])
    reader, count = dv_processing.io.MonoCameraRecording(str(tmp_path / "saved.aedat4")), 0
    while (batch := reader.getNextEventBatch()) is not None:
        count += batch.size()
    assert count == len(events) == info["events"]


def test_the_raw_part_of_a_killed_record_is_recovered(tmp_path, json_of):
    (tmp_path / "a.npz.part").write_bytes(EVENTS.tobytes()[:-5])
    done = json_of(0, "recover", tmp_path / "a.npz.part", tmp_path / "a.raw", "--size", "346x260")
    assert done["events"] == len(EVENTS) - 1
    np.testing.assert_array_equal(read_all(tmp_path / "a.raw")[1], EVENTS[:-1])


def test_a_torn_file_is_converted_up_to_there_with_a_verdict(tmp_path, json_of):
    text = b"t,x@346,y@260,on\n1,2,3,1\n2,3,4,0\n" + b"5,6,7,1\n" * 100_000 + b"nonsense\n"
    (tmp_path / "a.csv").write_bytes(text)
    assert "nonsense" in json_of(1, "convert", tmp_path / "a.csv", tmp_path / "b.aedat4")["trouble"]
    assert read_all(tmp_path / "b.aedat4")[1]["t"].tolist()[:3] == [1, 2, 5]


@pytest.mark.usefixtures("reads_here")
def test_a_table_without_a_header_is_read_in_the_order_that_is_given(tmp_path, capsys, json_of):
    table, picture = tmp_path / "a.txt", tmp_path / "a.png"
    table.write_text("10,20,1,0.5\n11,21,0,0.7\n12,22,0,0.6\n")
    assert _main(["info", str(table)]) == 2
    assert "column 4 has 0.5, which is no p" in capsys.readouterr().err
    info = json_of(0, "info", table, "--columns", "x,y,p,t")
    events = info["streams"]["events"]
    assert (events["first_us"], events["last_us"], events["steps_back"]) == (500_000, 700_000, 1)
    assert (info["mean_hz"], info["busiest_hz"]) == (None, None)
    assert info["assumed"] == ["it has no unit of time: its times are taken as s (--time-unit)"]
    options = ["--columns", "x,y,p,t", "--time-unit", "s"]
    done = json_of(1, "convert", table, tmp_path / "b.csv", "--size", "64x48", *options)
    assert done["events"] == 2
    assert "event 2 goes back in time, from 700000 to 600000 us" in done["trouble"]
    assert (tmp_path / "b.csv").read_text().split() == ["t,x@64,y@48,on", "500000,10,20,1", "700000,11,21,0"]
    table.write_text("10,20,1,0.5\n11,21,0,0.7\n")
    assert json_of(0, "picture", table, picture, "--size", "64x48", *options)["events"] == 2
    assert _main(["picture", "eros", str(picture), *options]) == 2


@pytest.mark.usefixtures("reads_here")
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["convert", "in.aedat4", "out.mp4"], 2, "none of the suffixes"),
        (["convert", "in.aedat4", "in.aedat4"], 2, "is the input itself"),
        (["convert", "in.aedat4", "gone/out.raw"], 2, "does not exist"),
        (["convert", "in.aedat4", "folder.raw"], 2, "is a folder"),
        (["convert", "nothing.raw", "out.raw"], 2, "No such file"),
        (["convert", "in.aedat4", "out.raw", "--to", "evt9"], 2, "format 'evt9' is not known here"),
        (["convert", "in.aedat4", "folder.raw", "--to", "ros2"], 2, "exists"),
        (["info", "in.aedat4", "--size", "big"], 2, "WIDTHxHEIGHT"),
        (["info", "folder.raw"], 2, "no ROS 2 bag"),
        (["recover", "text.aedat4", "out.aedat4"], 2, "no AEDAT 4.0 file"),
        (["recover", "in.aedat4", "out.raw"], 2, "must end in .aedat4"),
        (["record", "checkerboard", "out.foo"], 2, "none of the suffixes"),
        (["run", "checkerboard", "--record", "out.foo"], 2, "none of the suffixes"),
    ],
)
def test_wrong_use_is_told(arguments, code, words, tmp_path, json_of, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "in.aedat4", "aedat4", EVENTS[:100])
    (tmp_path / "folder.raw").mkdir()
    (tmp_path / "text.aedat4").write_text("hello")
    assert words in json_of(code, *arguments)["error"]


def test_a_full_disk_ends_a_conversion_in_words(tmp_path, json_of):
    write(tmp_path / "in.aedat4", "aedat4", EVENTS)
    (tmp_path / "full.raw").symlink_to("/dev/full")
    assert "No space left on device" in json_of(3, "convert", tmp_path / "in.aedat4", tmp_path / "full.raw")["error"]


@pytest.fixture
def board(tmp_path):
    (tmp_path / "board.toml").write_text(BOARD + '[[links]]\nkind = "loopback"\n')
    return tmp_path / "board.toml"


@pytest.mark.long
def test_a_rig_is_recorded_without_its_links(board, tmp_path, json_of):
    run = json_of(0, "record", board, tmp_path / "a.aedat4", "--seconds", "0.05")
    (link,) = run["links"].values()
    events = read_all(tmp_path / "a.aedat4")[1]
    assert (run["balanced"], link["file_troubles"]) == (True, [])
    assert len(events) == run["events"]["read_out"] > 1000


CAMERA = """
[camera]
model = "davis346"
[camera.frames]
[camera.imu]
[camera.sensor]
width = 64
height = 48
"""
RESETS = {"events": "resets", "edges": "edge_resets", "imu": "imu_resets", "frames": "frame_resets"}
EVERY_50_MS = "[trigger]\nperiod_ms = 50.0\n"


@pytest.fixture
def camera(tmp_path):
    """A rig with all that a camera can send, whose step is a parameter."""

    def of_step(step_us):
        path = tmp_path / f"camera{step_us}.toml"
        path.write_text(BOARD + f"step_us = {step_us}\n" + CAMERA + EVERY_50_MS)
        return path

    return of_step


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("step_us", [1000, 270_000])
def test_a_record_holds_what_its_format_can_whatever_the_step(step_us, camera, tmp_path, json_of):
    for name, left_out in (("a.npz", set()), ("a.raw", {"imu", "frames"}), ("a.aedat2", set())):
        run = json_of(0, "record", camera(step_us), tmp_path / name, "--seconds", "0.5")
        link = run["links"]["file"]
        assert (link["file_troubles"], run["not_recorded"]) == ([], [])
        (file,) = link["recordings"]
        assert file["written"]["events"] == run["events"]["read_out"] > 1000
        assert (file["written"]["edges"], set(file["left_out"])) == (19, left_out)  # the last pulse falls after the end
        counts = file["written"] | file["left_out"]
        assert (counts["frames"], 495 <= counts["imu"] <= 505) == (13, True)
    events = load_record(tmp_path / "a.npz")[0]
    for name in ("a.raw", "a.aedat2"):
        np.testing.assert_array_equal(read_all(tmp_path / name)[1], events)
    changes = load_edges(tmp_path / "a.npz")[0]["t"].tolist()
    assert set(changes) == {*range(50_000, 500_001, 50_000), *range(50_100, 450_101, 50_000)}


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("step_us", [1000, 270_000])
def test_truth_and_record_are_in_the_order_of_time_with_triggers(step_us, camera, tmp_path, json_of):
    rig, paths = camera(step_us), [tmp_path / "true.h5", tmp_path / "a.npz"]
    rig.write_text(rig.read_text() + '[[links]]\nkind = "loopback"\n')
    arguments = ["--seconds", "0.5", "--pace", "free", "--truth", paths[0], "--record", paths[1]]
    run = json_of(0, "run", rig, *arguments)
    assert run["truth_trouble"] == ""
    with h5py.File(paths[0]) as truth, np.load(paths[1]) as record:
        streams = [truth["events/t"][:], truth["clean_events/t"][:], truth["pictures/t"][:]]
        streams += [record[name]["t"][record[resets][-1] :] for name, resets in RESETS.items() if name in record]
        assert len(truth["events/t"]) == run["events"]["read_out"]
        assert len(record["edges"]) > 10
    assert all((np.diff(t.astype(np.float64)) >= 0).all() for t in streams)


@pytest.mark.system
def test_a_record_that_stopped_ends_with_a_verdict_and_says_why(camera, tmp_path, capsys):
    (tmp_path / "full.raw").symlink_to("/dev/full")
    assert _main(["record", str(camera(10_000)), str(tmp_path / "full.raw"), "--seconds", "0.2"]) == 1
    printed = capsys.readouterr().out
    last = " ".join(printed[printed.index("NOT WHOLE") :].split())
    assert last.startswith(f"NOT WHOLE: file stopped: No space left on device ({tmp_path / 'full.raw'}); `evstim info")
    assert "written to" not in printed


def test_a_record_reports_what_no_file_can_show(tmp_path, capsys, json_of):
    """The triggers of a bus come by a link, and a record has none."""
    rig = tmp_path / "bus.toml"
    bus = '[trigger]\nsource = "can"\n[[links]]\nkind = "can"\ninterface = "virtual"\nname = "can"\n'
    rig.write_text(BOARD + CAMERA + bus)
    run = json_of(0, "record", rig, tmp_path / "a.npz", "--seconds", "0.05")
    assert run["not_recorded"] == ["triggers, which come by the bus of the link 'can'"]
    assert _main(["record", str(rig), str(tmp_path / "a.npz"), "--seconds", "0.05"]) == 0
    assert "not recorded: triggers, which come by the bus of the link 'can'" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.system
def test_a_trigger_that_is_pressed_while_recording_is_in_the_file(camera, tmp_path):
    """By `evstim trigger`, as somebody at the bench does it."""
    evstim = [sys.executable, "-c", "from emulator.cli import main; main()"]
    rig = camera(120_000)
    rig.write_text(rig.read_text().replace(EVERY_50_MS, ""))
    record = [*evstim, "record", rig, tmp_path / "a.raw", "--seconds", "0", "--pace", "realtime", "--json"]
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    with subprocess.Popen(record, stdout=subprocess.PIPE, text=True, env=environment) as running:
        deadline_s = time.monotonic() + 300
        pressed = 0
        while pressed < 3:
            assert time.monotonic() < deadline_s
            press = [*evstim, "trigger", "rising", "--link", "file"]
            pressed += subprocess.run(press, env=environment, capture_output=True, check=False).returncode == 0
        running.send_signal(signal.SIGINT)
        run = json.loads(running.stdout.read().splitlines()[-1])
    assert running.returncode == 0, run
    (file,) = run["links"]["file"]["recordings"]
    assert (file["written"]["edges"], file["written"]["events"]) == (3, run["events"]["read_out"])
    _, events, edges = read_all(tmp_path / "a.raw")
    assert (len(events), len(edges)) == (run["events"]["read_out"], 3)
    assert (np.diff(edges["t"].astype(np.int64)) > 0).all()


@pytest.mark.system
def test_what_a_link_delivers_is_recorded_in_the_formats_of_others(board, tmp_path, json_of):
    for name in ("a.npz", "a.raw"):
        run = json_of(0, "run", board, "--seconds", "0.05", "--pace", "free", "--record", tmp_path / name)
        assert all(not link["file_troubles"] for link in run["links"].values())
    events, resets = load_record(tmp_path / "a.npz")
    np.testing.assert_array_equal(read_all(tmp_path / "a.raw")[1], events[resets[-1] :])
    assert len(events) > 1000


CONVERT = """
import resource, sys
from pathlib import Path
from emulator.cli.app import _main
code = _main(sys.argv[1:])
own = next(line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(code, own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@pytest.mark.long
@pytest.mark.system
def test_memory_does_not_grow_with_the_file(tmp_path):
    """A file ten times as long takes as much memory, in the process that writes and in the one that reads."""
    peaks = {}
    for count in (1_000_000, 10_000_000):
        events = events_at(np.arange(count))
        np.savez(tmp_path / "in.npz", events=events)
        arguments = ["convert", tmp_path / "in.npz", tmp_path / "out.raw", "--size", "{}x{}".format(*SIZE)]
        command = [sys.executable, "-c", CONVERT, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
        code, *peaks[count] = (int(word) for word in done.stdout.splitlines()[-1].split())
        assert code == 0
    for small, large in zip(peaks[1_000_000], peaks[10_000_000], strict=True):
        assert large - small < 40_000  # KiB; the file is 130 MB
