"""The pixel array: from frames of light to threshold crossings with exact times.

The whole memory of a pixel is in one `PixelState`; all other figures follow from the parameters and the seed. Absolute
time is used as whole nanoseconds only: leak is counted from an epoch that moves every 2^33 ns (8.6 s), so a step 30
days into a stream equals the same step at its start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame, PixelLight, Region
from emulator.sensor.numerics.compiled import log_compilation
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.pixels.curve import UNSEEN_SHARE
from emulator.sensor.pixels.idle import wake
from emulator.sensor.pixels.refinement import SHORTEST_NS, Refinement
from emulator.sensor.pixels.state import (
    BLOCK,
    EPOCH_BITS,
    FIELDS,
    PARTS,
    ArrayFaults,
    Field,
    Pixels,
    PixelState,
    StepConstants,
    draw,
    light_constants,
    put_field,
    take_field,
)
from emulator.sensor.pixels.step import Share, Tally, advance, compile_parts, replace_light
from emulator.sensor.pixels.touched import Touched, touch
from emulator.sensor.pixels.workers import EventBuffers, Workers
from emulator.sensor.presets import SensorParameters

__all__ = ["Crossings", "PixelArray", "PixelState"]

_EPOCH_NS = 1 << EPOCH_BITS

_Float32s = npt.NDArray[np.float32]
_NO_RATE = np.empty(0, np.float32)
_NO_UNITS = np.empty(0, np.uint8)


@dataclass(frozen=True, slots=True)
class Crossings:
    """Threshold crossings of one step, sorted by (time, pixel); views, valid until the next step or reset.

    Attributes
    ----------
    t_ns : (n,) int64
        Stream time.
    pixel : (n,) uint32
        row * width + column.
    on : (n,) bool
        True where the light increased.
    lost_in_pixel : int
        Crossings of this step that are not listed, because their pixel had more than 64.
    """

    t_ns: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.uint32]
    on: npt.NDArray[np.bool_]
    lost_in_pixel: int = 0

    def __len__(self) -> int:
        return self.t_ns.size


class PixelArray:
    """An array of event pixels.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor.
    seed : int
        Keys the mismatch, the phases and the spread of the leak. Two arrays with one seed are equal.
    threads : int
        Threads of a step; 0: as many as its work is worth. The events do not depend on it.

    Attributes
    ----------
    state : PixelState
    lost_in_pixel : int
        Crossings since `reset` beyond 64 of a pixel and step.
    quiet_nan : int
        Pixel-steps since `reset` whose light was NaN or infinite; such a pixel is silent, and its filter starts again
        from the next finite light.
    candidates, undersampled : int
        Pixel-steps since `reset` that had to be solved for crossings, and those whose light changed between the frames
        in a way that the frames do not show (see `interpolation`; known only where the time derivative is given).
    refined : int
        Undersampled pixel-steps that were halved instead; each asked for one light of a pixel.
    """

    def __init__(self, parameters: SensorParameters, seed: int, threads: int = 0) -> None:
        self.parameters = parameters
        self.seed = seed
        self._clear_counters()
        self._size = (parameters.height, parameters.width)
        self._whole = Region(0, parameters.height, 0, parameters.width)
        self._pixels = parameters.width * parameters.height
        self._pixel_bits = max(1, (self._pixels - 1).bit_length())
        self._refractory_ns = round(parameters.refractory_us * 1000)
        self._light_constants = light_constants(parameters)
        self._buffers = EventBuffers()
        self.state = self._dark_state()
        self._workers = Workers(self.state.fields.shape[0], threads)
        self._touched_units = np.zeros(self.state.fields.shape[0] * (1 + PARTS), np.uint8)
        self._known = self.state.fields
        self._replacing: tuple[_Float32s, _Float32s] | None = None
        self._refinement: Refinement | None = None

    def _dark_state(self) -> PixelState:
        """Return the state before the first light, with the fixed figures of each pixel drawn."""
        blocks = -(-self._pixels // BLOCK)
        fields, p = aligned_zeros((blocks, FIELDS, BLOCK)), self.parameters
        fields[:, Field.ON] = fields[:, Field.OFF] = np.inf
        drawn, pixel = draw(p, self.seed), np.arange(self._pixels)
        put_field(fields, Field.ON, drawn.on)
        put_field(fields, Field.OFF, drawn.off)
        sigma = p.leak_spread
        rate_hz = p.leak_hz * np.exp(sigma * normal(self.seed, Purpose.LEAK_RATE, pixel) - sigma**2 / 2)
        put_field(fields, Field.LEAK, rate_hz * take_field(fields, Field.ON, self._pixels))
        return PixelState(fields, np.zeros(blocks * BLOCK, np.int64), 0, 0, False)

    def _clear_counters(self) -> None:
        self.lost_in_pixel = self.quiet_nan = self.undersampled = self.candidates = 0
        self.refined = 0

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self.state.t_ns

    @property
    def undersampled_share(self) -> float:
        """Undersampled pixel-steps over those that had to be solved."""
        return self.undersampled / max(self.candidates, 1)

    def faults(self) -> ArrayFaults:
        """Return the access to defects and to the leak."""
        return ArrayFaults(self, self._pixels)

    def follow_parameters(self, constants: tuple[np.float32, np.float32, np.float32, np.float32]) -> None:
        """Take over changed `parameters`, and thresholds or leak that changed with them; see `adjustment`.

        Pixels rest while nothing can fire them, by the figures that were: after any change all are looked at again.
        """
        self._refractory_ns = round(self.parameters.refractory_us * 1000)
        self._light_constants = constants
        self._refinement = None
        self.wake()

    def compile_part(self, which: str) -> None:
        """Compile "blocks" or "candidates", large parts of the step that `step` then finds on disk."""
        pixels = Pixels(self.state.fields.reshape(-1), self.state.refractory_until_ns)
        touched = self._touched(None)
        share = Share(0, 1, self._workers.idle, touched)
        compile_parts(which, pixels, self._workers.buffers(), share, self._constants(0, 1_000_000))

    def wake(self) -> None:
        """Compute all blocks in the next step; for callers that change the state of pixels."""
        wake(self._workers.idle)

    def field(self, which: Field) -> _Float32s:
        """Return a copy of one field of the state, (height, width) float32."""
        return take_field(self.state.fields, which, self._pixels).reshape(self.parameters.height, self.parameters.width)

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame` with the filter at rest on its light, and counters at zero."""
        log_compilation(advance, "the pixel step")
        state, p = self.state, self.parameters
        flat, slope = self._flat(frame.light), _NO_RATE if frame.rate is None else self._flat(frame.rate)
        state.t_ns, state.epoch_ns = int(frame.t_ns), (int(frame.t_ns) >> EPOCH_BITS) << EPOCH_BITS
        state.refractory_until_ns[:] = frame.t_ns
        current = np.maximum(flat, 0) + np.float32(p.dark_current_relative)
        current[~np.isfinite(flat)] = np.nan
        log_light = np.log(current)
        _, at_reference, least, most = self._light_constants
        with np.errstate(over="ignore"):
            filter_rate = np.clip(at_reference * current, least, most)
        phase = uniform(self.seed, Purpose.LEAK_PHASE, np.arange(self._pixels)) if p.random_start else np.float64(0)
        on, leak = (take_field(state.fields, which, self._pixels) for which in (Field.ON, Field.LEAK))
        since_epoch = (state.t_ns - state.epoch_ns) * 1e-9
        state.fields[:, Field.LEAKED] = 0
        self._move_parasitic(-since_epoch, log_light)
        state.slopes_known = frame.rate is not None
        for which in (Field.LOG_LIGHT, Field.FILTERED, Field.SECOND):
            put_field(state.fields, which, log_light)
        put_field(state.fields, Field.RATE, filter_rate)
        put_field(
            state.fields,
            Field.SLOPE,
            np.where(flat > 0, slope, 0) / (current * filter_rate) if slope.size else np.full(flat.size, np.nan),
        )
        put_field(state.fields, Field.REFERENCE, log_light + leak * since_epoch - on * phase)
        self._clear_counters()
        self._replacing = None
        self.wake()

    def step(self, frame: LightFrame) -> Crossings:
        """Move from the last time to that of `frame`.

        Log light follows the cubic through its values and time derivatives at both ends; the parabola where only one
        derivative is known; the straight line without derivatives, or in steps longer than an epoch.

        If its time equals the last one, the step is empty, and this frame takes the place of the last one: the light
        jumps there, and the next step begins with it. With light between frames and the time derivative, undersampled
        steps are refined.

        Raises
        ------
        ValueError
            Time goes back, or a frame does not have the sensor's size.
        """
        flat, slope = self._flat(frame.light), _NO_RATE if frame.rate is None else self._flat(frame.rate)
        state, lost_before = self.state, self.lost_in_pixel
        t_ns = int(frame.t_ns)
        if t_ns < state.t_ns:
            raise ValueError(f"t_ns = {t_ns}: before the last step's {state.t_ns}; time does not go back")
        n = 0
        if t_ns - state.t_ns > _EPOCH_NS:
            n, slope = self._whole_epochs(flat, t_ns), _NO_RATE
        if t_ns > state.t_ns:
            n = self._advance((flat, slope), t_ns, n, frame.at, frame.changed)
        else:
            self._replacing = flat.copy(), slope.copy()
        found = self._buffers
        return Crossings(found.t_ns[:n], found.pixel[:n], found.on[:n], self.lost_in_pixel - lost_before)

    def _whole_epochs(self, flat: _Float32s, t_ns: int) -> int:
        """Advance by whole epochs, on a straight line in log light, until at most one is left; return the number."""
        state, n = self.state, 0
        self._replace_light()
        before, t0_ns = take_field(state.fields, Field.LOG_LIGHT, self._pixels), state.t_ns
        while t_ns - state.t_ns > _EPOCH_NS:
            share = (state.t_ns + _EPOCH_NS - t0_ns) / (t_ns - t0_ns)
            n = self._advance((self._between(before, flat, share), _NO_RATE), state.t_ns + _EPOCH_NS, n)
        return n

    def _between(self, log_before: _Float32s, light: _Float32s, share: float) -> _Float32s:
        """Return the light at a share of the step, on a straight line in the logarithm of the photocurrent."""
        dark = np.float32(self.parameters.dark_current_relative)
        log_after = np.log(np.maximum(light, 0) + dark)
        return np.asarray(np.exp(log_before + np.float32(share) * (log_after - log_before)) - dark, np.float32)

    def _advance(
        self,
        frame: tuple[_Float32s, _Float32s],
        t_ns: int,
        n: int,
        at: PixelLight | None = None,
        changed: Region | None = None,
    ) -> int:
        """Advance by at most an epoch, add the crossings after the first n, and return the new number."""
        state, buffers, slope = self.state, self._buffers, frame[1]
        self._replace_light()
        self._move_epoch()
        if state.fields is not self._known:
            self._known = state.fields
            self.wake()
        if slope.size and not state.slopes_known:
            state.fields[:, Field.SLOPE] = np.nan
            self.wake()
        state.slopes_known = bool(slope.size)
        t0_ns, with_slopes = state.t_ns, bool(slope.size)
        refines = with_slopes and at is not None and t_ns - t0_ns >= SHORTEST_NS
        pixels, c = (
            Pixels(state.fields.reshape(-1), state.refractory_until_ns),
            self._constants(t0_ns, t_ns, not with_slopes),
        )
        touched = self._touched(changed)
        if not refines or at is None:
            lists, tally = self._workers.step(frame, pixels, touched, c)
        else:
            share = Share(0, 1, self._workers.idle, touched)
            buffers.keys, found, tally = self._made_refinement().step(frame, pixels, share, buffers.keys, c, at)
            lists = [buffers.keys[:found]]
            lists[0].sort()
        self._count(tally)
        state.t_ns = t_ns
        return buffers.add(lists, (t0_ns, self._pixel_bits), n)

    def _replace_light(self) -> None:
        """Let the light jump to that of a frame whose time was the last one's, where there is one."""
        if self._replacing is None:
            return
        (flat, slope), self._replacing, state = self._replacing, None, self.state
        c = self._constants(state.t_ns, state.t_ns + 1, chord=not slope.size)
        pixels = Pixels(state.fields.reshape(-1), state.refractory_until_ns)
        self.quiet_nan += replace_light((flat, slope), pixels, self._workers.buffers().scratch, c)
        state.slopes_known = bool(slope.size)
        self.wake()

    def _touched(self, changed: Region | None) -> Touched:
        region = self._whole if changed is None else changed
        units = _NO_UNITS
        if region.boxes is not None:
            units = self._touched_units
            touch(region.boxes, self.parameters.width, units)
        return Touched(*region.bounds, self.parameters.width, units)

    def _move_epoch(self) -> None:
        """Count leak from the last whole epoch: the only place where a reference moves without an event."""
        state = self.state
        epoch_ns = (state.t_ns >> EPOCH_BITS) << EPOCH_BITS
        if epoch_ns != state.epoch_ns:
            moved_s = np.float32((epoch_ns - state.epoch_ns) * 1e-9)
            state.fields[:, Field.REFERENCE] -= state.fields[:, Field.LEAK] * moved_s
            self._move_parasitic(moved_s, take_field(state.fields, Field.LOG_LIGHT, self._pixels))
            state.epoch_ns = epoch_ns

    def _move_parasitic(self, by_s: float | np.float32, log_light: _Float32s) -> None:
        """Count the parasitic leak of the present light from an epoch that is `by_s` later."""
        hz = self.parameters.parasitic_hz_at_reference
        if hz:
            fields, lit = self.state.fields, np.where(np.isfinite(log_light), np.exp(np.minimum(log_light, 80)), 0)
            leaked = (
                take_field(fields, Field.LEAKED, self._pixels)
                + hz * take_field(fields, Field.ON, self._pixels) * lit * by_s
            )
            put_field(fields, Field.LEAKED, leaked)

    def _made_refinement(self) -> Refinement:
        """Return the refinement, which is made when first needed."""
        if self._refinement is None:
            dark, at_reference, least, most = self._light_constants
            resting = np.zeros(FIELDS, np.float32)
            resting[[Field.LOG_LIGHT, Field.FILTERED, Field.REFERENCE, Field.SECOND]] = np.log(dark)
            resting[Field.RATE] = np.clip(at_reference * dark, least, most)
            resting[[Field.ON, Field.OFF]] = np.inf
            table = self._workers.buffers().table
            self._refinement = Refinement(self.state.fields.shape[0], resting, table, self._constants)
        return self._refinement

    def _count(self, tally: Tally) -> None:
        self.lost_in_pixel += tally.lost
        self.undersampled += tally.undersampled
        self.candidates += tally.candidates
        self.quiet_nan += tally.unreadable
        self.refined += tally.refined

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
            unseen_share=UNSEEN_SHARE,
            refine=False,
        )

    def _flat(self, frame: _Float32s) -> _Float32s:
        if frame.shape != self._size or frame.dtype != np.float32:
            raise ValueError(f"light or rate is {frame.shape} {frame.dtype}: must be {self._size} float32")
        return np.ascontiguousarray(frame).reshape(-1)
