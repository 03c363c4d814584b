"""The chart of drawn scenes: exact light against point samples, and what GL's samples cost."""

import dataclasses

import pytest

from emulator.rig.loading import load_rig
from laboratory.accuracy import rendering
from laboratory.accuracy.rendering import LADDER, SETTINGS, Setting, Stretch, fits, rendering_rows
from laboratory.verbs.accuracy import _rigs


def small(name):
    rig = load_rig(name)
    sensor = dataclasses.replace(rig.camera.sensor, width=64, height=48)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))


def rows(monkeypatch, *settings, steps=4):
    pytest.importorskip("embreex", reason="the ray caster of the reference")
    monkeypatch.setattr(rendering, "SETTINGS", settings)
    return {row.setting: row for row in rendering_rows([small("eros-flyover")], Stretch(steps=steps))}


@pytest.mark.system
def test_exact_light_and_its_rate_are_best(monkeypatch):
    """In steps four times as long: in one step so large pixels see little motion, and shadows hide errors of times."""
    by_setting = rows(monkeypatch, *(each for each in SETTINGS if each.name.endswith(", steps x 4")), steps=12)
    for row in by_setting.values():
        assert row.events > 200
        assert row.false + row.missed < 0.15
        assert row.ms > 0
    exact, line = by_setting.values()
    assert exact.t50_ms < line.t50_ms


@pytest.mark.long
@pytest.mark.system
@pytest.mark.gl
def test_few_samples_make_many_wrong_events(monkeypatch, gl):
    by_setting = rows(monkeypatch, Setting("1", 1, with_rate=False), Setting("4 x 4", 4, with_rate=False), SETTINGS[0])
    wrong = {name: row.false + row.missed for name, row in by_setting.items()}
    assert wrong["1"] > wrong["4 x 4"] > wrong[SETTINGS[0].name]


@pytest.mark.system
@pytest.mark.parametrize("name", ["eros-flyover", "malapert"])
def test_a_ladder_has_settings_that_differ_in_time_alone_beside_exact_drawings(name):
    rows = {row.setting: row for row in rendering_rows([small(name)], LADDER)}
    wrong = {setting: row.false + row.missed for setting, row in rows.items()}
    assert {"as shipped", "drawn each second step", "drawn each step, steps / 2"} < {*rows}
    assert not any("GL" in setting or "line" in setting or "part" in setting for setting in rows)
    assert len({row.events for row in rows.values()}) == 1
    assert wrong["drawn each step, steps / 2"] <= wrong["drawn each step"] < wrong["drawn each step, steps x 4"] < 0.3
    if load_rig(name).run.drawing_us:  # as shipped
        assert wrong["as shipped"] == wrong["drawn each fourth step"] != wrong["drawn each second step"]
    assert f", {128 * load_rig(name).run.step_us * 1e-6:g} s" in rows["as shipped"].rig


def test_a_ladder_has_each_rig_at_both_sizes():
    rigs = _rigs(("eros", "malapert"), ladder=True)
    assert [rig.name for rig in rigs] == ["eros@346x260", "eros@1280x720", "malapert@346x260", "malapert@1280x720"]
    assert [rig.camera.size for rig in rigs] == 2 * [(346, 260), (1280, 720)]


def test_scenes_without_bodies_have_no_place_on_it():
    assert not fits(load_rig("stars"))
    assert fits(load_rig("eros"))
