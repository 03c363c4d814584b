"""The data path of a DVXplorer Micro after the gate: events wait as frames, and become words when they leave.

    events --in the order on the wire--> times of frames --> queue --> words, with a time word a millisecond --> host

All events of a frame get the time of its first event. A frame begins at a column that does not lie beyond the one
before, or when a period of the read-out has passed: inferred, as the chip reads its columns in rising order. So an
event is up to one period earlier than its column was read, as with the camera itself, which sends one time for each
frame.

Inertial samples leave at the interrupt endpoint, 16 octets each, as `sample_bytes` describes.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Numbers, Reading, ReadingKind, count_kinds
from firmware_protocol.dvxplorer.frame_words import FRAME_WORD, FrameEncoder, FrameTimes, in_wire_order
from firmware_protocol.dvxplorer.registers import SIZE
from firmware_protocol.events import Events, copy_events, empty_events, join_events
from firmware_protocol.fx3.inputs import ReadingInput
from firmware_protocol.fx3.registers import RegisterFile
from firmware_protocol.fx3.stream import Late
from firmware_protocol.fx3.words import Block, Marks, no_marks
from firmware_protocol.imu_samples import IMU_SAMPLE, ImuSamples, ImuSettings
from firmware_protocol.usb.device import Transfer

_BYTES_PER_EVENT = 8  # a column and a group
_MIN_BYTES = 1024
_IDLE_MS = 2  # time-out of a buffer that is not full (dv-processing writes 2000 us)
_LEAST_ROOM = 256  # words made together, also for a host that requests less
_FOREVER_US = 1 << 62


class FrameStream:
    """Frames on their way to the host, an `ItemEncoder`.

    Parameters
    ----------
    size : (width, height) of the array; events outside are refused.
    fifo_bytes : room for events that wait, at eight bytes each; at least 1024.

    Attributes
    ----------
    period_us : longest frame, us; 0: each time is a frame of its own.
    epoch_us : stream time at which device time is zero.
    """

    def __init__(self, size: tuple[int, int], fifo_bytes: int) -> None:
        if fifo_bytes < _MIN_BYTES:
            raise ValueError(f"a FIFO of {fifo_bytes} bytes is too small; give it at least {_MIN_BYTES}")
        self._size, self._capacity = size, fifo_bytes // _BYTES_PER_EVENT
        self._encoder, self._times = FrameEncoder(), FrameTimes()
        self._queue: deque[Events] = deque()
        self._queued = 0
        self._room = np.empty(_LEAST_ROOM, FRAME_WORD)
        self._cut: Transfer | None = None  # the rest of words beyond the length that the host requested
        self.period_us = 0.0
        self.epoch_us = 0

    @property
    def waiting(self) -> Numbers:
        """Numbers of events that wait."""
        cut = 0 if self._cut is None else len(self._cut.events)
        return Numbers(self._queued + cut)

    @property
    def free_words(self) -> int:
        """Free room for words of events."""
        return 2 * (self._capacity - self._queued)

    @property
    def room_until_us(self) -> int:
        """Without limit: words of time are made when they leave."""
        return _FOREVER_US

    def room_beside(self, reserved_words: int) -> int:
        """Return the number of events that fit; nothing else shares the room."""
        return self._capacity - self._queued

    def start_time(self, now_us: int) -> None:
        """Begin device time at zero for a reader in its initial state; drop the queue."""
        self.clear()
        self.epoch_us = now_us
        self._times.start(now_us)
        self._encoder.reset(now_us)

    def reset_time(self, now_us: int) -> None:
        """Do nothing: a Micro's time cannot be reset."""

    def advance(self, now_us: int) -> None:
        """Do nothing: words of time are made when they leave."""

    def put(self, events: Events, marks: Marks | None = None, blocks: Sequence[Block] = ()) -> Late:
        """Queue `events`, (n,) EVENT in stream time, with the times of their frames; drop those that find no room."""
        ordered = in_wire_order(events, self._size)
        fitting = ordered[: self.room_beside(0)]
        if len(fitting):
            fitting = copy_events(fitting) if ordered is events else fitting
            self._times.put(fitting, self.period_us)
            self._queue.append(fitting)
            self._queued += len(fitting)
        if len(fitting) < len(ordered):
            self._times.end_frame()
        return Late(len(ordered) - len(fitting), no_marks(), ())

    def clear(self) -> None:
        """Drop the queue; the next event begins a frame."""
        self._queue.clear()
        if self._cut is not None:
            self._encoder.take_back(np.frombuffer(self._cut.data, FRAME_WORD))
        self._queued, self._cut = 0, None
        self._times.end_frame()

    def take(self, now_us: int, room: int) -> Transfer | None:
        """Remove up to `room` octets of whole words; None if there are none."""
        if room < FRAME_WORD.itemsize:
            return None
        transfer = self._cut or self._next(now_us, max(room // FRAME_WORD.itemsize, _LEAST_ROOM))
        if transfer is None or len(transfer.data) <= room:
            self._cut = None
            return transfer
        end = room - room % FRAME_WORD.itemsize
        self._cut = replace(transfer, data=transfer.data[end:])
        return Transfer(epoch_us=transfer.epoch_us, data=transfer.data[:end])

    def _next(self, now_us: int, room: int) -> Transfer | None:
        if len(self._room) < room:
            self._room = np.empty(room, FRAME_WORD)
        out = self._room[:room]
        taken = [empty_events()]
        written = 0
        while self._queue:
            n_events, n_words = self._encoder.encode(self._queue[0], out[written:])
            taken.append(self._queue[0][:n_events])
            written += n_words
            if n_events < len(self._queue[0]):
                self._queue[0] = self._queue[0][n_events:]
                break
            self._queue.popleft()
        self._queued -= sum(map(len, taken))
        own_us = now_us - self.epoch_us
        if not self._queue and own_us // 1000 >= self._encoder.last_ms + _IDLE_MS:
            written += self._encoder.times(own_us, out[written:])
        if not written:
            return None
        return Transfer(join_events(taken), epoch_us=self.epoch_us, data=out[:written].tobytes())


_SAMPLE = struct.Struct("<BB7h")
SAMPLE_BYTES = _SAMPLE.size
_ON_THE_WIRE = (4, 5, 6, 0, 1, 2, 3)
_MOST_READY = 16  # samples that wait for the host


def sample_bytes(sample: ImuSamples) -> bytes:
    """Return one sample, (1,) IMU_SAMPLE, as it leaves the interrupt endpoint.

    1, scale byte, then int16 little-endian: gyroscope x, y, z, accelerometer x, y, z, temperature. It has no time.
    """
    return _SAMPLE.pack(1, int(sample["scale"][0]), *(int(sample["counts"][0][k]) for k in _ON_THE_WIRE))


def sample_of(data: bytes, t_us: int) -> ImuSamples | None:
    """Return the sample, (1,) IMU_SAMPLE at `t_us`, in a message of the interrupt endpoint; None for other messages."""
    if len(data) != SAMPLE_BYTES or data[0] != 1:
        return None
    _, scale, *counts = _SAMPLE.unpack(data)
    sample = np.zeros(1, IMU_SAMPLE)
    sample["t"], sample["scale"] = t_us, scale
    sample["counts"][0][list(_ON_THE_WIRE)] = counts
    return sample


class SampleOutput(ReadingInput):
    """Inertial samples, which leave by an endpoint of their own; the oldest are dropped while no host reads them.

    `settings_in` returns the settings in the registers, `words` as `follow` has it.
    """

    def __init__(
        self, registers: RegisterFile, fates: Fates, settings_in: Callable[..., ImuSettings], *, has_imu: bool
    ) -> None:
        super().__init__(SIZE, registers, fates, has_frames=False, has_imu=has_imu)
        self._settings_in = settings_in
        self._ready: deque[Reading] = deque()

    def follow(self, *, words: bool) -> None:
        """Read the settings of the inertial unit."""
        self._imu = self._settings_in(self._registers, words=words)

    def room(self, kind: ReadingKind, free_words: int) -> int:
        """Return the number of samples that fit beside those whose time has not come."""
        return max(0, _MOST_READY - len(self._waiting))

    def due(self, now_us: int, until_us: int, free_words: int) -> list[Block]:
        """Make the samples up to `until_us` ready; none enters the stream of events."""
        due = super().due(now_us, until_us, _FOREVER_US)
        self._ready.extend(block.reading for block in due)
        dropped = max(0, len(self._ready) - _MOST_READY)
        for _ in range(dropped):
            self._ready.popleft()
        if dropped:
            self._fates.of(ReadingKind.IMU).dropped_fifo += dropped
        return []

    def take(self, room: int, epoch_us: int) -> Transfer | None:
        """Remove the oldest sample that is ready; None if there is none, or no `room` for it."""
        if not self._ready or room < SAMPLE_BYTES:
            return None
        sample = self._ready.popleft()
        return Transfer(epoch_us=epoch_us, readings=(sample,), data=sample_bytes(sample.record))

    def flush(self) -> None:
        """Drop the samples that wait."""
        super().flush()
        self._ready.clear()

    @property
    def waiting(self) -> Numbers:
        """Numbers of samples that were offered and have not left."""
        return super().waiting.plus(Numbers(readings=count_kinds(tuple(self._ready))))
