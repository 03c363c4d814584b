"""The chart of drawn scenes: exact light against point samples, and what GL's samples cost."""

import dataclasses

import pytest

from emulator.rig.loading import load_rig
from laboratory.accuracy import rendering
from laboratory.accuracy.rendering import SETTINGS, Setting, Stretch, fits, rendering_rows


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


def test_scenes_without_bodies_have_no_place_on_it():
    assert not fits(load_rig("stars"))
    assert fits(load_rig("eros"))
