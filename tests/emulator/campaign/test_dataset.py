"""Data sets: the same sequences as files, as arrays, by any number of workers and after a kill; hostile input."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import av
import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import evstim
from emulator.campaign.campaign import Campaign
from emulator.campaign.dataset import Sequences, dataset_source, displacement
from emulator.campaign.loading import SequenceTruth
from emulator.campaign.one_run import CampaignStopped, Place, run_row
from emulator.campaign.table import begin_folder
from emulator.cli.app import _main
from emulator.rig.loading import shipped_rigs
from emulator.run.truth.source import TruthFile
from emulator.tables.toml_text import toml_value
from tests.hdf5_times import timed_objects
from transports.recording.files import read_events

COMMAND = [sys.executable, "-c", "from emulator.cli import main; main()"]
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
[camera]
[camera.sensor]
width = 64
height = 48
[camera.sensor.noise]
rms = 0.07
[[links]]
kind = "loopback"
[run]
step_us = 7000
"""
VARY = """
[[parameters]]
key = "camera.sensor.threshold_on"
kind = "uniform"
low = 0.1
high = 0.4
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "ball.toml"
    path.write_text(RIG)
    path.with_name("vary.toml").write_text(VARY)
    return path


def command(rig, folder, *more, count=3):
    options = ["--count", str(count), "--seconds", "0.2", "--vary", rig.with_name("vary.toml"), *more]
    return [*COMMAND, *map(str, ["dataset", rig, "--out", folder, *options])]


def made(rig, folder, *more, count=3):
    assert _main(command(rig, folder, *more, count=count)[len(COMMAND) :]) == 0


def digests(folder):
    sequences = json.loads((folder / "manifest.json").read_text())["sequences"]
    return [(s["file"], s["seed"], s["values"], s["events_digest"], s["truth_digest"]) for s in sequences]


@pytest.fixture(scope="module")
def folder(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "data"
    made(rig, folder, "--workers", "1")
    return folder


@pytest.mark.long
@pytest.mark.system
def test_sequences_do_not_depend_on_the_number_of_workers_or_the_format(rig, folder, tmp_path):
    made(rig, tmp_path / "data", "--workers", "2", "--format", "npz")
    names, others = digests(folder), digests(tmp_path / "data")
    assert [name for name, *_ in others] == [f"sequences/00000{k}.npz" for k in range(3)]
    assert [rest for _, *rest in names] == [rest for _, *rest in others]
    for name, *_ in names:
        arrays = np.load((tmp_path / "data" / name).with_suffix(".npz"))
        with h5py.File(folder / name) as file:
            for key in arrays.files:
                np.testing.assert_array_equal(file[key][:], arrays[key])
            assert len(file["events/t"]) > 100
            assert "light" not in file["pictures"]
            assert "clean_events" not in file


@pytest.fixture(scope="module")
def dsec(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dsec") / "data"
    made(rig, folder, "--workers", "2", "--format", "dsec")
    return folder


def flow_of(path):
    """Return flow (height, width, 2), px, and where it is valid, as DSEC's page decodes them; the reader is FFmpeg."""
    with av.open(str(path)) as file:
        image = next(file.decode(video=0)).to_ndarray(format="rgb48le").astype(float)
    return (image[..., :2] - 2**15) / 128, image[..., 2].astype(bool)


def way_of(truth, begin_us, end_us):
    """Return the motion of each pixel's point in px, by its depth and the poses at both times alone."""
    picture, (first, last) = (
        list(truth["pictures/t"]).index(begin_us),
        np.searchsorted(truth["poses/t"], (begin_us, end_us)),
    )
    depth_m, (height, width) = truth["pictures/depth"][picture], truth["pictures/depth"].shape[1:]
    turns = [Rotation.from_quat(q, scalar_first=True) for q in truth["poses/camera_q_world_from_camera"][:]]
    middles = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    rays = np.dstack([(middles - truth.attrs["centre_px"]) / truth.attrs["focal_px"], np.ones((height, width))])
    moved_m = truth["poses/camera_position_m"][last] - truth["poses/camera_position_m"][first]
    of_sky = np.isinf(depth_m)[..., None]
    points = np.where(of_sky, rays, rays * np.where(of_sky, 1.0, depth_m[..., None]))
    seen = turns[first].apply(points.reshape(-1, 3)) - np.where(of_sky, 0.0, moved_m).reshape(-1, 3)
    seen = turns[last].inv().apply(seen).reshape(height, width, 3)
    return truth.attrs["focal_px"] * seen[..., :2] / seen[..., 2:] + truth.attrs["centre_px"] - middles


@pytest.mark.long
@pytest.mark.system
def test_flow_in_dsec_s_files_is_the_motion_of_each_point_until_the_next_map(dsec):
    folder = dsec / "sequences" / "000001"
    pairs = np.loadtxt(folder / "flow/forward_timestamps.txt", delimiter=",", dtype=np.int64)
    np.testing.assert_array_equal(pairs, [(0, 100_000), (100_000, 200_000)])
    images = sorted((folder / "flow/forward").iterdir())
    assert [image.name for image in images] == ["000000.png", "000002.png"]  # of the picture at their first time
    times_us = np.loadtxt(folder / "images/timestamps.txt", dtype=np.int64)
    np.testing.assert_array_equal(times_us[[0, 2]], pairs[:, 0])
    with h5py.File(folder / "truth.h5") as truth:
        for image, (begin_us, end_us) in zip(images, pairs, strict=True):
            flow, valid = flow_of(image)
            of_ball = truth["pictures/labels"][int(image.stem)] == 1
            assert valid[of_ball].mean() > 0.85
            assert valid[~of_ball].mean() > 0.3  # of the sky, which leaves to the side, by up to 13 px
            errors_px = np.abs(flow - way_of(truth, begin_us, end_us))[valid]
            assert np.abs(flow[valid]).max() > 10
            assert np.median(errors_px) < 1 / 256
            assert errors_px.max() < 0.1


@pytest.mark.long
@pytest.mark.system
def test_a_sequence_of_dsec_has_its_files_and_the_truth_beside_them(folder, dsec):
    assert [name for name, *_ in digests(dsec)] == [f"sequences/00000{k}" for k in range(3)]
    assert [rest for _, *rest in digests(dsec)] == [rest for _, *rest in digests(folder)]
    assert json.loads((dsec / "manifest.json").read_text())["campaign"]["truth"]["format"] == "dsec"
    sequence, left = dsec / "sequences" / "000000", dsec / "sequences" / "000000" / "events" / "left"
    with (
        h5py.File(left / "events.h5") as events,
        h5py.File(sequence / "truth.h5") as truth,
        h5py.File(folder / "sequences" / "000000.h5") as other,
        h5py.File(left / "rectify_map.h5") as rectified,
    ):
        assert truth.attrs["complete"]
        for name in ("pictures/depth", "pictures/labels", "poses/camera_position_m", "events/origin"):
            np.testing.assert_array_equal(truth[name][:], other[name][:])
        for name in "xytp":
            np.testing.assert_array_equal(events[f"events/{name}"][:], other[f"events/{name}"][:])
        t_us = events["events/t"][:] + events["t_offset"][()]
        assert t_us.dtype == np.int64  # as DSEC's slicer adds them: unsigned ones of 64 bits would become floats
        np.testing.assert_array_equal(
            events["ms_to_idx"][:], np.searchsorted(t_us, 1000 * np.arange(1 + t_us[-1] // 1000))
        )
        y, x = np.mgrid[:48, :64]
        np.testing.assert_array_equal(rectified["rectify_map"][:], np.dstack([x, y]))


def test_a_displacement_follows_its_point_through_a_flow_that_turns():
    # Rigid rotation about the middle: a quarter turn a second, in closed form. A label fills all but the left columns.
    y, x = np.mgrid[-20.0:21.0, -20.0:21.0]
    flow = np.broadcast_to(np.dstack([-y, x]) * np.pi / 2, (5, 41, 41, 2)).astype(np.float32)
    labels = np.ones((5, 41, 41), np.uint16)
    labels[:, :, :4] = 2
    moved, is_known = displacement(np.arange(5) * 25_000, flow, labels)
    turned = (x + 1j * y) * np.exp(0.05j * np.pi)
    expected = np.dstack([turned.real - x, turned.imag - y])
    assert (
        np.abs(moved - expected)[is_known].max() < 0.01
    )  # the trapezoid's own: (step * rate)^3 / 12 a step, times 28 px
    stays = (np.abs(turned.real) <= 20) & (np.abs(turned.imag) <= 20)
    assert (is_known <= stays).all()
    same_side = (x < -16) == (np.ceil(turned.real) < -16)
    assert (is_known <= same_side).all()
    assert is_known.mean() > 0.7


@pytest.mark.system
def test_sequences_in_memory_are_those_of_the_files(rig, folder):
    data = evstim.dataset(rig, 3, seconds=0.2, vary=rig.with_name("vary.toml"))
    assert len(data) == 3
    assert "- sequences: 3 of 3" in (folder / "README.md").read_text()
    for sequence, (name, seed, values, _, digest) in zip(data, digests(folder), strict=True):
        assert (sequence.seed, sequence.values, sequence.digest) == (seed, values, digest)
        with h5py.File(folder / name) as file:
            for key, array in sequence.arrays.items():
                np.testing.assert_array_equal(file[key][:], array)
    assert data[-1].digest == data[2].digest == data[1:][1].digest
    assert sequence.names == ("ball",)
    with pytest.raises(IndexError, match="sequence 3 of 3"):
        data[3]


def test_events_do_not_depend_on_what_is_written_beside_them(rig):
    flow, clean = (evstim.dataset(rig, 2, seconds=0.05, truth=[layer])[1] for layer in ("flow", "clean_events"))
    assert len(flow.events) > 50
    assert (flow.events == clean.events).all()
    assert len(clean.arrays["clean_events/t"]) > 0
    assert [key for key in flow.arrays if key.startswith("pictures/")] == ["pictures/t", "pictures/flow"]


@pytest.mark.parametrize(("step_us", "rate_hz", "expected"), [(7000, 20, 6250), (80_000, 20, 50_000), (5000, 30, 5000)])
def test_the_step_divides_the_period_where_one_can(rig, tmp_path, step_us, rate_hz, expected):
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace("step_us = 7000", f"step_us = {step_us}"))
    source = dataset_source(path, tmp_path / "d.toml", Sequences(1, 1.0, SequenceTruth(rate_hz)))
    assert Campaign(source).rig(0).run.step_us == expected


@pytest.mark.long
def test_readers_of_dsec_take_a_sequence_for_a_recording(folder):
    path = folder / "sequences" / "000000.h5"
    events = read_events(path)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(events["t"], file["events/t"][:])
        firsts = file["ms_to_idx"][:].astype(int)
        assert file["t_offset"][()] == 0
    # What the data set's own slicer supposes: everything before the index is before its millisecond, nothing after.
    assert len(firsts) == 1 + events["t"][-1] // 1000
    for ms, first in enumerate(firsts):
        assert first == np.searchsorted(events["t"], ms * 1000)


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize("form", ["h5", "dsec"])
def test_an_interrupted_data_set_goes_on_and_is_the_same(form, rig, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    made(rig, whole, "--format", form, count=8)
    for number in (signal.SIGKILL, signal.SIGINT):
        process = subprocess.Popen(
            command(rig, killed, "--workers", "1", "--format", form, count=8),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        before = len(list(killed.glob("rows/*.parquet")))
        while len(list(killed.glob("rows/*.parquet"))) < before + 2:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        assert process.wait(60) in (-signal.SIGKILL, 1)
    assert len(digests(killed)) < 8  # that of the interrupt, with its manifest
    for path in killed.glob("sequences/0*"):  # each file is whole
        with h5py.File(path if form == "h5" else path / "truth.h5") as file:
            assert file.attrs["complete"]
    made(rig, killed, "--format", form, count=8)
    assert digests(whole) == digests(killed)
    assert sorted(os.listdir(killed / "sequences")) == [f"{k:06d}.h5" if form == "h5" else f"{k:06d}" for k in range(8)]
    files = [sorted(path.relative_to(folder) for path in folder.glob("sequences/**/*")) for folder in (whole, killed)]
    assert files[0] == files[1]


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("form", ["dsec", "h5", "npz"])
def test_the_same_sequence_has_the_same_bytes(rig, tmp_path, form):
    contents = []
    for name in ("first", "again"):
        place = tmp_path / name
        place.mkdir()
        sequences = Sequences(1, 0.12, SequenceTruth(format=form))
        row = run_row(Campaign(dataset_source(rig, place / "d.toml", sequences)), 0, Place(place), lambda session: None)
        assert row["outcome"] == "ok", row["error"]
        files = [path for path in sorted(place.rglob("*")) if path.is_file()]
        assert not [path for path in files if path.suffix == ".h5" and timed_objects(path)]
        contents.append({path.relative_to(place): path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    assert len(contents[0]) == (6 if form == "dsec" else 1)


@pytest.mark.parametrize(
    ("options", "differs"),
    [
        (["--truth", "flow"], '--truth: campaign.truth.layers was [], is ["flow"]'),
        (["--rate", "10"], "--rate: campaign.truth.rate_hz was 20.0, is 10.0"),
        (["--format", "npz"], '--format: campaign.truth.format was "h5", is "npz"'),
        (["--seconds", "0.3"], "--seconds: campaign.set.run.seconds was 0.2, is 0.3"),
        (["--seed", "7"], "--seed: campaign.seed was 1, is 7"),
        (["--count", "4"], "--count: campaign.count was 3, is 4"),
    ],
)
def test_a_changed_option_is_named_and_no_file_that_nobody_wrote(rig, tmp_path, json_of, options, differs):
    folder = tmp_path / "data"
    begin_folder(Campaign(dataset_source(rig, folder / "dataset.toml", Sequences(3, 0.2, SequenceTruth()))), folder)
    given = {"--count": "3", "--seconds": "0.2", options[0]: options[1]}
    words = [word for option in given.items() for word in option]
    error = json_of(2, "dataset", rig, "--out", folder, *words)["error"]
    assert f"has the sequences of another data set: {differs}. Give the options" in error
    assert "dataset.toml" not in error
    assert "--folder" not in error


def test_the_folder_of_a_data_set_that_cannot_be_is_its_option(rig, tmp_path, json_of):
    (tmp_path / "file").write_text("x")
    assert json_of(2, "dataset", rig, "--out", tmp_path / "file" / "data")["error"].startswith("--out: ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--truth", "pose"), "poses"),
        (("--truth", "depth,heat"), "heat"),
        (("--truth", ","), "'' is not known here"),
        (("--truth", "depth,,flow"), "'' is not known here"),
        (("--workers", "2", "--scheduler", "tcp://127.0.0.1:9"), "give one of them"),
        (("--rate", "0"), "rate_hz"),
        (("--format", "dsec", "--rate", "25"), "multiple of DSEC's 10 flows a second, got 25"),
        (("--format", "dsec", "--truth", "flow,depth"), 'needs "flow" and "labels"'),
        (("--format", "dsec", "--seconds", "5000"), "at most 4294 with format dsec"),
        (("--count", "0"), "--count"),
        (("--seconds", "nan"), "--seconds"),
        (("--vary", "no.toml"), "no.toml"),
        (("--seconds", "1e-10"), "--seconds"),
        (("--workers", "0"), "--workers"),
    ],
)
def test_mistakes_are_refused_with_their_reason(rig, tmp_path, json_of, options, message):
    assert message in json_of(2, "dataset", rig, "--out", tmp_path / "data", *options)["error"]
    assert not (tmp_path / "data").exists()


SCENES = {
    "checkerboard": ("", "--truth: this scene has no {} (a pattern on the chip has no distance and no place)", "depth"),
    "video": ('path = "v.npy"', "--truth: this scene has no {} (a video does not contain them)", "flow, poses"),
    "ros2": ('topic = "/i"', "--truth: this scene has no {} (images do not contain them)", "labels"),
    "external": ("", "--truth: this scene has no {} (a renderer sends light alone)", "depth"),
    "recording": ('path = "r.npz"', "a data set: a recording plays events that exist already", "light"),
}


@pytest.mark.parametrize("kind", SCENES)
def test_a_layer_that_the_scene_does_not_have_is_refused_before_anything_begins(kind, tmp_path, capsys):
    keys, message, layers = SCENES[kind]
    path = tmp_path / "rig.toml"
    path.write_text(f'[scene]\nkind = "{kind}"\n{keys}\n')
    for options in (["--truth", layers], ["--truth", f"light,{layers}", "--format", "npz"]):
        command = ["dataset", str(path), "--out", str(tmp_path / "data"), "--json", *options]
        assert _main(command) == 2
        assert message.format(layers) in json.loads(capsys.readouterr().out.splitlines()[-1])["error"]
        assert not (tmp_path / "data").exists()
    with pytest.raises(evstim.CampaignError):
        evstim.dataset(path, 1, truth=layers.split(", "))


def test_a_file_that_cannot_be_written_ends_the_data_set_without_a_row(rig, tmp_path, monkeypatch):
    # HDF5 may crash where a disk is full: its run has no fault and is to be done again.
    monkeypatch.setattr(
        TruthFile, "close", lambda self: setattr(self, "trouble", "truth stopped: its writer was killed")
    )
    campaign = Campaign(dataset_source(rig, tmp_path / "d.toml", Sequences(2, 0.02, SequenceTruth())))
    with pytest.raises(CampaignStopped, match="its writer was killed"):
        run_row(campaign, 0, Place(tmp_path), lambda session: None)
    assert list((tmp_path / "sequences").iterdir()) == []


def test_files_of_others_stay_as_they_are(rig, tmp_path, json_of):
    (tmp_path / "README.md").write_text("mine")
    assert "has other files" in json_of(2, "dataset", rig, "--out", tmp_path)["error"]
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


def test_of_each_shipped_rig_there_is_a_data_set_or_a_reason(tmp_path):
    refused = {}
    for name in shipped_rigs():
        try:
            Campaign(dataset_source(name, tmp_path / "d.toml", Sequences(2, 0.1, SequenceTruth())))
        except evstim.CampaignError as error:
            refused[name] = str(error)
    assert set(refused) == {"can-demo", "stars-stereo", "stars-two-families"}
    assert all("one camera and no link" in reason for reason in refused.values())


VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text(),
    lambda values: st.lists(values, max_size=3) | st.dictionaries(st.text(), values, max_size=3),
)


@given(VALUES)
def test_values_on_one_line_of_toml_are_read_as_they_were(value):
    line = f"value = {toml_value(value)}"
    assert "\n" not in line
    assert tomllib.loads(line) == {"value": value}


def test_what_the_page_varies_can_vary():
    page = Path(__file__).parents[3] / "docs/datasets.md"
    vary = tomllib.loads(page.read_text().partition("```toml\n")[2].partition("```")[0])
    campaign = Campaign(dataset_source("rendezvous", Path("d.toml"), Sequences(16, 0.1, SequenceTruth(), vary=vary)))
    rigs = [campaign.rig(k) for k in range(16)]
    assert len({rig.camera.sensor.noise for rig in rigs}) == 2
    for value in ("threshold_on", "corner_max_hz", "temperature"):
        assert len({getattr(rig.camera.sensor, value) for rig in rigs}) == 16


@pytest.mark.parametrize("key", ["rig", "count", "seed", "record", "program", "truth"])
def test_what_varies_cannot_replace_the_data_set(rig, key):
    with pytest.raises(evstim.CampaignError, match=f"vary: {key}: .*the data set itself gives it"):
        evstim.dataset(rig, 2, vary={key: 1})


GIVEN, IDLE = "the data set itself gives it", "a data set has no links, clocks and verdicts; remove it"
OWN_SEED = "each run has a seed of its own"
VARIED = [
    ("[set]\nlinks = [{ kind = 'file', path = 'leak.raw' }]", "line 2: set.links: it has no effect", IDLE),
    ("[[set.links]]\nkind = 'file'\npath = 'leak.raw'", "v.toml: set.links", IDLE),
    ("[[parameters]]\nkey = 'links'\nkind = 'list'\nvalues = [[{kind = 'loopback'}]]", "line 2: parameters", IDLE),
    ("[[parameters]]\nkey = 'faults[0].rate'\nkind = 'list'\nvalues = [1e-3]", "line 2: parameters", IDLE),
    ("[[parameters]]\nkey='scene.bright'\nalso=['camera.clock.ppm']\nkind='list'\nvalues=[1]", "parameters", IDLE),
    ("[set.camera.clock]\noffset_ppm = 20.0", "line 2: set.camera.clock.offset_ppm", IDLE),
    ("[set.camera]\nserial = '1'", "line 2: set.camera.serial", IDLE),
    ("[set.trigger]\nperiod_ms = 1.0", "set.trigger.period_ms", IDLE),
    ("[set.verdict]\nmin_rate_hz = 5.0", "set.verdict.min_rate_hz", IDLE),
    ("set.run.max_late_ms = 3.0", "line 1: set.run.max_late_ms", IDLE),
    ("title = 'mine'", "line 1: title", IDLE),
    ("min_success = 0.5", "line 1: min_success", IDLE),
    ("success = ['verdict']", "success", IDLE),
    ("[report]\nworst = 'margin'", "report", IDLE),
    ("seed = 5", "line 1: seed", GIVEN),
    ("set.run.seconds = 2.0", "set.run.seconds", GIVEN),
    ("set.run.pace = 'realtime'", "set.run.pace", GIVEN),
    ("[[parameters]]\nkey = 'run.seconds'\nkind = 'uniform'\nlow = 1\nhigh = 2", "line 2: parameters", GIVEN),
    ("[[parameters]]\nkey = 'run'\nkind = 'list'\nvalues = [{ seconds = 9.0 }]", "line 2: parameters", GIVEN),
    ("set.run.seed = 3", "line 1: set.run.seed", OWN_SEED),
    ("[[parameters]]\nkey = 'run.seed'\nkind = 'list'\nvalues = [1, 2]", "line 2: parameters", OWN_SEED),
    ("set = 3", "line 1: set: expected a table", "got 3"),
    ("sampling = 'grid'", "--count: count is for samples", "a grid has as many points"),
    ("set.run.step_us = 60000", "--rate: 20 needs run.step_us of at most 50000", ""),
    (
        "[[parameters]]\nkey = 'scene.sun.direction[0]'\nkind = 'uniform'\nlow = 2\nhigh = 1",
        "line 4: parameters",
        "low",
    ),
]


@pytest.mark.parametrize(("text", "place", "reason"), VARIED)
def test_what_has_no_effect_on_a_data_set_is_refused_where_it_stands(rig, tmp_path, capsys, text, place, reason):
    (tmp_path / "v.toml").write_text(text + "\n")
    options = ["--vary", str(tmp_path / "v.toml"), "--count", "2", "--json"]
    assert _main(["dataset", str(rig), "--out", str(tmp_path / "data"), *options]) == 2
    error = json.loads(capsys.readouterr().out.splitlines()[-1])["error"]
    assert place in error
    assert reason in error
    assert "dataset.toml" not in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["v.toml"]


def test_a_grid_has_its_own_number_of_sequences(rig):
    law = {"key": "camera.sensor.threshold_on", "kind": "list", "values": [0.1, 0.2, 0.3]}
    vary = {"sampling": "grid", "repeats": 2, "parameters": [law]}
    assert len(evstim.dataset(rig, None, vary=vary)) == 6
    assert len(evstim.dataset(rig, None)) == 100
    with pytest.raises(evstim.CampaignError, match="--count"):
        evstim.dataset(rig, 5, vary=vary)


def test_truth_of_a_high_rate_has_a_step_that_is_short_enough(rig):
    (sequence,) = evstim.dataset(rig, 1, seconds=0.01, truth=["flow"], rate_hz=3000.0)
    assert len(sequence.arrays["pictures/t"]) == 31
