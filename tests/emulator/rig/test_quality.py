"""Rungs of a rig: the keys that `run.quality` stands for, and the refusal of other values of them."""

import dataclasses

import pytest

from emulator.rig.loading import RigError, parse_rig, second_rig, shipped_rigs
from emulator.rig.quality import RUNGS, described, rung_keys

BODIES = '[scene]\nkind = "bodies"\n[[scene.bodies]]\nshape = "eros022540"\n[run]\nstep_us = 5000\nquality = {}\n'


def made(quality, more=""):
    return parse_rig(BODIES.format(quality) + more, "my.toml", "my")


@pytest.mark.parametrize("quality", RUNGS)
def test_a_rung_is_a_set_of_keys_that_a_rig_can_also_give(quality):
    by_rung = made(quality)
    given = {path[-1]: value for path, value in rung_keys(quality, "bodies", 5000).items()}
    assert by_rung.run.drawing_us == given["drawing_us"] == (1, 2, 4, 4, 6, 8)[quality] * 5000
    keys = f'drawing_us = {given["drawing_us"]}\n[camera.sensor.noise]\ngrade = "{given["grade"]}"\n'
    alone = made(-1, keys)
    assert dataclasses.replace(by_rung.run, quality=-1) == alone.run
    assert by_rung.camera == alone.camera
    assert made(quality, keys) == by_rung
    assert bool(described(quality, by_rung)["left_out"]) is (quality > 0)


def test_without_a_rung_each_key_is_as_the_rig_gives_it():
    assert (made(-1).run.drawing_us, made(-1).camera.sensor.noise.grade) == (0, "passages")
    assert made(3, "[camera.sensor]\nleak_hz = 0.0\n").camera.sensor.noise.grade == "offsets"
    assert "drawing_us" not in {path[-1] for path in rung_keys(2, "stars", 5000)}


@pytest.mark.parametrize("quality", ["6", "-2", "1.0", '"auto"', "true", "[1]", "{}"])
def test_a_rung_is_a_whole_number_of_the_ladder(quality):
    with pytest.raises(RigError, match="quality"):
        made(quality)


def test_a_rung_changes_no_value_that_a_rig_gives():
    with pytest.raises(RigError, match=r"line 7: run.quality: run.quality = 2 stands for .* = 20000, .* gives 5000"):
        made(2, "drawing_us = 5000\n")
    rig = made(2)
    with pytest.raises(ValueError, match=r"= 2 stands for run.drawing_us = 40000, and the rig gives 20000"):
        dataclasses.replace(rig, run=dataclasses.replace(rig.run, step_us=10_000))


@pytest.mark.parametrize("more", ["step_us = 1\n", "[camera]\nsensor = 3\n", "[camera.sensor]\nnoise = 3\n"])
def test_a_wrong_table_beside_a_rung_is_refused_as_without_one(more):
    with pytest.raises(RigError):
        made(3, more)


@pytest.mark.parametrize("quality", RUNGS)
def test_a_second_camera_stands_on_the_rung_of_the_first(quality):
    path = shipped_rigs()["stars-two-families"]
    text = path.read_text().replace("[run]", f"[run]\nquality = {quality}")
    rig = parse_rig(text, str(path), path.stem)
    second = second_rig(rig)
    assert second.camera.model != rig.camera.model
    assert second.run.quality == quality
    assert second.camera.sensor.noise.grade == rig.camera.sensor.noise.grade
