"""USB device model of a DAVIS346; `fx3.camera` describes its requests and its run gate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

from firmware_protocol.davis346.biases import BIASES, sensor_factors
from firmware_protocol.davis346.filters import DavisStatistics, DvsFilters
from firmware_protocol.davis346.registers import Layout, frame_settings, imu_settings, lines_wait, registers
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.device.fates import Fates
from firmware_protocol.fx3.camera import Fx3Camera, Parts
from firmware_protocol.fx3.inputs import ReadingInput
from firmware_protocol.fx3.registers import Module, Register, RegisterFile
from firmware_protocol.fx3.settings import Fx3Settings
from firmware_protocol.fx3.stream import EventStream, Fifo

PRODUCT_ID = 0x841A


@dataclass(frozen=True)
class Davis346Settings(Fx3Settings):
    """Settings of a DAVIS346.

    Attributes
    ----------
    bcd_device
        Low byte: firmware version, 6 for all drivers. High byte: hardware, 2 "blue", 3 "red".
    size
        (width, height) of the array. neuromorphic_drivers assumes 346 x 260; other sensors may send their events in
        DAVIS words if the receiver is configured for their size.
    layout
        Order in which rows and columns are sent.
    imu_unit
        0 none, 1 MPU-6050, 2 MPU-9250 or MPU-6500.
    activity_filter
        True if it has the filters of background activity and refractory period.
    """

    product_id: ClassVar[int] = PRODUCT_ID
    imu_units: ClassVar[tuple[int, ...]] = (1, 2)

    bcd_device: int = 0x0206
    size: tuple[int, int] = (346, 260)
    layout: Layout = Layout.UPRIGHT
    activity_filter: bool = False
    product: str = "DAViS FX3"

    def registers(self) -> Iterator[Register]:
        """Yield its registers."""
        return registers(self.size, self.layout, self.system, self.imu_unit, activity_filter=self.activity_filter)


class _DavisReadings(ReadingInput):
    """Frames and inertial samples of a DAVIS346."""

    def __init__(self, settings: Davis346Settings, registers: RegisterFile, fates: Fates) -> None:
        super().__init__(settings, registers, fates)
        self._size, self._layout = settings.size, settings.layout

    def follow(self, *, words: bool) -> None:
        self._lines_wait = lines_wait(self._registers)
        self._frames = frame_settings(self._registers, self._size, self._layout, words=words)
        self._imu = imu_settings(self._registers, words=words)


class Davis346(Fx3Camera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    settings: Davis346Settings

    def __init__(self, settings: Davis346Settings | None = None) -> None:
        super().__init__(settings or Davis346Settings())

    def _make_parts(self) -> Parts:
        settings = self.settings
        stream = EventStream(WordEncoder(settings.size, settings.layout.turned), Fifo(settings.fifo_bytes))
        filters = DvsFilters(settings.size, self._fates, has_activity=settings.activity_filter)
        readings = _DavisReadings(settings, self._registers, self._fates)
        return Parts(stream, filters, readings, DavisStatistics(self, stream, filters))

    def _factors_of_biases(self) -> Mapping[str, float]:
        return sensor_factors({bias.address: self._registers.read(Module.BIAS, bias.address) for bias in BIASES})
