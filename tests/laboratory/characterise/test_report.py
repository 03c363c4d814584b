"""What is published is well kept, comparisons say what they should, and the verb writes what it says."""

import csv
import dataclasses
import json
from functools import partial

import numpy as np
import pytest

import laboratory.verbs.characterise as verb
from emulator.cli.output import LACKING, WRONG_USE, Failure
from emulator.report import page as drawing
from emulator.sensor.presets import PRESETS
from laboratory.characterise.measurements import burst, latency, leak_light, s_curve
from laboratory.characterise.published import PUBLISHED
from laboratory.characterise.report import comparisons
from laboratory.characterise.stimuli import CURVES, FIGURE, Point, on_the_bench

DAVIS = PRESETS["davis346"]
SMALL = on_the_bench(DAVIS)


def some_measurements(p, quick):
    return [
        partial(s_curve, SMALL, "as configured", 0.035, np.array([-1.0, 1.0])),
        partial(leak_light, SMALL, "as configured", 1.0, 20.0),
        partial(latency, SMALL, 0.7, 1.0),
        partial(burst, p, 300, (64, 48)),
    ]


def compared(told, points):
    return next(c for c in comparisons(points) if c.published.description.startswith(told))


def test_every_published_figure_has_a_source_a_status_and_a_place():
    for known in PUBLISHED:
        assert known.source
        assert known.how in ("cited", "measured", "from memory")
        assert known.curve in CURVES or (known.curve == FIGURE and known.series)
        assert known.tolerance >= 1 or known.remark, known.told
        assert known.x or known.y


def test_a_figure_is_compared_where_it_is_known():
    line = [Point("bandwidth", "s", x, 2000 * x) for x in (0.1, 1.0, 10.0)]
    assert compared("3 kHz", line).verdict == "differs"
    assert compared("3 kHz", line).low == pytest.approx(2000)
    assert compared("3 kHz", [dataclasses.replace(p, y=1.3 * p.y) for p in line]).verdict == "as preset"
    assert compared("3 kHz", line[:1]).verdict == "not compared"  # the place lies outside


@pytest.mark.system
def test_the_verb_writes_a_page_tables_and_charts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(verb, "measurements", some_measurements)
    assert verb.characterise("davis346", out=tmp_path / "new", json=True) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert {path.rsplit("/", 1)[1] for path in told["files"]} == names
    assert {"characterise.html", "points.csv", "published.csv", "latency.svg", "latency.png"} <= names
    page = (tmp_path / "new/characterise.html").read_text()
    assert "<svg" in page
    assert "Lichtsteiner" in page
    assert "src=" not in page
    whole = json.loads((tmp_path / "new/characterise.json").read_text())
    rows = list(csv.DictReader((tmp_path / "new/points.csv").read_text().splitlines()))
    assert len(rows) == len(whole["points"])
    assert {row["curve"] for row in rows} == {
        "s_curve_on",
        "s_curve_off",
        "leak_light",
        "latency",
        "bandwidth",
        "burst",
        FIGURE,
    }


def test_the_verb_takes_a_rig(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(verb, "measurements", lambda p, quick: [partial(leak_light, on_the_bench(p), "x", 1.0, 2.0)])
    assert verb.characterise("checkerboard", out=tmp_path) == 0
    assert "characterise.html" in capsys.readouterr().out


def test_the_verb_says_whose_fault_it_is(tmp_path, monkeypatch):
    with pytest.raises(Failure) as no_such:
        verb.characterise("no_such_camera", out=tmp_path)
    assert no_such.value.exit_code == WRONG_USE
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(Failure, match="--out") as taken:
        verb.characterise("davis346", out=file)
    assert taken.value.exit_code == WRONG_USE

    def lacking(name):
        raise ImportError(name)

    monkeypatch.setattr(drawing.importlib, "import_module", lacking)
    with pytest.raises(Failure, match="matplotlib") as lacks:
        verb.characterise("davis346", out=tmp_path)
    assert lacks.value.exit_code == LACKING
