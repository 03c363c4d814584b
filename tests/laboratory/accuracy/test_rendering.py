"""The chart of drawn scenes: exact light against point samples, and what GL's samples cost."""

import dataclasses

import pytest

from emulator.rig.loading import load_rig
from laboratory.accuracy import rendering
from laboratory.accuracy.rendering import SETTINGS, Drawn, Setting, Stretch, fits, rendering_rows, rows_of
from laboratory.accuracy.report import reading_of_rendering, write_rendering


def small(name):
    rig = load_rig(name)
    sensor = dataclasses.replace(rig.camera.sensor, width=96, height=72)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))


def rows(monkeypatch, *settings, steps=4):
    pytest.importorskip("embreex", reason="the ray caster of the reference")
    monkeypatch.setattr(rendering, "SETTINGS", settings)
    return {row.setting: row for row in rendering_rows([small("eros-flyover")], Stretch(steps=steps))}


@pytest.mark.system
def test_exact_light_and_its_rate_are_best(monkeypatch):
    """In steps four times as long: in one step so large pixels see little motion, and shadows hide errors of times."""
    by_setting = rows(monkeypatch, SETTINGS[2], SETTINGS[4], steps=12)
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


def test_rows_are_counted_before_they_are_made():
    """Malapert is looked at in five stretches, or in the one that is asked for; a flyover's window has its own rows."""
    malapert = load_rig("malapert")
    assert rows_of([malapert]) == 5 * rows_of([malapert], Stretch(20.0)) == 5 * len(rendering.TERRAIN_SETTINGS)
    assert rows_of([load_rig("eros-flyover")], as_shipped=True) == 2


def test_it_is_written_for_people_and_programs(tmp_path):
    shown = [
        Drawn("a", "exact", 3.0, 0.1, 0.05, 0.2, 2.0, 0.05, 3.0, 1000),
        Drawn("a", "GL", 9.0, 0.0, 0.0, 0.1, 1.0, 0.17, 800.0, 1000),
    ]
    files = write_rendering(shown, tmp_path)
    assert {path.suffix for path in files} == {".html", ".csv", ".json", ".svg", ".png"}
    assert all(path.stat().st_size > 50 for path in files)
    (said,) = reading_of_rendering(shown)
    assert "exact 15.0 % in 3.0 ms" in said
