"""Reader of the page's pictures, as its browser reads them; see `emulator.live_page.messages`."""

import struct

import numpy as np

from emulator.live_page.messages import Picture

_HEADER = struct.Struct("<4sIHHQQIHHI")


def light_of_codes(codes):
    """Return the linear light of codes."""
    return (codes.astype(np.uint32) << 15).view(np.float32)


def decode_picture(message):
    """Return the picture in the bytes of a message."""
    magic, number, width, height, from_us, until_us, events, every, _, active = _HEADER.unpack_from(message)
    assert magic == b"EVP2"
    assert len(message) == _HEADER.size + 2 * width * height + 6 * active
    place = np.frombuffer(message, np.uint32, active, _HEADER.size)
    light = np.frombuffer(message, np.uint16, width * height, _HEADER.size + place.nbytes).reshape(height, width)
    last, count = np.frombuffer(message, np.uint8, offset=len(message) - 2 * active).reshape(2, active)
    return Picture(number, from_us, until_us, events, every, light, place, last.view(np.int8), count)
