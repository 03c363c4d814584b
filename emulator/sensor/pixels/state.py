"""Memory layout of the pixels' state, and the constants of a step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import kernel
from emulator.sensor.presets import SensorParameters

__all__ = [
    "BEFORE_ROWS",
    "BLOCK",
    "EPOCH_BITS",
    "FIELDS",
    "PART",
    "PARTS",
    "Field",
    "PixelState",
    "Pixels",
    "StepConstants",
    "light_constants",
    "put_field",
    "slot",
    "take_field",
    "whole_vectors",
]

BLOCK = 512
"""Pixels of a block. The speed depends on it, the arithmetic of a pixel does not."""

PART = 64
"""Pixels of a part of a block, the least that is moved or skipped: whole vectors, and one word of flags."""

PARTS = BLOCK // PART
"""Parts of a block."""

EPOCH_BITS = 33
"""Leak is counted from the last multiple of 2^33 ns, 8.6 s."""


_NO_LOW_PASS_RATE = 1e12  # rad/s: a lag of a picosecond
_HIGHEST_HZ = _NO_LOW_PASS_RATE / (2 * math.pi)


class Field(IntEnum):
    """The state of a pixel, float32. The state of an array is (blocks, FIELDS, BLOCK), flat."""

    LOG_LIGHT = 0  # u, ln of the photocurrent at the last step's end; NaN after unreadable light
    FILTERED = 1  # v
    RATE = 2  # lambda, rad/s
    SLOPE = 3  # of u at the last step's end, by warped time: (du/dt) / lambda; not finite where unknown
    REFERENCE = 4  # with leak times the time since the epoch added; NaN in the refractory period
    ON = 5  # thresholds, ln units, > 0
    OFF = 6
    LEAK = 7  # ln units a second
    SECOND = 8  # w, behind the second pole; unused without one
    LEAKED = (
        9  # parasitic leak since the pixel's last event, less what the present light leaks since the epoch, ln units
    )


FIELDS = len(Field)

BEFORE_ROWS = tuple(k * BLOCK for k in range(12))
"""Rows of a block's scratch. Before the step: u, v, lambda, slope by warped time; then the slopes per step at both
ends, S and q = 1 - e^-S; second pole and parasitic leak before the step; high and low bound of the compared value."""


@dataclass(slots=True)
class PixelState:
    """The state of an array between two steps; a copy of it continues the stream elsewhere.

    Attributes
    ----------
    fields : (blocks, FIELDS, BLOCK) float32
        See `Field`; pixels of the last block beyond the sensor's end never fire.
    refractory_until_ns : (blocks * BLOCK,) int64
        End of the refractory period, valid where the reference is NaN.
    t_ns : int
        Stream time.
    epoch_ns : int
        Time from which leak is counted.
    slopes_known : bool
        Whether the last frame came with its time derivative.
    """

    fields: npt.NDArray[np.float32]
    refractory_until_ns: npt.NDArray[np.int64]
    t_ns: int
    epoch_ns: int
    slopes_known: bool


class Pixels(NamedTuple):
    """The state of an array: `fields`, flat, and the end (ns) of the refractory period of pixels with reference NaN."""

    fields: npt.NDArray[np.float32]
    refractory_until_ns: npt.NDArray[np.int64]


class StepConstants(NamedTuple):
    """The constants of a step, the same for all pixels."""

    dark: np.float32
    rate_at_reference: np.float32  # rad/s
    rate_min: np.float32
    rate_max: np.float32
    parasitic: np.float32  # thresholds a second that light 1 leaks; 0: none
    second: np.float32  # length of the step in time constants of the second pole; 0: no such pole
    h: np.float32  # the step, s
    since_epoch_0: np.float32  # time since the epoch at the step's start and end, s
    since_epoch_1: np.float32
    refractory: np.float32  # as a share of the step
    h_ns: int
    t0_ns: int
    refractory_ns: int
    pixel_bits: int
    chord: bool  # whether log light is a straight line, because its derivative is not given
    unseen_share: np.float32  # share of a threshold that may stay unseen; more makes a step undersampled
    refine: bool  # whether undersampled pixels are gathered for refinement


@kernel
def slot(pixel: int) -> int:
    """Return the index of a pixel's first field in the flat state; its other fields follow at multiples of BLOCK."""
    return (pixel // BLOCK) * (FIELDS * BLOCK) + pixel % BLOCK


@kernel
def whole_vectors(n: int) -> int:
    """Return n rounded up to where a vector loop ends without a remainder.

    A remainder is scalar code, in which a*b + c may be contracted differently from the vector code. A pixel's events
    would then depend on how many others are solved with it.
    """
    return (n + 63) // 64 * 64


def take_field(fields: npt.NDArray[np.float32], which: Field, pixels: int) -> npt.NDArray[np.float32]:
    """Return a copy of one field in pixel order, (pixels,) float32."""
    return np.asarray(fields[:, which].reshape(-1)[:pixels].copy())


def put_field(fields: npt.NDArray[np.float32], which: Field, values: npt.NDArray[np.floating]) -> None:
    """Set one field from values in pixel order, (pixels,)."""
    row = fields[:, which].reshape(-1)
    row[: values.size] = values
    fields[:, which] = row.reshape(-1, BLOCK)


def light_constants(p: SensorParameters) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the dark current, relative, the filter's rate at light 1, and the bounds of that rate, rad/s."""
    at_reference, least, most = (
        (_NO_LOW_PASS_RATE,) * 3
        if math.isinf(p.corner_hz_at_reference)
        else (2 * math.pi * hz for hz in (p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _HIGHEST_HZ)))
    )
    return np.float32(p.dark_current_relative), np.float32(at_reference), np.float32(least), np.float32(most)
