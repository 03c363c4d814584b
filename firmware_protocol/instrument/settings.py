"""Settings of an instrument at its start, and the biases of its sensor.

Telecommands set biases by number:

DAVIS346    number of the bias in module 5, value its word; so with a DAVIS240C, which has numbers of its own
IMX636      number of its register after 1000, in steps of four octets: 1 fo, 3 hpf, 4 diff_on, 5 diff, 6 diff_off,
8 refr; value its current, 0 to 255
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from firmware_protocol.bounds import check_bounds
from firmware_protocol.davis346.biases import sensor_factors
from firmware_protocol.davis346.model import DAVIS346, DavisModel
from firmware_protocol.imx636.registers import BIASES as IMX_BIASES
from firmware_protocol.instrument.queue import Policy, QueueBounds, Selection
from firmware_protocol.prophesee.biases import BiasModel


@dataclass(frozen=True)
class InstrumentSettings:
    """Settings of the camera's messages: event format, selection, limits, housekeeping.

    Attributes
    ----------
    tick_us : unit of event times.
    coding : coding of blocks.
    block_events, block_bytes : largest block.
    region : [x, y, width, height] of the pixels that are sent; empty for all.
    keep_every : of those, only columns and rows that are a multiple of this.
    rate_limit : most events a second on the average; 0 for no limit but the line's.
    when_full : events to drop when more arrive than leave.
    queue_events, queue_ms : limits of the queue, in events and in time.
    housekeeping_s : time between two housekeeping messages; 0 for none except on request.
    autostart : events flow without a start command.
    temperature_c : temperature in housekeeping.
    """

    tick_us: Literal[1, 10, 100, 1000] = 1
    coding: Literal["smallest", "flat", "rows", "bitmap"] = "smallest"
    block_events: Annotated[int, Meta(ge=1, le=65_535)] = 2048
    block_bytes: Annotated[int, Meta(ge=64, le=8192)] = 1024
    region: tuple[int, ...] = ()
    keep_every: Annotated[int, Meta(ge=1, le=64)] = 1
    rate_limit: Annotated[int, Meta(ge=0, le=0xFFFF_FFFF)] = 0
    when_full: Literal["drop_oldest", "drop_newest"] = "drop_oldest"
    queue_events: int = 65_536
    queue_ms: Annotated[float, Meta(ge=1, le=60_000)] = 100.0
    housekeeping_s: float = 1.0
    autostart: bool = True
    temperature_c: Annotated[float, Meta(ge=-273, le=300)] = 20.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.region and (len(self.region) != 4 or min(self.region) < 0 or 0 in self.region[2:]):
            raise ValueError(f"region must be [x, y, width, height] in pixels, or empty, got {list(self.region)}")
        if not self.block_events <= self.queue_events <= 1 << 24:
            raise ValueError(f"queue_events must be block_events to {1 << 24}, got {self.queue_events}")
        if not (self.housekeeping_s == 0 or 0.01 <= self.housekeeping_s <= 86_400):
            raise ValueError(f"housekeeping_s must be 0 (none) or 0.01 to 86400, got {self.housekeeping_s}")

    @property
    def bounds(self) -> QueueBounds:
        """Limits of the queue."""
        return QueueBounds(self.queue_events, round(self.queue_ms * 1000), self.block_events, Policy(self.when_full))

    def carried_hz(self, bits_per_s: float, size: tuple[int, int]) -> float:
        """Return the events a second that a line of `bits_per_s` for packets carries from an array of `size`, about.

        The step between two events that are spread evenly over pixels and ticks has a geometric distribution; its
        entropy and a polarity are the bits of an event. Bursts of neighbours need fewer.
        """
        rate_hz, is_flat = bits_per_s / 32, self.coding == "flat"
        span_us = 1 << (31 - sum((side - 1).bit_length() for side in size)) if is_flat else math.inf
        for _ in range(_ROUNDS):
            step = size[0] * size[1] * 1e6 / (rate_hz * self.tick_us)
            bits = 32 if is_flat else math.log2(math.e * max(step, 1.0)) + 1
            of_block = min(8 * (self.block_bytes - 14) / bits, self.block_events, max(1.0, rate_hz * span_us * 1e-6))
            rate_hz = bits_per_s / (bits + 8 * _HEAD_BYTES / of_block)
        return min(rate_hz, self.rate_limit or math.inf)

    def selection(self, size: tuple[int, int]) -> Selection:
        """Return the selected pixels of an array of `size` = (width, height); raises ValueError."""
        x, y, width, height = self.region or (0, 0, *size)
        return Selection(x, y, width, height, self.keep_every).within(size)

    def selected_share(self, size: tuple[int, int]) -> float:
        """Return the share of an array's pixels that are selected, about."""
        chosen = self.selection(size)
        return chosen.width * chosen.height / (chosen.keep_every**2 * size[0] * size[1])


_HEAD_BYTES = 40  # of a block, its packet and its frame
_ROUNDS = 8

_FIRST, _STEP = 0x1000, 4  # of the addresses of IMX636 biases
_MOST = 255
_IMX_NUMBERS = {(address - _FIRST) // _STEP: name for name, (address, _) in IMX_BIASES.items()}


class DavisBiases:
    """Biases of a DAVIS346, or of another model of its family.

    Attributes
    ----------
    values : present values, by number.
    factors, without_effect : factors of the pixels by the biases, and biases without an effect, each with the reason.
    """

    def __init__(self, model: DavisModel = DAVIS346) -> None:
        self._model = model
        self.values = {bias.address: int(bias.default) for bias in model.biases}
        self.factors: Mapping[str, float] = {}
        self.without_effect: Mapping[str, str] = {}

    def set(self, number: int, value: int) -> None:
        """Set one; raises ValueError for an unknown number."""
        if number not in self.values:
            raise ValueError(f"there is no bias {number}")
        self.values[number] = value
        self.factors = sensor_factors(self.values, self._model.biases, least_fine=self._model.least_fine)


class Imx636Biases:
    """Biases of an IMX636; attributes as `DavisBiases`."""

    def __init__(self, model: BiasModel) -> None:
        self._model = model
        self.values = {number: IMX_BIASES[name][1] for number, name in _IMX_NUMBERS.items()}

    def set(self, number: int, value: int) -> None:
        """Set one; raises ValueError for an unknown number or a value out of range."""
        if number not in self.values:
            raise ValueError(f"there is no bias {number}")
        if value > _MOST:
            raise ValueError(f"bias {number} goes to {_MOST}, got {value}")
        self.values[number] = value

    @property
    def factors(self) -> Mapping[str, float]:
        """Factors of the pixels by the biases."""
        return self._model.factors(self._steps)

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases without an effect on the pixels, each with the reason."""
        return self._model.without_effect(self._steps)

    @property
    def _steps(self) -> dict[str, int]:
        return {name: self.values[number] - IMX_BIASES[name][1] for number, name in _IMX_NUMBERS.items()}


SensorBiases = DavisBiases | Imx636Biases
