"""The report: intervals and indices against closed forms, the worst runs, one page without a network."""

import math
import re

import numpy as np
import pytest
from SALib.analyze import pawn as salib_pawn

from emulator.campaign import report as module
from emulator.campaign.loading import proportion
from emulator.campaign.report import pawn, sensitivity, slices_of, worst_runs, write_report
from emulator.campaign.sampling import OneOf, Uniform, unit_points


def wilson(successes, runs, z=1.959963984540054):
    """The formula of Wilson (1927)."""
    p, n = successes / runs, runs
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)


@pytest.mark.parametrize(("successes", "runs"), [(0, 59), (297, 300), (5, 10), (10, 10)])
def test_intervals_are_those_of_wilson(successes, runs):
    known = proportion(successes, runs)
    assert (known.low, known.high) == pytest.approx(wilson(successes, runs), abs=1e-12)


LAWS = [Uniform(name, low=-math.pi, high=math.pi) for name in ("a", "b", "c")]


def ishigami(points):
    """Rows of the function of Ishigami and Homma (1990), whose Sobol indices are known."""
    x = np.array([[law.at(u) for law, u in zip(LAWS, point, strict=True)] for point in points])
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    return [{"a": a, "b": b, "c": c, "y": v} for (a, b, c), v in zip(x.tolist(), y.tolist(), strict=True)]


def test_sobol_indices_of_a_known_function():
    found = sensitivity(ishigami(unit_points("saltelli", 2048, 3, seed=1)), LAWS, "y", 2048)
    assert "Sobol indices (Saltelli's design, 2048 base points)" in found.method
    first, total = [[row[k] for row in found.rows] for k in ("alone (S1)", "with all others (ST)")]
    assert first == pytest.approx([0.3139, 0.4424, 0.0], abs=0.04)
    assert total == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.04)


def test_a_design_with_a_hole_gives_no_sobol_indices():
    rows = ishigami(unit_points("saltelli", 16, 3, seed=1))
    found = sensitivity([*rows[:-1], {**rows[-1], "y": None}], LAWS, "y", 16)
    assert "no Sobol indices" in found.method
    assert "PAWN" in found.rows[0]


def test_a_sample_gives_pawn_and_ranks():
    points = np.random.default_rng(1).random((400, 2))
    rows = [{"a": a, "b": b, "y": math.exp(3 * a)} for a, b in points.tolist()]
    found = sensitivity(rows, LAWS[:2], "y", 0)
    a, b = found.rows
    assert found.method == "PAWN index and rank correlation of 400 runs as sampled"
    assert a["rank correlation"] == pytest.approx(1.0)
    assert abs(b["rank correlation"]) < 0.15
    # Ten slices of what alone matters: the distance of slice k is max(k, 9 - k) / 10, and their median 0.7.
    assert a["PAWN"] == pytest.approx(0.7, abs=0.005)
    assert b["PAWN"] < b["PAWN, 95 % of chance"] < 0.3 < a["PAWN"]


def test_pawn_is_that_of_salib():
    """Its slices leave the run with the highest value out; for a list of values it has one slice too few."""
    x, y = np.random.default_rng(2).random((2, 400))
    y += x**2
    problem = {"num_vars": 1, "names": ["x"], "bounds": [[0.0, 1.0]]}
    theirs = salib_pawn.analyze(problem, x[:, None], y, S=10, seed=1)["median"][0]
    assert pawn(y, slices_of(x)) == pytest.approx(theirs, abs=0.005)


def test_without_salib_there_are_pawn_and_ranks(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    rows = [{"a": float(k), "kind": "xy"[k % 2], "y": -float(k)} for k in range(40)]
    found = sensitivity(rows, [LAWS[0], OneOf("kind", values=("x", "y"))], "y", 10)
    assert "SALib" in found.method
    assert found.rows[0]["rank correlation"] == pytest.approx(-1.0)
    assert list(found.rows[1]) == ["parameter", "PAWN", "PAWN, 95 % of chance", "rank correlation", "p"]


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ([{"a": 1.0, "y": float(k)} for k in range(19)], "fewer than 20 runs"),
        ([{"a": float(k), "y": 1.0} for k in range(30)], "the same value"),
    ],
)
def test_where_nothing_can_be_told_it_says_so(rows, why):
    assert why in sensitivity(rows, LAWS[:1], "y", 0).method


@pytest.fixture
def rows():
    draw = np.random.default_rng(2)
    made = []
    for k in range(48):
        speed = float(draw.uniform(30, 600))
        made.append(
            {"index": k, "outcome": "ok", "error": "", "success": speed > 90, "margin": speed / 90 - 1}
            | {"camera.sensor.threshold_on": float(draw.uniform(0.1, 0.5)), "scene.speed_px_s": speed}
            | {"verdict": True, "events.read_out": int(speed), "events.rate_hz": speed, "machine.wall_s": 0.1}
        )
    made[7] |= {"outcome": "crashed", "error": "<b>SIGKILL</b>", "success": False, "margin": None}
    return made


def test_the_worst_runs_come_first(campaign, rows):
    worst = worst_runs(campaign(count=48), rows)
    assert worst[0]["index"] == 7
    assert len(worst) == 10
    assert [row["margin"] for row in worst[1:]] == sorted(row["margin"] for row in rows if row["index"] != 7)[:9]
    made = campaign(count=48, more='[report]\nworst = "events.rate_hz"\nworst_is = "highest"', top="success = []")
    good = [row for row in worst_runs(made, [row for row in rows if row["success"]])]
    assert good[0]["events.rate_hz"] == max(row["events.rate_hz"] for row in rows if row["success"])


@pytest.mark.system
def test_the_page_needs_nothing_else(campaign, rows, tmp_path):
    made = campaign(count=48, top='title = "a <title>"\nsuccess = ["verdict", "events.read_out > 90"]')
    page = write_report(made, rows, tmp_path / "new").read_text()
    known = proportion(sum(row["success"] for row in rows), 48)
    assert f'class="verdict good" role="status"><strong>\u2714 GOOD</strong>Success: {known}.' in page
    assert ">scene.speed, px/s</th>" in page, "the unit is apart from the key"
    assert "a &lt;title&gt;" in page
    assert "&lt;b&gt;SIGKILL" in page
    assert page.count("<svg") == 2
    assert page.count("data:image/png;base64") == 2
    assert "PAWN index" in page
    assert "again small.toml INDEX --record" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "NaN" not in re.sub(r'(?s)data:image.*?"', "", page)


@pytest.mark.sampled
@pytest.mark.parametrize(("least", "count", "verdict"), [(0.99, 48, "bad"), (0.5, 48, "good"), (0.5, 64, "unfinished")])
def test_the_verdict_is_that_of_the_exit_code(campaign, rows, tmp_path, least, count, verdict):
    page = write_report(campaign(count=count, top=f"min_success = {least}"), rows, tmp_path).read_text()
    assert f'class="verdict {verdict}"' in page
