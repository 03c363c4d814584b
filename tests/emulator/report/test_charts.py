"""Charts of reports: ticks, places of values, marks, and their bounded size."""

from xml.etree import ElementTree

import numpy as np
import pytest

from emulator.report.charts import Axis, Chart, Lane, Mark, Quantiles, Share, quantile_chart, share_bar


def elements(svg, tag, kind):
    root = ElementTree.fromstring(svg)
    return [one for one in root.iter(tag) if one.get("class") == kind]


def test_steps_go_through_the_values():
    svg = Chart(Axis("s", 0.0, 2.0), Axis("events", 0.0, 4.0), "two bins", height=100).steps(
        np.array([0.0, 1.0, 2.0]), np.array([1.0, 4.0]), "on"
    )
    (line,) = elements(svg.svg(), "polyline", "line on")
    points = [tuple(map(float, point.split(","))) for point in line.get("points").split()]
    (x0, low), (x1, _), (x2, high), (x3, _) = points
    assert x1 == x2 == pytest.approx((x0 + x3) / 2)
    assert low - high == pytest.approx(75)  # three of four events, of 100


def test_marks_are_at_their_times_and_spans_have_their_length():
    lane = Lane("faults", "fault", [Mark(1.0, 3.0, "F1"), Mark(4.0)])
    svg = Chart(Axis("s", 0.0, 4.0), Axis("events", 0.0, 1.0), "lanes", lanes=[lane]).svg()
    span, instant = elements(svg, "rect", "fault")
    assert float(span.get("width")) == pytest.approx(628 / 2 + 3)
    assert float(instant.get("width")) == 3
    assert ">F1</text>" in svg


def test_a_bar_has_widths_by_amount_and_small_parts_are_visible():
    svg = share_bar([Share("A", 3_000_000, "fine"), Share("B", 1, "lost"), Share("C", 0, "gone")], "bar")
    (whole,), (small,) = elements(svg, "rect", "part fine"), elements(svg, "rect", "part lost")
    assert float(whole.get("width")) == pytest.approx(720, abs=1)
    assert float(small.get("width")) == 3
    assert float(small.get("x")) + 3 <= 720
    assert not elements(svg, "rect", "part gone")
    assert ">A</text>" in svg


def test_quantiles_lie_in_order_and_beyond_their_bound():
    rows = [Quantiles("usb", [("p50", 100.0), ("p99", 1000.0), ("max", 10_000.0)], 500.0, "bound")]
    svg = quantile_chart(rows, "time, us")
    (dot,) = elements(svg, "circle", "dot")
    (bound,) = elements(svg, "line", "bound")
    square = elements(svg, "polygon", "dot")[0].get("points")
    assert float(dot.get("cx")) < float(bound.get("x1")) < float(square.split(",")[0])
    assert "usb: p50 100, p99 1\u202f000, max 10\u202f000, bound 500" in svg


def test_texts_are_escaped_and_described():
    lane = Lane("<b>", "fault", [Mark(1.0, None, "<i>")])
    svg = Chart(Axis("<u>", 0.0, 4.0), Axis("&", 0.0, 1.0), 'a "chart" <s>', lanes=[lane]).svg()
    root = ElementTree.fromstring(svg)
    assert (root.get("role"), root.get("aria-label")) == ("img", 'a "chart" <s>')
    assert not {one.tag for one in root.iter()} & {"b", "i", "u", "s"}
