"""Distances between a real value and ours, by hand, over seeds, and the pages that are made of them."""

import json
import math

import pytest

from laboratory.validation.findings import Datum, Findings, Source, over_seeds
from laboratory.validation.page import within, write

SOURCE = Source("A camera", "doi 1", "Free.", "read off")


def datum(what="one", real=2.0, ours=3.0, kind="relative", bound=0.1, fitted=False, **more):
    return Datum(what, real, ours, "us", kind, bound, fitted, **more)


@pytest.mark.parametrize(
    ("kind", "distance", "excess"),
    [("relative", 0.5, 5.0), ("factor", 1.5, math.log(1.5) / math.log(0.1)), ("difference", 1.0, 10.0),
     ("statistic", 3.0, 30.0)],
)  # fmt: skip
def test_each_kind_of_distance(kind, distance, excess):
    one = datum(kind=kind)
    assert one.distance == pytest.approx(distance)
    assert one.excess == pytest.approx(excess)


def test_a_bound_is_inclusive_and_ratios_need_values():
    assert datum(ours=2.5, bound=0.25).alike
    assert not datum(ours=2.6, bound=0.25).alike
    assert datum(real=0.0).distance == math.inf
    assert not datum(ours=math.nan, kind="difference").alike


@pytest.mark.parametrize("missing", ["bound", "real"])
def test_no_datum_comes_without_a_bound_or_a_real_value(missing):
    with pytest.raises(ValueError, match="needs both"):
        datum(**{missing: math.nan})


def test_a_range_over_seeds_is_judged_by_its_worst():
    runs = [findings("one", [datum(real=10.0, ours=ours), datum(real=10.0, ours=10.0)]) for ours in (10.4, 9.5, 11.2)]
    first, second = over_seeds(runs).data
    assert first.ours == 10.4
    assert first.seeds == (10.4, 9.5, 11.2)
    assert first.distance == pytest.approx(0.12)
    assert not first.alike
    assert second.alike
    assert within([first, second]) == "1 to 2"


def findings(name, data, draw=None):
    return Findings(
        name, f"Title of {name}", "imx636", "Light on, light off.", (SOURCE,), tuple(data), ("A limit.",), draw
    )


def test_predicted_rows_lead_and_what_disagrees_most_comes_first(tmp_path):
    def draw(stem):
        paths = [stem.with_suffix(suffix) for suffix in (".svg", ".png")]
        for path in paths:
            path.write_text("")
        return paths

    follows = datum("follows", ours=9.9, fitted=True, remark="r")
    one = findings("first", [datum("close", ours=2.1), datum("apart", ours=2.5, apart=0.03), follows])
    two = findings("second", [datum("far", ours=9.0)], draw)
    files = write([one, two], tmp_path)
    worth = (tmp_path / "worth.md").read_text()
    assert worth.index("## Predicted") < worth.index("| Title of second | imx636 | 0 | 1 |") < worth.index("## Fitted")
    assert "| Title of first | imx636 | 1 | 2 | 15.0 %|25.0 % |" in worth
    assert "| Title of first | imx636 | 0 | 1 |" in worth[worth.index("## Fitted") :]
    text = (tmp_path / "validation.md").read_text()
    places = [
        text.index(name) for name in ("|far|", "|apart|", "## What disagrees, fitted", "|follows|", "## Title of")
    ]
    assert places == sorted(places)
    assert "close" not in text[: text.index("## Title of first")]
    assert "|apart|2 us||2.5 us|25.0 %|10.0 %|3.0 %||" in text
    assert "|follows|2 us|9.9 us||395.0 %|10.0 %|–|r|" in text
    assert "![Title of second](validation/second.png)" in text
    assert "Source: A camera, doi 1; read off. Free." in text
    assert text.count("Light on, light off.") == text.count("A limit.") == text.count("read off") == 1
    assert 'As in "Title of first".' in text
    assert all(path.exists() for path in files)
    document = json.loads((tmp_path / "validation" / "validation.json").read_text())
    assert [one["name"] for one in document] == ["first", "second"]
    rows = document[0]["data"]
    assert [(row["fitted"], row["predicted"], row["alike"]) for row in rows[1:]] == [
        (None, 2.5, False),
        (9.9, None, False),
    ]
