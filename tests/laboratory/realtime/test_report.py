"""Reports of real-time factors: for people, for programs, and as a section of the docs."""

import json

import pytest

from laboratory.realtime.report import BEGIN, END, markdown, put_section, write_report

ROW = {
    "rig": "eros", "size": "346x260", "setting": "as shipped", "factor": 1.31, "stream_s": 20.0, "session_cores": 0.98,
    "link_cores": 0.05, "receiver_cores": None, "memory_mib": 281.4, "first_event_s": 1.9, "events": 10,
    "received_share": 0.997, "false": 0.004, "missed": 0.006, "wrong": 0.01, "true_events": 1604,
    "t50_ms": 0.123, "t95_ms": 4.5, "middle": 0.0512,
}  # fmt: skip
NO_TRUTH = {**ROW, "rig": "stars", "false": None, "missed": None, "wrong": None, "true_events": None, "middle": None}
ABOUT = {"machine": "two cores", "date": "2026-11-22", "note": "", "failures": {}}


def test_a_report_has_page_table_and_chart(tmp_path):
    rows = [ROW, {**ROW, "setting": "steps x 2", "factor": 2.2, "wrong": 0.0}, {**ROW, "size": "1280x720"}, NO_TRUTH]
    files = {path.name for path in write_report(rows, ABOUT, tmp_path)}
    assert files == {"realtime.html", "realtime.csv", "realtime.json", "realtime.svg", "realtime.png"}
    assert json.loads((tmp_path / "realtime.json").read_text()) == {**ABOUT, "rows": rows}
    html = (tmp_path / "realtime.html").read_text()
    assert "<svg" in html
    assert "two cores" in html


def test_the_section_has_the_rigs_as_shipped_alone():
    text = markdown([ROW, {**ROW, "setting": "line"}, NO_TRUTH], ABOUT, "pictures/x.png")
    assert "|eros|346x260|1.3|0.98, 0.05, –|281|1.90|100|0.4 + 0.6|0.12, 4.50|5.1|" in text
    assert "|stars|346x260|1.3|0.98, 0.05, –|281|1.90|100|–|–|–|" in text
    assert text.count("|eros|") == 1
    assert "machine: two cores; date: 2026-11-22." in text
    assert "](pictures/x.png)" in text
    assert "![" not in markdown([NO_TRUTH], ABOUT, None)


def test_a_section_is_replaced_as_often_as_wanted(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Head\n\n{BEGIN}\n{END}\n\nTail\n")
    for text in ("first\n", "second\n"):
        put_section(page, text)
        assert page.read_text() == f"# Head\n\n{BEGIN}\n\n{text}\n{END}\n\nTail\n"
    page.write_text("nothing")
    with pytest.raises(ValueError, match="has no lines"):
        put_section(page, "x")
