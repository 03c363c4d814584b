"""Items: everything that moves through a camera in time order.

    item      record                                           at one time
    edge      (m,) EDGE: a change on the external input        first
    reading   one record of its kind: part of a frame, sample  second
    event     (n,) EVENT                                       last

A reading is one record of a structured array that has a field `t`, u64 microseconds of stream time. Its kind determines
the record: `frames.line_record` for frames, `imu_samples.IMU_SAMPLE` for samples.

The last stage of every camera is an `ItemEncoder`: it holds the items and makes bytes of them as late as possible, so
that items dropped before leave no trace in the bytes.

    camera            encoder                                   bytes
    DAVIS346          `fx3.stream.EventStream`                  words in transfers of USB
    DVXplorer         the same, with `dvxplorer.words`          words in transfers of USB
    DVXplorer Micro   `dvxplorer.frame_stream.FrameStream`      words in transfers of USB
    EVK4, Gen 3.1     `prophesee.usb.UsbOutflow`                EVT3 in transfers of USB
    GenX320           the same                                  EVT2.1, EVT2 or EVT3 in transfers of USB
    Triton2           `imx636.triton2.BlockOutflow`             EVT3 in blocks of GVSP
    instrument        `instrument.event_path.EventPath`         event blocks in messages
                      `instrument.event_path.EdgePath`          edge blocks in messages
    others            `plain_device.ItemQueue`                  none: the link makes them
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy.typing as npt

from firmware_protocol.events import Edges, Events, empty_edges, empty_events

Readings = npt.NDArray[Any]
"""Records of one kind, shape (n,), sorted by `t`."""


class ReadingKind(StrEnum):
    """Kind of a reading."""

    FRAMES = "frames"
    IMU = "imu"


@dataclass(frozen=True)
class Reading:
    """One record of a kind, (1,) of its dtype."""

    kind: ReadingKind
    record: Readings


_NO_READINGS: Counter[ReadingKind] = Counter()


class Numbers(NamedTuple):
    """Numbers of items of each kind; those of readings by their kind."""

    events: int = 0
    edges: int = 0
    readings: Counter[ReadingKind] = _NO_READINGS

    def plus(self, other: Numbers) -> Numbers:
        """Return the sums of both."""
        readings = self.readings + other.readings if other.readings else self.readings
        return Numbers(self.events + other.events, self.edges + other.edges, readings)

    def less(self, other: Numbers) -> Numbers:
        """Return what is left without `other`."""
        readings = self.readings - other.readings if other.readings else self.readings
        return Numbers(self.events - other.events, self.edges - other.edges, readings)

    @property
    def total(self) -> int:
        """Number of items of all kinds."""
        return self.events + self.edges + (self.readings.total() if self.readings else 0)


def count_kinds(readings: Sequence[Reading]) -> Counter[ReadingKind]:
    """Return the number of readings of each kind."""
    return Counter(reading.kind for reading in readings) if readings else _NO_READINGS


@dataclass(frozen=True)
class Items:
    """Items that leave a device together; nothing that leaves later is earlier.

    Attributes
    ----------
    events, edges, readings
        (n,) EVENT, (m,) EDGE, and readings, in stream time: microseconds since the start of the run.
    epoch_us : Stream time at which the device's own clock was last zero: device time is `t - epoch_us`. Negative if
        that clock was set ahead.
    """

    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    epoch_us: int = 0
    readings: tuple[Reading, ...] = ()

    @property
    def numbers(self) -> Numbers:
        """Numbers of its items."""
        return Numbers(len(self.events), len(self.edges), count_kinds(self.readings))


_Taken = TypeVar("_Taken", bound=Items, covariant=True)


class ItemEncoder(Protocol[_Taken]):
    """Last stage of a camera: items wait in it, and leave it together with their bytes."""

    @property
    def waiting(self) -> Numbers:
        """Numbers of items that wait."""

    def take(self, now_us: int, room: int) -> _Taken | None:
        """Remove the first items, as many as `room` permits, and return them with their bytes.

        None if nothing may leave at stream time `now_us`. `room` is the octets of a transfer or of a packet, or the
        most items of a message.
        """

    def clear(self) -> None:
        """Drop the items that wait."""
