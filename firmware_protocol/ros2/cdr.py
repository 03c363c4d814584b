"""CDR, the encoding of messages of ROS 2: little-endian, each number at a multiple of its own size.

    0 1 0 0     plain CDR, little-endian; the offsets of all that follows are counted from here
    string      u32 length with its final zero, text, zero
    sequence    u32 number of elements, elements

Source: OMG, "DDS Interoperability Wire Protocol" (DDSI-RTPS) 2.3, section 10; "Extended CDR", encoding version 1.
"""

from __future__ import annotations

import struct

__all__ = ["CdrError", "CdrReader", "CdrWriter", "Octets"]

Octets = bytes | bytearray | memoryview

_LITTLE, _BIG = b"\0\1", b"\0\0"
_HEAD_BYTES = 4


class CdrError(ValueError):
    """A message is not what its type says."""


class CdrWriter:
    """Writes one message."""

    def __init__(self) -> None:
        self._data = bytearray(_LITTLE + b"\0\0")

    def number(self, form: str, value: int) -> None:
        """Append a number of the `struct` format `form`."""
        size = struct.calcsize(form)
        self._align(size)
        self._data += struct.pack("<" + form, value)

    def text(self, text: str) -> None:
        """Append a string."""
        encoded = text.encode() + b"\0"
        self.number("I", len(encoded))
        self._data += encoded

    def octets(self, data: Octets) -> None:
        """Append a sequence of octets."""
        view = memoryview(data).cast("B")
        self.number("I", len(view))
        self._data += view

    def message(self) -> bytes:
        """Return the message, filled up to a multiple of four bytes."""
        self._align(4)
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - _HEAD_BYTES) % size)


class CdrReader:
    """Reads one message, of either byte order; raises CdrError for what is not there."""

    def __init__(self, message: bytes) -> None:
        if message[:2] not in (_LITTLE, _BIG) or len(message) < _HEAD_BYTES:
            raise CdrError("a message is not plain CDR")
        self._order = "<" if message[:2] == _LITTLE else ">"
        self._data = memoryview(message)[_HEAD_BYTES:]
        self._at = 0

    def number(self, form: str) -> int:
        """Return the next number, of the `struct` format `form`."""
        size = struct.calcsize(form)
        self._at += -self._at % size
        value = struct.unpack(self._order + form, self._taken(size))[0]
        return int(value)

    def text(self) -> str:
        """Return the next string."""
        encoded = bytes(self._taken(self.number("I")))
        if encoded[-1:] != b"\0":
            raise CdrError("a string has no end")
        return encoded[:-1].decode(errors="replace")

    def octets(self) -> memoryview:
        """Return the next sequence of octets, a part of the message."""
        return self._taken(self.number("I"))

    def _taken(self, size: int) -> memoryview:
        if size > len(self._data) - self._at:
            raise CdrError("a message is cut")
        self._at += size
        return self._data[self._at - size : self._at]
