"""Where a pixel's state lies in memory, and what is the same for all pixels of a step."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import kernel

__all__ = ["BEFORE_ROWS", "BLOCK", "FIELDS", "Field", "Pixels", "StepConstants", "slot", "whole_vectors"]

BLOCK = 1024
"""Pixels of a block; the arithmetic of a pixel does not depend on it, the speed does."""


class Field(IntEnum):
    """The state of a pixel, float32. The state of an array is (blocks, FIELDS, BLOCK), flat."""

    LOG_LIGHT = 0  # u, ln of the photocurrent at the last step's end; NaN after unreadable light
    FILTERED = 1  # v
    RATE = 2  # lambda, rad/s
    SLOPE = 3  # of u at the last step's end, by warped time: (du/dt) / lambda; not finite where it is not known
    REFERENCE = 4  # with leak times the time since the epoch added; NaN while the pixel is blind
    ON = 5  # thresholds, ln units, > 0
    OFF = 6
    LEAK = 7  # ln units a second
    SECOND = 8  # w, behind the second pole; not in use without one
    LEAKED = 9  # by light since the pixel's last event, ln units; not in use without parasitic leak


FIELDS = len(Field)

BEFORE_ROWS = tuple(k * BLOCK for k in range(12))
"""Rows of a block's scratch: as it was before the step: u, v, lambda, slope by warped time; then the slopes per step at
both ends, S, q = 1 - e^-S, what is behind the second pole and had leaked before, and bounds of the compared value."""


class Pixels(NamedTuple):
    """The state of an array: `fields`, flat, and until when (ns) a pixel whose reference is NaN is blind."""

    fields: npt.NDArray[np.float32]
    blind_until_ns: npt.NDArray[np.int64]


class StepConstants(NamedTuple):
    """What is the same for all pixels of a step."""

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
    chord: bool  # whether light is taken as straight lines in its logarithm, its derivative not given
    trust: np.float32  # share of a threshold beyond which what goes on unseen makes a step suspect
    halve: bool  # whether suspects are set aside, to be solved in halves


@kernel
def slot(pixel: int) -> int:
    """Return where the first field of a pixel is in the flat state; the others follow at multiples of BLOCK."""
    return (pixel // BLOCK) * (FIELDS * BLOCK) + pixel % BLOCK


@kernel
def whole_vectors(n: int) -> int:
    """Return n rounded up to where a vector loop ends without a remainder.

    A remainder is scalar code, which may round elsewhere than the vectors do (a*b + c is contracted piece by piece of
    code), and then a pixel's events would depend on how many others are solved with it.
    """
    return (n + 63) // 64 * 64
