"""Lines of keys in rig files."""

from hypothesis import given
from hypothesis import strategies as st

from emulator.rig.text import line_of

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
