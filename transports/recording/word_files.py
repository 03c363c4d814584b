"""Files whose bytes are those of `firmware_protocol`: AEDAT 2.0 and 3.1, and `.raw` files of Prophesee's formats.

The latter are EVT3, EVT2, and EVT2.1 in both orders of octets. Their words are encoded here: faery 0.7.1 writes no time
in long silences, so readers of its EVT3 files miss wraps.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import cast

from firmware_protocol.evt.evt2 import Evt2Decoder, Evt2Encoder, Form, evt2_header
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.evt.words import evt3_header
from firmware_protocol.recordings.aedat import (
    SIZES,
    Aedat2Decoder,
    Aedat31Decoder,
    Words,
    aedat2_header,
    aedat31_header,
    edge_words,
    encode_aedat31,
    encode_frame,
    encode_imu,
    event_words,
    frame_words,
    guarded_start,
    imu_words,
    packed,
    parse_aedat2_header,
    parse_aedat31_header,
)
from firmware_protocol.recordings.event_files import DatDecoder, EventStreamDecoder
from firmware_protocol.recordings.part import Facts, Part
from transports.recording.event_files import EventReader, check_end, decoded, opened
from transports.recording.format import format_to_read
from transports.recording.part import RecordingError, Size

_MOST_HEADER = 1 << 22  # jAER writes all its preferences: 2100 lines


class Aedat2Writer:
    """Writer of events, pin events, IMU samples and frames in jAER's layout, of a sensor of `facts.size`.

    A frame is the reset reads of its pixels, at the start of its exposure, and their signal reads at its end, which
    wait until all earlier data have arrived.
    """

    def __init__(self, path: Path, facts: Facts) -> None:
        self._size = facts.size or (0, 0)
        self._file = path.open("wb", buffering=1 << 16)
        self._file.write(aedat2_header(self._size, facts.unix_us))
        self._signal: list[Words] = []
        self._is_start = True

    def write(self, part: Part) -> None:
        """Append records; none of the next part is earlier."""
        reset = []
        for frame in part.frames:
            reads = frame_words(frame, self._size[1])
            reset.append(reads[0])
            self._signal.append(reads[1])
        words = [edge_words(part.edges), imu_words(part.imu), *reset, event_words(part.events, self._size)]
        until_us = max((int(stream["t"][-1]) for stream in words if len(stream)), default=0)
        due = [reads for reads in self._signal if int(reads["t"][0]) <= until_us]
        self._signal = [reads for reads in self._signal if int(reads["t"][0]) > until_us]
        self._append([*words[:2], *due, *words[2:]])

    def _append(self, words: list[Words]) -> None:
        records = packed(words)
        self._file.write(guarded_start(records) if self._is_start else records)
        self._is_start = self._is_start and not records
        self._file.flush()

    def close(self) -> None:
        """Write the waiting records and close the file."""
        try:
            self._append(self._signal)
        finally:
            self._file.close()


class Aedat2Reader:
    """Reader of events, pin events, IMU samples and frames; `size` is the sensor's if the file does not give it."""

    def __init__(self, path: Path, size: Size | None) -> None:
        self._path = path
        self._head = opened(parse_aedat2_header, path, _MOST_HEADER)
        size = size or self._head.size
        if not size:
            raise RecordingError("it does not contain the size of its sensor: give --size, such as 346x260")
        self.facts = Facts(size, "aedat2", self._head.unix_us, _STREAMS)

    def parts(self) -> Iterator[Part]:
        """Yield events, and raise RecordingError at the end if any were outside the sensor."""
        decoder = Aedat2Decoder(self.facts.size or (0, 0), self._head.chip)
        yield from decoded(decoder, self._path, self._head.start)
        if decoder.outside:
            raise RecordingError(
                f"{decoder.outside} events lie outside {self.facts.size} and are left out: give --size"
            )


class Aedat31Writer:
    """Writer of events, special events, IMU samples and frames in cAER's layout."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._file = path.open("wb", buffering=1 << 16)
        started = time.strftime("%Y-%m-%d %H:%M:%S (TZ+0000)", time.gmtime(facts.unix_us // 1_000_000))
        self._file.write(aedat31_header(facts.camera, started))

    def write(self, part: Part) -> None:
        """Append packets."""
        self._file.write(encode_aedat31(part.events, part.edges) + encode_imu(part.imu))
        for frame in part.frames:
            self._file.write(encode_frame(frame))
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Aedat31Reader:
    """Reader of events, special events, IMU samples and frames; the file does not give the size of its sensor."""

    def __init__(self, path: Path, size: Size | None) -> None:
        self._path = path
        self._start, source = opened(parse_aedat31_header, path, _MOST_HEADER)
        size_of_model = next((s for model, s in SIZES.items() if source.lower().startswith(model)), None)
        self.facts = Facts(size or size_of_model, source or "aedat31", streams=_STREAMS)

    def parts(self) -> Iterator[Part]:
        """Yield the contents of whole packets."""
        return decoded(Aedat31Decoder(), self._path, self._start)


_STREAMS = frozenset({"edges", "imu", "frames"})  # possible streams: only reading the whole file shows if they exist


DatReader = partial(EventReader, DatDecoder, "dat")
EsReader = partial(EventReader, EventStreamDecoder, "es")


_EVT_PIECE_BYTES = 1 << 17  # at most twelve events in each word: 786 432 events
_EVT_MOST_HEADER = 1 << 16


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

    def __init__(self, path: Path, size: Size | None) -> None:
        with path.open("rb") as file:
            head = file.read(_EVT_MOST_HEADER)
        text = re.match(rb"(?:%[^\n]*\n)*?(?:% end\s*?\n|(?!%))", head)
        if not text:
            raise RecordingError("its lines of text have no end")
        if not text[0]:
            raise RecordingError("it is no .raw file of Prophesee's cameras: they begin with a line of text, '% ...'")
        self._path, self._start = path, text.end()
        name = format_to_read(path).name
        self._form = None if name == "evt3" else cast("Form", name)
        lines = {key.decode(): value.decode(errors="replace") for key, value in _EVT_LINE.findall(text[0])}
        header = {key: value for key, value in lines.items() if key.lower() not in _EVT_FORM}
        self.facts = Facts(_evt_size(text[0]) or size, name, header=header)

    def parts(self) -> Iterator[Part]:
        """Yield events and triggers, half a mebibyte of words at a time."""
        decoder = Evt3Decoder() if self._form is None else Evt2Decoder(self._form)
        with self._path.open("rb") as file:
            file.seek(self._start)
            while data := file.read(_EVT_PIECE_BYTES):
                yield Part(*decoder.decode(data))
            check_end((file.tell() - self._start) % {"evt3": 2, "evt2": 4}.get(self._form or "evt3", 8))


_EVT_LINE = re.compile(rb"(?m)^% (\w{1,50}) +(\S.{,199}?)\s*$")
_EVT_FORM = {"evt", "format", "geometry", "endianness"}  # what these lines contain is in other facts


def _evt_size(text: bytes) -> Size | None:
    patterns = (
        rb"(?m)^% geometry (?P<width>[1-9]\d{0,4})x(?P<height>[1-9]\d{0,4})",
        rb"width=(?P<width>[1-9]\d{0,4});height=(?P<height>[1-9]\d{0,4})",
        rb"height=(?P<height>[1-9]\d{0,4});width=(?P<width>[1-9]\d{0,4})",
    )
    for pattern in patterns:
        if size := re.search(pattern, text):
            return int(size["width"]), int(size["height"])
    return None
