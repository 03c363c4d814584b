"""A truth file of a small run: what it holds is what was true, and it stays readable whatever dies."""

import dataclasses
import io
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import evstim
from emulator.cli.app import _main
from emulator.light import LightFrame
from emulator.rig.loading import RigError, load_rig, parse_rig
from emulator.run.assembly import build_scene
from emulator.run.truth import file as recorder_module
from emulator.run.truth.file import About, TruthRecorder, truth_in
from emulator.run.truth.source import TruthRefused, ideal_of
from emulator.sensor.sensor import Sensor
from tests.emulator.campaign.processes import gone
from tests.hdf5_times import timed_objects
from transports.guarded_reader import encoded

EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]

RIG = """
title = "A ball before a small sensor"
[scene]
kind = "bodies"
[scene.camera]
kind = "keyframes"
look_at_m = [0.0, 0.0, 0.0]
up = [0.0, -1.0, 0.0]
keyframes = [{ t_s = 0.0, position_m = [0.0, 0.0, -8.0] }, { t_s = 0.6, position_m = [4.0, 0.0, -7.0] }]
[[scene.bodies]]
name = "ball"
shape = "globe"
[[scene.bodies]]
shape = "target_panel"
[scene.bodies.path]
kind = "fixed"
position_m = [0.5, 0.5, -2.0]
[camera]
[camera.sensor]
width = 64
height = 48
leak_hz = 5.0
[camera.sensor.noise]
rms = 0.07
[camera.sensor.radiation]
hits_per_cm2_s = 1000.0
[run]
step_us = 10000
seed = 3
method = "line"
"""


def small_rig(tmp_path, more=""):
    path = tmp_path / "small.toml"
    path.write_text(RIG + more)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The events of a run of 0.6 s, its rig and its truth."""
    folder = tmp_path_factory.mktemp("truth")
    with evstim.run(small_rig(folder), seconds=0.6, pace="free", truth=folder / "t.h5", truth_every=1) as run:
        events = np.concatenate(list(run))
    assert run.truth_trouble == ""
    with h5py.File(folder / "t.h5") as file:
        yield events, load_rig(str(folder / "small.toml")), file


@pytest.mark.system
def test_events_are_those_of_a_run_without_truth(made, tmp_path):
    events, _, file = made
    with evstim.run(small_rig(tmp_path), seconds=0.6, pace="free") as run:
        bare = np.concatenate(list(run))
    assert (bare == events).all()
    for name, field in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        assert (file[f"events/{name}"][:] == events[field]).all()


@pytest.mark.long
def test_origins_name_themselves(made):
    _, _, file = made
    codes = h5py.check_enum_dtype(file["events/origin"].dtype)
    assert codes == {"unknown": 0, "signal": 1, "leak": 2, "noise": 3, "background": 4, "particle": 5}
    counts = np.bincount(file["events/origin"][:], minlength=6)
    assert (counts >= [0, 500, 500, 50, 0, 5]).all()
    assert counts[0] == counts[4] == 0


def test_pictures_are_those_of_the_scene(made):
    _, rig, file = made
    times = file["pictures/t"][:]
    assert (times == np.arange(61) * 10_000).all()
    assert file["pictures/depth"].shape == (61, 48, 64)
    assert file["pictures/flow"].shape == (61, 48, 64, 2)
    light = np.zeros((48, 64), np.float32)
    with build_scene(rig) as scene:
        for k in (0, 30, 60):
            scene.light(int(times[k] * 1000), light)
            assert (file["pictures/light"][k] == light).all()
            placed = scene.geometry().places(int(times[k] * 1000))
            assert (file["poses/camera_position_m"][k] == placed.camera_m).all()
            assert (file["poses/bodies_position_m"][k] == placed.bodies_m).all()
    depth, labels = file["pictures/depth"][30], file["pictures/labels"][30]
    assert [name.decode() for name in file["labels/name"]] == ["sky", "ball", "target_panel"]
    assert set(np.unique(labels)) == {0, 1, 2}
    assert depth[labels == 2].max() < depth[labels == 1].min() < 8 < depth[labels == 0].min() == np.inf


def test_each_event_has_the_label_of_the_nearest_picture(made):
    _, _, file = made
    for group in ("events", "clean_events"):
        t, x, y, label = (file[f"{group}/{name}"][:] for name in ("t", "x", "y", "label"))
        nearest = np.minimum((t + 5_000) // 10_000, 60).astype(int)
        assert (file["pictures/labels"][:][nearest, y, x] == label).all()
    labels = file["pictures/labels"][:]
    assert (labels[1:] != labels[:-1]).any(axis=(1, 2)).mean() > 0.6  # a wrong picture would show


def test_clean_events_are_those_of_an_ideal_sensor_on_the_light_that_was_written(made):
    _, rig, file = made
    ideal = Sensor(ideal_of(rig.camera.sensor), 99)  # nothing in it is random
    assert (ideal.parameters.threshold_on, ideal.parameters.leak_hz) == (rig.camera.sensor.threshold_on, 0)
    ideal.reset(LightFrame(0, file["pictures/light"][0]))
    events = [ideal.expose(LightFrame(k * 10_000_000, file["pictures/light"][k])) for k in range(1, 61)]
    events = np.concatenate([*events, ideal.finish()])
    assert len(events) > 500
    for name, field in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        assert (file[f"clean_events/{name}"][:] == events[field]).all()


def test_what_the_file_says_of_itself(made):
    _, rig, file = made
    assert file.attrs["format"] == "evstim-truth"
    assert file.attrs["complete"]
    assert file.attrs["focal_px"] == rig.camera.lens.pinhole((64, 48)).focal_px
    assert file.attrs["rig"] == "small"
    told = truth_in(Path(file.filename))
    assert told["pictures"] == 61
    assert told["events"] == len(file["events/t"]) == sum(told["origins"].values())


def test_every_nth_picture_of_a_run_within_a_program(tmp_path):
    rig = small_rig(tmp_path)
    with evstim.run(rig, seconds=0.1, pace="free", truth=tmp_path / "t.h5", truth_every=5) as run:
        run.wait()
    assert run.truth_trouble == ""
    with h5py.File(tmp_path / "t.h5") as file:
        assert file["pictures/t"][:].tolist() == [0, 50_000, 100_000]
        assert len(file["poses/t"]) == 11
    with pytest.raises(TruthRefused, match="it must be 1 or more"):
        evstim.run(rig, truth=tmp_path / "t.h5", truth_every=0)


@pytest.mark.long
def test_by_default_25_pictures_a_second_are_written_and_their_size_is_reported_before(tmp_path, capsys):
    command = ["run", str(small_rig(tmp_path)), "--seconds", "0.1", "--pace", "free", "--truth", str(tmp_path / "t.h5")]
    assert _main([*command, "--json"]) == 0
    printed = " ".join(capsys.readouterr().err.split())
    assert f"truth: 25 light frames a second, at most 0.14 MB of them in {tmp_path / 't.h5'}" in printed
    with h5py.File(tmp_path / "t.h5") as file:
        assert file["pictures/t"][:].tolist() == [0, 40_000, 80_000]
        assert len(file["poses/t"]) == 11


def test_a_video_has_light_and_events_alone(tmp_path):
    np.save(tmp_path / "v.npy", np.random.default_rng(0).random((5, 48, 64)).astype(np.float32))
    text = RIG[: RIG.index("[scene]")] + '[scene]\nkind = "video"\npath = "v.npy"\n' + RIG[RIG.index("[camera]") :]
    (tmp_path / "video.toml").write_text(text)
    with evstim.run(tmp_path / "video.toml", seconds=0.1, pace="free", truth=tmp_path / "t.h5") as run:
        run.wait()
    with h5py.File(tmp_path / "t.h5") as file:
        assert set(file["pictures"]) == {"t", "light"}
        assert "poses" not in file
        assert "a video does not contain them" in file.attrs["absent"]
        assert len(file["events/t"]) == len(file["events/origin"]) > 100


@pytest.mark.long
@pytest.mark.system
def test_what_cannot_have_truth_says_why(tmp_path):
    rig = small_rig(tmp_path)
    with pytest.raises(TruthRefused, match=r"must end in \.h5 or \.hdf5"):
        evstim.run(rig, truth=tmp_path / "t.zarr")
    with (
        pytest.raises(OSError, match="No such file or directory"),
        evstim.run(rig, truth=tmp_path / "no" / "t.h5") as run,
    ):
        run.wait()
    command = [*EVSTIM, "run", rig, "--truth"]
    for more, said in (
        ([tmp_path / "t.txt"], "give an .h5 file"),
        ([tmp_path / "t.h5", "--truth-every", "0"], "it must be 1 or more"),
        ([tmp_path / "no" / "t.h5"], "does not exist"),
    ):
        done = subprocess.run([*command, *more], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert said in " ".join((done.stdout + done.stderr).split())


@pytest.mark.long
@pytest.mark.system
def test_a_full_disk_ends_the_truth_and_not_the_run(tmp_path):
    """The limit on the size of a file holds for the writer as a full disk does."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    command = [*EVSTIM, "run", small_rig(tmp_path), "--seconds", "0.6", "--pace", "free", "--json"]
    command += ["--truth", tmp_path / "t.h5", "--truth-every", "1"]
    done = subprocess.run(command, capture_output=True, preexec_fn=limit, check=False)
    told = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 1
    assert told["sim_seconds"] == pytest.approx(0.6)
    assert told["truth_trouble"] == f"truth stopped: File too large ({tmp_path / 't.h5'})"


@pytest.fixture
def endless(tmp_path):
    """A run without an end, in real time, that has written some pictures."""
    path = tmp_path / "t.h5"
    command = [*EVSTIM, "run", small_rig(tmp_path), "--seconds", "0", "--truth", path, "--truth-every", "1"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    until = time.monotonic() + 120
    while not (path.exists() and (truth_in(path) or {"pictures": 0})["pictures"] > 20):
        assert time.monotonic() < until
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.1)
    yield process, path
    process.kill()
    process.communicate()


def told_when_ready(path):
    """What the file holds, when its writer has finished it and lets others open it."""
    until = time.monotonic() + 120
    while True:
        try:
            h5py.File(path, "r").close()
            return truth_in(path)
        except OSError:
            assert time.monotonic() < until
            time.sleep(0.2)


@pytest.mark.long
@pytest.mark.system
def test_others_may_read_while_it_is_written(endless):
    process, path = endless
    with h5py.File(path, "r", swmr=True) as file:
        before = len(file["pictures/t"])
        until = time.monotonic() + 120
        while len(file["pictures/t"]) <= before:
            assert time.monotonic() < until
            time.sleep(0.1)
            file["pictures/t"].refresh()
        assert before > 20
    assert process.poll() is None


@pytest.mark.long
@pytest.mark.system
def test_a_signal_ends_the_file_in_good_order(endless):
    process, path = endless
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=300)
    told = truth_in(path)
    assert told["complete"]
    assert told["pictures"] == told["poses"] > 10


@pytest.mark.long
@pytest.mark.system
def test_a_killed_run_leaves_all_that_was_sent(endless):
    process, path = endless
    process.kill()
    process.wait()
    told = told_when_ready(path)
    assert not told["complete"]
    assert told["pictures"] > 10
    assert told["events"] > 100


@pytest.mark.long
@pytest.mark.system
def test_a_killed_writer_leaves_what_was_flushed_and_the_run_says_so(endless):
    process, path = endless
    (writer,) = (
        int(pid)
        for pid in os.listdir("/proc")
        if pid.isdigit() and b"write_file" in command_of(pid) and str(path).encode() in command_of(pid)
    )
    os.kill(writer, signal.SIGKILL)
    assert gone(writer)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 1
    assert "truth stopped: its writer was killed" in " ".join(said.split())
    told = truth_in(path)
    assert not told["complete"]
    assert told["pictures"] > 10


def command_of(pid):
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return file.read()
    except OSError:
        return b""


def test_a_run_in_real_time_leaves_out_what_finds_no_room_and_counts_it(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "_CAPACITY_BYTES", 30_000)
    recorder = TruthRecorder(tmp_path / "t.h5", About((64, 48)), waits=False)
    os.kill(recorder._writer.pid, signal.SIGSTOP)  # a disk that is far too slow, however busy this machine is
    rows = {"pictures/t": np.zeros(1), "pictures/light": np.ones((1, 48, 64), np.float32)}
    for _ in range(200):
        recorder.put(rows | {"events/t": np.arange(10, dtype=np.uint64)})
    os.kill(recorder._writer.pid, signal.SIGCONT)
    recorder.close()
    assert recorder.missing_pictures > 50
    assert recorder.missing_events == 10 * recorder.missing_pictures
    assert f"{recorder.missing_pictures} pictures and {recorder.missing_events} events" in recorder.trouble
    told = truth_in(tmp_path / "t.h5")
    assert told["pictures"] == 200 - recorder.missing_pictures
    assert told["missing_pictures"] == recorder.missing_pictures
    assert not told["complete"]


def test_a_run_that_may_wait_does_and_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "_CAPACITY_BYTES", 30_000)
    recorder = TruthRecorder(tmp_path / "t.h5", About((64, 48)), waits=True)
    for k in range(100):
        recorder.put({"pictures/t": np.full(1, float(k)), "pictures/light": np.ones((1, 48, 64), np.float32)})
        assert recorder._writer._queue.waiting_bytes <= 30_000
    recorder.close()
    assert recorder.trouble == ""
    with h5py.File(tmp_path / "t.h5") as file:
        assert file["pictures/t"][:].tolist() == list(range(100))


def test_equal_rows_are_equal_bytes_whenever_they_come(tmp_path, monkeypatch):
    """Neither a time in the file nor a flush by the wall clock, which would lay out the chunks in another order."""
    random = np.random.default_rng(1)
    messages = [
        {"pictures/t": np.full(1, k * 1e5), "events/t": np.cumsum(random.integers(0, 9, 3000)).astype(np.uint64)}
        for k in range(20)
    ]
    data = b"".join(part for rows in [*messages, {"attributes": {"complete": True}}] for part in encoded(rows))
    for name, step_s in (("a.h5", 0.0), ("b.h5", 10.0)):
        clock = itertools.count(0.0, step_s)
        monkeypatch.setattr(time, "monotonic", lambda clock=clock: next(clock))
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data)))
        recorder_module._write(recorder_module.create(tmp_path / name, About((64, 48), ["ball"])), tmp_path / name)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert not timed_objects(tmp_path / "a.h5")


def test_other_files_are_no_truth(tmp_path):
    assert truth_in(tmp_path / "none.h5") is None
    (tmp_path / "text.h5").write_text("no HDF5")
    assert truth_in(tmp_path / "text.h5") is None
    (tmp_path / "cut.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))
    assert truth_in(tmp_path / "cut.h5") is None
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    assert truth_in(tmp_path / "other.h5") is None


def test_a_recording_that_is_played_has_no_truth(tmp_path):
    np.savez(tmp_path / "r.npz", events=np.zeros(0))
    text = 'title = "r"\n[scene]\nkind = "recording"\npath = "r.npz"\n'
    try:
        rig = parse_rig(text, str(tmp_path / "r.toml"), "r")
    except RigError as error:
        pytest.fail(str(error))
    with pytest.raises(TruthRefused, match="events that exist already"):
        evstim.run(dataclasses.replace(rig), truth=tmp_path / "t.h5")
