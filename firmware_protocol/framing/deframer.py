"""Detection of frames in a stream of bytes that may be damaged: the common part of all framings with a delimiter.

A stream is split at each delimiter; a piece between two delimiters is a frame, and an empty piece is ignored. The
division of the stream into calls of `push` affects neither results nor counts. Every byte has one fate:

    received = in frames (with their delimiters, and idle delimiters) + skipped (in refused pieces) + pending

A deframer holds at most one frame of the greatest length; a longer piece is refused and skipped to the next delimiter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field

DEFAULT_MAX_PAYLOAD = 8192
"""Longest payload of a frame in bytes, by default: twice the length that CRC-16 protects well."""


class FrameError(ValueError):
    """A frame is damaged. The message is the reason under which it is counted."""


@dataclass
class FrameCounters:
    """Counts of a deframer.

    Attributes
    ----------
    bytes_received
        All bytes pushed.
    bytes_framed
        Bytes of good frames, and delimiters between frames.
    bytes_skipped
        Bytes that belong to no good frame.
    frames
        Good frames.
    refused
        Bad frames by reason.
    """

    bytes_received: int = 0
    bytes_framed: int = 0
    bytes_skipped: int = 0
    frames: int = 0
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of their frame."""
        return self.bytes_received - self.bytes_framed - self.bytes_skipped

    def good(self, length: int) -> None:
        """Count a good frame of `length` bytes on the line."""
        self.frames += 1
        self.bytes_framed += length

    def bad(self, reason: str, length: int) -> None:
        """Count a refused frame of `length` bytes on the line."""
        self.refused[reason] += 1
        self.bytes_skipped += length


class StreamDeframer(ABC):
    """Receives bytes in any pieces and returns the payloads of complete, valid frames."""

    def __init__(self) -> None:
        self.counters = FrameCounters()

    @abstractmethod
    def push(self, data: bytes) -> list[bytes]:
        """Process the next bytes of the stream; return the payloads of the frames that they complete, in order."""


class DelimitedDeframer(StreamDeframer, ABC):
    """Splits the stream at one delimiter byte.

    Parameters
    ----------
    delimiter
        Byte that occurs in no frame.
    max_frame
        Longest frame in bytes on the line, without delimiters.
    """

    def __init__(self, delimiter: int, max_frame: int) -> None:
        super().__init__()
        self._delimiter = bytes([delimiter])
        self._max_frame = max_frame
        self._begun = b""
        self._skipping = False

    @abstractmethod
    def decode(self, piece: bytes) -> bytes:
        """Return the payload of a piece between delimiters (not empty). Raises FrameError if it is damaged."""

    def push(self, data: bytes) -> list[bytes]:
        """Process the next bytes of the stream; return the payloads of the frames that they complete, in order."""
        self.counters.bytes_received += len(data)
        pieces = data.split(self._delimiter)
        if len(pieces) == 1:
            self._begin(self._begun + data)
            return []
        pieces[0] = self._begun + pieces[0]
        self._begun = b""
        last = pieces.pop()
        payloads = [payload for piece in pieces if (payload := self._finish(piece)) is not None]
        self._begin(last)
        return payloads

    def _begin(self, piece: bytes) -> None:
        """Store the head of a frame, or skip it when it has grown too long."""
        if not self._skipping and len(piece) > self._max_frame:
            self._skipping = True
            self.counters.refused["too long"] += 1
        if self._skipping:
            self.counters.bytes_skipped += len(piece)
            piece = b""
        self._begun = piece

    def _finish(self, piece: bytes) -> bytes | None:
        """Decode a piece that a delimiter has ended."""
        if self._skipping:
            self._skipping = False
            self.counters.bytes_skipped += len(piece) + 1
            return None
        if not piece:
            self.counters.bytes_framed += 1
            return None
        try:
            if len(piece) > self._max_frame:
                raise FrameError("too long")
            payload = self.decode(piece)
        except FrameError as error:
            self.counters.bad(str(error), len(piece) + 1)
            return None
        self.counters.good(len(piece) + 1)
        return payload
