"""`evstim tune`: the table of rungs, the choice, the file of the chosen rig, and what is refused."""

import json
import re

import pytest

from emulator.cli import tune as module
from emulator.cli.app import _main
from emulator.rig.loading import load_rig
from emulator.run.tuning import Rung

RIG = """\
[scene]
kind = "bodies"
[[scene.bodies]]
shape = "eros022540"
[run]
step_us = 5000
[[links]]
kind = "loopback"
"""


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rock.toml"
    path.write_text(RIG)
    return path


@pytest.fixture(autouse=True)
def climbed(monkeypatch):
    """Rungs that are (1 + rung) / 4 times real time, twice as much with half the sides; `stop` interrupts one."""
    seen = {"stop": None, "rigs": []}

    class Fake:
        def __init__(self, rig):
            self.width = rig.camera.size[0]
            seen["rigs"].append(self.width)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def climb(self, rig):
            if rig.run.quality == seen["stop"]:
                raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
            factor = (1 + rig.run.quality) / 4 * (346 / self.width)
            return Rung(factor + 0.1, factor, 10.0, rig.run.quality / 100, 200.0)

    monkeypatch.setattr(module, "Ladder", Fake)
    monkeypatch.setattr(module, "prepared", lambda _: None)
    return seen


def result_of(capsys, code, *arguments):
    assert _main(["tune", *map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_the_best_rung_is_the_most_accurate_that_is_fast_enough(rig, capsys):
    result = result_of(capsys, 0, rig, "--at-least", "1.2")
    assert result["best"] == 4
    assert [row["keys"]["run.drawing_us"] for row in result["rungs"]] == [5000, 10_000, 20_000, 20_000, 30_000, 40_000]
    assert _main(["tune", str(rig), "--at-least", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["rung", "leaves", "out"]
    assert " ".join(lines[2].split()) == "1 1 of 2 exact drawings 0.60 0.50 10 ms 1.00% 200 MiB"
    assert lines[-1] == "best: run.quality = 1"


def test_where_none_is_fast_enough_the_nearest_and_other_ways_are_shown(rig, capsys, climbed):
    assert _main(["tune", str(rig), "--at-least", "2.5"]) == 1
    lines = capsys.readouterr().out.splitlines()[-3:]
    assert lines[0] == "none reaches 2.5: the nearest is rung 5 with 1.50 times real time"
    assert lines[1] == "or, there, a sensor of 173x130 pixels: 3.00 times real time"
    assert lines[2] == "or lockstep, in step with a bus: 0.67 s for a second of the stream"
    assert climbed["rigs"] == [346, 173]


@pytest.mark.parametrize("given", ["", "quality = 0\n"])
def test_the_chosen_rig_is_written_as_the_rig_with_its_rung(given, rig, tmp_path, capsys):
    rig.write_text(RIG.replace("step_us = 5000\n", f"step_us = 5000\n{given}"))
    out = tmp_path / "fast.toml"
    keys = ("--set", "run.step_us=8000", "--set", "camera.serial=00000009", "--set", "verdict.max_drop=0.5")
    result_of(capsys, 0, rig, "--out", out, *keys)
    written = load_rig(str(out))
    assert (written.run.quality, written.run.step_us, written.run.drawing_us) == (5, 8000, 64_000)
    assert (written.camera.serial, written.verdict.max_drop) == ("00000009", 0.5)


def test_a_rung_that_a_key_of_the_rig_excludes_is_not_tried(rig, capsys):
    result = result_of(capsys, 1, rig, "--set", "run.drawing_us=10000")
    assert [row["measured"] is not None for row in result["rungs"]] == [False, True, False, False, False, False]
    assert "run.quality = 5 stands for run.drawing_us = 40000" in result["rungs"][5]["refused"]
    assert "drawing_us" in result_of(capsys, 2, rig, "--set", "run.drawing_us=7000")["error"]


def test_an_interrupt_ends_with_what_is_known(rig, capsys, climbed):
    climbed["stop"] = 2
    result = result_of(capsys, 1, rig)
    assert result["interrupted"]
    assert [row["measured"] is not None for row in result["rungs"]] == [True, True, False, False, False, False]
    climbed["stop"] = 0
    assert result_of(capsys, 1, rig)["error"] == "interrupted"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--at-least", "0"], "--at-least"),
        (["--at-least", "nan"], "--at-least"),
        (["--out", "x.json"], ".toml"),
        (["--set", "run.quality=3"], "all rungs are tried"),
        (["--set", "run.quality"], "KEY=VALUE"),
        (["--set", "run..x=3"], "key must be like"),
        (["--set", "run.step_us=-3"], "step_us"),
        (["--set", "links[4].port=3"], "links[4]"),
        (["--set", "run.nosuch=3"], "nosuch"),
    ],
)
def test_wrong_use(options, reason, rig, capsys):
    assert reason in result_of(capsys, 2, rig, *options)["error"]


def test_poses_from_outside_cannot_be_tuned(rig, capsys):
    rig.write_text(RIG.replace("[run]", '[scene.bodies.path]\nkind = "live"\n[run]'))
    assert "from outside" in result_of(capsys, 2, rig)["error"]


def test_a_plan_shows_the_keys_of_the_rung_and_its_wrong_events(tmp_path, capsys):
    path = tmp_path / "rock.toml"
    scene = '[scene]\nkind = "bodies"\n[scene.camera]\nkind = "fixed"\nposition_m = [0.0, 0.0, -90.0]\n'
    body = '[[scene.bodies]]\nshape = "eros022540"\n[scene.bodies.path]\nkind = "spin"\nspin_deg_s = 6.0\n'
    camera = "[camera]\nsensor = {width = 64, height = 48}\nlens = {field_of_view_deg = 21.0, f_number = 5.0}\n"
    path.write_text(f"{scene}{body}{camera}[run]\nstep_us = 40000\nseconds = 5.0\nquality = 5\n")
    assert _main(["plan", str(path), "--json"]) == 0
    rung = json.loads(capsys.readouterr().out.splitlines()[-1])["rung"]
    assert rung["keys"]["run.drawing_us"] == 320_000
    assert 0 < rung["wrong_share"] < 1
    assert _main(["plan", str(path)]) == 0
    shown = capsys.readouterr().out
    line = next(line for line in shown.splitlines() if line.startswith("quality"))
    assert line.startswith("quality  5: run.drawing_us = 320000 and camera.sensor.noise.grade = 'offsets'; ")
    assert re.search(rf"; leaves out {rung['left_out']}; \d+\.\d\d% of the events of the light wrong here$", line)
