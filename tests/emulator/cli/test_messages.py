"""Messages of the command line: the value at fault, its place, and what to do."""

import dataclasses
import sys

import numpy as np
import pytest

from emulator.cli.app import _main, app
from emulator.cli.output import status
from emulator.cli.picture import PictureOptions, looks
from emulator.rig.loading import load_rig, parse_rig
from emulator.rig.remarks import remarks
from firmware_protocol.events import EVENT

BOARD = '[scene]\nkind = "checkerboard"\n'
NO_NOISE = '[camera]\nmodel = "ideal"\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[camera.sensor]\nwidth = "wide"\n', ["line 4", "camera.sensor.width", "'wide'"]),
        ("[run]\nstep_us = 1.5\n", ["line 4", "run.step_us", "1.5"]),
        ('[run]\npace = "fast"\n', ["run.pace", "'fast'"]),
        ("[run]\nseed = 1\nseed = 2\n", ["line 5: run.seed is given twice, first in line 4: leave one out"]),
        ("[run]\n[scene]\n", ["line 4: [scene] is given twice, first in line 1: put its keys under one header"]),
    ],
)
def test_a_wrong_value_is_shown(text, words, tmp_path, json_of):
    path = tmp_path / "wrong.toml"
    path.write_text(BOARD + text)
    error = json_of(2, "check", path)["error"]
    assert [word for word in words if word not in error] == []


def test_a_rig_that_is_not_utf8_is_told_by_line(tmp_path, json_of):
    path = tmp_path / "latin.toml"
    path.write_bytes(BOARD.encode() + b"# caf\xe9\n")
    error = json_of(2, "check", path)["error"]
    assert "line 3" in error
    assert "0xe9" in error
    assert "save the file as UTF-8" in error


@pytest.mark.parametrize("verb", [[], ["report"], ["again"]])
def test_a_campaign_file_that_is_not_there_is_told_before_a_package_that_is_not(verb, tmp_path, json_of, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # importing it raises ImportError
    missing = tmp_path / "speed.toml"
    error = json_of(2, "campaign", *verb, missing, *(["0"] if verb == ["again"] else []))["error"]
    assert error == f"{missing}: no such file: give the path of a campaign file (docs/campaigns.md has one)"
    missing.write_text('rig = "loopback"\ncount = 1\n')
    assert (
        "campaigns need pyarrow"
        in json_of(3, "campaign", *verb, missing, *(["0"] if verb == ["again"] else []))["error"]
    )


def test_a_folder_is_no_rig(tmp_path, json_of):
    assert "is a folder" in json_of(2, "check", tmp_path)["error"]


def test_an_unknown_camera_is_answered_with_the_presets(tmp_path, json_of):
    assert (
        "davis346, davis346_noisy, davis240c, dvxplorer_micro, imx636"
        in json_of(2, "characterise", "nope", "--out", tmp_path / "out")["error"]
    )


@pytest.mark.parametrize(("threshold", "count"), [(0.3, 0), (2.0, 0), (2.5, 1)])
def test_a_threshold_that_no_sensor_has_is_questioned(threshold, count):
    rig = parse_rig(f"{BOARD}[camera.sensor]\nthreshold_on = {threshold}\n", "r.toml", "r")
    assert len(remarks(rig)) == count


def flight(tmp_path, seconds, table="t.csv"):
    (tmp_path / "t.csv").write_text("t_s,x_m,y_m,z_m\n0,0,0,-9000\n1,0,5,-9000\n")
    path = tmp_path / "flight.toml"
    path.write_text(
        f'[scene]\nkind = "bodies"\n[scene.camera]\nkind = "file"\npath = "{table}"\nlook_at_m = [0, 0, 0]\n'
        f'[[scene.bodies]]\nshape = "eros007790"\n[run]\nseconds = {seconds}\n'
    )
    return path


@pytest.mark.parametrize(("seconds", "notes"), [(1.0, 0), (5.0, 1)])
def test_a_trajectory_shorter_than_the_run_is_told(seconds, notes, tmp_path, json_of):
    told = json_of(0, "check", flight(tmp_path, seconds))["notes"]
    assert len(told) == notes
    assert all("ends after 1 s" in note for note in told)


def test_check_opens_the_files_that_a_rig_names(tmp_path, json_of):
    error = json_of(2, "check", flight(tmp_path, 1.0, "gone.csv"))["error"]
    assert "scene.camera.path: gone.csv cannot be opened" in error
    (tmp_path / "t.csv").write_text("nonsense\n")
    path = flight(tmp_path, 1.0)
    (tmp_path / "t.csv").write_text("t_s,x_m\n0,0\n")
    assert "y_m, z_m is missing" in json_of(2, "check", path)["error"]


def test_the_plan_of_a_recording_has_no_nan(tmp_path, capsys):
    np.savez(tmp_path / "r.npz", events=np.zeros(1, EVENT), resets=np.zeros(0, np.int64))
    path = tmp_path / "r.toml"
    path.write_text('[scene]\nkind = "recording"\npath = "r.npz"\n')
    for options in ([], ["--json"]):
        assert _main(["plan", str(path), *options]) == 0
        told = capsys.readouterr().out
        assert "nan" not in told.lower().split()
        assert "plays events that exist already" in told


def test_quiet_leaves_the_result_and_the_errors(capfd):
    try:
        assert _main(["rigs", "--quiet"]) == 0
        assert "checkerboard" in capfd.readouterr().out
        assert _main(["check", "nosuch", "--quiet"]) == 2
        assert "nosuch" in capfd.readouterr().err
    finally:
        status.quiet = False


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_can_complete_the_verbs(shell):
    assert "characterise" in app.generate_completion(prog_name="evstim", shell=shell)


@pytest.fixture
def board(tmp_path):
    path = tmp_path / "board.toml"
    path.write_text(BOARD + "speed_px_s = 20.0\n[camera.sensor]\nwidth = 64\nheight = 48\n[run]\nstep_us = 2000\n")
    return path


def test_a_picture_looks_back_until_there_is_something_to_see(board, tmp_path, json_of):
    slow = tmp_path / "slow.toml"
    slow.write_text(board.read_text().replace("20.0", "0.1").replace("[camera.sensor]", NO_NOISE + "[camera.sensor]"))
    counts = []
    for options in (["--window-ms", "20"], []):
        counts.append(json_of(0, "picture", slow, tmp_path / "a.png", "--at-s", "1.0", *options)["events"])
    assert counts[1] > counts[0]
    assert counts[1] >= 0.005 * 64 * 48


def test_a_movie_has_25_pictures_a_second(board, tmp_path, json_of):
    from PIL import Image

    path = tmp_path / "a.gif"
    assert json_of(0, "picture", board, path, "--at-s", "0.1", "--seconds", "0.4")["events"] > 0
    with Image.open(path) as image:
        assert image.n_frames == 11  # both ends
        assert image.size == (128, 48 * 2 + 18)


def test_a_picture_of_another_format_is_refused(board, tmp_path, json_of):
    assert ".png, .gif or .mp4" in json_of(2, "picture", board, tmp_path / "a.jpg")["error"]


def test_a_window_shorter_than_a_step_has_its_events():
    """Steps are counted back from the picture: the last one ends with it."""
    rig = load_rig("loopback")
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, step_us=40_000))
    *_, events = next(looks(rig, PictureOptions(0.25, seconds=0.0), 10.0))
    assert len(events) > 100
    assert 240_000 <= events["t"].min() <= events["t"].max() <= 250_000
