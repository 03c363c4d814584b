"""TOML text: lines of keys, and what is wrong with a text."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.tables.toml_text import TomlError, line_of, read_toml

TEXT = """\
title = "a # not a comment"
[scene]
kind = "checkerboard"
square_px = 20.0  # comment

[camera]
model = "davis346"
[camera.sensor]
threshold_on = 0.2
readout.event_ns = 80

[[links]]
kind = "usbip"
[[links]]
  port = 3
"""


def test_keys_are_found_where_they_stand():
    assert line_of(TEXT, ("title",)) == 1
    assert line_of(TEXT, ("scene",)) == 2
    assert line_of(TEXT, ("scene", "square_px")) == 4
    assert line_of(TEXT, ("camera", "sensor", "threshold_on")) == 9
    assert line_of(TEXT, ("camera", "sensor", "readout", "event_ns")) == 10
    assert line_of(TEXT, ("links", 0, "kind")) == 13
    assert line_of(TEXT, ("links", 1, "port")) == 15


def test_a_missing_key_is_at_its_table():
    assert line_of(TEXT, ("links", 1, "kind")) == 14
    assert line_of(TEXT, ("run", "step_us")) is None


@given(st.text(max_size=200))
def test_any_text_can_be_looked_through(text):
    line = line_of(text, ("a", "b"))
    assert line is None or 1 <= line <= len(text.splitlines())


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("[run]\nseed = 1\nstep_us = 5\nseed = 2\n", 4, "run.seed is given twice, first in line 2: leave one out"),
        ("a = 1\n[run]\n[b]\n[run]\n", 4, "[run] is given twice, first in line 2: put its keys under one header"),
        (
            '[[links]]\nport = 1\n[[links]]\nport = 1\nname = "a"\n"port" = 2\n',
            6,
            "links[1].port is given twice, first in line 4: leave one out",
        ),
        ("[[links]]\n[links.x]\n[links.x]\n", 3, "[links[0].x] is given twice, first in line 2: put its"),
        ("a = {b = 1, b = 2}\n", None, "a key or a table is given twice, leave one out: Duplicate"),
        ('x = """\na = 1\na = 2\n"""\ny =\n', None, "not valid TOML: Invalid value (at line 5"),
        ("x = " + "[" * 5000, None, "nested too deeply"),
    ],
)
def test_a_text_that_is_not_toml_is_told_with_line_and_cure(text, line, message):
    with pytest.raises(TomlError) as told:
        read_toml(text)
    assert message in str(told.value)
    assert told.value.line == line
    assert told.value.at("r.toml") == (f"r.toml, line {line}: {told.value}" if line else f"r.toml: {told.value}")


@given(st.text(alphabet='ab[]=. \n"1{}', max_size=60))
def test_any_text_is_a_table_or_an_error(text):
    line = None
    try:
        assert isinstance(read_toml(text), dict)
    except TomlError as error:
        line = error.line
    assert line is None or 1 <= line <= text.count("\n") + 1
