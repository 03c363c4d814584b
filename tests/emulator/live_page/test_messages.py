"""The page's messages: pictures come back as they were, and nothing that a browser can say hurts."""

import json
import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.live_page.messages import BadMessage, Picture, decode_picture, encode_picture, parse_command

_COMMANDS = [
    {"do": "hello", "token": "ab"},
    {"do": "seen", "number": 3},
    {"do": "adjust", "name": "leak_hz", "value": 0.5},
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
    light, count = (draw(0, 256, (height, width), np.uint8) for _ in range(2))
    last = draw(-127, 128, (height, width), np.int8)
    message = encode_picture(Picture(number, t_us, t_us + 5, events, every, light, last, count))
    back = decode_picture(message)
    assert (back.number, back.from_us, back.until_us, back.events, back.every) == (
        number,
        t_us,
        t_us + 5,
        events,
        every,
    )
    assert np.array_equal(back.light, light)
    assert np.array_equal(back.last, last)
    assert np.array_equal(back.count, count)


def test_the_bytes_are_those_that_the_browser_reads():
    planes = np.array([[1, 2]], np.uint8), np.array([[-3, 4]], np.int8), np.array([[5, 6]], np.uint8)
    message = encode_picture(Picture(7, 8, 9, 10, 11, *planes))
    assert message[:4] == b"EVP1"
    assert struct.unpack_from("<HH", message, 8) == (2, 1)  # getUint16(8), getUint16(10) in page.js
    assert struct.unpack_from("<QQ", message, 12) == (8, 9)
    assert struct.unpack_from("<H", message, 32) == (11,)
    assert message[36:] == bytes([1, 2, 253, 4, 5, 6])


@given(st.binary(max_size=200), st.booleans())
def test_bytes_that_are_no_picture_are_refused(data, with_magic):
    with pytest.raises(BadMessage):
        decode_picture(b"EVP1" + data if with_magic and len(data) != 32 else data[:30])


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
    st.dictionaries(st.sampled_from(["do", "name", "value", "number", "change", "seed", "fault"]), _values),
)
def test_fields_of_wrong_types_are_refused(command, changed):
    try:
        parsed = parse_command(json.dumps({**command, **changed}))
    except BadMessage:
        return
    assert isinstance(parsed.get("value", 0.0), float)
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
