"""IMU samples of a run, step by step, as the camera's registers ask."""

from __future__ import annotations

from emulator.light import Light
from emulator.sensor.imu.converter import Converter
from emulator.sensor.imu.unit import ImuUnit
from firmware_protocol.imu_samples import IMU_SAMPLE, ImuSamples, ImuSettings, no_samples
from firmware_protocol.readings import ReadingKind

__all__ = ["ImuSource"]


class ImuSource:
    """A source of readings: what the unit feels, in counts. While nobody has switched it on, it costs nothing."""

    kind = ReadingKind.IMU
    record = IMU_SAMPLE

    def __init__(self, unit: ImuUnit) -> None:
        self._unit = unit
        self._converter = Converter()
        self._t_ns = 0

    def reset(self, light: Light, t_ns: int) -> None:
        """Start at `t_ns`."""
        self._t_ns = t_ns
        self._converter = Converter()

    def read(self, light: Light, t_ns: int, settings: tuple[int, ...]) -> ImuSamples:
        """Move to `t_ns` and return the samples until then."""
        asked = ImuSettings(bool(settings[0]), *settings[1:]) if settings else ImuSettings()
        since_ns, self._t_ns = self._t_ns, t_ns
        if not asked.run:
            self._converter.stop()
            return no_samples()
        return self._converter.samples(self._unit.between(since_ns, t_ns), asked)
