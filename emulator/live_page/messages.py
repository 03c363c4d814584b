"""Messages between the page's server and a browser, without any I/O.

To the browser: binary pictures (below), and JSON texts with a `kind`.

    picture   "EVP1" | number u32 | width u16 | height u16 | from_us u64 | until_us u64 | events u32 | every u16 | 0 u16
              | light (height, width) u8 | last (height, width) i8 | count (height, width) u8        little-endian

    light     the scene's light, encoded for a screen, 0 to 255
    last      0: no event in the interval; else +-1 to +-127: how late in it the last one was, the sign is the polarity
    count     ON events in the low four bits, OFF events in the high four, at most 15 each
    every     only one event in so many is drawn, where there are very many

From the browser: JSON texts, one object each, with `do`.

    {"do": "hello", "token": TEXT}              first of all; the token where the page needs one
    {"do": "seen", "number": N}                 the last message has been shown, so another may come
    {"do": "adjust", "name": NAME, "value": X}  a figure of the sensor
    {"do": "inject", "fault": {table}}          as in a rig
    {"do": "trigger"} {"do": "pause"} {"do": "step"} {"do": "resume"}
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["MOST_COMMAND_BYTES", "BadMessage", "Picture", "decode_picture", "encode_picture", "parse_command"]

MOST_COMMAND_BYTES = 4096

_HEADER = struct.Struct("<4sIHHQQIHH")
_MAGIC = b"EVP1"
_ORDERS = frozenset({"trigger", "pause", "step", "resume"})
_Plane = npt.NDArray[np.uint8]


class BadMessage(ValueError):
    """A message that is none of those above."""


@dataclass(frozen=True, eq=False)
class Picture:
    """What is drawn of one interval of stream time.

    Attributes
    ----------
    light, count : (height, width) uint8
    last : (height, width) int8
    events
        All events of the interval, drawn or not.
    every
        One in so many of them is drawn.
    """

    number: int
    from_us: int
    until_us: int
    events: int
    every: int
    light: _Plane
    last: npt.NDArray[np.int8]
    count: _Plane


def encode_picture(picture: Picture) -> bytes:
    """Return a picture as the bytes of a message."""
    height, width = picture.light.shape
    header = _HEADER.pack(
        _MAGIC, picture.number & 0xFFFFFFFF, width, height, picture.from_us, picture.until_us, picture.events,
        picture.every, 0,
    )  # fmt: skip
    return b"".join((header, picture.light.tobytes(), picture.last.tobytes(), picture.count.tobytes()))


def decode_picture(message: bytes) -> Picture:
    """Return the picture in the bytes of a message; raises BadMessage."""
    if len(message) < _HEADER.size or message[:4] != _MAGIC:
        raise BadMessage("this is no picture")
    _, number, width, height, from_us, until_us, events, every, _ = _HEADER.unpack_from(message)
    if len(message) != _HEADER.size + 3 * width * height:
        raise BadMessage(f"a picture of {width} x {height} pixels has another length")
    planes = np.frombuffer(message, np.uint8, offset=_HEADER.size).reshape(3, height, width)
    return Picture(number, from_us, until_us, events, every, planes[0], planes[1].view(np.int8), planes[2])


def parse_command(text: str) -> dict[str, Any]:
    """Return a browser's message, with the fields above and no others; raises BadMessage."""
    if len(text) > MOST_COMMAND_BYTES:
        raise BadMessage(f"a message has at most {MOST_COMMAND_BYTES} bytes")
    try:
        message = json.loads(text, parse_constant=_refused)
    except (ValueError, RecursionError) as error:
        raise BadMessage(f"this is no JSON: {error}") from error
    if not isinstance(message, dict):
        raise BadMessage("a JSON object is expected")
    return _checked(message)


def _refused(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _checked(message: dict[str, Any]) -> dict[str, Any]:
    match message:
        case {"do": "hello", **rest}:
            token = rest.get("token", "")
            return {"do": "hello", "token": token if isinstance(token, str) else ""}
        case {"do": "seen", "number": int(number)} if not isinstance(number, bool):
            return {"do": "seen", "number": number}
        case {"do": "adjust", "name": str(name), "value": int() | float() as value} if _is_number(value):
            return {"do": "adjust", "name": name, "value": float(value)}
        case {"do": "inject", "fault": dict(fault)}:
            return {"do": "inject", "fault": fault}
        case {"do": str(order)} if order in _ORDERS:
            return {"do": order}
    raise BadMessage("known are hello, seen, adjust, inject, trigger, pause, step and resume")


def _is_number(value: float) -> bool:
    try:
        return not isinstance(value, bool) and math.isfinite(float(value))
    except OverflowError:
        return False
