"""The sweep, its reading, the page, and the verb that makes them."""

import csv
import dataclasses
import json

import pytest

from emulator.cli.output import LACKING, WRONG_USE, Failure
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from laboratory.accuracy import report as charts
from laboratory.accuracy.harness import CASES, REFERENCE, Case, Method, Swept, events, methods, score, truth
from laboratory.accuracy.report import write_stability, write_work_precision
from laboratory.accuracy.scenes import BlurredCheckerboard, SineGrating
from laboratory.accuracy.scores import compare_samples
from laboratory.accuracy.stability import SWEEPS, boundary, cells
from laboratory.accuracy.sweeps import EFFECTS, QUICK_EFFECTS, effect_rows, settings, sweep
from laboratory.methods.grid import NoisyPixels
from laboratory.verbs.accuracy import accuracy
from tests.laboratory.accuracy.rows import row

SMALL = Case("sine", SineGrating(pixels=8), row(8), 0.05)
LINE = Method("line", PixelArray)


def test_the_line_is_nearly_right_and_the_error_is_in_us():
    scores = score(LINE, SMALL, 5e-4)
    assert scores.right >= 0.9
    assert 0.5 < scores.t95_us < 20
    assert scores.true_events == len(truth(SMALL)) > 50


def test_a_sweep_has_a_point_for_each_setting():
    chosen = (Swept(SMALL, "a sine", (1.0, 5.0)),)
    ways = [LINE, methods()[-1]]
    points = list(sweep(chosen, ways))
    assert len(points) == settings(chosen, ways) == 4
    assert [(p.method, p.step_ms, p.frames_per_s) for p in points[:2]] == [("line", 1.0, 1000.0), ("line", 5.0, 200.0)]
    assert points[0].us_per_stream_ms == points[0].us_per_frame
    assert points[0].row()["t95_us"] == points[0].scores.t95_us


def test_scenes_with_noise_are_samples_and_of_our_own_pixels_alone():
    """The reference is alike to itself with other numbers; pixels without the noise are not.

    Six groups of the reference's pixels give the spread of its count; the bound is 3.9 standard errors of both.
    """
    (swept,) = (swept for swept in CASES if swept.case.name == "noise_dim")
    case = dataclasses.replace(swept.case, duration_s=1.0)
    small = dataclasses.replace(swept, case=case, steps_ms=(5.0, 20.0))
    assert [method.name for method in small.fitting(methods())] == ["hermite", "refined", "line"]
    assert settings([small], methods()) == 6
    again = events(dataclasses.replace(REFERENCE, make=lambda p, seed: NoisyPixels(p, seed + 1)), case, 1e-3)[0]
    scores = compare_samples(again, truth(case))
    counts = truth(case).counts.reshape(6, 10).sum(1)
    assert abs(scores.count - 1) < 3.9 * 2**0.5 * counts.std() / 5**0.5 / counts.mean()
    assert scores.right > 0.9
    quiet = dataclasses.replace(case.parameters, noise=NoiseParameters())
    silent = compare_samples(events(LINE, dataclasses.replace(case, parameters=quiet), 5e-3)[0], truth(case))
    assert silent.count < 0.8
    assert silent.right < 0.8


@pytest.mark.system
def test_each_effect_alone_changes_what_it_should():
    case = Case("board", BlurredCheckerboard(pixels=60), row(60, leak_hz=2.0), 0.2)
    rows = {r.name: r for r in effect_rows(case, 2e-3, QUICK_EFFECTS)}
    assert list(rows) == [effect.name for effect in QUICK_EFFECTS]
    assert all(r.us_per_frame > 10 for r in rows.values())
    ideal = rows["none: the ideal sensor"].scores
    assert (ideal.right, ideal.t95_us, ideal.wrong_events) == (1, 0, 0)
    assert rows["low-pass, following the light"].scores.t50_us > 200
    assert rows["refractory period"].scores.count < 0.99
    assert rows["threshold mismatch"].scores.t95_us > 10
    assert rows["junction leak"].scores.wrong_events > 0
    assert rows["event-time jitter"].scores.t50_us == pytest.approx(100, abs=20)
    assert rows["dead pixels"].scores.count < 1
    for noisy in ("noise", "hot pixels"):
        assert rows[noisy].scores.count > 1


@pytest.mark.system
def test_the_chart_is_written_as_files_that_can_be_read(tmp_path):
    chosen = (Swept(SMALL, "a sine & more", (1.0, 5.0)),)
    points = list(sweep(chosen, [LINE, methods()[-1]]))
    effects = list(effect_rows(SMALL, 5e-3, EFFECTS[:2]))
    files = write_work_precision(points, effects, chosen, tmp_path)
    names = {path.name for path in files}
    assert names == {path.name for path in tmp_path.iterdir()}
    assert {"accuracy.html", "work_precision.csv", "work_precision.json", "effects.csv"} < names
    page = (tmp_path / "accuracy.html").read_text()
    assert page.count("<svg") == 3
    assert "a sine &amp; more" in page
    for outside in ('src="http', 'href="http', "@import", "<script"):
        assert outside not in page
    with (tmp_path / "work_precision.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    assert float(rows[0]["t95_us"]) == points[0].scores.t95_us
    assert len(json.loads((tmp_path / "work_precision.json").read_text())["points"]) == 4
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")


def test_the_map_is_written_with_its_boundaries(tmp_path):
    axis = dataclasses.replace(SWEEPS[1], values=(0.1, 10.0))
    found = list(cells([axis], [LINE]))
    assert boundary(found, axis, "line") == 0.1
    files = write_stability(found, [axis], tmp_path)
    assert {path.name for path in files} == {path.name for path in tmp_path.iterdir()}
    told = json.loads((tmp_path / "stability.json").read_text())
    assert told["boundaries"][0]["line"] == 0.1
    assert "line to 0.1" in told["reading"][1]


def test_the_verb_says_what_is_missing(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(Failure, match="--out") as wrong:
        accuracy(out=tmp_path / "file")
    assert wrong.value.exit_code == WRONG_USE

    def without(name):
        raise ImportError(name)

    monkeypatch.setattr(charts.importlib, "import_module", without)
    with pytest.raises(Failure, match=r"'\.\[report\]'") as lacking:
        accuracy(out=tmp_path / "new")
    assert lacking.value.exit_code == LACKING
    assert not (tmp_path / "new").exists()
