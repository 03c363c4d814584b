"""Measurements are made once, in order, and go on where an interrupt left them."""

import json

import pytest

from emulator.cli.app import _main
from laboratory.bench.streams import BenchFailed
from laboratory.realtime import measurements as module
from laboratory.realtime.measurements import WHOLE, Measurements, Store, measurements_of
from laboratory.realtime.program import Speed
from laboratory.realtime.report import BEGIN, END
from laboratory.realtime.variants import SIZES
from laboratory.realtime.wrong_events import Wrong

WRONG = Wrong(0.01, 0.02, 500, 0.1, 2.0, 0.05)
SPEED = Speed(2.0, 20.0, 0.9, 0.1, 0.2, 250.0, 1.5, 1000, 1.0)


@pytest.fixture
def measured(monkeypatch):
    """Names of what is measured, by stand-ins that take no time."""
    names = []
    monkeypatch.setattr(module, "measure_speed", lambda variant, span: (names.append(variant.key), SPEED)[1])
    monkeypatch.setattr(module, "truth_of", lambda variant, stretch, folder: names.append(f"truth {variant.key}"))
    monkeypatch.setattr(module, "wrong_events", lambda variant, truth: (names.append(f"wrong {variant.key}"), WRONG)[1])
    return names


def measurements(folder, *rigs, sizes=SIZES[:1], extent=WHOLE, sweep=False):
    wanted = list(measurements_of(rigs, sizes, sweep=sweep))
    return Measurements(wanted, Store(folder / "results.jsonl"), extent)


def done(one):
    return [each.name for each in one.run()]


def test_all_is_measured_once_and_stored(tmp_path, measured):
    first = measurements(tmp_path, "checkerboard", "stars", sizes=SIZES)
    done(first)
    assert measured == [
        "checkerboard 346x260 as shipped", "checkerboard 1280x720 as shipped",
        "stars 346x260 as shipped", "stars 1280x720 as shipped",
        "truth checkerboard 346x260 as shipped", "wrong checkerboard 346x260 as shipped",
        "truth checkerboard 1280x720 as shipped", "wrong checkerboard 1280x720 as shipped",
    ]  # fmt: skip
    measured.clear()
    again = measurements(tmp_path, "checkerboard", "stars", sizes=SIZES)
    done(again)
    assert measured == []
    assert again.rows() == first.rows()
    assert [row["wrong"] for row in again.rows()] == [pytest.approx(0.03)] * 2 + [None] * 2


def test_a_failure_is_reported_and_tried_again(tmp_path, measured, monkeypatch):
    def fail(variant, span):
        raise BenchFailed("no port")

    monkeypatch.setattr(module, "measure_speed", fail)
    broken = measurements(tmp_path, "stars")
    done(broken)
    assert broken.failures == {"stars 346x260 as shipped: speed": "no port"}
    assert broken.rows() == []
    monkeypatch.setattr(module, "measure_speed", lambda variant, span: SPEED)
    whole = measurements(tmp_path, "stars")
    done(whole)
    assert len(whole.rows()) == 1


def test_a_line_that_a_kill_has_cut_is_left_out(tmp_path):
    path = tmp_path / "results.jsonl"
    Store(path).put("a", "name", {"factor": 1.0})
    Store(path).put("b", "name", {"factor": 2.0})
    path.write_text(path.read_text()[:-10])
    assert Store(path).get("a") == {"factor": 1.0}
    assert Store(path).get("b") is None


def test_ctrl_c_writes_the_report_of_what_there_is(tmp_path, measured, monkeypatch, capsys):
    def interrupted(variant, span):
        if variant.rig == "stars":
            raise KeyboardInterrupt
        return SPEED

    monkeypatch.setattr(module, "measure_speed", interrupted)
    monkeypatch.setattr("laboratory.verbs.realtime.prepared", lambda parts: 0)
    command = ["bench", "realtime", "checkerboard", "stars", "--size", "346x260", "--out", str(tmp_path), "--json"]
    assert _main(command) == 1
    result = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert [row["rig"] for row in result["rows"]] == ["checkerboard"]
    assert "interrupted" in result["note"]
    assert json.loads((tmp_path / "realtime.json").read_text())["rows"] == result["rows"]
    monkeypatch.setattr(module, "measure_speed", lambda variant, span: SPEED)
    measured.clear()
    assert _main(command) == 0
    assert measured == ["truth checkerboard 346x260 as shipped", "wrong checkerboard 346x260 as shipped"]
    assert len((tmp_path / "realtime.jsonl").read_text().splitlines()) == 3  # the speed of the board once
    assert len(json.loads(capsys.readouterr().out.strip().splitlines()[-1])["rows"]) == 2


def test_one_command_writes_the_section_of_the_docs(tmp_path, measured, monkeypatch, capsys):
    monkeypatch.setattr("laboratory.verbs.realtime.prepared", lambda parts: 0)
    page, out = tmp_path / "docs" / "page.md", tmp_path / "out"
    page.parent.mkdir()
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    assert _main(["bench", "realtime", "checkerboard", "--out", str(out), "--page", str(page)]) == 0
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "|checkerboard|1280x720|2|0.90, 0.10, 0.20|250|1.50|100|1 + 2|" in text
    assert (page.parent / "pictures" / "realtime.png").read_bytes().startswith(b"\x89PNG")
    assert "checkerboard" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [
        ["nosuch"],
        ["checkerboard", "--size", "1x1"],
        ["checkerboard", "--page", "/no/such/page.md"],
        ["checkerboard", "--quick", "--page", "docs/benchmarks.md"],
    ],
)
def test_wrong_use(tmp_path, arguments, capsys):
    assert _main(["bench", "realtime", *arguments, "--out", str(tmp_path), "--json"]) == 2
    assert json.loads(capsys.readouterr().out.strip().splitlines()[-1])["exit_code"] == 2
