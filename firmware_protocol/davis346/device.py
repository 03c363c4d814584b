"""USB device model of a DAVIS346 and of a DAVIS240C (see `model`); `fx3.camera` describes requests and run gate.

The DVS module's filters between run gate and encoder, in the order of the published logic, and its statistics.

    events -> polarity -> region of interest -> hot pixels -> background activity, refractory -> skip -> encoder

    register  filter      rule
    61        polarity    1: all events become OFF
    62, 63    polarity    1: those of one polarity are suppressed, ON where 63 is 1; by the polarity of the pixel
    41..44    region      start column, start row, end column, end row; both ends belong to it
    11..26    hot pixels  eight pairs of row and column
    31..34    see `activity_filter`, in a camera that has it
    51, 52    skip        1: N events pass, the next one is skipped, and so on; N is register 52

Coordinates are the user's in both layouts: the logic swaps them itself. Only power-on resets the count of the skip
filter. Filtered events are counted as not selected, except those of background activity and refractory period, which
have their own fates. The statistics of the module count the events of these two filters and of the hot pixels; they
have no counter for polarity, region and skip.

Source: DVSAERFilters of the published logic (DAVIS FX3), libcaer 3.3.15 (davis.h).

The counter registers show events since power-on, from the counters of the camera's parts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from firmware_protocol.davis346.biases import sensor_factors
from firmware_protocol.davis346.model import DAVIS240C, DAVIS346, DavisModel
from firmware_protocol.davis346.registers import Layout, Statistic, frame_settings, imu_settings, lines_wait, registers
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.device.fates import Counts, Fates
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Events, Mask
from firmware_protocol.fx3.camera import Fx3Camera, Fx3Settings
from firmware_protocol.fx3.inputs import ReadingInput
from firmware_protocol.fx3.registers import Module, Register, RegisterFile, SystemInfo
from firmware_protocol.fx3.stream import EventStream, Fifo
from firmware_protocol.fx3.words import Block
from firmware_protocol.usb.descriptors import Speed


@dataclass(frozen=True)
class Davis346Settings(Fx3Settings):
    """Settings of a DAVIS346.

    Attributes
    ----------
    bcd_device : low byte: firmware version, 6 for all drivers. High byte: hardware, 2 "blue", 3 "red".
    size : (width, height) of the array. neuromorphic_drivers assumes 346 x 260; other sensors may send their events in
        DAVIS words if the receiver is configured for their size.
    layout : order in which rows and columns are sent.
    imu_unit : 0 none, 1 MPU-6050, 2 MPU-9250 or MPU-6500.
    activity_filter : True if it has the filters of background activity and refractory period.
    """

    model: ClassVar[DavisModel] = DAVIS346
    product_id: ClassVar[int] = DAVIS346.product_id
    imu_units: ClassVar[tuple[int, ...]] = (1, 2)

    bcd_device: int = 0x0206
    size: tuple[int, int] = (346, 260)
    layout: Layout = Layout.UPRIGHT
    activity_filter: bool = False
    product: str = "DAViS FX3"

    def registers(self) -> Iterator[Register]:
        """Yield its registers."""
        return registers(
            self.size, self.layout, self.system, self.imu_unit, activity_filter=self.activity_filter, model=self.model
        )


@dataclass(frozen=True)
class Davis240cSettings(Davis346Settings):
    """Settings of a DAVIS240C; low byte of `bcd_device`: firmware version 4, high byte 0: an FX2."""

    model: ClassVar[DavisModel] = DAVIS240C
    product_id: ClassVar[int] = DAVIS240C.product_id
    imu_units: ClassVar[tuple[int, ...]] = (1,)
    bcd_usb: ClassVar[int] = 0x0200
    has_debug_endpoint: ClassVar[bool] = False

    bcd_device: int = 0x0004
    size: tuple[int, int] = DAVIS240C.size
    speed: Speed = Speed.HIGH
    system: SystemInfo = field(
        default_factory=lambda: SystemInfo(chip_id=2, logic_clock_mhz=90, adc_clock_mhz=30, usb_clock_mhz=30)
    )
    product: str = "DAViS FX2"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.layout.turned:
            raise ValueError("the chip of a DAVIS240C is mounted upright: layout must be upright")
        if self.activity_filter:
            raise ValueError("a DAVIS240C has no filters of activity: activity_filter must be false")


class _DavisReadings(ReadingInput):
    """Frames and inertial samples of a DAVIS."""

    def __init__(self, settings: Davis346Settings, registers: RegisterFile, fates: Fates) -> None:
        super().__init__(settings.size, registers, fates, has_frames=settings.frames, has_imu=settings.imu_unit != 0)
        self._size, self._layout = settings.size, settings.layout
        self._shift = settings.model.sample_shift

    def follow(self, *, words: bool) -> None:
        self._lines_wait = lines_wait(self._registers)
        self._frames = frame_settings(self._registers, self._size, self._layout, words=words)
        self._imu = imu_settings(self._registers, words=words)

    def _blocks_of(self, kind: ReadingKind, readings: Readings) -> list[Block]:
        """Return readings as blocks: words of samples without their low bits, readings as hosts restore them."""
        if kind is not ReadingKind.FRAMES or not self._shift:
            return super()._blocks_of(kind, readings)
        sent = readings.copy()
        sent["samples"] >>= self._shift
        blocks = super()._blocks_of(kind, sent)
        for block in blocks:
            block.reading.record["samples"] <<= self._shift
        return blocks


class Davis346(Fx3Camera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    settings: Davis346Settings
    _stream: EventStream
    _filters: DvsFilters

    def __init__(self, settings: Davis346Settings | None = None) -> None:
        super().__init__(settings or Davis346Settings())

    def _make_parts(self) -> None:
        settings = self.settings
        self._stream = EventStream(WordEncoder(settings.size, settings.layout.turned), Fifo(settings.fifo_bytes))
        self._filters = DvsFilters(settings.size, self._fates, has_activity=settings.activity_filter)
        self._readings = _DavisReadings(settings, self._registers, self._fates)

    def _counted(self) -> Mapping[Enum, int]:
        """One FIFO stands for the DVS module's and the USB buffers', so both dropped counters show its drops."""
        fates = self.counters
        return {
            Statistic.DVS_ROWS: self._stream.rows,
            Statistic.DVS_COLUMNS: fates.flushed + fates.delivered + fates.lost_on_link + fates.queued,
            Statistic.DVS_DROPPED: fates.dropped_fifo,
            Statistic.DVS_FILTERED_PIXELS: self._filters.hot,
            Statistic.DVS_FILTERED_BACKGROUND_ACTIVITY: fates.dropped_background,
            Statistic.DVS_FILTERED_REFRACTORY: fates.dropped_refractory,
            Statistic.MUX_DVS_DROPPED: fates.dropped_fifo,
            Statistic.MUX_EXTINPUT_DROPPED: fates.edges.dropped_fifo,
        }

    def _factors_of_biases(self) -> Mapping[str, float]:
        model = self.settings.model
        words = {bias.address: self._registers.read(Module.BIAS, bias.address) for bias in model.biases}
        return sensor_factors(words, model.biases, least_fine=model.least_fine)


class Davis240c(Davis346):
    """The same device with the records of a DAVIS240C."""

    def __init__(self, settings: Davis240cSettings | None = None) -> None:
        super().__init__(settings or Davis240cSettings())


if TYPE_CHECKING:
    from firmware_protocol.davis346.activity_filter import ActivityFilter, ActivityResult


_HOT_PIXELS = 8


@dataclass(frozen=True)
class FilterSettings:
    """Filter settings in the registers; a filter that the camera has not lets all events pass.

    Attributes
    ----------
    suppressed : polarity that does not pass; None: both do.
    region : (first column, first row, last column, last row).
    hot : (column, row) of each pixel that does not pass; those outside the array are left out.
    every : events that pass before one is skipped; None: all pass.
    """

    flatten: bool
    suppressed: bool | None
    region: tuple[int, int, int, int]
    hot: tuple[tuple[int, int], ...]
    every: int | None

    @property
    def is_open(self) -> bool:
        """True if events of every pixel of the region pass unchanged."""
        return not self.flatten and self.suppressed is None and not self.hot and self.every is None

    @classmethod
    def of(cls, registers: RegisterFile, size: tuple[int, int]) -> FilterSettings:
        """Return the settings in the registers of a camera of `size` (width, height)."""

        def value(address: int) -> int:
            return registers.read(Module.DVS, address)

        pairs = [(value(12 + 2 * k), value(11 + 2 * k)) for k in range(_HOT_PIXELS)] if value(10) else []
        return cls(
            flatten=bool(value(61) & 1),
            suppressed=bool(value(63) & 1) if value(62) & 1 else None,
            region=(value(41), value(42), value(43), value(44)) if value(40) else (0, 0, size[0] - 1, size[1] - 1),
            hot=tuple((x, y) for x, y in pairs if x < size[0] and y < size[1]),
            every=value(52) if value(51) & 1 else None,
        )


@dataclass(frozen=True)
class _Filtered:
    """Counts of the events of a batch that did not pass, for `DvsFilters.take`.

    Attributes
    ----------
    not_selected, hot : numbers of events not selected, and of those among them at hot pixels.
    counted : number of events that reached the skip filter.
    activity : result of the activity filter; None: it is off.
    """

    not_selected: int = 0
    hot: int = 0
    counted: int = 0
    activity: ActivityResult | None = None


class DvsFilters:
    """The filters of one camera, which count in its `fates`; `hot`: of the events not selected, those at hot pixels."""

    def __init__(self, size: tuple[int, int], fates: Counts, *, has_activity: bool = False) -> None:
        self._fates = fates
        self._size = size
        self._whole = (0, 0, size[0] - 1, size[1] - 1)
        self._skip_count = 0
        self.hot = 0
        self._filtered = _Filtered()
        self._activity: ActivityFilter | None = None
        if has_activity:
            from firmware_protocol.davis346.activity_filter import ActivityFilter

            self._activity = ActivityFilter(size)

    def power_on(self) -> None:
        """Set the count of the skip filter to zero, and clear the memory of the activity filter."""
        self._skip_count = 0
        if self._activity is not None:
            self._activity.power_on()

    def follow(self, registers: RegisterFile, now_us: int) -> None:
        """Apply registers that were written at `now_us`."""
        self._settings = FilterSettings.of(registers, self._size)
        if self._activity is not None:
            self._activity.follow(registers, now_us)

    def passed(self, events: Events, registers: RegisterFile) -> Events:
        """Return the part of `events`, (n,) EVENT, that passes; `events` may be changed. `take` counts the others."""
        settings = self._settings
        self._filtered = _Filtered()
        if self._activity is None and settings.is_open and settings.region == self._whole:
            return events
        good = self._in_region(events, settings)
        if settings.suppressed is not None:
            good &= events["on"] != settings.suppressed
        cold = np.ones(len(events), np.bool_)
        for x, y in settings.hot:
            cold &= (events["x"] != x) | (events["y"] != y)
        hot = int(np.count_nonzero(good & ~cold))
        good &= cold
        activity = None if self._activity is None else self._activity.result_for(events[good], registers)
        if activity is not None:
            good[good] = activity.passes
        counted = 0 if settings.every is None else int(np.count_nonzero(good))
        if settings.every is not None:
            places = self._skip_count + np.arange(counted)
            good[np.flatnonzero(good)[places % (settings.every + 1) == settings.every]] = False
        if settings.flatten:
            events["on"] = False
        passing = events if good.all() else events[good]
        dropped = 0 if activity is None else activity.isolated + activity.too_soon
        self._filtered = _Filtered(len(events) - len(passing) - dropped, hot, counted, activity)
        return passing

    def take(self) -> None:
        """Count the events that did not pass in the last call of `passed`."""
        filtered = self._filtered
        if self._activity is not None and filtered.activity is not None:
            self._activity.take(filtered.activity)
            self._fates.dropped_background += filtered.activity.isolated
            self._fates.dropped_refractory += filtered.activity.too_soon
        self._fates.not_selected += filtered.not_selected
        self.hot += filtered.hot
        self._skip_count += filtered.counted

    def _in_region(self, events: Events, settings: FilterSettings) -> Mask:
        if settings.region == self._whole:  # so that events outside the array are still refused, and not filtered
            return np.ones(len(events), np.bool_)
        left, top, right, bottom = settings.region
        x, y = events["x"], events["y"]
        return (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
