"""Requests of Basilisk's vizInterface and what answers them; each is a list of parts of one ZeroMQ message.

    request                                        reply
    PING                                           PONG
    SIM_UPDATE, "", "", VizMessage                 OK; Basilisk raises an error at anything else
    REQUEST_INPUT             (live stream only)   VIZARD_INPUT, VizInput (here empty: nobody touches anything)
    REQUEST_IMAGE_<cameraID>                       length as big-endian int32, that many bytes of an image file

Basilisk stands still from each request to its reply. Source: `vizInterface.cpp` in AVSLab/basilisk (develop of July
2026), and what bsk 2.12.1 sends.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = [
    "INPUT_REPLY",
    "NO_IMAGE",
    "OK",
    "PONG",
    "ImageRequest",
    "InputRequest",
    "Ping",
    "Request",
    "RequestError",
    "SimUpdate",
    "image_reply",
    "merged",
    "parse_request",
    "refusal",
]

Parts = list[bytes]

PONG: Parts = [b"PONG"]
OK: Parts = [b"OK"]
INPUT_REPLY: Parts = [b"VIZARD_INPUT", b""]
NO_IMAGE: Parts = [bytes(4), b""]
"""Basilisk's image message is then not valid."""

_IMAGE = re.compile(rb"REQUEST_IMAGE_(\d{1,18})")
_MOST_IMAGE_BYTES = (1 << 31) - 1
_SHOWN_BYTES = 40


class RequestError(ValueError):
    """The parts are no request; the text says why."""


@dataclass(frozen=True)
class Ping:
    """Basilisk asks whether somebody is there."""


@dataclass(frozen=True)
class SimUpdate:
    """The state of the simulation: a serialized VizMessage, which has not been looked at."""

    data: bytes


@dataclass(frozen=True)
class InputRequest:
    """Basilisk asks for what a user did."""


@dataclass(frozen=True)
class ImageRequest:
    """Basilisk asks for the image of a camera, at the time of the last update."""

    camera: int


Request = Ping | SimUpdate | InputRequest | ImageRequest


def parse_request(parts: Sequence[bytes]) -> Request:
    """Return what the parts of a message ask for; raises RequestError."""
    match list(parts):
        case [b"PING"]:
            return Ping()
        case [b"SIM_UPDATE", _, _, data]:
            return SimUpdate(data)
        case [b"SIM_UPDATE", *rest]:
            raise RequestError(f"a SIM_UPDATE has 4 parts, got {1 + len(rest)}")
        case [b"REQUEST_INPUT"]:
            return InputRequest()
        case [first] if image := _IMAGE.fullmatch(first):
            return ImageRequest(int(image[1]))
        case [first, *rest]:
            raise RequestError(f"{first[:_SHOWN_BYTES]!r} with {len(rest)} more parts is no request")
        case _:
            raise RequestError("a message without parts is no request")


def image_reply(image: bytes) -> Parts:
    """Return the reply that carries an image file; raises ValueError where it is too long."""
    if len(image) > _MOST_IMAGE_BYTES:
        raise ValueError(f"an image of {len(image)} bytes: the length has 31 bits")
    return [len(image).to_bytes(4, "big"), image]


def merged(ours: Parts, theirs: Parts) -> Parts:
    """Return the reply to a request that two visualisers have answered.

    Theirs, where we have no image and no input of a user to give, and where they refuse what we accept; else ours.
    """
    return theirs if ours in (OK, NO_IMAGE, INPUT_REPLY) else ours


def refusal(reason: str) -> Parts:
    """Return the reply to what cannot be used; Basilisk raises an error where it had sent a SIM_UPDATE."""
    return [f"ERROR: {reason}".encode()]
