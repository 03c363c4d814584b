"""`evstim check` and the files that a rig names: their status first, what was read, and what was only opened."""

import io
import os
import zipfile

import numpy as np
import pytest

from emulator.cli.app import _main
from tests.made_events import events_at


def rig_of(tmp_path, file, kind="recording"):
    path = tmp_path / "r.toml"
    path.write_text(f'[scene]\nkind = "{kind}"\npath = "{file}"\n')
    return path


def pickled(path):
    np.savez(path, events=np.array([{}], dtype=object), resets=np.zeros(0, np.int64))


def bomb(path):
    member = io.BytesIO()
    np.lib.format.write_array(member, np.zeros(1 << 27, np.uint8))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.npy", member.getvalue())


@pytest.mark.timeout(120)  # a FIFO without a writer is waited for without end
@pytest.mark.parametrize("kind", ["recording", "video"])
@pytest.mark.parametrize("options", [[], ["--draw"]])
def test_a_fifo_is_no_regular_file(kind, options, tmp_path, json_of):
    os.mkfifo(tmp_path / "pipe.npz")
    told = json_of(2, "check", rig_of(tmp_path, tmp_path / "pipe.npz", kind), *options)
    assert "scene.path" in told["error"]
    assert "pipe.npz is no regular file" in told["error"]


@pytest.mark.parametrize(
    ("file", "words"),
    [("/dev/zero", "is no regular file"), ("empty.npz", "is empty"), ("gone.npz", "cannot be opened")],
)
def test_a_device_and_an_empty_file_are_refused(file, words, tmp_path, json_of):
    (tmp_path / "empty.npz").touch()
    assert words in json_of(2, "check", rig_of(tmp_path, tmp_path / file))["error"]


@pytest.mark.parametrize("make", [pickled, bomb])
def test_a_recording_that_is_only_opened_is_named_and_read_with_draw(make, tmp_path, capsys, json_of):
    file = tmp_path / "r.npz"
    make(file)
    rig = rig_of(tmp_path, "r.npz")
    told = json_of(0, "check", rig)
    assert told["files"] == [{"key": "scene.path", "path": str(file), "bytes": file.stat().st_size, "is_read": False}]
    assert _main(["check", str(rig)]) == 0
    out = capsys.readouterr().out
    assert f"opened, not read: scene.path ({file}, {file.stat().st_size} bytes)" in out
    assert "--draw" in out
    assert "r.npz" in json_of(2, "check", rig, "--draw")["error"]


def test_a_sound_recording_is_read_with_draw(tmp_path, json_of):
    events = events_at(np.arange(5))
    np.savez(tmp_path / "r.npz", events=events, resets=np.zeros(0, np.int64))
    told = json_of(0, "check", rig_of(tmp_path, "r.npz"), "--draw")
    assert [file["is_read"] for file in told["files"]] == [True]


def test_a_trajectory_is_read_always(tmp_path, json_of):
    (tmp_path / "t.csv").write_text("t_s,x_m,y_m,z_m\n0,0,0,-9000\n1,0,5,-9000\n")
    (tmp_path / "r.toml").write_text(
        '[scene]\nkind = "bodies"\n[scene.camera]\nkind = "file"\npath = "t.csv"\nlook_at_m = [0, 0, 0]\n'
        '[[scene.bodies]]\nshape = "eros007790"\n'
    )
    told = json_of(0, "check", tmp_path / "r.toml")
    assert {file["key"]: file["is_read"] for file in told["files"]} == {
        "scene.camera.path": True, "scene.bodies[0].shape": False,
    }  # fmt: skip
