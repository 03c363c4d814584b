"""Documents to sign: escaped texts, bounded tables, verdicts in words, contrast of the colours."""

import re
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

import pytest

import emulator.report.document
from emulator.report.document import Column, Document, Section, signature

STYLE = Path(emulator.report.document.__file__).with_name("report_page.css").read_text(encoding="utf-8")
COLUMNS = [Column("a", "name"), Column("b", "events", "number"), Column("c", "verdict", "verdict")]


def test_a_table_has_a_caption_and_headers_of_rows_and_columns():
    made = Section("S").table("All", COLUMNS, [{"a": "x", "b": 12_345, "c": True}, {"a": "y", "c": False}]).html()
    root = ElementTree.fromstring(made)
    (table,) = root.iter("table")
    assert table.find("caption").text == "All"
    assert [cell.get("scope") for cell in table.iter("th")] == ["col"] * 3 + ["row"] * 2
    first, second = list(table.find("tbody"))
    assert [cell.text for cell in first] == ["x", "12\u202f345", "\u2714 kept"]
    assert [cell.text for cell in second] == ["y", "\u2013", "\u2718 BROKEN"]


def test_a_long_table_is_cut_and_the_rest_counted():
    made = Section("S").table("All", COLUMNS[:2], [{"a": str(k), "b": k} for k in range(100_000)]).html()
    assert made.count("<tr") == 101
    assert "and 99900 more, listed in report.json" in made


def test_texts_of_others_are_escaped_cut_and_printable():
    nasty = '<script>alert("x")</script>\x00\udcff'
    page = Document(nasty, nasty, "bad", nasty).add(Section(nasty).text("z" * 10_000).code(nasty[:27])).html()
    assert "<script" not in page
    assert "\x00" not in page
    assert "\udcff" not in page
    assert "z" * 401 not in page


def test_the_verdict_is_in_words_beside_its_colour():
    for kind in ("good", "bad", "unfinished"):
        assert re.search(rf'class="verdict {kind}".*{kind.upper()}', Document("t", "", kind, "words").html())


def test_a_reviewer_has_room_to_decide_and_sign():
    text = signature(["Rig x"]).html()
    assert all(word in text for word in ("accepted with remarks", "rejected", "Name and role", "Date", "Signature"))
    assert text.count('class="box"') == 3


def colours_of(block):
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block))


def contrast(one, other):
    def luminance(colour):
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("dark", [False, True])
def test_texts_and_lines_have_the_contrast_of_wcag(dark):
    colours = colours_of(STYLE.split("@media", 1)[0])
    if dark:
        colours |= colours_of(STYLE.split("@media", 2)[1])
    pairs = [*product(("ink", "dim", "bad", "good"), ("paper", "card"))]
    pairs += [(name, f"{name}-paper") for name in ("good", "bad", "open")]
    assert {pair: contrast(*map(colours.get, pair)) >= 4.5 for pair in pairs} == dict.fromkeys(pairs, True)
    lines = [*product(("on", "off", "edge", "late"), ("card",))]
    assert {pair: contrast(*map(colours.get, pair)) >= 3 for pair in lines} == dict.fromkeys(lines, True)


def test_keys_in_bars_have_the_contrast_of_wcag():
    fills = dict(re.findall(r"\.part\.(\w+) \{ fill: (#[0-9a-f]{6})", STYLE))
    assert set(fills) == {"fine", "lost", "held", "cut", "gone"}
    assert {kind for kind, colour in fills.items() if contrast(colour, "#ffffff") < 4.5} == set()


def test_the_page_needs_nothing_else():
    assert not re.search(r"(src|href|url\(|@import|<script)", Document("t", "s", "good", "w").html())
