"""Basilisk's requests and their replies."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.vizard import (
    INPUT_REPLY,
    NO_IMAGE,
    OK,
    PONG,
    ImageRequest,
    InputRequest,
    Ping,
    RequestError,
    SimUpdate,
    image_reply,
    merged,
    parse_request,
    refusal,
)


@pytest.mark.parametrize(
    ("parts", "request_"),
    [
        ([b"PING"], Ping()),
        ([b"SIM_UPDATE", b"", b"", b"data"], SimUpdate(b"data")),
        ([b"REQUEST_INPUT"], InputRequest()),
        ([b"REQUEST_IMAGE_0"], ImageRequest(0)),
        ([b"REQUEST_IMAGE_12"], ImageRequest(12)),
    ],
)
def test_what_basilisk_asks(parts, request_):
    assert parse_request(parts) == request_


@pytest.mark.parametrize(
    ("parts", "why"),
    [
        ([], "without parts"),
        ([b"SIM_UPDATE", b"data"], "has 4 parts, got 2"),
        ([b"SIM_UPDATE", b"", b"", b"", b""], "has 4 parts, got 5"),
        ([b"REQUEST_IMAGE_"], "no request"),
        ([b"REQUEST_IMAGE_-1"], "no request"),
        ([b"REQUEST_IMAGE_1", b""], "1 more parts"),
        ([b"REQUEST_IMAGE_" + b"9" * 19], "no request"),
        ([b"x" * 1_000_000], "no request"),
    ],
)
def test_what_is_no_request(parts, why):
    with pytest.raises(RequestError, match=why) as caught:
        parse_request(parts)
    assert len(str(caught.value)) < 200


@given(st.lists(st.binary(max_size=30), max_size=6))
def test_any_parts_are_a_request_or_refused(parts):
    try:
        parse_request(parts)
    except RequestError:
        return
    assert parts[0].startswith((b"PING", b"SIM_UPDATE", b"REQUEST_"))


def test_an_image_has_its_length_before_it():
    assert image_reply(b"\x89PNG" + bytes(300)) == [b"\x00\x00\x01\x30", b"\x89PNG" + bytes(300)]
    assert image_reply(b"") == NO_IMAGE


def test_a_refusal_is_not_taken_for_an_answer():
    (text,) = refusal("why")
    assert text == b"ERROR: why"


@pytest.mark.parametrize(
    ("ours", "theirs", "taken"),
    [
        (PONG, PONG, "ours"),
        (OK, refusal("why"), "theirs"),
        (refusal("why"), OK, "ours"),
        (NO_IMAGE, image_reply(b"theirs"), "theirs"),
        (image_reply(b"ours"), NO_IMAGE, "ours"),
        (INPUT_REPLY, [b"VIZARD_INPUT", b"a key"], "theirs"),
    ],
)
def test_of_two_replies_the_one_that_says_more_is_taken(ours, theirs, taken):
    assert merged(ours, theirs) == {"ours": ours, "theirs": theirs}[taken]
