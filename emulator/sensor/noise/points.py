"""Noise events as a point process by the level of each pixel: drawn by their rate, at a cost that follows events.

The rate of a pixel's noise events depends on where its reference lies beside the signal. After an event the reference
is at the comparator's voltage of that time; when the signal then stops near a threshold, or a run starts at a random
phase of the leak, noise fires the pixel many times a second, ON and OFF in turns, until the events have brought the
level back to the middle, where they are rare. A pixel therefore has

    offset    of its reference from that of the pixels' method, which follows the signal alone
    level     the offset less the comparator's level, read from the pixels' method; a leak moves it

and the exact law of first passages (`passages`) gives its ON and its OFF rate from the distances of the thresholds and
from the noise in the light of the step (`law`). A noise event moves the offset by a threshold, to the voltage at the
end of the refractory period. When the pixels' method comes to a crossing that noise has already made, with an offset of
more than half a threshold in that direction, this crossing does not fire, and the offset goes back: noise makes events
early and does not add to them.

Times are drawn as candidates of a rate above that of the events, a power of two, and thinned at their time. A pixel
that had crossings of its own is looked at again at each window of 4.2 ms until its level rests; every other pixel at
its candidates, at least once in 32 s in the mean. All random numbers are keyed by pixel and time, never by the step: an
array of still light gives the same noise whatever the steps. In moving light the levels and the light are those at the
end of the step. Left out: the rest of an excursion within a time constant after a reset, and a noise event's refractory
period for the signal.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.draws import (
    HORIZON_NS,
    WINDOW_NS,
    Constants,
    Count,
    Lists,
    Packed,
    PixelNoise,
    ReadPixels,
    Setting,
    cross,
    draw_first,
    due,
    fire,
    insert,
    look_again,
    open_horizon,
    open_window,
    settle,
)
from emulator.sensor.noise.law import fixed_corner_hz, noise_scale
from emulator.sensor.noise.passages import passage_table
from emulator.sensor.numerics.keyed import Purpose, root_of
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings
from emulator.sensor.presets import SensorParameters
from emulator.threads import ThreadPool, available_threads

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]
_Pixels = npt.NDArray[np.int64]

_FASTEST_HZ = 1e9
_NO_POLE_HZ = 1e300
_KEYS = 1024
_PART = 1 << 14  # pixels that a thread settles at once
_NOTHING_READ = np.empty(0, np.float32), np.empty(0, np.float32)


class LevelReader(Protocol):
    """Access to the comparators' levels of a method of pixels."""

    def moving(self, pixel: _Pixels) -> tuple[_Float32s, _Float32s]:
        """Return the levels of pixels (n,), NaN in the refractory period, and their drifts by leak, ln units a second.

        Both are those at the present time of the pixels.
        """
        ...


def _constants(p: SensorParameters, seed: int) -> Constants:
    corner_hz = min(fixed_corner_hz(p), _NO_POLE_HZ)
    unlimited = math.isinf(p.corner_hz_at_reference)
    hz = (_FASTEST_HZ,) * 3 if unlimited else (p.corner_hz_at_reference, p.corner_min_hz, p.corner_max_hz)
    return Constants(
        root=root_of(seed, Purpose.NOISE_EVENTS),
        root_of_looks=root_of(seed, Purpose.NOISE_BURST),
        dark=p.dark_current_relative,
        hz_at_reference=hz[0],
        hz_min=hz[1],
        hz_max=min(hz[2], _FASTEST_HZ),
        rms=p.noise.rms * (math.sqrt(1 + _FASTEST_HZ / corner_hz) if unlimited else 1.0),
        corner_hz=corner_hz,
        refractory_ns=round(p.refractory_us * 1000),
    )


class NoiseEvents:
    """The noise events of an array.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor, with `noise.rms` > 0.
    seed : int
        Keys all random numbers.
    thresholds : (2, pixels) or (pixels,) float64
        Each pixel's ON and OFF threshold, ln units; infinite for dead pixels.
    levels : LevelReader or None
        The comparators' levels; without them references start at the signal, and only noise moves them.
    """

    def __init__(
        self, parameters: SensorParameters, seed: int, thresholds: _Floats, levels: LevelReader | None = None
    ) -> None:
        self._seed, self._reader = seed, levels
        pixels = thresholds.shape[-1]
        self._pixel_bits = max(1, (pixels - 1).bit_length())
        self._table = passage_table()
        self._state = PixelNoise(
            np.zeros((pixels, 3), np.int64),
            np.zeros((pixels, 4), np.float32),
            np.empty((pixels, 3), np.float32),
            np.zeros(pixels, np.uint32),
            np.zeros(pixels, np.uint8),
        )
        soon, window, moved, self._due = (np.zeros(pixels, np.int64) for _ in range(4))
        self._lists = Lists(soon, window, moved, np.zeros(len(Count), np.int64))
        self._keys = np.empty(_KEYS, np.uint64)
        self._model(parameters, thresholds)
        self.reset(0)

    def _model(self, parameters: SensorParameters, thresholds: _Floats) -> None:
        self._constants = _constants(parameters, self._seed)
        self._before_start_ns = round(parameters.noise.history_s * 1e9)
        self._state.limits[:, :2] = np.broadcast_to(thresholds, (2, thresholds.shape[-1])).T
        self._state.limits[:, 2] = noise_scale(parameters, self._seed) if parameters.noise.spread else 1

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`, with the pixels' levels of that time and the light of `begin`, or else of the first step."""
        self._state.times[:] = t_ns
        self._state.levels[:] = 0
        self._state.crossed[:] = 0
        self._t_ns, self._history_ns = t_ns, self._before_start_ns
        self._start_again()

    def _start_again(self) -> None:
        """Draw all candidates again at the present time, at the pixels' levels."""
        self._started = False
        self._state.place[:] = 0
        self._lists.counts[:] = 0
        if self._reader is not None:
            level, drift = self._reader.moving(np.arange(self._state.place.size))
            readable = np.isfinite(level)
            self._state.levels[readable, 1], self._state.levels[readable, 2] = level[readable], drift[readable]
            self._state.times[readable, 1] = self._t_ns

    def follow(self, parameters: SensorParameters, thresholds: _Floats) -> None:
        """Apply changed parameters from the present time on; `thresholds` as in the constructor."""
        self._model(parameters, thresholds)
        self._start_again()

    def begin(self, light: _Float32s) -> None:
        """Find the levels that noise has left by the start, in its light, (pixels,) float32: ahead of the first step.

        Without it the first step does this in its own light, and takes seconds where there is much noise.
        """
        if self._started:
            return
        self._started = True
        setting = self._setting(light)
        draw_first(self._t_ns, self._history_ns, setting, self._state)
        if self._history_ns:
            self._settle(setting)
            self._history_ns = 0
        window_ns = self._t_ns // WINDOW_NS * WINDOW_NS
        open_horizon(window_ns, self._state, self._lists)
        open_window(window_ns, self._state, self._lists)
        self._window_end_ns = window_ns + WINDOW_NS

    def _settle(self, setting: Setting) -> None:
        """Run the noise of the time before the start, by all cores: a noisy 720p sensor has 10^8 events in 100 s."""
        pixels = self._state.place.size

        def settle_part(part: int, _: int) -> None:
            first = part * _PART
            settle(first, min(first + _PART, pixels), self._t_ns, setting, self._state)

        pool = ThreadPool(available_threads())
        try:
            pool.each(settle_part, -(-pixels // _PART))
        finally:
            pool.close()

    def take(self, crossings: Crossings, light: _Float32s) -> Crossings:
        """Return those of a step's crossings that fire: the others are events that noise made before.

        Parameters
        ----------
        crossings : of the pixels' own method, from the last time on.
        light : (pixels,) float32, as in `add_to`, which follows.
        """
        if not len(crossings):
            return crossings
        self.begin(light)
        fires = np.empty(len(crossings), np.bool_)
        arrays, setting = (crossings.t_ns, crossings.pixel, crossings.on), self._setting(light)
        while not cross(
            arrays, self._window_end_ns, setting, self._state, self._lists, self._packed(self._t_ns), fires
        ):
            self._more_keys()
        if fires.all():
            return crossings
        return Crossings(arrays[0][fires], arrays[1][fires], arrays[2][fires], crossings.lost_in_pixel)

    def step(self, light: _Float32s, t_ns: int) -> Crossings:
        """Return the events from the last time up to, and without, `t_ns`, under `light`, (pixels,) float32."""
        return self.add_to(NO_CROSSINGS, light, t_ns)

    def add_to(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Return a step's `crossings` with the noise events up to, and without, `t_ns` among them."""
        if t_ns <= self._t_ns:
            return crossings
        self.begin(light)
        t0_ns = self._t_ns
        while self._t_ns < t_ns:
            if self._t_ns >= self._window_end_ns:
                self._open(light, t_ns)
            end_ns = min(t_ns, self._window_end_ns)
            self._run(light, end_ns, t_ns, t0_ns)
            self._t_ns = end_ns
        raised, self._lists.counts[Count.FOUND] = int(self._lists.counts[Count.FOUND]), 0
        if not raised:
            return crossings
        keys = self._keys[:raised]
        keys.sort()
        n = raised + len(crossings)
        out = np.empty(n, np.int64), np.empty(n, np.uint32), np.empty(n, np.bool_)
        insert(keys, t0_ns, self._pixel_bits, (crossings.t_ns, crossings.pixel, crossings.on), out)
        return Crossings(*out, crossings.lost_in_pixel)

    def _open(self, light: _Float32s, t_ns: int) -> None:
        """Open the window that begins at the present time; levels are those at `t_ns`."""
        window_ns, lists = self._t_ns, self._lists
        self._window_end_ns = window_ns + WINDOW_NS
        if lists.counts[Count.MOVED]:
            pixels = lists.moved[: lists.counts[Count.MOVED]]
            moved = ReadPixels(pixels, *self._levels_of(pixels))
            look_again((window_ns, t_ns), moved, self._setting(light), self._state, lists)
        if window_ns % HORIZON_NS == 0:
            open_horizon(window_ns, self._state, lists)
        open_window(window_ns, self._state, lists)

    def _levels_of(self, pixel: _Pixels) -> tuple[_Float32s, _Float32s]:
        if self._reader is not None:
            return self._reader.moving(pixel)
        return np.full(pixel.size, np.nan, np.float32), np.zeros(pixel.size, np.float32)

    def _setting(self, light: _Float32s) -> Setting:
        return Setting(light, self._constants, self._table)

    def _packed(self, t0_ns: int) -> Packed:
        return Packed(self._keys, t0_ns, self._pixel_bits)

    def _run(self, light: _Float32s, end_ns: int, t_ns: int, t0_ns: int) -> None:
        """Run the candidates before `end_ns`, within the window; levels are those at `t_ns`."""
        if not self._lists.counts[Count.WINDOW]:
            return
        n = due(end_ns, self._window_end_ns, self._state, self._lists, self._due)
        if not n:
            return
        pixels = self._due[:n]
        read = self._levels_of(pixels) if self._reader is not None else _NOTHING_READ
        due_pixels, setting = ReadPixels(pixels, *read), self._setting(light)
        while not fire(due_pixels, (end_ns, t_ns), setting, self._state, self._lists, self._packed(t0_ns)):
            self._more_keys()

    def _more_keys(self) -> None:
        self._keys = np.concatenate([self._keys, np.empty_like(self._keys)])
