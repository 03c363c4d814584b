"""USB device model of Prophesee's board with a GenX320: the Treuzell protocol of the EVK4, another sensor.

The USB side, with its endpoints, is `prophesee.usb`; the registers are in `registers`.

Run gate: events leave while the pixels run (register 0000 bit 10), the output is enabled (9028 bit 1 is 0) and time
runs (9008 bit 0). Words are EVT2.1 from power-on; EVT2 or EVT3 if the host sets it (7044).

Sources: OpenEB 5.1.1, whose drivers require the ids, the interface, `Chip.compatible`, the chip's register and a
release from 03.08.00 on. Inferred: the strings and the name of the sensor, which OpenEB does not compare; the kind of
board, which for other boards is OpenEB's number of the system (EVK3 with a GenX320 in production: 3B).

The effect of the biases on the simulated pixels is uncertain: no formula and no measurement is public.

Biases are absolute, 0 to 127; at the values that OpenEB writes when it opens the sensor (fo 34, hpf 40, diff_on 25,
diff 51, diff_off 28, refr 10) all factors are 1. `prophesee.biases` has the form of the factors.

    directions      those of Prophesee's page "Biases", which holds for all its sensors: a higher diff_on, diff_off is a
                    higher threshold, a higher fo passes faster changes, a higher refr is a shorter dead time. OpenMV's
                    guide to its presets agrees on the first three, and states the opposite of refr
    diff_on,        twice the IMX636's slopes, which were fitted to a measurement: assumed is that 7 bits here span the
    diff_off        range of 8 bits there
    fo, refr        one over the value at open, as for the IMX636: assumed is a current proportional to the register

hpf has the IMX636's slope, above the value at open. `[camera.bias_slopes]` of a rig replaces any of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.genx320.registers import SIZE, Registers, Surroundings
from firmware_protocol.genx320.selection import Selection
from firmware_protocol.prophesee.biases import BiasModel, BiasSlopes
from firmware_protocol.prophesee.usb import BoardIdentity, ChipNames, TreuzellCamera, TreuzellSettings

SLOPES = BiasSlopes(diff_on=0.0286, diff_off=0.0416, diff_off_above=0.0272, off_delay=0.089, fo=1 / 34, refr=0.1)
"""Effect of one step of each bias."""

_TRAIL = 0xD000, 0xD008, 0xD00C


BOARD = BoardIdentity("EVK3 GenX320", (0x04B4, 0x00F5), "Prophesee", "EVK3", kind=0x3B)
CHIP_NAMES = ChipNames("CX3 GenX320 Event-Based Camera", ("psee,cx3_genx320",))
"""The board's identity, and the sensor's names."""


@dataclass(frozen=True)
class Genx320Settings(TreuzellSettings):
    """Settings of a camera.

    Attributes
    ----------
    biases : effect of the biases on the sensor.
    surroundings, board : readings of the sensor's own instruments; identity of the board.
    """

    size = SIZE
    chip_names = CHIP_NAMES
    biases: BiasModel = field(default_factory=lambda: BiasModel(SLOPES))
    surroundings: Surroundings = field(default_factory=Surroundings)
    board: BoardIdentity = BOARD


class Genx320(TreuzellCamera):
    """The camera; see `prophesee.usb.TreuzellCamera`."""

    def __init__(self, settings: Genx320Settings | None = None) -> None:
        settings = settings or Genx320Settings()
        registers = Registers(settings.surroundings, settings.biases)
        super().__init__(settings, registers, Selection(registers))

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Settings that hosts changed without an effect here, each with the reason."""
        control, trail, burst = (self.read_register(address) for address in _TRAIL)
        is_on = control & 5 == 1 and (trail | burst) & 1
        changed = {"trail_filter": "it is not modelled"} if is_on else {}
        return {**super().without_effect, **changed}
