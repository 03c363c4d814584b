"""USB device model of boards with Prophesee's Gen 3.1 (640 x 480): a SilkyEvCam VGA, an EVK3 VGA.

The USB side, with its endpoints, is `prophesee.usb`; the registers are in `registers`. The words are EVT3.

    board            vendor:product   kind   drivers
    SilkyEvCam VGA   31F7:0002        00     neuromorphic_drivers 0.18
    EVK3 VGA         04B4:00F5 (*)    28 (*) OpenEB 5.1.1

Both have a thermometer as device 1, whose register 0 is in degrees, and take registers by frames without a size (*).

Run gate: events leave while the analogue supply is on and time runs (register 0000), the output has its clock (0238),
the pixels run (0204) and events go to the host (0008). Drivers have the noise filter drop all events until .25 s
(OpenEB) or .25 ms (neuromorphic_drivers) after that.

Sources: neuromorphic_drivers (ids, kind, strings, names of the devices, order of its registers), OpenEB 5.1.1 (release,
interface, numbers of the system and of the chip). Inferred: (*) of the EVK3, whose kind is, as those of other boards,
OpenEB's number of the system; its strings, which OpenEB does not compare; the SilkyEvCam's number of the system; that
the noise filter, once on, drops events until the rate of a whole period is high enough.

Biases are voltages (diff, diff_on, diff_off: 7.06 mV a step) and currents. The effect on the simulated pixels:

    diff_on,        by their distance from diff. A threshold is taken as proportional to it: one over the 138 and 132 mV
    diff_off        of NIST's camera, on which the preset's thresholds were fitted; its delay of OFF events is measured
    fo, refr        one over the value at open, as for the IMX636: assumed is a current proportional to the register
    hpf             the IMX636's slope, 1 Hz a step above the value at open: a guess

`[camera.bias_slopes]` of a rig replaces any of them; `prophesee.biases` has the form of the factors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.events import Events
from firmware_protocol.gen31.registers import SIZE, Address, Registers
from firmware_protocol.prophesee.biases import BiasModel, BiasSlopes
from firmware_protocol.prophesee.camera import NoiseFilter, RateBand, Selected, unpacked
from firmware_protocol.prophesee.registers import NoRegister
from firmware_protocol.prophesee.treuzell import BoardDevice
from firmware_protocol.prophesee.usb import BoardIdentity, ChipNames, TreuzellCamera, TreuzellSettings

SLOPES = BiasSlopes(diff_on=0.051, diff_off=0.053, diff_off_above=0.053, off_delay=0.053, fo=1 / 61, refr=1 / 79)
"""Effect of one step of each bias."""

_SILKY = (0x31F7, 0x0002)
_PROPHESEE = (0x04B4, 0x00F5)
_TEXT = "SilkyEvCam Gen3.1 v03.09.00C"

BOARDS: Mapping[str, BoardIdentity] = {
    "silkyevcam_vga": BoardIdentity("SilkyEvCam VGA", _SILKY, "CenturyArks", _TEXT, kind=0, short_frames=True),
    "evk3_vga": BoardIdentity("EVK3 VGA", _PROPHESEE, "Prophesee", "EVK3", kind=0x28, short_frames=True),
}
"""Boards by the name of the camera model in a rig."""

CHIP_NAMES = ChipNames("CCam5 FPGA Event-Based Camera", ("psee,ccam5_fpga",))
"""The sensor's names."""


class _Thermometer:
    """Registers of a thermometer: register 0 has whole degrees."""

    def __init__(self, celsius: float) -> None:
        self._degrees = round(celsius) & 0xFF

    def read_register(self, address: int) -> int:
        """Return the temperature; raises NoRegister at another address than 0."""
        if address:
            raise NoRegister(f"no register at 0x{address:08X}")
        return self._degrees

    def write_register(self, address: int, value: int) -> None:
        """Raise NoRegister: nothing can be written."""
        raise NoRegister(f"register 0x{address:08X} cannot be written {value}")


@dataclass(frozen=True)
class Gen31Settings(TreuzellSettings):
    """Settings of a camera.

    Attributes
    ----------
    biases : effect of the biases on the sensor.
    board : the board's identity.
    celsius, lux : temperature of the board; light on the chip.
    """

    size = SIZE
    chip_names = CHIP_NAMES
    biases: BiasModel = field(default_factory=lambda: BiasModel(SLOPES))
    board: BoardIdentity = BOARDS["silkyevcam_vga"]
    celsius: float = 35.0
    lux: float = 100.0

    @property
    def beside_sensor(self) -> tuple[BoardDevice, ...]:
        """The thermometer."""
        return (BoardDevice("Temperature Sensor", ("ti,tmp103",), _Thermometer(self.celsius)),)


_WINDOWS_ON = 1 << 1
_TAKE_OVER = 1 << 5
_ANY_RATE = 1 << 62


class Selection:
    """The window and the noise filter of a register file, applied to events."""

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._noise = NoiseFilter()
        self.reset()

    def reset(self) -> None:
        """Return to the power-on state."""
        self._columns, self._rows = (np.ones(pixels, np.bool_) for pixels in SIZE)
        self._noise.configure(None)

    def written(self, address: int) -> None:
        """Apply the effect of a register that was just written."""
        if address == Address.RESET and self._registers[Address.RESET] & 1:
            self.reset()
        elif address == Address.ARRAY and self._registers[Address.ARRAY] & _TAKE_OVER:
            columns, rows = SIZE
            self._columns = unpacked(self._registers.words(Address.COLUMNS, 20), columns)
            self._rows = unpacked(self._registers.words(Address.ROWS, 15), rows)
        elif address in (Address.NOISE, Address.NOISE_RATE):
            rate = self._registers[Address.NOISE_RATE]
            period_us, least = max(1, rate >> 14 & 0x3FF), rate & 0x3FFF
            band = RateBand(period_us, least, least - 1, 0, _ANY_RATE)
            self._noise.configure(band if self._registers[Address.NOISE] & 1 else None, is_low=True)

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""
        selected = events
        if self._registers[Address.ARRAY] & _WINDOWS_ON:
            selected = selected[self._columns[selected["x"]] & self._rows[selected["y"]]]
        selected = self._noise.passed(selected, epoch_us)
        return Selected(selected, len(events) - len(selected), 0)


class Gen31(TreuzellCamera):
    """The camera; see `prophesee.usb.TreuzellCamera`."""

    def __init__(self, settings: Gen31Settings | None = None) -> None:
        settings = settings or Gen31Settings()
        registers = Registers(settings.lux)
        super().__init__(settings, registers, Selection(registers))
