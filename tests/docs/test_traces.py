"""The traces of docs/traces/ are what the code sends, and receivers read in them what their decodes say."""

import re
import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
SCRIPT = runpy.run_path(str(DOCS / "make_traces.py"))
EVENTS, EDGES = SCRIPT["EVENTS"].tolist(), SCRIPT["EDGES"].tolist()


def trace(name):
    return (DOCS / "traces" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", SCRIPT["files"]())
def test_a_trace_is_what_its_script_makes(name):
    assert trace(name) == SCRIPT["files"]()[name]


@pytest.mark.parametrize(("capture", "decode"), [("serial.hex", "serial.txt"), ("can.log", "can.txt")])
def test_each_line_has_its_row_and_each_event_is_told_once(capture, decode):
    rows = [line.split(" | ") for line in trace(decode).splitlines()[1:]]
    times = [re.match(r"\((.*?)\)", line)[1] for line in trace(capture).splitlines()]
    lines = [[int(number) for number in row[0].split(" to ")] for row in rows]
    assert [number for span in lines for number in range(span[0], span[-1] + 1)] == list(range(1, len(times) + 1))
    assert [row[1].split(" to ") for row in rows] == [[times[number - 1] for number in span] for span in lines]
    told = [tuple(map(int, found)) for found in re.findall(r"(\d+) us x (\d+) y (\d+)", trace(decode))]
    assert told == [event[:3] for event in EVENTS]
