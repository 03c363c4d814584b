"""The command line as a user meets it: exit codes, JSON, and messages that say what to do."""

import json
import re
import socket
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from emulator.cli import doctor
from emulator.cli.app import _main
from emulator.cli.verbs import VERBS
from emulator.run.trial import Trial
from emulator.scene.bodies.mesh import load_mesh
from firmware_protocol.events import EVENT
from transports.link.deliveries import digest_of
from transports.needs import Finding

DEMO = """
[scene]
kind = "checkerboard"
speed_px_s = 10.0
[run]
step_us = 5000
max_late_ms = 0
[[links]]
kind = "usbip"
"""


def last_json(text):
    return json.loads(text.strip().splitlines()[-1])


@pytest.fixture
def rig(tmp_path):
    """A small rig that runs anywhere: a slow board on few pixels, read back by the loopback host."""
    path = tmp_path / "small.toml"
    path.write_text(
        '[scene]\nkind = "checkerboard"\nspeed_px_s = 20.0\n'
        "[camera.sensor]\nwidth = 64\nheight = 48\n"
        '[run]\nstep_us = 2000\nseconds = 0.2\nmax_late_ms = 0\n[[links]]\nkind = "loopback"\n'
    )
    return path


@pytest.mark.parametrize(("is_json", "noted"), [(False, ["serial"]), (True, [])])
def test_the_first_notes_of_a_run_show_which_lines_are_too_slow(is_json, noted, rig, capsys):
    """A line of 9600 baud carries few of the events of a fast board; one of 200 Mbit/s carries all."""
    links = '[[links]]\nkind = "serial"\nbaud = 9600\n[[links]]\nkind = "udp_packets"\ncommand_port = 0\n'
    text = rig.read_text().replace("20.0", "200.0").replace('[[links]]\nkind = "loopback"\n', links)
    rig.write_text(text)
    _main(["run", str(rig), "--pace", "free", "--seconds", "0.01", *(["--json"] if is_json else [])])
    printed = "".join(capsys.readouterr()).replace("\n", " ")
    assert re.findall(r"link (\w+): its line carries about \d+ events/s, 0\.\d+ % of the \d+ that", printed) == noted


def test_every_command_loads_and_has_help(capsys):
    assert _main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name in VERBS:
        assert f"\n  {name}: " in shown
        assert _main([name, "--help"]) == 0
        assert f"evstim {name}" in capsys.readouterr().out


def test_without_arguments_five_tasks_are_shown_and_each_is_a_command(capsys):
    assert _main([]) == 0
    shown = capsys.readouterr().out
    tasks = [line.split() for line in shown.splitlines() if line.startswith("  evstim ")]
    assert len(tasks) == 5
    assert {task[1] for task in tasks} <= set(VERBS)
    assert "evstim --help" in shown


def test_rigs_and_their_json(json_of):
    rigs = json_of(0, "rigs")["rigs"]
    assert {"checkerboard", "eros", "loopback"} <= {rig["name"] for rig in rigs}


@pytest.mark.parametrize("name", ["checkerboard", "eros", "loopback"])
def test_shipped_rigs_are_good(name, json_of):
    assert json_of(0, "check", name)["good"] is True


def test_the_schema_is_json(capsys):
    assert _main(["schema"]) == 0
    assert last_json(capsys.readouterr().out)["title"] == "evstim rig"


def test_doctor_names_a_fix_for_everything_that_is_missing(json_of):
    findings = json_of(0, "doctor")["findings"]
    assert {"EGL", "usbip", "vhci-hcd", "UDC", "vcan", "USB permission"} <= {f["name"] for f in findings}
    assert {"pillow", "av", "faery", "matplotlib"} <= {f["name"] for f in findings}
    assert all(f["good"] or f["fix"] for f in findings)


def finding(name, fix=None):
    return Finding(name, detail=f"version of {name}", needed_for="a test", fix=fix)


def test_doctor_is_short_where_all_is_well_and_names_what_is_missing(monkeypatch, capsys):
    parts = [finding(f"part{k}") for k in range(25)]
    monkeypatch.setattr(doctor, "examine", lambda: parts)
    assert _main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) <= 5
    assert shown.startswith("there: part0")
    assert "nothing is missing" in shown
    assert all(part.name in shown for part in parts)
    parts.append(finding("vcan", fix="modprobe vcan"))
    assert _main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert " no vcan" in shown
    assert "fix: modprobe vcan" in shown
    assert "nothing is missing" not in shown
    assert shown.index("there:") < shown.index("`evstim run eros`") < shown.index("missing, each") < shown.index(" no ")
    assert _main(["doctor", "--all"]) == 0
    shown = capsys.readouterr().out
    assert all(part.detail in shown for part in parts)


@pytest.mark.system
def test_doctor_prepares_the_relief_of_a_rig(monkeypatch, tmp_path):
    prepared = []
    monkeypatch.setattr(doctor, "prepared", prepared.append)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _main(["doctor", "--prepare", "eros"]) == 0
    assert len(prepared) == 1
    assert list((tmp_path / "evstim").glob("detail-*.npy"))


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("step_us", [20_000, 1])
def test_doctor_tells_whether_a_rig_runs_in_real_time(step_us, rig, capsys):
    rig.write_text(rig.read_text().replace("step_us = 2000", f"step_us = {step_us}"))
    code = _main(["doctor", str(rig), "--json"])
    told = last_json(capsys.readouterr().out)
    in_real_time = told["times_real_time"] > 1
    assert told["real_time"] is in_real_time
    assert code == (0 if in_real_time else 1)
    assert step_us > 1 or not in_real_time  # no machine makes a million steps a second
    assert told["expected"]["pixels_s"] > 0


def test_a_verdict_has_the_speed_and_what_would_mend_it(rig, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "trial", lambda *_: Trial(1e-3, 3e-3, 1e-3))
    assert _main(["doctor", str(rig)]) == 1
    sentence = capsys.readouterr().out.splitlines()[-1]
    assert sentence.startswith(f"{rig.stem} does NOT run in real time on this machine: 0.25 times real time in a trial")
    assert sentence.endswith(f"`evstim tune {rig}` shows what would")


def test_an_interrupt_within_a_kernel_is_one(rig, monkeypatch, capsys):
    """Numba raises SystemError in its place."""

    def interrupted(*_):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(doctor, "trial", interrupted)
    monkeypatch.setattr("emulator.cli.app.ignore_stop_signals", lambda: None)
    assert _main(["doctor", str(rig)]) == 1
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["bogus"],
        ["run"],
        ["run", "nosuch"],
        ["run", "loopback", "--pace", "fast"],
        ["run", "loopback", "--seconds", "-1"],
        ["run", "loopback", "--record", "/no/such/folder/x.npz"],
        ["bench", "--only", "nosuch"],
        ["demo", "loopback"],
        ["listen", "--usbip", "here"],
    ],
)
def test_wrong_use_is_exit_code_2_and_one_json_object(arguments, json_of):
    told = json_of(2, *arguments)
    assert told["exit_code"] == 2
    assert told["error"]


@pytest.mark.parametrize("shape", ["nosuch", "broken.tab"])
def test_a_shape_that_cannot_be_used_is_the_rigs_fault(shape, tmp_path, json_of):
    (tmp_path / "broken.tab").write_text("v 0 0 0\nv 1 0 0\nv nan 1 0\nf 0 1 2\n")
    path = tmp_path / "rock.toml"
    path.write_text(f'[scene]\nkind = "bodies"\n[[scene.bodies]]\nshape = "{shape}"\n')
    assert shape in json_of(2, "check", path, "--draw")["error"]


def test_a_method_that_lacks_an_effect_is_the_rigs_fault(rig, json_of):
    text = rig.read_text().replace("[camera.sensor]", '[camera.sensor]\nphotoreceptor = "circuit"\nhighpass_hz = 1.0')
    rig.write_text(text)
    assert "evstim's own pixels" in json_of(2, "run", rig)["error"]


def test_a_picture_shows_what_the_rig_models(rig, tmp_path, json_of):
    noisy = tmp_path / "noisy.toml"
    noisy.write_text(rig.read_text().replace("height = 48\n", "height = 48\nleak_hz = 50.0\n"))
    counts = []
    for path in (rig, noisy):
        counts.append(json_of(0, "picture", path, tmp_path / "a.png", "--at-s", "0.1")["events"])
    assert counts[1] > 2 * counts[0]


@pytest.mark.system
def test_without_gl_everything_runs_and_who_asks_for_gl_is_told_the_packages(rig, json_of, monkeypatch):
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "libEGL_absent.so.1")
    assert _main(["check", "eros", "--draw", "--json"]) == 0
    assert _main(["run", str(rig), "--pace", "free"]) == 0
    monkeypatch.setenv("EVSTIM_RENDERER", "llvmpipe")
    assert "apt install libegl1 libgl1 libgl1-mesa-dri" in json_of(3, "check", "eros", "--draw")["error"]


def test_a_camera_that_is_not_there_is_exit_code_3(json_of):
    assert json_of(3, "listen", "--usbip", "127.0.0.1:9")["exit_code"] == 3


@pytest.mark.system
def test_a_run_tells_where_every_event_went(rig, tmp_path, json_of):
    record = tmp_path / "delivered.npz"
    told = json_of(0, "run", rig, "--record", record, "--pace", "free")
    assert {
        "rig", "sim_seconds", "wall_seconds", "frames", "steps", "events", "balanced", "latency_us", "lateness",
    } <= set(told)  # fmt: skip
    events = told["events"]
    link = events["links"]["loopback"]
    assert told["balanced"] is True
    assert told["sim_seconds"] == pytest.approx(0.2)
    assert told["steps"] == 100
    assert events["raised"] == events["lost_in_pixel"] + events["lost_at_readout"] + events["read_out"]
    assert events["read_out"] == link["delivered"] + link["dropped"] + link["dropped_in_device"]
    assert link["delivered"] > 100
    assert told["links"]["loopback"]["error"] is None
    with np.load(record) as file:
        assert file["events"].dtype == EVENT
        assert len(file["events"]) == link["delivered"]
        assert digest_of(file["events"]) == told["links"]["loopback"]["digest"]


@pytest.mark.system
def test_the_same_run_again_gives_the_same_events(rig, tmp_path):
    digests = {}
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        record = tmp_path / f"{name}.npz"
        assert _main(["run", str(rig), "--seed", str(seed), "--pace", "free", "--record", str(record)]) == 0
        with np.load(record) as file:
            digests[name] = file["events"].tobytes()
    assert digests["a"] == digests["b"] != digests["c"]


def test_a_port_that_is_taken_is_told_with_the_cure(rig, tmp_path, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        text = rig.read_text().replace("width = 64\nheight = 48\n", "").replace('"loopback"', f'"usbip"\nport = {port}')
        path = tmp_path / "taken.toml"
        path.write_text(text)
        assert _main(["run", str(path), "--json"]) == 3
    assert "another port" in last_json(capsys.readouterr().out)["error"]


@pytest.mark.system
@pytest.mark.socket
def test_the_demo_compares_every_event(tmp_path, capsys):
    path = tmp_path / "demo.toml"
    path.write_text(DEMO)
    out = tmp_path / "out"
    code = _main(["demo", str(path), "--seconds", "1.5", "--report", str(out), "--json"])
    printed = capsys.readouterr().out
    told = last_json(printed)
    assert code == 0, told
    assert told["good"] is True
    assert told["comparison"]["equal"] is True
    assert told["comparison"]["received"] > 1000
    assert f"report: {out / 'report.html'}" in printed
    assert f"movie: {out / 'received.gif'}, " in printed
    assert (told["movie"], told["report"]) == (str(out / "received.gif"), str(out))
    assert json.loads((out / "report.json").read_text())["verdict"] == "good"
    with Image.open(out / "received.gif") as movie:
        assert 2 <= movie.n_frames <= 22  # few on a machine that is late
        movie.seek(movie.n_frames - 1)
        colours = set(map(tuple, np.asarray(movie.convert("RGB")).reshape(-1, 3)))
    assert {(230, 159, 0), (86, 180, 233)} <= colours  # ON and OFF events


@pytest.mark.long
@pytest.mark.system
@pytest.mark.socket
def test_a_demo_without_pillow_has_no_movie_and_is_good(tmp_path, capsys, monkeypatch):
    (tmp_path / "demo.toml").write_text(DEMO)
    monkeypatch.setitem(sys.modules, "PIL", None)  # importing it raises ImportError
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    command = ["demo", str(tmp_path / "demo.toml"), "--seconds", "0.5", "--report", str(tmp_path / "out"), "--json"]
    assert _main(command) == 0
    printed = capsys.readouterr().out
    assert "no movie of the received events: writing .gif needs pillow: pip install" in printed
    assert last_json(printed)["movie"] is None


@pytest.mark.long
@pytest.mark.system
def test_modules_in_the_users_folder_are_not_taken_for_libraries(tmp_path, monkeypatch, capsys):
    for name in ("json", "attr", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not the library')")
    trimesh.creation.icosphere(1).export(tmp_path / "ball.stl")
    (tmp_path / "demo.toml").write_text(DEMO)
    monkeypatch.chdir(tmp_path)
    assert _main(["demo", "demo.toml", "--seconds", "0.5", "--report", "out", "--json"]) == 0, capsys.readouterr().out
    assert len(load_mesh(tmp_path / "ball.stl").faces) == 80
