"""The pixel array: from pictures of light to threshold crossings with exact times.

All that a pixel remembers is in one `PixelState`; everything else follows from the parameters and the seed. Nothing
refers to absolute time but whole nanoseconds: leak is counted from an epoch that moves every 2^33 ns (8.6 s), so a step
30 days into a stream equals the same step at its start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.light import PixelLight
from emulator.sensor.numerics.compiled import say_if_not_compiled
from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.pixels.candidates import new_table
from emulator.sensor.pixels.interpolation import SUSPECT
from emulator.sensor.pixels.quiet_pass import Tally, advance, unpack
from emulator.sensor.pixels.refinement import SHORTEST_NS, Halving
from emulator.sensor.pixels.state import BLOCK, FIELDS, Field, Pixels, StepConstants
from emulator.sensor.pixels.subset import new_aside
from emulator.sensor.presets import SensorParameters

__all__ = ["Crossings", "PixelArray", "PixelState", "light_constants"]

_EPOCH_BITS = 33
_EPOCH_NS = 1 << _EPOCH_BITS
_NO_LOW_PASS_RATE = 1e12  # rad/s: a lag of a picosecond
_HIGHEST_HZ = _NO_LOW_PASS_RATE / (2 * math.pi)
_LEAST_THRESHOLD = 0.1  # of the nominal one, however far the mismatch would go

_Float32s = npt.NDArray[np.float32]
_NO_RATE = np.empty(0, np.float32)
_NO_ROOM = new_aside(0)


@dataclass(frozen=True, slots=True)
class Crossings:
    """Threshold crossings of one step, sorted by (time, pixel); views, valid until the next step or reset.

    Attributes
    ----------
    t_ns : (n,) int64, stream time.
    pixel : (n,) uint32, row * width + column.
    on : (n,) bool, True where it got brighter.
    lost_in_pixel : crossings of this step that are not listed, because their pixel had more than 64.
    """

    t_ns: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.uint32]
    on: npt.NDArray[np.bool_]
    lost_in_pixel: int = 0

    def __len__(self) -> int:
        return self.t_ns.size


@dataclass(slots=True)
class PixelState:
    """All that changes from step to step; copy it to continue elsewhere.

    Attributes
    ----------
    fields : (blocks, FIELDS, BLOCK) float32, see `layout.Field`; pixels beyond the picture's end never fire.
    blind_until_ns : (blocks * BLOCK,) int64, meaningful for blind pixels (reference NaN).
    t_ns : stream time.
    epoch_ns : where leak is counted from.
    slopes_known : whether the last picture came with its time derivative.
    """

    fields: _Float32s
    blind_until_ns: npt.NDArray[np.int64]
    t_ns: int
    epoch_ns: int
    slopes_known: bool


@dataclass(slots=True)
class _Room:
    """Buffers that grow when needed and are kept."""

    keys: npt.NDArray[np.uint64] = field(default_factory=lambda: np.empty(4096, np.uint64))
    t_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    pixel: npt.NDArray[np.uint32] = field(default_factory=lambda: np.empty(0, np.uint32))
    on: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))

    def fit(self, n: int) -> None:
        """Make room for n events, keeping those that are there."""
        if n > self.t_ns.size:
            more = max(n, 2 * self.t_ns.size) - self.t_ns.size
            self.t_ns = np.concatenate([self.t_ns, np.empty(more, np.int64)])
            self.pixel = np.concatenate([self.pixel, np.empty(more, np.uint32)])
            self.on = np.concatenate([self.on, np.empty(more, np.bool_)])


class PixelArray:
    """An array of event pixels.

    Parameters
    ----------
    parameters : the sensor.
    seed : keys the mismatch, the leak's phases and spread. Two arrays of one seed are equal.

    Attributes
    ----------
    state : PixelState
    lost_in_pixel : crossings since `reset` beyond 64 a pixel and step.
    quiet_nan : pixel-steps since `reset` whose light was NaN or infinite; such a pixel is silent, and its filter starts
        anew from the next finite light.
    suspects, candidates : pixel-steps since `reset` whose light did something between the pictures that they do not
        show (see `trust`; told only where the time derivative is given), and those that had to be solved for crossings.
    halved : suspects that were solved in halves instead; so many lights of a pixel were asked for.
    """

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        self.parameters = parameters
        self.seed = seed
        self._clear_counters()
        self._size = (parameters.height, parameters.width)
        self._pixels = parameters.width * parameters.height
        self._pixel_bits = max(1, (self._pixels - 1).bit_length())
        self._refractory_ns = round(parameters.refractory_us * 1000)
        self._light_constants = light_constants(parameters)
        self._room = _Room()
        self._table = new_table()
        self.state = self._dark_state()
        self._halving: Halving | None = None

    def _dark_state(self) -> PixelState:
        """Return the state of an array that never saw light: what is fixed for each pixel is drawn."""
        blocks = -(-self._pixels // BLOCK)
        fields = np.zeros((blocks, FIELDS, BLOCK), np.float32)
        fields[:, Field.ON] = fields[:, Field.OFF] = np.inf
        p, pixel = self.parameters, np.arange(self._pixels)
        for which, purpose, nominal in (
            (Field.ON, Purpose.THRESHOLD_ON, p.threshold_on),
            (Field.OFF, Purpose.THRESHOLD_OFF, p.threshold_off),
        ):
            spread = 1 + p.mismatch * normal(self.seed, purpose, pixel)
            _put(fields, which, nominal * np.maximum(spread, _LEAST_THRESHOLD))
        sigma = p.leak_spread
        rate_hz = p.leak_hz * np.exp(sigma * normal(self.seed, Purpose.LEAK_RATE, pixel) - sigma**2 / 2)
        _put(fields, Field.LEAK, rate_hz * _take(fields, Field.ON, self._pixels))
        return PixelState(fields, np.zeros(blocks * BLOCK, np.int64), 0, 0, False)

    def _clear_counters(self) -> None:
        self.lost_in_pixel = self.quiet_nan = self.suspects = self.candidates = 0
        self.halved = 0

    def field(self, which: Field) -> _Float32s:
        """Return a copy of one field of the state, (height, width) float32."""
        return _take(self.state.fields, which, self._pixels).reshape(self.parameters.height, self.parameters.width)

    def reset(self, light: _Float32s, t_ns: int, rate: _Float32s | None = None) -> None:
        """Start at `t_ns` with the filter at rest on `light`, and counters at zero; `light` and `rate` as in `step`."""
        say_if_not_compiled(advance, "the pixel step")
        state, p = self.state, self.parameters
        flat, slope = self._flat(light), _NO_RATE if rate is None else self._flat(rate)
        state.t_ns, state.epoch_ns = int(t_ns), (int(t_ns) >> _EPOCH_BITS) << _EPOCH_BITS
        state.blind_until_ns[:] = t_ns
        current = np.maximum(flat, 0) + np.float32(p.dark_current_relative)
        current[~np.isfinite(flat)] = np.nan
        log_light = np.log(current)
        _, at_reference, least, most = self._light_constants
        filter_rate = np.clip(at_reference * current, least, most)
        phase = uniform(self.seed, Purpose.LEAK_PHASE, np.arange(self._pixels))
        on, leak = (_take(state.fields, which, self._pixels) for which in (Field.ON, Field.LEAK))
        since_epoch = (state.t_ns - state.epoch_ns) * 1e-9
        state.fields[:, Field.LEAKED] = 0
        state.slopes_known = rate is not None
        for which in (Field.LOG_LIGHT, Field.FILTERED, Field.SECOND):
            _put(state.fields, which, log_light)
        _put(state.fields, Field.RATE, filter_rate)
        _put(
            state.fields,
            Field.SLOPE,
            np.where(flat > 0, slope, 0) / (current * filter_rate) if slope.size else np.full(flat.size, np.nan),
        )
        _put(state.fields, Field.REFERENCE, log_light + leak * since_epoch - on * phase)
        self._clear_counters()

    def step(
        self, light: _Float32s, t_ns: int, rate: _Float32s | None = None, at: PixelLight | None = None
    ) -> Crossings:
        """Move from the last time to `t_ns`.

        The log of the light changes along the cubic through its values and time derivatives at both ends; where only
        one derivative is known along a parabola; without any, or in steps longer than an epoch, along a straight line.

        Parameters
        ----------
        light : (height, width) float32, relative to the reference level; below 0 counts as 0.
        t_ns : stream time of that picture. Equal to the last time: nothing happens.
        rate : (height, width) float32, the light's time derivative at `t_ns`, a second. Not finite: not known there.
        at : tells the light of single pixels in between. With it and `rate`, suspects are solved in halves.

        Raises
        ------
        ValueError
            Time goes back, or a picture has not the sensor's size.
        """
        flat, slope = self._flat(light), _NO_RATE if rate is None else self._flat(rate)
        state, lost_before = self.state, self.lost_in_pixel
        t_ns = int(t_ns)
        if t_ns < state.t_ns:
            raise ValueError(f"t_ns = {t_ns}: before the last step's {state.t_ns}; time does not go back")
        n = 0
        if t_ns - state.t_ns > _EPOCH_NS:
            n, slope = self._whole_epochs(flat, t_ns), _NO_RATE
        if t_ns > state.t_ns:
            n = self._piece((flat, slope), t_ns, n, at)
        room = self._room
        return Crossings(room.t_ns[:n], room.pixel[:n], room.on[:n], self.lost_in_pixel - lost_before)

    def _whole_epochs(self, flat: _Float32s, t_ns: int) -> int:
        """Advance by whole epochs, on a straight line in log light, until at most one is left; return the number."""
        state, n = self.state, 0
        before, t0_ns = _take(state.fields, Field.LOG_LIGHT, self._pixels), state.t_ns
        while t_ns - state.t_ns > _EPOCH_NS:
            share = (state.t_ns + _EPOCH_NS - t0_ns) / (t_ns - t0_ns)
            n = self._piece((self._between(before, flat, share), _NO_RATE), state.t_ns + _EPOCH_NS, n)
        return n

    def _between(self, log_before: _Float32s, light: _Float32s, share: float) -> _Float32s:
        """Return the light part of the way, on a straight line in the logarithm of the photocurrent."""
        dark = np.float32(self.parameters.dark_current_relative)
        log_after = np.log(np.maximum(light, 0) + dark)
        return np.asarray(np.exp(log_before + np.float32(share) * (log_after - log_before)) - dark, np.float32)

    def _piece(self, picture: tuple[_Float32s, _Float32s], t_ns: int, n: int, at: PixelLight | None = None) -> int:
        """Advance by at most an epoch, add the crossings after the first n, and return the new number."""
        state, room, slope = self.state, self._room, picture[1]
        self._move_epoch()
        if slope.size and not state.slopes_known:
            state.fields[:, Field.SLOPE] = np.nan
        state.slopes_known = bool(slope.size)
        t0_ns, with_slopes = state.t_ns, bool(slope.size)
        halving = self._halves() if with_slopes and at is not None and t_ns - t0_ns >= SHORTEST_NS else None
        pixels, c = (
            Pixels(state.fields.reshape(-1), state.blind_until_ns),
            self._constants(t0_ns, t_ns, not with_slopes),
        )
        if halving is None or at is None:
            room.keys, found, tally = advance(picture, pixels, self._table, _NO_ROOM, room.keys, c)
        else:
            room.keys, found, tally = halving.step(picture, pixels, room.keys, c, at)
        self._count(tally)
        if found:
            keys = room.keys[:found]
            keys.sort()
            room.fit(n + found)
            unpack(keys, t0_ns, self._pixel_bits, room.t_ns[n : n + found], room.pixel[n:], room.on[n:])
        state.t_ns = t_ns
        return n + int(found)

    def _move_epoch(self) -> None:
        """Let leak be counted from the last whole epoch: the one place where a reference moves without an event."""
        state = self.state
        epoch_ns = (state.t_ns >> _EPOCH_BITS) << _EPOCH_BITS
        if epoch_ns != state.epoch_ns:
            moved_s = np.float32((epoch_ns - state.epoch_ns) * 1e-9)
            state.fields[:, Field.REFERENCE] -= state.fields[:, Field.LEAK] * moved_s
            state.epoch_ns = epoch_ns

    def _halves(self) -> Halving:
        """Return what solves suspects in halves, made when first needed."""
        if self._halving is None:
            dark, at_reference, least, most = self._light_constants
            resting = np.zeros(FIELDS, np.float32)
            resting[[Field.LOG_LIGHT, Field.FILTERED, Field.REFERENCE, Field.SECOND]] = np.log(dark)
            resting[Field.RATE] = np.clip(at_reference * dark, least, most)
            resting[[Field.ON, Field.OFF]] = np.inf
            self._halving = Halving(self.state.fields.shape[0], resting, self._table, self._constants)
        return self._halving

    def _count(self, tally: Tally) -> None:
        self.lost_in_pixel += tally.lost
        self.suspects += tally.suspects
        self.candidates += tally.candidates
        self.quiet_nan += tally.unreadable
        self.halved += tally.aside

    def _constants(self, t0_ns: int, t1_ns: int, chord: bool = False) -> StepConstants:
        p, (dark, at_reference, least, most) = self.parameters, self._light_constants
        since_ns, h_ns = t0_ns - self.state.epoch_ns, t1_ns - t0_ns
        return StepConstants(
            dark,
            at_reference,
            least,
            most,
            parasitic=np.float32(p.parasitic_hz_at_reference),
            second=np.float32(2 * math.pi * p.source_follower_hz * h_ns * 1e-9),
            h=np.float32(h_ns * 1e-9),
            since_epoch_0=np.float32(since_ns * 1e-9),
            since_epoch_1=np.float32((since_ns + h_ns) * 1e-9),
            refractory=np.float32(self._refractory_ns / h_ns),
            h_ns=h_ns,
            t0_ns=t0_ns,
            refractory_ns=self._refractory_ns,
            pixel_bits=self._pixel_bits,
            chord=chord,
            trust=SUSPECT,
            halve=False,
        )

    def _flat(self, picture: _Float32s) -> _Float32s:
        if picture.shape != self._size or picture.dtype != np.float32:
            raise ValueError(f"light or rate is {picture.shape} {picture.dtype}: must be {self._size} float32")
        return np.ascontiguousarray(picture).reshape(-1)


def _take(fields: _Float32s, which: Field, pixels: int) -> _Float32s:
    """Return a copy of one field in pixel order, (pixels,) float32."""
    return np.asarray(fields[:, which].reshape(-1)[:pixels].copy())


def _put(fields: _Float32s, which: Field, values: npt.NDArray[np.floating]) -> None:
    """Set one field from values in pixel order, (pixels,)."""
    row = fields[:, which].reshape(-1)
    row[: values.size] = values
    fields[:, which] = row.reshape(-1, BLOCK)


def light_constants(p: SensorParameters) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the dark current, the filter's rate at light 1 and its bounds, rad/s."""
    at_reference, least, most = (
        (_NO_LOW_PASS_RATE,) * 3
        if math.isinf(p.corner_hz_at_reference)
        else (2 * math.pi * hz for hz in (p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _HIGHEST_HZ)))
    )
    return np.float32(p.dark_current_relative), np.float32(at_reference), np.float32(least), np.float32(most)
