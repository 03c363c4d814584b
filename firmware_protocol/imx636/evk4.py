"""USB device model of a Prophesee EVK4 HD (IMX636) and its siblings: see `imx636.boards` for these.

The USB side, with its endpoints, is `prophesee.usb`.

Run gate: events leave while the array runs (register 0004 bit 10), the output is enabled (9028 bit 1 is 0) and time
runs (9008 bit 0). Words are EVT3, or EVT2.1 if the host sets it (7000 bit 1).

Biases act on the sensor through `sensor_factors`; see `prophesee.biases`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from firmware_protocol.imx636.boards import BOARDS, BoardModel
from firmware_protocol.imx636.registers import SIZE, Chip, Registers, Surroundings
from firmware_protocol.imx636.selection import Selection
from firmware_protocol.prophesee.usb import TreuzellCamera, TreuzellSettings

__all__ = ["Evk4", "Evk4Settings"]


@dataclass(frozen=True)
class Evk4Settings(TreuzellSettings):
    """Settings of a camera.

    Attributes
    ----------
    surroundings
        Readings of the sensor's own instruments.
    board
        The board: its identity and its sensor.
    """

    surroundings: Surroundings = field(default_factory=Surroundings)
    board: BoardModel = BOARDS["evk4"]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return SIZE

    @property
    def identity_of_board(self) -> BoardModel:
        """Identity of the board."""
        return self.board

    @property
    def chip_names(self) -> Chip:
        """Names of the sensor."""
        return self.board.chip


class Evk4(TreuzellCamera):
    """The camera; see `prophesee.usb.TreuzellCamera`."""

    def __init__(self, settings: Evk4Settings | None = None) -> None:
        settings = settings or Evk4Settings()
        registers = Registers(settings.surroundings, settings.biases, settings.board.chip)
        super().__init__(settings, registers, Selection(registers))
