"""Distances between a real value and ours, by hand, and the page that is made of them."""

import dataclasses
import json
import math

import pytest

from laboratory.validation.findings import Datum, Findings, Source
from laboratory.validation.page import write

SOURCE = Source("A camera", "doi 1", "Free.", "read off")


def datum(what="one", real=2.0, ours=3.0, kind="relative", bound=0.1, remark=""):
    return Datum(what, real, ours, "us", kind, bound, remark)


@pytest.mark.parametrize(
    ("kind", "distance", "excess"),
    [("relative", 0.5, 5.0), ("factor", 1.5, math.log(1.5) / math.log(0.1)), ("difference", 1.0, 10.0),
     ("statistic", 3.0, 30.0)],
)  # fmt: skip
def test_each_kind_of_distance(kind, distance, excess):
    one = datum(kind=kind)
    assert one.distance == pytest.approx(distance)
    assert one.excess == pytest.approx(excess)
    assert one.judged


def test_a_bound_is_inclusive_and_ratios_need_values():
    assert datum(ours=2.5, bound=0.25).alike
    assert not datum(ours=2.6, bound=0.25).alike
    assert datum(real=0.0).distance == math.inf
    assert not datum(real=math.nan, kind="difference").alike


def test_a_datum_without_a_bound_gives_the_reason():
    with pytest.raises(ValueError, match="needs a remark"):
        datum(bound=math.nan)
    assert not datum(bound=math.nan, remark="unknown light").judged


def findings(name, data, draw=None):
    return Findings(
        name, f"Title of {name}", "imx636", "Light on, light off.", (SOURCE,), tuple(data), ("A limit.",), draw
    )


def test_the_page_begins_with_what_disagrees_most(tmp_path):
    def draw(stem):
        paths = [stem.with_suffix(suffix) for suffix in (".svg", ".png")]
        for path in paths:
            path.write_text("")
        return paths

    one = findings(
        "first", [datum("close", ours=2.1), datum("apart", ours=2.5), datum("open", bound=math.nan, remark="r")]
    )
    two = findings("second", [datum("far", ours=9.0)], draw)
    files = write([one, two], tmp_path)
    text = (tmp_path / "validation.md").read_text()
    disagreement = text[text.index("## What disagrees") : text.index("## Title of first")]
    assert disagreement.index("far") < disagreement.index("apart")
    assert "close" not in disagreement
    assert "open" not in disagreement
    assert "| Title of first | imx636 | 1 | 2 |" in text
    assert "|apart|2 us|2.5 us|25.0 %|10.0 %||" in text
    assert "|open|2 us|3 us|50.0 %|–|r|" in text
    assert "![Title of second](validation/second.png)" in text
    assert "Source: A camera, doi 1; read off. Free." in text
    assert text.count("Light on, light off.") == text.count("A limit.") == text.count("read off") == 1
    assert 'As in "Title of first".' in text
    assert all(path.exists() for path in files)
    document = json.loads((tmp_path / "validation" / "validation.json").read_text())
    assert [one["name"] for one in document] == ["first", "second"]
    assert [row["alike"] for row in document[0]["data"]] == [True, False, None]


def test_a_page_without_disagreement_states_it(tmp_path):
    write([findings("only", [dataclasses.replace(datum(), ours=2.0)])], tmp_path)
    assert "Nothing: every value lies within its bound." in (tmp_path / "validation.md").read_text()


def test_a_grid_of_conditions_is_one_table(tmp_path):
    data = [datum(f"ON at {light} W/m2, {biases}", ours=2.1) for light in range(5) for biases in ("low", "mid", "high")]
    data[1] = dataclasses.replace(data[1], ours=3.0)
    data[2] = dataclasses.replace(data[2], bound=math.nan, remark="beyond")
    write([findings("only", data)], tmp_path)
    text = (tmp_path / "validation.md").read_text()
    assert "|condition|low|mid|high|\n|---|---|---|---|\n|ON at 0 W/m2|2/2.1|**2/3**|(2/2.1)|\n" in text
    assert "Unit: us. Bound: 10.0 %. Not judged: beyond." in text


def test_a_remark_of_several_values_stands_once(tmp_path):
    data = [datum(what, bound=math.nan, remark="dim") for what in ("one", "two")]
    write([findings("only", data)], tmp_path)
    text = (tmp_path / "validation.md").read_text()
    assert "|two|2 us|3 us|50.0 %|–|1|\n\nRemarks: 1: dim." in text
