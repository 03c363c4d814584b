"""`.raw` files of Prophesee's formats: EVT3, EVT2, and EVT2.1 in both orders of octets.

The words are encoded here: faery 0.7.1 writes no time in long silences, so readers of its EVT3 files miss wraps.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

from firmware_protocol.evt.evt2 import Evt2Decoder, Evt2Encoder, Form, evt2_header
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.evt.words import evt3_header
from transports.recording.part import Facts, Part, RecordingError

__all__ = ["Evt2Writer", "Evt3Writer", "Evt21LegacyWriter", "Evt21Writer", "EvtReader"]

_PIECE_BYTES = 1 << 17  # at most twelve events in each word: 786 432 events
_MOST_HEADER = 1 << 16


class _Writer:
    """Writer of the words of an encoder after a header."""

    def __init__(self, path: Path, header: bytes, encoder: Evt2Encoder | Evt3Encoder) -> None:
        self._file = path.open("wb", buffering=1 << 16)
        self._encoder = encoder
        self._file.write(header)

    def write(self, part: Part) -> None:
        """Append words."""
        self._file.write(self._encoder.encode(part.events, part.edges))
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Evt3Writer(_Writer):
    """Writer of EVT3: events and triggers."""

    def __init__(self, path: Path, facts: Facts) -> None:
        size = facts.size or (0, 0)
        super().__init__(path, evt3_header(size), Evt3Encoder(width=size[0]))


class Evt2Writer(_Writer):
    """Writer of EVT2: events and triggers."""

    form: ClassVar[Form] = "evt2"

    def __init__(self, path: Path, facts: Facts) -> None:
        super().__init__(path, evt2_header(facts.size or (0, 0), self.form), Evt2Encoder(self.form))


class Evt21Writer(Evt2Writer):
    """Writer of EVT2.1, little-endian, as a GenX320 sends it: events and triggers."""

    form = "evt21"


class Evt21LegacyWriter(Evt2Writer):
    """Writer of EVT2.1 in the order of octets of an IMX636 and its siblings: events and triggers."""

    form = "evt21-legacy"


class EvtReader:
    """Reader of `.raw` files of EVT3, EVT2 and EVT2.1, as given in their header; EVT3 if it gives no format."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        with path.open("rb") as file:
            head = file.read(_MOST_HEADER)
        self._path, self._start = path, _end_of_header(head)
        text = head[: self._start]
        self._form = _form_of(text)
        self.facts = Facts(_size(text) or size, self._form or "evt3")

    def parts(self) -> Iterator[Part]:
        """Yield events and triggers, half a mebibyte of words at a time."""
        decoder = Evt3Decoder() if self._form is None else Evt2Decoder(self._form)
        with self._path.open("rb") as file:
            file.seek(self._start)
            while data := file.read(_PIECE_BYTES):
                yield Part(*decoder.decode(data))


def _end_of_header(head: bytes) -> int:
    start = 0
    while head[start : start + 1] == b"%":
        end = head.find(b"\n", start)
        if end < 0:
            raise RecordingError("its lines of text have no end")
        line, start = head[start:end], end + 1
        if line.strip() == b"% end":
            break
    if not start:
        raise RecordingError("it is no .raw file of Prophesee's cameras: they begin with a line of text, '% ...'")
    return start


def _form_of(text: bytes) -> Form | None:
    """Return the form of EVT2 or EVT2.1; None for EVT3."""
    if re.search(rb"(?mi)^% (evt 2\.1|format EVT2\.?1)", text):
        return "evt21-legacy" if re.search(rb"(?mi)endianness[ =]legacy", text) else "evt21"
    return "evt2" if re.search(rb"(?mi)^% (evt 2\.0|format EVT2\b)", text) else None


def _size(text: bytes) -> tuple[int, int] | None:
    told = re.search(rb"(?m)^% geometry (\d{1,5})x(\d{1,5})", text)
    told = told or re.search(rb"width=(\d{1,5});height=(\d{1,5})", text)
    if told is None and (turned := re.search(rb"height=(\d{1,5});width=(\d{1,5})", text)):
        return int(turned[2]), int(turned[1])
    return None if told is None else (int(told[1]), int(told[2]))
