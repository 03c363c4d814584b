"""USB device model of a DVXplorer with an FX3, 640 x 480; `fx3.camera` describes its requests and its run gate.

Events need the chip's mode to be "stream" as well. Not modelled: binning, the activity decision block, global reset,
the external trigger mode of the chip, and messages on the debug endpoint.

Identity: 0x0309 in the device descriptor (FX3, firmware 9), logic 18, patch 4: the one choice that libcaer 3.3.15,
dv-processing 1.7.9 and 2.0.4, and neuromorphic_drivers 0.18 all open. Strings and power of a real camera are not
public; descriptors are those of a DAVIS346.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar

from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.dvxplorer.filters import ChipFilters
from firmware_protocol.dvxplorer.registers import (
    SIZE,
    SYSTEM,
    Chip,
    ChipStatistic,
    chip_of,
    imu_settings,
    registers,
    run_gate,
    scan_us,
    sensor_factors,
    without_effect,
)
from firmware_protocol.dvxplorer.words import GroupEncoder
from firmware_protocol.fx3.camera import Fx3Camera, Fx3Settings
from firmware_protocol.fx3.inputs import ReadingInput
from firmware_protocol.fx3.registers import Register, RunGate, SystemInfo
from firmware_protocol.fx3.stream import EventStream, Fifo
from firmware_protocol.fx3.words import Block, blocks_of
from firmware_protocol.imu_samples import AXES_ON_THE_WIRE, BMI160

PRODUCT_ID = 0x8419

_PAIRS = 1 << 7


@dataclass(frozen=True)
class DvxplorerSettings(Fx3Settings):
    """Settings of a DVXplorer.

    Attributes
    ----------
    bcd_device : low byte: firmware version, 9 for all drivers. High byte: 3, hardware with an FX3.
    imu_unit : 0 none, 3 BMI160.
    """

    product_id: ClassVar[int] = PRODUCT_ID
    imu_units: ClassVar[tuple[int, ...]] = (BMI160,)

    bcd_device: int = 0x0309
    size: tuple[int, int] = SIZE
    system: SystemInfo = field(default_factory=lambda: SYSTEM)
    product: str = "DVXplorer"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size != SIZE:
            raise ValueError(f"a DVXplorer has {SIZE[0]} x {SIZE[1]} pixels, got {self.size[0]} x {self.size[1]}")

    def registers(self) -> Iterator[Register]:
        """Yield its registers."""
        return registers(self.system, self.imu_unit)


class _Samples(ReadingInput):
    """Inertial samples on their way into the stream."""

    def follow(self, *, words: bool) -> None:
        self._imu = imu_settings(self._registers, words=words)

    def _blocks_of(self, kind: ReadingKind, readings: Readings) -> list[Block]:
        """Return samples as blocks; their words have the axes in the order of the wire."""
        sent = readings.copy()
        sent["counts"] = readings["counts"][:, AXES_ON_THE_WIRE]
        blocks = blocks_of(kind, readings)
        return [Block(b.t_us, a.words, b.reading) for a, b in zip(blocks_of(kind, sent), blocks, strict=True)]


class Dvxplorer(Fx3Camera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    settings: DvxplorerSettings

    def __init__(self, settings: DvxplorerSettings | None = None) -> None:
        self._encoder = GroupEncoder(SIZE)
        super().__init__(settings or DvxplorerSettings())

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases that hosts changed without an effect here, each with the reason."""
        return without_effect(chip_of(self._registers))

    @property
    def scan_us(self) -> float:
        """Period of a scan without events, us, in the registers."""
        return scan_us(self._registers)

    def _make_parts(self) -> None:
        self._stream = self._words = EventStream(self._encoder, Fifo(self.settings.fifo_bytes))
        self._filters = ChipFilters(self._fates)
        has_imu = self.settings.imu_unit != 0
        self._readings = _Samples(SIZE, self._registers, self._fates, has_frames=False, has_imu=has_imu)

    def _counted(self) -> Mapping[Enum, int]:
        """One FIFO stands for the DVS module's and the USB buffers': what is dropped found no room in it."""
        fates = self.counters
        return {
            ChipStatistic.MUX_EXTINPUT_DROPPED: fates.edges.dropped_fifo,
            ChipStatistic.MUX_DVS_DROPPED: fates.dropped_fifo,
            ChipStatistic.DVS_COLUMNS: self._words.rows,
            ChipStatistic.DVS_GROUPS: self._encoder.groups,
            ChipStatistic.DVS_DROPPED_COLUMNS: self._encoder.dropped_columns,
            ChipStatistic.DVS_DROPPED_GROUPS: self._encoder.dropped_groups,
        }

    def _factors_of_biases(self) -> Mapping[str, float]:
        return sensor_factors(chip_of(self._registers), self.scan_us)

    def _run_gate(self) -> RunGate:
        self._encoder.compressed = bool(chip_of(self._registers)(Chip.FORMAT) & _PAIRS)
        return run_gate(self._registers)
