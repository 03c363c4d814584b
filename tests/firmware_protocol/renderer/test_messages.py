"""Messages of external renderers: golden octets, round trips, and octets of any kind."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.renderer import (
    ANY_TIME,
    HEADER_OCTETS,
    READY,
    Camera,
    Draw,
    End,
    Hello,
    Image,
    Layers,
    Levels,
    MessageError,
    Response,
    Type,
    parse_header,
    planes_of,
    slot_octets,
)


def _body(message):
    _, length = parse_header(message[:HEADER_OCTETS])
    assert length == len(message) - HEADER_OCTETS
    return message[HEADER_OCTETS:]


def test_a_hello_has_the_octets_of_the_drawing():
    hello = Hello(Layers.MOTION | Layers.RATE, Levels.U16, Response.SRGB, 1023, shared=True, name="mine")
    expected = bytes.fromhex("45565352 0100 0100 5000000000000000 05000000 02 01 ff03 01000000 00000000")
    assert hello.pack() == expected + b"mine" + bytes(60)
    assert Hello.parse(_body(hello.pack())) == hello


def test_a_draw_and_an_image_have_the_octets_of_the_drawing():
    draw = Draw(3, -5, 2, (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert _body(draw.pack()) == struct.pack("<QqII7d", 3, -5, 2, 0, 1, 0, 0, 1, 0, 0, 0)
    assert Draw.parse(_body(draw.pack())) == draw
    image = Image(3, ANY_TIME + 1, 12.5)
    assert Image.parse(_body(image.pack())) == image
    assert parse_header(image.pack(64)[:HEADER_OCTETS]) == (Type.IMAGE, 24 + 64)


def test_camera_end_and_ready_return_as_they_were():
    camera = Camera((346, 260), 780.35, 10_000_000, 8, 719_680, has_pose=True, path="/proc/12/fd/3")
    assert Camera.parse(_body(camera.pack())) == camera
    assert End.parse(_body(End("bad image").pack())) == End("bad image")
    assert parse_header(READY) == (Type.READY, 0)


def test_names_and_reasons_have_no_control_characters():
    assert Hello.parse(_body(Hello(name="a\x1b[2Jb").pack())).name == "a?[2Jb"
    assert End.parse(b"one\ntwo\xff") == End("one?two\ufffd")


def test_planes_stand_at_multiples_of_64_octets():
    hello = Hello(Layers.MOTION | Layers.DEPTH | Layers.RATE, Levels.U8, white=255)
    planes = planes_of(hello, (5, 3))
    assert [(p.name, p.dtype, p.channels, p.offset) for p in planes] == [
        ("light", "u1", 1, 0), ("motion", "<f4", 2, 64), ("depth", "<f4", 1, 192), ("rate", "<f4", 1, 256),
    ]  # fmt: skip
    assert slot_octets(hello, (5, 3)) == 320
    assert slot_octets(Hello(), (4, 4)) == 64


@pytest.mark.parametrize(
    ("levels", "response", "white"),
    [(Levels.FLOAT32, Response.SRGB, 0), (Levels.FLOAT32, Response.LINEAR, 1), (Levels.U8, Response.LINEAR, 256),
     (Levels.U8, Response.LINEAR, 0), (Levels.U16, Response.SRGB, 65536)],
)  # fmt: skip
def test_values_that_do_not_belong_together_are_refused(levels, response, white):
    with pytest.raises(MessageError):
        Hello(Layers.NONE, levels, response, white)


def test_a_bound_below_zero_is_refused_and_nan_is_not():
    with pytest.raises(MessageError, match="bound on motion"):
        Image.parse(struct.pack("<Qqd", 0, 0, -1.0))
    assert math.isnan(Image.parse(struct.pack("<Qqd", 0, 0, math.nan)).motion_bound_px_s)


@given(st.binary(min_size=HEADER_OCTETS, max_size=HEADER_OCTETS))
def test_any_header_is_parsed_or_refused(octets):
    try:
        kind, _ = parse_header(octets)
    except MessageError:
        return
    assert octets[:4] == b"EVSR"
    assert kind in Type


@given(st.one_of(st.binary(max_size=200), st.binary(min_size=80, max_size=80)))
def test_any_rest_of_a_message_is_parsed_or_refused(octets):
    for kind in (Hello, Camera, Draw, Image, End):
        try:
            value = kind.parse(octets)
        except MessageError:
            continue
        assert isinstance(value, kind)


_HELLOS = st.builds(
    lambda layers, white, srgb, shared, name: Hello(
        Layers(layers), Levels.U16, Response(srgb), white, shared=shared, name=name
    ),
    st.integers(0, 7), st.integers(1, 65535), st.integers(0, 1), st.booleans(), st.text("abc XYZ09", max_size=64),
)  # fmt: skip


@given(_HELLOS)
def test_every_hello_returns_as_it_was(hello):
    assert Hello.parse(_body(hello.pack())) == hello
