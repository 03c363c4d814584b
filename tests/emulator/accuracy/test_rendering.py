"""Drawing more cheaply costs events, and the chart says so."""

import dataclasses

import pytest

from emulator.accuracy import rendering
from emulator.accuracy.rendering import SETTINGS, Drawn, fits, rendering_rows
from emulator.accuracy.report import reading_of_rendering, write_rendering
from emulator.rig.loading import load_rig

pytestmark = pytest.mark.gl


def small(name):
    rig = load_rig(name)
    sensor = dataclasses.replace(rig.camera.sensor, width=64, height=48)
    return dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))


def test_fewer_samples_make_more_wrong_events_and_the_reference_none(monkeypatch):
    kept = [setting for setting in SETTINGS if setting.name in ("1 sample", "3 x 3", "4 x 4")]
    monkeypatch.setattr(rendering, "SETTINGS", kept)
    rows = {row.setting: row for row in rendering_rows([small("rendezvous")], steps=12)}
    wrong = {name: row.false + row.missed for name, row in rows.items()}
    assert set(rows) == {setting.name for setting in kept}
    assert wrong["1 sample"] > wrong["3 x 3"] > wrong["4 x 4"] == 0
    assert rows["1 sample"].false > 0 < rows["1 sample"].missed
    assert all(row.ms > 0 and row.events > 100 for row in rows.values())


def test_scenes_without_samples_have_no_place_on_it():
    assert not fits(load_rig("stars"))
    assert fits(load_rig("eros"))


def test_it_is_written_for_people_and_programs(tmp_path):
    rows = [Drawn("a", "2 x 2", 3.0, 0.1, 0.05, 1000), Drawn("a", "4 x 4", 9.0, 0.0, 0.0, 1000)]
    files = write_rendering(rows, tmp_path)
    assert {path.suffix for path in files} == {".html", ".csv", ".json", ".svg", ".png"}
    assert all(path.stat().st_size > 50 for path in files)
    (said,) = reading_of_rendering(rows)
    assert "2 x 2 15.0 % in 3.0 ms" in said
