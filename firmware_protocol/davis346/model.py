"""Records of the cameras of the DAVIS family: the properties in which one differs from another.

    DAVIS346    FX3, 346 x 260, converter on the chip, 37 addresses of biases
    DAVIS240C   FX2, 240 x 180, converter on the board, 22 addresses of biases

Both have the requests, modules, words and run gate of `fx3.camera`, since libcaer reads both with one parser.

The DAVIS240C: product 841b, firmware 4, logic 18 and chip 2 are those of libcaer 3.3.15 (davis.c, davis.h). The rest is
that of the published sources for its board, of which logic 18 is a later version:

    clocks        logic 90 MHz, ADC and USB 30 MHz, exact (Settings_DAVIS240c.vhd, MachXO)
    geometry      columns and rows are the user's, frames start in the upper left corner (Settings_DAVIS240c.vhd):
                  orientation 0
    logic         no filters, no statistics and no generator: the board's top level builds none of them (TopLevel.vhd,
                  MachXO). Their registers do not exist, and all that report a part read 0
    chip          parameters 128 to 142 (DAVIS240ConfigRecords.vhd); 139 has no effect on a DAVIS240C (jAER)
    descriptors   USB 2.0, bulk endpoint 0x82 alone, "DAViS FX2" (dscr.a51 of the firmware)

Its converter's references leave half of the range, so libcaer doubles the samples (davis_common.h): `sample_shift`.

A source of 0 has no current by libcaer's formula, and libcaer writes OffBn = (4, 0) by default: an OFF threshold
without bound, which the real camera has not. Half a step of the fine value, `least_fine`, is an estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.davis346.biases import BIASES, DAVIS240_BIASES, BiasDefinition
from firmware_protocol.fx3.registers import Module, Rows


@dataclass(frozen=True)
class DavisModel:
    """A camera of the family.

    Attributes
    ----------
    product_id : product number of USB.
    size : (width, height) in the user's frame.
    biases : its biases.
    chip : parameters of the chip, behind the biases in module 5.
    lacks : (module, first, last address) of registers that the others have and this one has not.
    sample_shift : bits by which a sample of its frames is below that of a 10-bit converter with its whole range.
    least_fine : fine value that stands for 0 in a current source.
    """

    product_id: int
    size: tuple[int, int]
    biases: tuple[BiasDefinition, ...]
    chip: Rows
    lacks: tuple[tuple[Module, int, int], ...] = ()
    sample_shift: int = 0
    least_fine: float = 0.0

    def has(self, module: Module, address: int) -> bool:
        """Return true if it has a register that others of the family have."""
        return not any(module is of and first <= address <= last for of, first, last in self.lacks)


_CHIP: Rows = (
    *((128 + k, f"DIGITAL_MUX_{k}", 0, 4) for k in range(4)),
    *((132 + k, f"ANALOG_MUX_{k}", 0, 4) for k in range(3)),
    (135, "BIAS_MUX_0", 0, 4),
    (136, "RESET_CALIB_NEURON", 1),
    (137, "TYPE_N_CALIB_NEURON", 0),
    (138, "RESET_TEST_PIXEL", 1),
    (140, "AER_N_AROW", 0),
    (141, "USE_AOUT", 0),
    (142, "GLOBAL_SHUTTER", 1),
)

DAVIS346 = DavisModel(0x841A, (346, 260), BIASES, (*_CHIP, (143, "SELECT_GRAY_COUNTER", 1), (144, "TEST_ADC", 0)))
DAVIS240C = DavisModel(
    0x841B,
    (240, 180),
    DAVIS240_BIASES,
    (*_CHIP, (139, "SPECIAL_PIXEL_CONTROL", 0)),
    lacks=((Module.MULTIPLEXER, 80, 84), (Module.DVS, 10, 92), (Module.EXTERNAL_INPUT, 10, 16)),
    sample_shift=1,
    least_fine=0.5,
)
