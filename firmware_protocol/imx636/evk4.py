"""USB device model of a Prophesee EVK4 HD (IMX636) and its siblings.

The USB side, with its endpoints, is `prophesee.usb`.

Run gate: events leave while the array runs (register 0004 bit 10), the output is enabled (9028 bit 1 is 0) and time
runs (9008 bit 0). Words are EVT3, or EVT2.1 if the host sets it (7000 bit 1).

Biases act on the sensor through `sensor_factors`; see `prophesee.biases`.

Row and column masks take effect together when bit 5 of the array control is written; masked pixels at once. The event
rate control is that of `prophesee.camera`.

All boards on USB with an IMX636, or a sensor of its family, have the interface, the endpoints, the control protocol and
the words of the EVK4. They differ in these:

    board              vendor:product   kind   sensor      drivers
    EVK4               04B4:00F5        31     IMX636      neuromorphic_drivers, OpenEB
    EVK3 HD            04B4:00F5        30     Gen4.1      neuromorphic_drivers, OpenEB
    SilkyEvCam HD      31F7:0003        31     IMX636      neuromorphic_drivers 0.18
    SilkyEvCam HD Lite 31F7:0004        35     IMX646 (*)  neuromorphic_drivers 0.18
    uEye XCP-E         1409:8E00        31     IMX636      neuromorphic_drivers
    uEye XLS-E         1409:8E00 (*)    31 (*) IMX636 (*)  neuromorphic_drivers 0.18

(*) inferred, see below. The makers' own programs open the Silky and the uEye by plug-ins of OpenEB that are not public.

`kind` is the first byte of the answer to vendor request 72. neuromorphic_drivers lists a board by vendor, product and
kind, and compares both strings when it opens one; that of an EVK3 HD compares none. OpenEB compares neither: it reads
`Chip.compatible` and the registers of the chip.

Sources: neuromorphic_drivers (vendor, product and kind in the source of 0.16 and its successors; the strings as they
stand in the library of 0.18.2); its issue 5 (a user's SilkyEvCam HD Lite: 31F7:0004, kind 35), its pull requests 4
(SilkyEvCam HD) and 11 (uEye XLS-E: two strings, no other change); OpenEB 5.1.1, psee_universal.cpp, and the registers
that its drivers of the sensors check. Inferred:

- the sensor of the SilkyEvCam HD Lite: it has another kind than the SilkyEvCam HD, and OpenEB an HD sensor IMX646;
- the uEye XLS-E's product, kind and sensor: the pull request for it adds strings alone;
- the EVK3 HD's strings: no driver compares them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.events import Events, Int64s
from firmware_protocol.imx636.registers import (
    GEN41,
    IMX636,
    IMX646,
    PIXEL_MASKS,
    SIZE,
    Address,
    Chip,
    Registers,
    Surroundings,
)
from firmware_protocol.prophesee.camera import Mask, RateControl, Selected, unpacked
from firmware_protocol.prophesee.usb import BoardIdentity, ChipNames, TreuzellCamera, TreuzellSettings


@dataclass(frozen=True)
class BoardModel(BoardIdentity):
    """Identity of a board, and its sensor `chip`."""

    chip: Chip = IMX636


_PROPHESEE = (0x04B4, 0x00F5)
_SILKY = (0x31F7, 0x0003)
_SILKY_LITE = (0x31F7, 0x0004)
_UEYE = (0x1409, 0x8E00)
_IDS = "IDS Imaging Development Systems GmbH"

BOARDS: Mapping[str, BoardModel] = {
    "evk4": BoardModel("EVK4", _PROPHESEE, "Prophesee", "EVK4"),
    "evk3_hd": BoardModel("EVK3 HD", _PROPHESEE, "Prophesee", "EVK3", kind=0x30, chip=GEN41, short_frames=True),
    "silkyevcam_hd": BoardModel("SilkyEvCam HD", _SILKY, "CenturyArks", "SilkyEvCam HD v03.09.00C"),
    "silkyevcam_hd_lite": BoardModel(
        "SilkyEvCam HD Lite", _SILKY_LITE, "CenturyArks", "SilkyEvCam HD Lite v03.09.01C", kind=0x35, chip=IMX646
    ),
    "ueye_xcp_e": BoardModel("uEye XCP-E", _UEYE, _IDS, "UE-39B0XCP"),
    "ueye_xls_e": BoardModel("uEye XLS-E", _UEYE, _IDS, "UE-39B2XLS"),
}
"""Boards by the name of the camera model in a rig."""


_MASKS_ON = 1 << 1
_TAKE_OVER = 1 << 5
_KEEP_INSIDE = 1 << 6
_RATE = (Address.RATE_STATE, Address.RATE_PERIOD, Address.RATE_EVENTS, Address.RATE_ON, Address.RATE_DROPS)


@dataclass(frozen=True)
class Evk4Settings(TreuzellSettings):
    """Settings of a camera.

    `surroundings`: readings of the sensor's own instruments; `board`: the board's identity and its sensor.
    """

    size = SIZE
    surroundings: Surroundings = field(default_factory=Surroundings)
    board: BoardModel = BOARDS["evk4"]

    @property
    def chip_names(self) -> ChipNames:
        """Names of the sensor."""
        return ChipNames(self.board.chip.name, self.board.chip.compatible)


class Selection:
    """The masks and the rate control of a register file, applied to events."""

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.reset()

    def reset(self) -> None:
        """Return to the power-on state."""
        self._columns, self._rows = (np.zeros(pixels, np.bool_) for pixels in SIZE)
        self._pixels = np.zeros(0, np.int64)
        self._rate = RateControl(self._registers[Address.RATE_PERIOD])
        self._hides = False

    def written(self, address: int) -> None:
        """Apply the effect of a register that was just written."""
        if address == Address.RESET:
            self.reset()
        elif address == Address.ARRAY:
            self._take_over()
        elif Address.PIXELS <= address < Address.PIXELS + 4 * PIXEL_MASKS:
            words = self._registers.words(Address.PIXELS, PIXEL_MASKS)
            words = words[words >> 31 == 1].astype(np.int64)
            self._pixels = _numbers(words & 0x7FF, words >> 16 & 0x3FF)
        elif address in _RATE:
            self._set_rate()

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""
        selected = events[~self._hidden(events)] if self._hides or len(self._pixels) else events
        return self._rate.selected(events, selected, epoch_us)

    def _hidden(self, events: Events) -> Mask:
        hidden = np.zeros(len(events), np.bool_)
        if self._hides:
            rows, columns = self._rows[events["y"]], self._columns[events["x"]]
            inside = self._registers[Address.ARRAY] & _KEEP_INSIDE
            hidden = rows | columns if inside else rows & columns
        if len(self._pixels):
            hidden |= np.isin(_numbers(events["x"].astype(np.int64), events["y"].astype(np.int64)), self._pixels)
        return hidden

    def _take_over(self) -> None:
        control = self._registers[Address.ARRAY]
        if control & _TAKE_OVER:
            self._columns = self._mask(Address.COLUMNS, SIZE[0])
            self._rows = self._mask(Address.ROWS, SIZE[1])
        self._hides = bool(control & _MASKS_ON) and bool(self._columns.any() or self._rows.any())

    def _mask(self, address: int, pixels: int) -> Mask:
        return unpacked(self._registers.words(address, -(-pixels // 32)), pixels)

    def _set_rate(self) -> None:
        state, period_us, events, on, drops = (self._registers[address] for address in _RATE)
        self._rate.period_us, self._rate.most = max(1, period_us & 0x3FF), events & 0x3F_FFFF
        self._rate.on = bool(state & 3 == 1 and on & 1 and drops & 1)


def _numbers(x: Int64s, y: Int64s) -> Int64s:
    return y * SIZE[0] + x


class Evk4(TreuzellCamera):
    """The camera; see `prophesee.usb.TreuzellCamera`."""

    def __init__(self, settings: Evk4Settings | None = None) -> None:
        settings = settings or Evk4Settings()
        registers = Registers(settings.surroundings, settings.biases, settings.board.chip)
        super().__init__(settings, registers, Selection(registers))
