"""`.raw` files of Prophesee's formats: EVT3, EVT2, and EVT2.1 in both orders of octets.

The words are encoded here: faery 0.7.1 writes no time in long silences, so readers of its EVT3 files miss wraps.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import cast

from firmware_protocol.evt.evt2 import Evt2Decoder, Evt2Encoder, Form, evt2_header
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.evt.words import evt3_header
from transports.recording.format import format_to_read
from transports.recording.part import Facts, Part, RecordingError

_PIECE_BYTES = 1 << 17  # at most twelve events in each word: 786 432 events
_MOST_HEADER = 1 << 16


class _EvtWriter:
    """Writer of events and triggers as words of a form, None: EVT3, after its header."""

    def __init__(self, form: Form | None, path: Path, facts: Facts) -> None:
        size = facts.size or (0, 0)
        self._encoder = Evt3Encoder(width=size[0]) if form is None else Evt2Encoder(form)
        self._file = path.open("wb", buffering=1 << 16)
        self._file.write(evt3_header(size) if form is None else evt2_header(size, form))

    def write(self, part: Part) -> None:
        """Append words."""
        self._file.write(self._encoder.encode(part.events, part.edges))
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


Evt3Writer = partial(_EvtWriter, None)
Evt2Writer = partial(_EvtWriter, "evt2")
Evt21Writer = partial(_EvtWriter, "evt21")  # little-endian, as a GenX320 sends it
Evt21LegacyWriter = partial(_EvtWriter, "evt21-legacy")  # in the order of octets of an IMX636 and its siblings


class EvtReader:
    """Reader of `.raw` files of EVT3, EVT2 and EVT2.1, as given in their header; EVT3 if it gives no format."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        with path.open("rb") as file:
            head = file.read(_MOST_HEADER)
        self._path, self._start = path, _end_of_header(head)
        text = head[: self._start]
        name = format_to_read(path).name
        self._form = None if name == "evt3" else cast("Form", name)
        self.facts = Facts(_size(text) or size, name)

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


def _size(text: bytes) -> tuple[int, int] | None:
    told = re.search(rb"(?m)^% geometry (\d{1,5})x(\d{1,5})", text)
    told = told or re.search(rb"width=(\d{1,5});height=(\d{1,5})", text)
    if told is None and (turned := re.search(rb"height=(\d{1,5});width=(\d{1,5})", text)):
        return int(turned[2]), int(turned[1])
    return None if told is None else (int(told[1]), int(told[2]))
