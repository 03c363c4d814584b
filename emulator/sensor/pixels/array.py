"""The pixel array: from frames of light to threshold crossings with exact times.

The whole memory of a pixel is in one `PixelState`; all other values follow from the parameters and the seed. Absolute
time is used as whole nanoseconds only: leak is counted from an epoch that moves every 2^33 ns (8.6 s), so a step 30
days into a stream equals the same step at its start.

A change of a bias reaches the pixels here, in `PixelArray.adjust`: thresholds and leak in the state of each pixel,
corner frequencies and refractory period through `StepConstants`, which `_constants` makes for each step.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame, Region
from emulator.sensor.noise.hazard import integral_tables
from emulator.sensor.noise.law import SHARES, Before, solve_start
from emulator.sensor.numerics.compiled import log_compilation
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.numerics.keyed import Purpose, root_of, streams
from emulator.sensor.pixels import state as layout
from emulator.sensor.pixels.candidate_table import new_table
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, EventBuffers, Keys
from emulator.sensor.pixels.curve import UNSEEN_SHARE
from emulator.sensor.pixels.idle import Touched, touch, wake
from emulator.sensor.pixels.method import STOP, Capabilities, PixelMethod, StepInterrupted, time_of
from emulator.sensor.pixels.noisy import settle
from emulator.sensor.pixels.offsets import draw_anew
from emulator.sensor.pixels.state import Field, Memory
from emulator.sensor.pixels.step import (
    SHORTEST_NS,
    MoveShare,
    Share,
    Tally,
    Workers,
    advance,
    compile_parts,
    replace_light,
)
from emulator.sensor.presets import SensorParameters
from emulator.threads import ThreadPool, available_threads

_EPOCH_NS = 1 << layout.EPOCH_BITS
_LONG_AGO_NS = 1 << 40
_LITTLE = 0.02  # of the noise's rms: leak that changes moves the value by no more before pixels are computed again
_CERTIFIED_NS = 10_000_000  # length of the steps for which the first certificates are made
_PART = 1 << 14  # pixels that a thread settles at once
_NODES_APART = np.array([0.1, 0.1, 0.7, 1.0], np.float32)  # of laws: logs of ON, OFF, receptor's rate, leak
_LEAST_TURNS, _NO_NOISE = np.float32(1e-4), np.float32(2e3)  # turns by leak before the start; thresholds over the rms

_Float32s = npt.NDArray[np.float32]
_NO_RATE = np.empty(0, np.float32)
_NO_UNITS = np.empty(0, np.uint8)


class PixelArray(PixelMethod):
    """An array of event pixels.

    Parameters
    ----------
    parameters : the sensor.
    seed : keys the mismatch, the phases and the spread of the leak. Two arrays with one seed are equal.
    threads : threads of a step; 0: as many as its work is worth. The events do not depend on it.

    Attributes
    ----------
    state : PixelState
    lost_in_pixel : crossings since `reset` beyond 64 of a pixel and step.
    quiet_nan : pixel-steps since `reset` whose light was NaN or infinite; such a pixel is silent, and its filter starts
        again from the next finite light.
    candidates, undersampled : pixel-steps since `reset` that had to be solved for crossings, and those whose light
        changed in a way that the frames do not show (see `curve`; known only where the time derivative is given).
    refined : undersampled pixel-steps that were refined instead; each needed the light of a pixel once.
    of_noise : crossings of the last step for which the signal had gone less than half of the way to its threshold.
    """

    capabilities: ClassVar = Capabilities(
        uses_rate=True,
        refines_pixels=True,
        skips_unchanged=True,
        is_adjustable=True,
        takes_row_reads=True,
        has_faults=True,
        has_comparator=True,
        has_large_signal=True,
    )

    def __init__(self, parameters: SensorParameters, seed: int, threads: int = 0) -> None:
        super().__init__(parameters, seed)
        self._clear_counters()
        self._whole = Region(0, parameters.height, 0, parameters.width)
        self._pixels = parameters.width * parameters.height
        self._flag_bits = int(parameters.noise.rms > 0)  # behind a pixel's number: whether the event is the noise's
        self._is_drawn = parameters.noise.rms > 0 and parameters.noise.grade == "offsets"
        self._pixel_bits = max(1, (self._pixels - 1).bit_length()) + self._flag_bits
        self._refractory_ns = _refractory_ns(parameters)
        self._light_constants = layout.light_constants(parameters)
        self._noise_root = root_of(seed, Purpose.NOISE_EVENTS)
        self._buffers = EventBuffers()
        self._tables = integral_tables() if parameters.noise.rms else np.empty(0, np.int32)
        self.state = self._dark_state()
        self._workers = Workers(self.state.fields.shape[0], threads)
        self._delays = max(parameters.comparator.on_us, parameters.comparator.off_us) > 0
        self._touched_units = np.zeros(self.state.fields.shape[0] * (1 + layout.PARTS), np.uint8)
        self._moved_fields = self.state.fields
        self._replacing: layout.FlatLight | None = None
        self._refinements: dict[int, Any] = {}  # by thread

    def _dark_state(self) -> layout.PixelState:
        """Return the state before the first light, with thresholds and leak of each pixel."""
        blocks = -(-self._pixels // layout.BLOCK)
        fields, p = aligned_zeros((blocks, layout.FIELDS, layout.BLOCK)), self.parameters
        fields[:] = self._resting()[:, None]
        pixels = layout.draw(p, self.seed)
        layout.put_field(fields, Field.ON, pixels.on)
        layout.put_field(fields, Field.OFF, pixels.off)
        layout.put_field(fields, Field.LEAK, pixels.leak_hz * layout.take_field(fields, Field.ON, self._pixels))
        memory = layout.noise_memory(p, self.seed, blocks * layout.BLOCK) if p.noise.rms else np.empty(0, np.float32)
        positions = np.zeros((1 + (p.reset.noise > 0)) * blocks * layout.BLOCK, np.int64)
        return layout.PixelState(fields, positions, 0, 0, False, memory)

    def _clear_counters(self) -> None:
        self.lost_in_pixel = self.quiet_nan = self.undersampled = self.candidates = self.refined = 0
        self.of_noise = NO_CROSSINGS

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self.state.t_ns

    @property
    def undersampled_share(self) -> float:
        """Undersampled pixel-steps over those that had to be solved."""
        return self.undersampled / max(self.candidates, 1)

    def adjust(self, name: str, value: float) -> None:
        """Set one of `adjustable` from the array's time on; raises ValueError where the value is not allowed.

        The comparators' levels do not jump: a new threshold meets the same stored level, and the reference moves with
        the leak. A refractory period that has begun keeps its end. Resting pixels are computed again: they may fire.
        """
        before = self.parameters
        if name == "source_follower_hz" and not (before.source_follower_hz > 0 and value > 0):
            raise ValueError(
                "source_follower_hz can change between values above 0 only: the pole cannot be added or removed"
            )
        changed: dict[str, Any] = {name: value}
        after = dataclasses.replace(before, **changed)
        if name == "source_follower_hz" and before.noise.corner_hz:  # a pole of the same transistors
            corner_hz = min(before.noise.corner_hz * value / before.source_follower_hz, 1e6)
            after = dataclasses.replace(after, noise=dataclasses.replace(before.noise, corner_hz=corner_hz))
        leak_hz = self.leak_hz()
        if name == "threshold_on":
            self._scale_threshold(Field.ON, after.threshold_on / before.threshold_on)
            self.set_leak(leak_hz)  # events a second stay as they were
        elif name == "threshold_off":
            self._scale_threshold(Field.OFF, after.threshold_off / before.threshold_off)
        elif name == "leak_hz" and before.leak_hz:
            self.set_leak(leak_hz * (after.leak_hz / before.leak_hz))
        elif name == "leak_hz":
            self.set_leak(layout.draw(after, self.seed).leak_hz)
        if bool(before.highpass_hz) != bool(after.highpass_hz):
            self._switch_high_pass(before, after)
        if name == "corner_max_hz":
            self._limit_rates(layout.light_constants(after))
        self.parameters, self._light_constants = after, layout.light_constants(after)
        self._refractory_ns = _refractory_ns(after)
        self._refinements = {}
        if self._is_drawn:
            self._draw_anew()
        elif after.noise.rms:
            layout.put_field(self.state.fields, Field.UNTIL, np.full(self._pixels, -np.inf))  # no certificate holds now
        self.wake()

    def _scale_threshold(self, field: Field, ratio: float) -> None:
        """Multiply a threshold of all pixels that are not dead."""
        values = self.state.fields[:, field]
        values *= np.where(values < layout.DEAD_THRESHOLD, np.float32(ratio), np.float32(1))

    def _switch_high_pass(self, before: SensorParameters, after: SensorParameters) -> None:
        """Begin the high-pass, at rest on the present signal, or end it; the comparators' levels stay."""
        fields = self.state.fields
        if after.highpass_hz:
            fields[:, Field.HIGH_PASSED] = 0
        fields[:, Field.REFERENCE] += fields[:, layout.compared_field(after)] - fields[:, layout.compared_field(before)]

    def _limit_rates(self, c: layout.LightConstants) -> None:
        """Give the photoreceptors the rates of new constants at once, and the slopes by warped time with them."""
        fields, highest = self.state.fields, self._light_constants.rate_max
        rate, slope = fields[:, Field.RATE].copy(), fields[:, Field.SLOPE]
        with np.errstate(over="ignore"):
            unlimited = np.where(rate >= highest, c.rate_at_reference * np.exp(fields[:, Field.LOG_LIGHT]), rate)
        fields[:, Field.RATE] = np.clip(unlimited, c.rate_min, c.rate_max)
        slope *= rate / fields[:, Field.RATE]

    def thresholds_of(self, pixel: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of one pixel as they are now; infinite for a dead one."""
        flat, pixels = self.state.fields.reshape(-1), np.array([pixel])
        on, off = (float(flat[layout.field_index(pixels, field)][0]) for field in (Field.ON, Field.OFF))
        return (on, off) if on < layout.DEAD_THRESHOLD else (math.inf, math.inf)

    def levels(self) -> layout.Levels:
        """Return the access to the comparators' levels."""
        return layout.Levels(self)

    def kill(self, pixel: npt.NDArray[np.int64]) -> None:
        """Make pixels, (n,), dead; they leak in units of their thresholds, so the parasitic leak still fires them."""
        flat = self.state.fields.reshape(-1)
        flat[layout.field_index(pixel, Field.ON)] = layout.DEAD_THRESHOLD
        flat[layout.field_index(pixel, Field.OFF)] = layout.DEAD_THRESHOLD
        flat[layout.field_index(pixel, Field.LEAK)] = 0
        if self._is_drawn:
            self._draw_anew()
        self.wake()

    def leak_hz(self) -> npt.NDArray[np.float64]:
        """Return the leak rate of all pixels, (pixels,), without the parasitic leak."""
        leak, on = (layout.take_field(self.state.fields, field, self._pixels) for field in (Field.LEAK, Field.ON))
        return np.asarray(leak / on.astype(np.float64))

    def set_leak(self, leak_hz: npt.NDArray[np.float64]) -> None:
        """Set the leak rate of all pixels, (pixels,); the reference moves, so that the comparators' levels stay."""
        state, pixel = self.state, np.arange(self._pixels)
        flat = state.fields.reshape(-1)
        leak = (leak_hz * flat[layout.field_index(pixel, Field.ON)]).astype(np.float32)
        since_epoch_s = np.float32((state.t_ns - state.epoch_ns) * 1e-9)
        change = leak - flat[layout.field_index(pixel, Field.LEAK)]
        flat[layout.field_index(pixel, Field.REFERENCE)] += change * since_epoch_s
        flat[layout.field_index(pixel, Field.LEAK)] = leak
        certified = layout.field_index(pixel, Field.UNTIL)  # for the leak of before
        with np.errstate(divide="ignore", invalid="ignore"):
            until_s = since_epoch_s + _LITTLE * self.parameters.noise.rms / np.abs(change)
        if not self._is_drawn:
            flat[certified] = np.fmin(flat[certified], until_s)
        self.wake()

    def compile_part(self, part: str) -> None:
        """Compile "blocks", "candidates" or "noise", large parts of the step that `step` then finds on disk."""
        share = Share(0, 1, self._workers.idle, self._touched(None), STOP)
        compile_parts(part, self._flat_state(), self._workers.buffers[0], share, self._constants(0, 1_000_000))

    def _flat_state(self) -> layout.Pixels:
        state = self.state
        return layout.Pixels(state.fields.reshape(-1), state.refractory_until_ns, state.memory, self._tables)

    def wake(self) -> None:
        """Compute all blocks in the next step; for callers that change the state of pixels."""
        wake(self._workers.idle)

    def field(self, field: Field) -> _Float32s:
        """Return a copy of one field of the state, (height, width) float32."""
        return layout.take_field(self.state.fields, field, self._pixels).reshape(self.parameters.height, -1)

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame` with the filter at rest on its light, and counters at zero."""
        log_compilation(advance, "the pixel step")
        state, p = self.state, self.parameters
        flat, slope = self._flat(frame.light), _NO_RATE if frame.rate is None else self._flat(frame.rate)
        state.t_ns, state.epoch_ns = int(frame.t_ns), (int(frame.t_ns) >> layout.EPOCH_BITS) << layout.EPOCH_BITS
        pixels = state.fields.shape[0] * layout.BLOCK
        state.refractory_until_ns[:pixels] = frame.t_ns
        if p.reset.noise:
            state.refractory_until_ns[pixels:] = streams(root_of(self.seed, Purpose.RESET_NOISE), pixels).view(np.int64)
        state.late, state.late_from_ns = np.empty(0, np.uint64), state.t_ns
        current = np.maximum(flat, 0) + np.float32(p.dark_current_relative)
        current[~np.isfinite(flat)] = np.nan
        log_light = np.log(current)
        light = self._light_constants
        with np.errstate(over="ignore"):
            filter_rate = np.clip(light.rate_at_reference * current, light.rate_min, light.rate_max)
            lit_slope = np.where(flat > 0, slope, 0) / (current * filter_rate) if slope.size else np.nan * current
        phase = layout.leak_phase(p, self.seed)
        on, leak = (layout.take_field(state.fields, field, self._pixels) for field in (Field.ON, Field.LEAK))
        since_epoch = (state.t_ns - state.epoch_ns) * 1e-9
        state.fields[:, [Field.LEAKED, Field.HIGH_PASSED]] = 0
        self._move_parasitic(-since_epoch, log_light)
        state.slopes_known = frame.rate is not None
        for field in (Field.LOG_LIGHT, Field.FILTERED, Field.SECOND):
            layout.put_field(state.fields, field, log_light)
        layout.put_field(state.fields, Field.RATE, filter_rate)
        layout.put_field(state.fields, Field.SLOPE, lit_slope)
        settled = log_light - log_light if p.highpass_hz else log_light  # 0, NaN in light that is none
        layout.put_field(state.fields, Field.REFERENCE, settled + leak * since_epoch - on * phase)
        del current, log_light, filter_rate, lit_slope, phase, on, leak, settled  # half as large as the state
        if p.noise.rms:
            self._settle()
        if self._is_drawn:
            self._set_apart()
            self._draw_anew()
        self._clear_counters()
        self._replacing = None
        self.wake()

    def _settle(self) -> None:
        """Draw references of the start, from laws at nodes around the pixels' parameters, and first numbers."""
        state, p = self.state, self.parameters
        layout.put_field(state.fields, Field.UNTIL, np.full(self._pixels, -np.inf))
        memory = state.memory.reshape(-1, layout.MEMORY)
        memory[:, [Memory.N, Memory.V]] = 0
        state.refractory_until_ns[: len(memory)] = state.t_ns - _LONG_AGO_NS  # the noise has forgotten the last reset
        fields = Field.ON, Field.OFF, Field.RATE, Field.LEAK, Field.LOG_LIGHT
        on, off, rate, leak, log_light = (layout.take_field(state.fields, field, self._pixels) for field in fields)
        rms = memory[: self._pixels, Memory.SCALE] * np.float32(p.noise.rms)
        lit = np.exp(log_light) * np.float32(p.parasitic_hz_at_reference)
        turns = np.float32(p.noise.history_s) * (leak / on + lit) + _LEAST_TURNS
        places = np.stack([on / rms, off / rms, rate, turns])
        np.log(places, out=places)
        places /= _NODES_APART[:, None]
        settled = np.isfinite(places.sum(axis=0)) & (on < _NO_NOISE * rms) & (p.noise.history_s > 0)
        del on, off, rate, leak, log_light, rms, lit, turns  # half as large as the state
        lowest = np.floor(places.min(axis=1, where=settled, initial=_NO_NOISE))
        places -= lowest[:, None]
        places[:, ~settled] = np.nan
        used = np.zeros(places.max(axis=1, where=settled, initial=0).astype(int) + 2, np.bool_)
        used[tuple(places[:, settled].astype(int))] = True
        for axis in range(used.ndim):
            used |= np.roll(used, 1, axis)  # the other corners of the cells
        nodes, of_node = np.flatnonzero(used), np.exp((np.argwhere(used) + lowest) * _NODES_APART)
        laws = np.empty((used.size, SHARES.size), np.float32)
        root, flat = root_of(self.seed, Purpose.NOISE_BURST), self._flat_state()
        c = self._constants(state.t_ns - _CERTIFIED_NS, state.t_ns)
        dead_s, poles = self._refractory_ns * 1e-9, (c.noise_pole, c.high_rate)
        before = Before(p.noise.history_s, float(p.random_start), dead_s, *poles)
        strides = np.cumprod((SHARES.size, *used.shape[:0:-1]))[::-1].copy()

        def settle_part(part: int, _: int) -> None:
            first, last = part * _PART, min((part + 1) * _PART, self._pixels)
            settle(first, last, places, strides, laws.reshape(-1), root, flat, c)

        pool = ThreadPool(available_threads())
        try:
            pool.each(lambda k, _: solve_start(*of_node[k], before, self._tables, laws[nodes[k]]), len(nodes))
            pool.each(settle_part, -(-self._pixels // _PART))
        finally:
            pool.close()

    def _set_apart(self) -> None:
        """Keep the noise of the last reset beside the references, which are those of the signal alone."""
        state, memory = self.state, self.state.memory.reshape(-1, layout.MEMORY)[: self._pixels]
        at = memory[:, Memory.SEEN]  # value at the start, from the reference
        memory[:, Memory.N] = np.where(np.isfinite(at), -at, 0)
        reference = layout.take_field(state.fields, Field.REFERENCE, self._pixels)
        layout.put_field(state.fields, Field.REFERENCE, reference - memory[:, Memory.N])

    def _draw_anew(self) -> None:
        """Draw how far each pixel goes to its next event, and when it comes in still light, as after a reset."""
        c = self._constants(self.state.t_ns - _CERTIFIED_NS, self.state.t_ns)
        draw_anew(0, self._pixels, self._flat_state(), self._workers.buffers[0].table.draws, c)

    def step(self, frame: LightFrame) -> Crossings:
        """Move from the last time to that of `frame`.

        Log light follows the cubic through its values and time derivatives at both ends; the parabola where only one
        derivative is known; the straight line without derivatives, or in steps longer than an epoch.

        If its time equals the last one, the step is empty, and this frame replaces the last one: the light jumps there,
        and the next step begins with it. With light between frames and its derivative, undersampled steps are refined.
        Raises ValueError if time goes back, or a frame does not have the sensor's size.
        """
        flat, slope = self._flat(frame.light), _NO_RATE if frame.rate is None else self._flat(frame.rate)
        state, lost_before = self.state, self.lost_in_pixel
        t_ns, n = time_of(frame, state.t_ns), 0
        if t_ns - state.t_ns > _EPOCH_NS:
            n, slope = self._whole_epochs(flat, t_ns), _NO_RATE
        if t_ns > state.t_ns:
            n = self._advance(layout.FlatLight(flat, slope), t_ns, n, frame)
        else:
            self._replacing = layout.FlatLight(flat.copy(), slope.copy())
        events = self._buffers
        if self._flag_bits:
            flagged = np.flatnonzero(events.pixel[:n] & 1)
            events.pixel[:n] >>= 1
            self.of_noise = Crossings(events.t_ns[flagged], events.pixel[flagged], events.on[flagged])
        return Crossings(events.t_ns[:n], events.pixel[:n], events.on[:n], self.lost_in_pixel - lost_before)

    def _whole_epochs(self, flat: _Float32s, t_ns: int) -> int:
        """Advance by whole epochs, on a straight line in log light, until at most one is left; return the number."""
        state, n = self.state, 0
        self._replace_light()
        before, t0_ns = layout.take_field(state.fields, Field.LOG_LIGHT, self._pixels), state.t_ns
        dark = np.float32(self.parameters.dark_current_relative)
        change = np.log(np.maximum(flat, 0) + dark) - before
        while t_ns - state.t_ns > _EPOCH_NS:
            share = np.float32((state.t_ns + _EPOCH_NS - t0_ns) / (t_ns - t0_ns))
            light = np.exp(before + share * change) - dark
            n = self._advance(layout.FlatLight(light, _NO_RATE), state.t_ns + _EPOCH_NS, n)
        return n

    def _advance(self, frame: layout.FlatLight, t_ns: int, n: int, light_frame: LightFrame | None = None) -> int:
        """Advance by at most an epoch, add the crossings after the first n, and return the new number.

        `light_frame` is the one whose light and rate `frame` has; without it the whole light may have changed.
        """
        state, buffers = self.state, self._buffers
        with_slopes = bool(frame.rate.size)
        self._replace_light()
        self._move_epoch()
        if state.fields is not self._moved_fields:
            self._moved_fields = state.fields
            self.wake()
        if with_slopes and not state.slopes_known:
            state.fields[:, Field.SLOPE] = np.nan
            self.wake()
        state.slopes_known = with_slopes
        t0_ns, pixels = state.t_ns, self._flat_state()
        c = self._constants(t0_ns, t_ns, not with_slopes)
        touched = self._touched(None if light_frame is None else light_frame.changed)
        refine: MoveShare | None = None
        if light_frame is not None and light_frame.at is not None and with_slopes and t_ns - t0_ns >= SHORTEST_NS:
            from emulator.sensor.pixels.refinement import Refinement  # which few arrays need

            def refine_share(thread: int, share: Share, keys: Keys) -> tuple[Keys, int, Tally]:
                if thread not in self._refinements:
                    blocks = len(state.fields)
                    self._refinements[thread] = Refinement(blocks, self._resting(), new_table(), self._constants)
                step = self._refinements[thread].step
                moved: tuple[Keys, int, Tally] = step(frame, pixels, share, keys, c, light_frame)
                return moved

            refine = refine_share

        keys, tally = self._workers.step(frame, pixels, touched, c, refine)
        if STOP[0]:
            raise StepInterrupted
        self.lost_in_pixel += tally.lost
        self.undersampled += tally.undersampled
        self.candidates += tally.candidates
        self.quiet_nan += tally.unreadable
        self.refined += tally.refined
        state.t_ns = t_ns
        if self._delays:
            keys = self._switched(keys, t0_ns)
        return buffers.add(keys, t0_ns, self._pixel_bits, n)

    def _switched(self, keys: Keys, t0_ns: int) -> Keys:
        """Return the events whose comparator has switched by now; the others wait for a later step.

        Events of `keys` count from `t0_ns`. One that still waits when the stream ends has not happened.
        """
        state, shift = self.state, np.uint64(self._pixel_bits + 1)
        keys = np.concatenate([keys, state.late - (np.uint64(t0_ns - state.late_from_ns) << shift)])
        keys.sort()
        n = int(np.searchsorted(keys, np.uint64(state.t_ns - t0_ns + 1) << shift))
        state.late, state.late_from_ns = keys[n:].copy(), t0_ns
        return keys[:n]

    def _replace_light(self) -> None:
        """Change the light at once to that of a pending frame at the time of the last one."""
        if self._replacing is None:
            return
        frame, self._replacing = self._replacing, None
        state = self.state
        c = self._constants(state.t_ns, state.t_ns + 1, chord=not frame.rate.size)
        self.quiet_nan += replace_light(frame, self._flat_state(), self._workers.buffers[0].scratch, c)
        state.slopes_known = bool(frame.rate.size)
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
        epoch_ns = (state.t_ns >> layout.EPOCH_BITS) << layout.EPOCH_BITS
        if epoch_ns != state.epoch_ns:
            moved_s = np.float32((epoch_ns - state.epoch_ns) * 1e-9)
            state.fields[:, Field.REFERENCE] -= state.fields[:, Field.LEAK] * moved_s
            state.fields[:, Field.UNTIL] -= moved_s + np.float32(1e-5)  # never later by its rounding
            memory = state.memory.reshape(-1, layout.MEMORY)
            memory[:, Memory.SEEN_S] -= moved_s
            self._move_parasitic(moved_s, layout.take_field(state.fields, Field.LOG_LIGHT, self._pixels))
            state.epoch_ns = epoch_ns

    def _move_parasitic(self, by_s: float | np.float32, log_light: _Float32s) -> None:
        """Count the parasitic leak of the present light from an epoch that is `by_s` later."""
        hz = self.parameters.parasitic_hz_at_reference
        if hz:
            fields, lit = self.state.fields, np.where(np.isfinite(log_light), np.exp(np.minimum(log_light, 80)), 0)
            leaked, on = (layout.take_field(fields, of, self._pixels) for of in (Field.LEAKED, Field.ON))
            layout.put_field(fields, Field.LEAKED, leaked + hz * on * lit * by_s)

    def _resting(self) -> npt.NDArray[np.float32]:
        """Return the state of a pixel that rests in the dark, (FIELDS,): of those beyond the end of the last block."""
        light = self._light_constants
        resting = np.zeros(layout.FIELDS, np.float32)
        resting[[Field.LOG_LIGHT, Field.FILTERED, Field.SECOND]] = np.log(light.dark)
        resting[Field.RATE] = np.clip(light.rate_at_reference * light.dark, light.rate_min, light.rate_max)
        # No leak, in units of ON, comes near the reference.
        resting[[Field.REFERENCE, Field.ON, Field.OFF]] = 1e30, 1.0, np.inf
        resting[[Field.ON_LIMIT, Field.OFF_LIMIT, Field.SPEED_LIMIT, Field.UNTIL]] = np.inf
        return resting

    def _constants(self, t0_ns: int, t1_ns: int, chord: bool = False) -> layout.StepConstants:
        p = self.parameters
        since_ns, h_ns = t0_ns - self.state.epoch_ns, t1_ns - t0_ns
        return layout.StepConstants(
            *self._light_constants,
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
            large=p.photoreceptor == "large_signal",
            reset=layout.ResetError(np.float32(p.reset.offset), np.float32(p.reset.noise)),
            on_delay=p.comparator.on_us * 1e-6,
            off_delay=p.comparator.off_us * 1e-6,
            contrast_per_e=float(p.comparator.contrast_per_e),
            noisy=p.noise.rms > 0 and not self._is_drawn,
            offsets=self._is_drawn,
            noise_rms=float(p.noise.rms),
            noise_pole=2 * math.pi * (p.noise.corner_hz or p.source_follower_hz),
            noise_root=self._noise_root,
            since_s=since_ns * 1e-9,
            high=np.float32(2 * math.pi * p.highpass_hz * h_ns * 1e-9),
            high_rate=2 * math.pi * p.highpass_hz,
            compared=int(layout.compared_field(p)) * layout.BLOCK,
        )


def _refractory_ns(p: SensorParameters) -> int:
    """Return the refractory period, ns; at least 1 where comparators are late: the reference is set at its end."""
    return max(round(p.refractory_us * 1000), int(max(p.comparator.on_us, p.comparator.off_us) > 0))
