"""The page's messages: pictures come back as they were, and nothing that a browser can say hurts."""

import json
import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.live_page.messages import BadMessage, Picture, encode_picture, light_codes, parse_command
from tests.emulator.live_page.pictures import decode_picture, light_of_codes

_COMMANDS = [
    {"do": "hello", "token": "ab"},
    {"do": "seen", "number": 3},
    {"do": "adjust", "name": "leak_hz", "value": 0.5},
    {"do": "pixel", "x": 3, "y": -1},
    {"do": "inject", "fault": {"kind": "unplugged"}},
    {"do": "undo", "change": 4},
    {"do": "again", "seed": 7},
    {"do": "stop"},
    {"do": "trigger"},
    {"do": "pause"},
    {"do": "step"},
    {"do": "resume"},
]


@given(
    st.integers(1, 40),
    st.integers(1, 30),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**63),
    st.integers(0, 2**32 - 1),
    st.integers(1, 65535),
    st.integers(0, 2**32),
)
def test_a_picture_comes_back_as_it_was(width, height, number, t_us, events, every, seed):
    draw = np.random.default_rng(seed).integers
    light = draw(0, 65536, (height, width), np.uint16)
    place = np.flatnonzero(draw(0, 2, height * width)).astype(np.uint32)
    last, count = draw(-127, 128, len(place), np.int8), draw(0, 256, len(place), np.uint8)
    message = encode_picture(Picture(number, t_us, t_us + 5, events, every, light, place, last, count))
    back = decode_picture(message)
    assert (back.number, back.from_us, back.until_us, back.events, back.every) == (
        number,
        t_us,
        t_us + 5,
        events,
        every,
    )
    assert np.array_equal(back.light, light)
    assert np.array_equal(back.place, place)
    assert np.array_equal(back.last, last)
    assert np.array_equal(back.count, count)


def test_the_bytes_are_those_that_the_browser_reads():
    light, place = np.array([[1, 0x0302]], np.uint16), np.array([1], np.uint32)
    message = encode_picture(Picture(7, 8, 9, 10, 11, light, place, np.array([-3], np.int8), np.array([5], np.uint8)))
    assert message[:4] == b"EVP2"
    assert struct.unpack_from("<HH", message, 8) == (2, 1)  # getUint16(8), getUint16(10) in picture.js
    assert struct.unpack_from("<QQ", message, 12) == (8, 9)
    assert struct.unpack_from("<H", message, 32) == (11,)
    assert struct.unpack_from("<I", message, 36) == (1,)
    assert message[40:] == bytes([1, 0, 0, 0, 1, 0, 2, 3, 253, 5])


@given(st.floats(1e-30, 1e30))
def test_a_level_of_light_keeps_its_value_and_its_order(level):
    light = np.array([level, 1.01 * level], np.float32)
    codes = light_codes(light)
    assert np.allclose(light_of_codes(codes), light, rtol=2**-9)
    assert codes[0] < codes[1]


def test_light_that_is_no_number_has_a_code():
    codes = light_codes(np.array([np.nan, -np.inf, -1.0, 0.0, np.inf], np.float32))
    assert list(codes[:4]) == [0, 0, 0, 0]
    assert np.isfinite(light_of_codes(codes)).all()
    assert light_of_codes(codes)[4] > 9e37


@pytest.mark.parametrize("command", _COMMANDS, ids=lambda c: c["do"])
def test_commands_are_understood_and_unknown_fields_left_out(command):
    assert parse_command(json.dumps({**command, "more": 1})) == command


@given(st.text(max_size=300))
def test_any_text_is_a_command_or_refused(text):
    with suppress(BadMessage):
        assert parse_command(text)["do"]


_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.sampled_from(_COMMANDS),
    st.dictionaries(st.sampled_from(["do", "name", "value", "number", "change", "seed", "fault", "x", "y"]), _values),
)
def test_fields_of_wrong_types_are_refused(command, changed):
    try:
        parsed = parse_command(json.dumps({**command, **changed}))
    except BadMessage:
        return
    assert isinstance(parsed.get("value", 0.0), float)
    assert {type(parsed.get(name, 0)) for name in ("x", "y")} == {int}
    assert np.isfinite(parsed.get("value", 0.0))
    assert type(parsed.get("number", 0)) is int
    assert {type(parsed.get(name, 0)) for name in ("change", "seed")} == {int}
    assert isinstance(parsed.get("fault", {}), dict)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "[" * 4000,
        '{"do": "adjust", "name": "leak_hz", "value": NaN}',
        '{"do": "adjust", "name": "leak_hz", "value": 1e999}',
        '{"do": "adjust", "name": "leak_hz", "value": ' + "9" * 400 + "}",
        '{"do": "seen", "number": true}',
        '{"do": "undo", "change": true}',
        '{"do": "undo", "change": 1.5}',
        '{"do": "undo"}',
        '{"do": "again", "seed": "1"}',
        '{"do": "again", "seed": 1e3}',
        '{"do": "explode"}',
        "{}",
        "1",
    ],
)
def test_what_is_hostile_is_refused(text):
    with pytest.raises(BadMessage):
        parse_command(text)
