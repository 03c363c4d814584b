"""The biases of an instrument's sensor, as telecommands set them by number, and what they do to its pixels.

DAVIS346    number of the bias in module 5, value its word
IMX636      number of its register after 1000, in steps of four octets: 1 fo, 3 hpf, 4 diff_on, 5 diff, 6 diff_off,
8 refr; value its current, 0 to 255
"""

from __future__ import annotations

from collections.abc import Mapping

from firmware_protocol.davis346.bias_effects import sensor_factors
from firmware_protocol.davis346.biases import BIASES as DAVIS_BIASES
from firmware_protocol.imx636.bias_effects import BiasModel
from firmware_protocol.imx636.registers import BIASES as IMX_BIASES

__all__ = ["DavisBiases", "Imx636Biases", "SensorBiases"]

_FIRST, _STEP, _MOST = 0x1000, 4, 255
_IMX_NUMBERS = {(address - _FIRST) // _STEP: name for name, (address, _) in IMX_BIASES.items()}


class DavisBiases:
    """Those of a DAVIS346.

    Attributes
    ----------
    values
        As they are now, by number.
    factors, without_effect
        See `EventDevice.sensor_factors` and `EventDevice.without_effect`.
    """

    def __init__(self) -> None:
        self.values = {bias.address: int(bias.default) for bias in DAVIS_BIASES}
        self.factors: Mapping[str, float] = {}
        self.without_effect: Mapping[str, str] = {}

    def set(self, number: int, value: int) -> None:
        """Set one; raises ValueError for a number that there is not."""
        if number not in self.values:
            raise ValueError(f"there is no bias {number}")
        self.values[number] = value
        self.factors = sensor_factors(self.values)


class Imx636Biases:
    """Those of an IMX636; attributes as `DavisBiases`."""

    def __init__(self, model: BiasModel) -> None:
        self._model = model
        self.values = {number: IMX_BIASES[name][1] for number, name in _IMX_NUMBERS.items()}

    def set(self, number: int, value: int) -> None:
        """Set one; raises ValueError for a number or a value that there is not."""
        if number not in self.values:
            raise ValueError(f"there is no bias {number}")
        if value > _MOST:
            raise ValueError(f"bias {number} goes to {_MOST}, got {value}")
        self.values[number] = value

    @property
    def factors(self) -> Mapping[str, float]:
        """See `DavisBiases`."""
        return self._model.factors(self._steps)

    @property
    def without_effect(self) -> Mapping[str, str]:
        """See `DavisBiases`."""
        return self._model.without_effect(self._steps)

    @property
    def _steps(self) -> dict[str, int]:
        return {name: self.values[number] - IMX_BIASES[name][1] for number, name in _IMX_NUMBERS.items()}


SensorBiases = DavisBiases | Imx636Biases
