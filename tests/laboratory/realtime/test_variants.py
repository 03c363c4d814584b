"""Variants of rigs: every shipped one loads at both sizes, and a rig file is written as it is read."""

import dataclasses
import math

import pytest

from emulator.rig.loading import find_rig, load_rig, parse_rig, read_rig, shipped_rigs
from emulator.sensor.presets import PRESETS
from emulator.tables.toml_text import read_toml, toml_of
from laboratory.realtime.variants import SHIPPED, SIZES, Setting, distinct, variant_of
from laboratory.realtime.wrong_events import middle_of


@pytest.mark.parametrize("path", shipped_rigs().values(), ids=lambda path: path.stem)
def test_toml_is_read_as_it_is_written(path):
    tables = read_toml(path.read_text())
    assert read_toml(toml_of(tables)) == tables


def test_all_values_of_toml_are_written():
    tables = {
        "a b": 'quote " back \\ line\nunit µ 😀 \x7f',
        "x": {"yes": True, "no": False, "n": -3, "tiny": 1e-9, "huge": 1e300, "inf": math.inf},
        "list": [[1.5, 2.5], [{"k": "v"}], []],
    }
    assert read_toml(toml_of(tables)) == tables


@pytest.mark.parametrize("size", SIZES, ids=lambda size: size.name)
@pytest.mark.parametrize("name", [*distinct(shipped_rigs())][::4])
def test_every_rig_has_both_sizes_and_its_own_scene(name, size):
    variant, own = variant_of(name, size), load_rig(name)
    rig = parse_rig(variant.text(4321), "file.toml", name)
    assert "x".join(map(str, rig.camera.size)) == size.name
    assert rig.scene == own.scene
    assert rig.camera.lens == own.camera.lens
    stated = read_toml(read_rig(find_rig(name)))["camera"].get("sensor", {}).get("temperature", {})
    of_model = PRESETS[{"346x260": "davis346", "1280x720": "imx636"}[size.name]].temperature
    assert rig.camera.sensor.temperature == dataclasses.replace(of_model, **stated)
    assert (rig.run.step_us, rig.run.method, rig.run.seed) == (own.run.step_us, own.run.method, own.run.seed)
    assert [(link.kind, link.port) for link in rig.links] == [("usbip", 4321)]


def test_a_setting_changes_its_key_alone():
    shipped = variant_of("eros", SIZES[0])
    step_us = shipped.loaded().run.step_us
    changed = shipped.changed(Setting("half", {("run", "step_us"): step_us // 2}))
    assert changed.loaded().run == dataclasses.replace(shipped.loaded().run, step_us=step_us // 2)
    assert changed.loaded().scene == shipped.loaded().scene
    assert shipped.loaded().run.step_us == step_us
    assert shipped.setting == SHIPPED


def test_the_middle_of_a_large_sensor_has_its_focal_length():
    whole = variant_of("eros", SIZES[1]).loaded()
    middle = middle_of(whole)
    assert middle.camera.size == (346, 260)
    focal = [r.camera.size[0] / math.tan(math.radians(r.camera.lens.field_of_view_deg) / 2) for r in (whole, middle)]
    assert focal[0] == pytest.approx(focal[1])
    assert middle_of(variant_of("eros", SIZES[0]).loaded()).camera.lens.field_of_view_deg == pytest.approx(21.0)
