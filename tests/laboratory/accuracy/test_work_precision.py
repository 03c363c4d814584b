"""The sweep, its reading, the page, and the verb that makes them."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest

from emulator.cli.output import LACKING, WRONG_USE, Failure
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import draw
from laboratory.accuracy import report as charts
from laboratory.accuracy.harness import (
    CASES,
    REFERENCE,
    SEED,
    Case,
    Method,
    Swept,
    events,
    methods,
    score,
    step_cost_us,
    truth,
)
from laboratory.accuracy.report import reading, write_stability, write_work_precision
from laboratory.accuracy.scenes import BlurredCheckerboard, SineGrating
from laboratory.accuracy.scores import Scores, compare_samples
from laboratory.accuracy.stability import SWEEPS, boundary, cells
from laboratory.accuracy.sweeps import (
    EFFECTS,
    QUICK_EFFECTS,
    Point,
    effect_rows,
    frames_needed,
    settings,
    sweep,
)
from laboratory.methods.grid import NoisyPixels
from laboratory.verbs.accuracy import accuracy
from tests.laboratory.accuracy.rows import row

SMALL = Case("sine", SineGrating(pixels=8), row(8), 0.05)
LINE = Method("line", PixelArray)


def point(method, step_ms, t95_us, right=1.0, case="c"):
    scores = Scores(right, t95_us / 2, t95_us, 1.0, 0.0, 0.0, 0.0, 10, 10)
    return Point(case, method, step_ms, 1e3 / step_ms, 10.0, 10.0 / step_ms, scores)


def test_methods_are_ours_and_those_of_others():
    names = [method.name for method in methods()]
    assert names == [
        "hermite",
        "refined",
        "line",
        "pangu",
        "v2e",
        "v2e_exact_filter",
        "sikorski",
        "esim",
        "frame_difference",
    ]


def test_every_scene_of_the_chart_has_its_sensor():
    assert len({swept.case.name for swept in CASES}) == len(CASES)
    for swept in CASES:
        assert swept.case.scene.pixels == swept.case.parameters.width
        assert list(swept.steps_ms) == sorted(swept.steps_ms)
        for step_ms in swept.steps_ms:
            steps = swept.case.duration_s * 1e3 / step_ms
            assert steps == pytest.approx(round(steps)), "the truth ends with the last step"


@pytest.mark.parametrize("method", methods(), ids=lambda m: m.name)
def test_stream_time_does_not_matter(method):
    later = dataclasses.replace(SMALL, start_ns=1 << 33 << 8)
    now, then = (events(method, case, 1e-3)[0] for case in (SMALL, later))
    np.testing.assert_allclose(now.t_us, then.t_us, atol=1e-3)
    np.testing.assert_array_equal(now.on, then.on)


def test_the_line_is_nearly_right_and_the_error_is_in_us():
    scores = score(LINE, SMALL, 5e-4)
    assert scores.right >= 0.9
    assert 0.5 < scores.t95_us < 20
    assert scores.true_events == len(truth(SMALL)) > 50


def test_the_cost_is_that_of_a_whole_sensor():
    assert 10 < step_cost_us(LINE, SMALL, 1e-3) < 1e6


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


def test_frames_needed_lie_between_points_on_a_line_in_logarithms():
    second_order = [point("line", step, 4.0 * step**2) for step in (0.5, 1.0, 2.0)]
    need = frames_needed(second_order, "c", "line", 8.0)
    assert (need.kind, need.frames_per_s) == ("between", pytest.approx(1000 / math.sqrt(2)))
    assert frames_needed(second_order, "c", "line", 100.0).kind == "at most"
    beyond = frames_needed(second_order, "c", "line", 0.01)
    assert (beyond.kind, beyond.frames_per_s) == ("beyond", pytest.approx(20000))
    assert str(beyond) == "about 20 000"


def test_frames_needed_ask_for_right_sequences_too():
    wrong = [point("line", 1.0, 1.0), point("line", 2.0, 1.0, right=0.5)]
    assert frames_needed(wrong, "c", "line", 10.0) == frames_needed(wrong, "c", "line", 1.0)
    assert frames_needed(wrong, "c", "line", 10.0).frames_per_s == 1000


@pytest.mark.parametrize("errors", [(100.0, 100.0), (math.nan, math.nan), (100.0, 99.0)])
def test_an_error_that_does_not_fall_with_the_step_is_never_small(errors):
    flat = [point("esim", step, error) for step, error in zip((1.0, 2.0), errors, strict=True)]
    assert str(frames_needed(flat, "c", "esim", 10.0)) == "never"


def test_the_reading_says_how_many_frames_the_others_need():
    points = [point("line", step, 4 * step**2) for step in (1.0, 2.0)]
    points += [point("v2e", step, 400 * step) for step in (1.0, 2.0)]
    points += [point("esim", step, 4000) for step in (1.0, 2.0)]
    lines = reading(points, {"c": "a case"})
    assert any("10 us, v2e needs 63 to 63 times" in line for line in lines)
    assert any("out of reach of esim" in line for line in lines)


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


def test_the_light_can_be_read_back_from_the_events():
    """Start and thresholds known, the sum of the events lies within a threshold of the filtered log light."""
    drawn = draw(SMALL.parameters, SEED)
    stream, _ = events(LINE, SMALL, 5e-4)
    start = np.log(SMALL.scene.value(0.0)[0] + SMALL.parameters.dark_current_relative) - drawn.on * drawn.phase
    read, known = (
        start + np.bincount(s.pixel, np.where(s.on, drawn.on[s.pixel], -drawn.off[s.pixel]), minlength=s.pixels)
        for s in (stream, truth(SMALL))
    )
    log_light = np.log(SMALL.scene.value(SMALL.duration_s)[0])
    lag = 2 * math.pi * 20 / (2 * math.pi * 300 * 0.3)  # at most, ln units: steepest slope times the longest tau
    assert np.abs(read - log_light).max() < 0.25 + lag
    assert np.mean((read - known) ** 2) < 1e-3
