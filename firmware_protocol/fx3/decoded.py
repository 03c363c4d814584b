"""Content of a piece of an FX3 camera's stream as its decoders return it: events, specials, frames, and faults."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Edges, Events
from firmware_protocol.frames import brightness
from firmware_protocol.fx3.words import IMU_READ, WORD, Special, Words, edges_of
from firmware_protocol.imu_samples import ImuSamples

_RESET = int(Special.TIMESTAMP_RESET)
_MARKS = np.array(
    [
        Special.INPUT_FALLING,
        Special.INPUT_RISING,
        Special.INPUT_PULSE,
        Special.GENERATOR_FALLING,
        Special.GENERATOR_RISING,
    ],
    WORD,
)


@dataclass(frozen=True)
class FrameRead:
    """A frame in the user's coordinates.

    Attributes
    ----------
    start_us, exposure_start_us, exposure_end_us, end_us : device time.
    exposure_cycles : exposure register, cycles of the ADC's clock.
    roi : first column, first row, last column, last row.
    resets : timestamp resets that the reader had read before.
    reset, signal : (rows, columns) uint16, the two reads of the region.
    """

    start_us: int
    exposure_start_us: int
    exposure_end_us: int
    end_us: int
    exposure_cycles: int
    global_shutter: bool
    roi: tuple[int, int, int, int]
    resets: int
    reset: Words
    signal: Words

    @property
    def pixels(self) -> Words:
        """(rows, columns) uint16, as `brightness`."""
        return brightness(self.reset, self.signal)


SPECIAL_EVENT = np.dtype([("t", "<u8"), ("code", "<u2"), ("index", "<i8")])
"""Device time in us, code (see `words.Special`), and how many events of the same Decoded came before it."""


@dataclass(frozen=True)
class Decoded:
    """Content of a piece of stream.

    Attributes
    ----------
    events : (n,) EVENT in device time, microseconds since the last timestamp reset.
    specials : (m,) SPECIAL_EVENT.
    frames : frames that this piece completed.
    imu_read : (k,) IMU_READ: samples of the inertial unit; see `ImuReader`.
    resets_in_all : timestamp resets since the decoder was made.
    """

    events: Events
    specials: npt.NDArray[np.void]
    frames: tuple[FrameRead, ...] = ()
    imu_read: npt.NDArray[np.void] = field(default_factory=lambda: np.empty(0, IMU_READ))
    resets_in_all: int = 0

    @property
    def resets(self) -> npt.NDArray[np.int64]:
        """Index into `events` of the first event after each timestamp reset."""
        index: npt.NDArray[np.int64] = self.specials["index"][self.specials["code"] == _RESET]
        return index

    def since_reset(self) -> Decoded:
        """Return the part after the last timestamp reset; the whole if there was none."""
        at = np.flatnonzero(self.specials["code"] == _RESET)
        if not len(at):
            return self
        first, specials = int(self.resets[-1]), self.specials[at[-1] + 1 :].copy()
        specials["index"] -= first
        frames = tuple(frame for frame in self.frames if frame.resets == self.resets_in_all)
        imu_read = self.imu_read[self.imu_read["resets"] == self.resets_in_all]
        return Decoded(self.events[first:], specials, frames, imu_read, self.resets_in_all)

    @property
    def imu(self) -> ImuSamples:
        """(k,) IMU_SAMPLE in device time."""
        return np.ascontiguousarray(self.imu_read["sample"])

    @property
    def edges(self) -> Edges:
        """(k,) EDGE in device time: edges that the external input and the generator reported; see `words`."""
        marks = self.specials[np.isin(self.specials["code"], _MARKS)]
        return edges_of(marks["t"], marks["code"])


@dataclass(frozen=True)
class WordFaults:
    """Words that a correct DVS stream does not contain, counted since the decoder was made."""

    row_outside: int = 0
    column_outside: int = 0
    time_not_increasing: int = 0
    unknown_special: int = 0
    unknown_misc: int = 0
    not_interpreted: int = 0

    def __add__(self, other: WordFaults) -> WordFaults:
        return WordFaults(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def total(self) -> int:
        """All faults; valid words that are not interpreted are not among them."""
        return (
            self.row_outside + self.column_outside + self.time_not_increasing + self.unknown_special + self.unknown_misc
        )
