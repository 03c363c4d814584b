"""State of the pixels: memory layout, constants of a step, the drawn parameters of each pixel, and packed events.

Each pixel's thresholds, leak and leak phase are drawn here in float64: methods and truth share the pixels of a seed.

The reference is stored with leak times the time since the epoch added (see `array`). When the leak changes, the
reference moves by the change of leak times that time, and the comparator's level stays.

`Levels` gives the distance of the comparators of some pixels from their references, and fires pixels from outside:

level = signal + leak - reference, ln units: an ON event where it reaches the ON threshold

The reference after a reset differs from the signal by an offset, with noise from one reset to the next. It is part of
the stored reference, so every test of a step, the quiet one included, holds for it. The noise of a pixel's reset number
k is number k of its stream: the sum of which a number is made is stored, and each reset adds to it, so no index of the
pixel in the array is needed. Beyond the most events of a step (`event_time`) resets have no offset, or with a
refractory period that of the last reset before.

Fast because a block's fields follow each other in one flat array (`Field`): its rows lie at distances known when
compiled, and a block with its scratch stays in the nearest caches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, kernel
from emulator.sensor.numerics.keyed import Purpose, normal, normal_from, stream, uniform, word
from emulator.sensor.pixels.crossings import Keys
from emulator.sensor.presets import SensorParameters
from firmware_protocol.device.clock import GOLDEN

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
    LEAKED = 9  # parasitic leak since the pixel's last event, less that of the present light since the epoch, ln units
    # The certificate of a pixel with noise, see `noisy`: limits of the compared value from the reference, ln units,
    # its largest speed, ln units a second, below 0 for still light, and the time since the epoch until which it holds.
    # Of grade "offsets": limits, polarity of the event that comes in still light, and its time.
    ON_LIMIT = 10
    OFF_LIMIT = 11
    SPEED_LIMIT = 12
    UNTIL = 13
    HIGH_PASSED = 14  # y, behind the high-pass; unused without one


FIELDS = len(Field)

BEFORE_ROWS = tuple(k * BLOCK for k in range(13))
"""Rows of a block's scratch. Before the step: u, v, lambda, slope by warped time; then the slopes per step at both
ends, S and q = 1 - e^-S; second pole and parasitic leak before the step; high and low bound of the compared value;
output of the high-pass before the step."""


@dataclass(slots=True)
class PixelState:
    """The state of an array between two steps; a copy of it continues the stream elsewhere.

    Attributes
    ----------
    fields : see `Field`, (blocks, FIELDS, BLOCK) float32; pixels of the last block beyond the sensor's end never fire.
    refractory_until_ns : end of the refractory period, (blocks * BLOCK,) int64, valid where the reference is NaN. With
        noise of resets as many entries follow: the position in each pixel's stream of random numbers.
    t_ns : stream time.
    epoch_ns : time from which leak is counted.
    slopes_known : whether the last frame came with its time derivative.
    memory : noise of the pixels, see `Memory`, (blocks * BLOCK * MEMORY,) float32; empty without noise.
    late : events whose comparator switches after `t_ns`, (n,) uint64, as in `pack`, times counted from `late_from_ns`.
    """

    fields: npt.NDArray[np.float32]
    refractory_until_ns: npt.NDArray[np.int64]
    t_ns: int
    epoch_ns: int
    slopes_known: bool
    memory: npt.NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    late: Keys = field(default_factory=lambda: np.empty(0, np.uint64))
    late_from_ns: int = 0


class Memory(IntEnum):
    """The noise of a pixel, float32. The memory of an array is (pixels, MEMORY), flat."""

    N = 0  # value and slope at the end of the last refractory period, ln units and a second
    V = 1
    SCALE = 2  # rms over that of the sensor
    NUMBER = 3  # of the pixel in the sensor, which keys its random numbers
    LEFT = 4  # what is left of the number drawn at the last reset, against which the hazard is integrated
    OFF_LEFT = 1  # of V: the number of OFF, where `offsets` draws one for each threshold
    SEEN_S = 5  # time since the epoch of the last visit, s, and the value then, from the reference, ln units
    SEEN = 6


MEMORY = len(Memory)


class Pixels(NamedTuple):
    """The state of an array: `fields`, flat, and the end (ns) of the refractory period of pixels with reference NaN.

    With noise the second array has the end of the last refractory period of all pixels. Positions in the streams of
    reset noise follow in it, see `PixelState`: one array for both, because each costs time in every call.
    """

    fields: npt.NDArray[np.float32]
    refractory_until_ns: npt.NDArray[np.int64]
    memory: npt.NDArray[np.float32]  # of the noise
    tables: npt.NDArray[np.int32]  # of hazards and their integrals, packed


class FlatLight(NamedTuple):
    """The light at the end of a step, (pixels,) float32."""

    light: npt.NDArray[np.float32]
    rate: npt.NDArray[np.float32]  # its time derivative, per second; empty if log light is a straight line (`chord`)


class ResetError(NamedTuple):
    """The distance of a reference from the signal after a reset, ln units: its mean, and its standard deviation."""

    offset: np.float32
    noise: np.float32


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
    refine: bool  # undersampled pixels are collected for refinement
    large: bool  # whether the photoreceptor follows the large-signal law (see `receptor`)
    reset: ResetError = ResetError(np.float32(0), np.float32(0))
    on_delay: float = 0.0  # times of the comparators, s; see `comparator`
    off_delay: float = 0.0
    contrast_per_e: float = 1.0
    noisy: bool = False  # events are first passages of signal and noise
    offsets: bool = False  # noise sets thresholds at each reset, see `offsets`
    noise_rms: float = 0.0  # behind the receptor, ln units
    noise_pole: float = 0.0  # rate of the fixed pole behind it, 1/s; 0: none
    noise_root: np.uint64 = np.uint64(0)  # of the pixels' streams
    since_s: float = 0.0  # time since the epoch at the step's start, in float64
    high: np.float32 = np.float32(0)  # length of the step in time constants of the high-pass; 0: none
    high_rate: float = 0.0  # of the high-pass, 1/s
    compared: int = 0  # row of the comparators' input, without leak, within a block


@kernel
def noise_stream(pixels: Pixels, pixel: int, c: StepConstants) -> np.uint64:
    """Return the stream of random numbers of a pixel's noise."""
    number: np.uint64 = stream(c.noise_root, np.int64(pixels.memory[pixel * MEMORY + Memory.NUMBER]))
    return number


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


_MOST_OFFSET = np.float32(0.9)  # of a pixel's thresholds
_ZERO = np.float32(0)


@kernel
def reset_offset(
    pixels: Pixels, pixel: int, ahead: int, on: np.float32, off: np.float32, error: ResetError
) -> np.float32:
    """Return the offset of a pixel's reference, ln units, after its last reset (`ahead` 0) or its next one (1).

    `on` and `off` are the pixel's thresholds: a reference stays within them, so that no reset fires the pixel again.
    """
    offset = error.offset
    if error.noise > _ZERO:
        place = pixels.refractory_until_ns.size // 2 + pixel
        bits = word(np.uint64(pixels.refractory_until_ns[place]) - GOLDEN, ahead)
        offset += error.noise * np.float32(normal_from(bits))
    return np.float32(min(max(offset, -_MOST_OFFSET * on), _MOST_OFFSET * off))


@kernel
def reset_offset_at(number: np.uint64, t_ns: int, on: float, off: float, error: ResetError) -> float:
    """Return the offset of a reference that is set at a time; `number` is the stream of the pixel's noise."""
    offset = float(error.offset)
    if error.noise > _ZERO:
        offset += float(error.noise) * normal_from(word(number, t_ns))
    return min(max(offset, -0.9 * on), 0.9 * off)


@kernel
def count_reset(pixels: Pixels, pixel: int, noise: np.float32) -> None:
    """Count a reset of a pixel: its next offset has the next number of its stream."""
    if noise > _ZERO:
        place = pixels.refractory_until_ns.size // 2 + pixel
        pixels.refractory_until_ns[place] = np.int64(np.uint64(pixels.refractory_until_ns[place]) + GOLDEN)


def take_field(fields: npt.NDArray[np.float32], field: Field, pixels: int) -> npt.NDArray[np.float32]:
    """Return a copy of one field in pixel order, (pixels,) float32."""
    return np.asarray(fields[:, field].reshape(-1)[:pixels].copy())


def put_field(fields: npt.NDArray[np.float32], field: Field, values: npt.NDArray[np.floating]) -> None:
    """Set one field from values in pixel order, (pixels,)."""
    row = fields[:, field].reshape(-1)
    row[: values.size] = values
    fields[:, field] = row.reshape(-1, BLOCK)


class LightConstants(NamedTuple):
    """From light to the rate of the filter: dark current, relative; rate at light 1, and its bounds, rad/s."""

    dark: np.float32
    rate_at_reference: np.float32
    rate_min: np.float32
    rate_max: np.float32


def light_constants(p: SensorParameters) -> LightConstants:
    """Return the constants of a sensor's light."""
    dark = np.float32(p.dark_current_relative)
    if math.isinf(p.corner_hz_at_reference):
        return LightConstants(dark, *(np.float32(_NO_LOW_PASS_RATE) for _ in range(3)))
    corners_hz = p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _HIGHEST_HZ)
    return LightConstants(dark, *(np.float32(2 * math.pi * hz) for hz in corners_hz))


_LEAST_THRESHOLD = 0.1  # of the nominal one, however far the mismatch would go

_Float64s = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Drawn:
    """Figures drawn once for each pixel, (pixels,) float64.

    Attributes
    ----------
    on, off : thresholds, ln units.
    leak_hz : leak, ON events per second.
    phase : share of the ON threshold by which the first reference lies below the first light; 0 without `random_start`.
    """

    on: _Float64s
    off: _Float64s
    leak_hz: _Float64s
    phase: _Float64s

    @property
    def leak(self) -> _Float64s:
        """Leak, (pixels,) float64, ln units per second."""
        return self.leak_hz * self.on


def draw(parameters: SensorParameters, seed: int) -> Drawn:
    """Return the parameters of a sensor's pixels for a seed."""
    pixel = np.arange(parameters.width * parameters.height)
    on, off = (
        nominal * np.maximum(1 + parameters.mismatch * normal(seed, purpose, pixel), _LEAST_THRESHOLD)
        for purpose, nominal in (
            (Purpose.THRESHOLD_ON, parameters.threshold_on),
            (Purpose.THRESHOLD_OFF, parameters.threshold_off),
        )
    )
    sigma = parameters.leak_spread
    rate_hz = parameters.leak_hz * np.exp(sigma * normal(seed, Purpose.LEAK_RATE, pixel) - sigma**2 / 2)
    return Drawn(on, off, rate_hz, leak_phase(parameters, seed))


def leak_phase(parameters: SensorParameters, seed: int) -> _Float64s:
    """Return the phases of the leak, (pixels,) float64; see `Drawn`."""
    pixel = np.arange(parameters.width * parameters.height)
    return uniform(seed, Purpose.LEAK_PHASE, pixel) if parameters.random_start else np.zeros(pixel.size)


def noise_memory(parameters: SensorParameters, seed: int, pixels: int) -> npt.NDArray[np.float32]:
    """Return the memory of pixels, (pixels * MEMORY,), whose noise has no last reset yet."""
    memory = np.zeros((pixels, MEMORY), np.float32)
    memory[parameters.width * parameters.height :, Memory.LEFT] = np.inf  # those beyond the sensor's end never fire
    memory[:, Memory.SCALE] = np.exp(parameters.noise.spread * normal(seed, Purpose.NOISE_SPREAD, np.arange(pixels)))
    memory[:, Memory.NUMBER] = np.arange(pixels)
    return memory.reshape(-1)


DEAD_THRESHOLD = 1e6
"""Thresholds of a dead pixel, ln units: no light has a million e-folds, and float32 does arithmetic with it."""

_Int64s = npt.NDArray[np.int64]


def field_index(pixel: _Int64s, field: Field) -> _Int64s:
    """Return the indices of a field of some pixels in the flat state."""
    return np.asarray((pixel // BLOCK) * (FIELDS * BLOCK) + int(field) * BLOCK + pixel % BLOCK)


def compared_field(p: SensorParameters) -> Field:
    """Return the field of the comparators' input, without leak."""
    return Field.HIGH_PASSED if p.highpass_hz else Field.SECOND if p.source_follower_hz else Field.FILTERED


_Float32s = npt.NDArray[np.float32]

_U, _, _, _, _REF, _ON, _OFF, _LEAK, _, _P, _, _, _, _, _ = (int(f) * BLOCK for f in Field)
_NOW = np.int64(0)


@cached_entry
def _fire(pixels: Pixels, selected: _Int64s, error: ResetError) -> None:
    for k in range(selected.size):
        at = slot(selected[k])
        on = pixels.fields[at + _ON]
        off = pixels.fields[at + _OFF]
        count_reset(pixels, selected[k], error.noise)
        pixels.fields[at + _REF] += on + reset_offset(pixels, selected[k], _NOW, on, off, error)


class _Array(Protocol):
    """A `PixelArray`."""

    parameters: SensorParameters
    state: PixelState

    def wake(self) -> None:
        """Look at all pixels again in the next step."""


class Levels:
    """The levels of an array's pixels at its present time."""

    def __init__(self, array: _Array) -> None:
        self._array = array

    def _field(self, field: int, pixel: _Int64s) -> _Float32s:
        return np.asarray(self._array.state.fields.reshape(-1)[field_index(pixel, Field(field))])

    def of(self, pixel: _Int64s) -> _Float32s:
        """Return the levels of pixels (n,); NaN in the refractory period."""
        state, p = self._array.state, self._array.parameters
        since_epoch_s, hz = np.float64(state.t_ns - state.epoch_ns) * 1e-9, p.parasitic_hz_at_reference
        level = self._field(compared_field(p), pixel) + self._field(Field.LEAK, pixel) * since_epoch_s
        if hz > 0:
            lit = np.exp(self._field(Field.LOG_LIGHT, pixel))
            level += self._field(Field.LEAKED, pixel) + hz * self._field(Field.ON, pixel) * lit * since_epoch_s
        return np.asarray(level - self._field(Field.REFERENCE, pixel), np.float32)

    def thresholds(self, pixel: _Int64s) -> tuple[_Float32s, _Float32s]:
        """Return the ON and OFF thresholds of pixels (n,)."""
        return self._field(Field.ON, pixel), self._field(Field.OFF, pixel)

    def fire(self, pixel: _Int64s) -> None:
        """Move the references of pixels (n,), each named once, by an ON event."""
        if len(pixel):
            state, reset = self._array.state, self._array.parameters.reset
            pixels = Pixels(state.fields.reshape(-1), state.refractory_until_ns, state.memory, np.empty(0, np.int32))
            _fire(pixels, pixel, ResetError(np.float32(reset.offset), np.float32(reset.noise)))
            self._array.wake()
