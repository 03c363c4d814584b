"""Event pixels in a graphics card's memory: `PixelArray`, step by step, as a compute shader.

Light enters as a texture, uploaded or drawn in the same context. A first pass moves the quiet pixels and lists those
that may fire; a second pass moves these. Events leave as a list of pixels and times within the step, which the
processor sorts. All random numbers are drawn by the processor, keyed as for `PixelArray`, so both have the same pixels;
their events agree within the rounding of float32.

Time on the card is relative: a share of the step within a step, and from step to step the whole nanoseconds that are
left of a refractory period. So steps and refractory periods are at most 2^31 ns. When the list of events is too short,
it is made longer and the step is repeated from the state before it, so the result does not depend on the order of the
pixels.

Undersampled steps are not refined.
"""

from __future__ import annotations

import math
import weakref
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.gl.context import open_context, renderer_name
from emulator.light import MachineLacks, PixelLight
from emulator.sensor.gpu.step import COUNTS, CROSSINGS, GROUP, NOT_KNOWN, PIXEL, QUIET, THRESHOLDS
from emulator.sensor.pixels.array import Crossings
from emulator.sensor.pixels.state import draw, light_constants
from emulator.sensor.presets import SensorParameters

if TYPE_CHECKING:
    import moderngl

__all__ = ["GpuArray"]

_EPOCH_BITS = 33
_LONGEST_NS = 1 << 31
_FIRST_CAPACITY = 1 << 16
_EVENT_BYTES = 8

_NOTHING = np.empty((0, 2), np.uint32)
_NO_COUNTS = np.array([(0, 1, 1, 0, 0, 0, 0, 0)], COUNTS)

_Float32s = npt.NDArray[np.float32]


class GpuArray:
    """An array of event pixels on a graphics card, with the interface of `PixelArray`.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor.
    seed : int
        Keys the pixels, which are those of a `PixelArray` with that seed.
    context : moderngl.Context, optional
        The context of this thread; without one the array creates its own, and releases it at its end.

    Attributes
    ----------
    renderer : str
        Name of the device, in GL's words.
    lost_in_pixel : int
        Crossings since `reset` beyond 64 of a pixel and step, or beyond the longest possible list.
    quiet_nan, undersampled, candidates : int
        As of `PixelArray`.

    Raises
    ------
    ValueError
        The sensor has an effect that is not supported here.
    MachineLacks
        There is no GL, or the sensor is too large for it.
    """

    def __init__(self, parameters: SensorParameters, seed: int, context: moderngl.Context | None = None) -> None:
        _require_supported(parameters)
        self.parameters, self.seed = parameters, seed
        self._size = parameters.width, parameters.height
        self._refractory_ns = round(parameters.refractory_us * 1000)
        self._t_ns = self._epoch_ns = 0
        self._slopes_known = False
        self._clear_counters()
        self._drawn = draw(parameters, seed)
        self._gl = open_context() if context is None else context
        if context is None:
            weakref.finalize(self, self._gl.release)
        self.renderer = renderer_name(self._gl)
        with self._gl:
            self._build()

    def _build(self) -> None:
        gl, pixels = self._gl, self.parameters.width * self.parameters.height
        _require_memory(gl, self._size)
        self._passes = gl.compute_shader(QUIET), gl.compute_shader(CROSSINGS)
        self._states = [gl.buffer(reserve=pixels * PIXEL.itemsize) for _ in range(2)]
        thresholds = np.empty(pixels, THRESHOLDS)
        for name in ("on", "off", "leak"):
            thresholds[name] = getattr(self._drawn, name)
        self._thresholds = gl.buffer(thresholds)
        self._counts = gl.buffer(reserve=COUNTS.itemsize)
        self._candidates = gl.buffer(reserve=pixels * 4)
        self._largest_capacity = int(gl.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]) // _EVENT_BYTES
        self._reserve(_FIRST_CAPACITY)
        self._light, self._rate = (gl.texture(self._size, 1, dtype="f4") for _ in range(2))
        dark, at_reference, least, most = light_constants(self.parameters)
        self._set(size=self._size, light=0, light_rate=1, refractory_ns=self._refractory_ns)
        self._set(dark=dark, rate_at_reference=at_reference, rate_min=least, rate_max=most)
        self._set(parasitic=self.parameters.parasitic_hz_at_reference)

    def _set(self, **uniforms: object) -> None:
        """Set uniforms in the passes that have them: a compiler removes the uniforms that its shader does not use."""
        for step in self._passes:
            for name in uniforms.keys() & set(step):
                step[name] = uniforms[name]

    def _reserve(self, events: int) -> None:
        self._capacity = min(events, self._largest_capacity)
        self._events = self._gl.buffer(reserve=self._capacity * _EVENT_BYTES)

    def _clear_counters(self) -> None:
        self.lost_in_pixel = self.quiet_nan = self.undersampled = self.candidates = 0

    def reset(self, light: _Float32s, t_ns: int, rate: _Float32s | None = None) -> None:
        """Start at `t_ns` with the filter at rest on `light`, and counters at zero; `light` and `rate` as in `step`."""
        flat = self._checked(light).reshape(-1)
        dark, at_reference, least, most = light_constants(self.parameters)
        self._t_ns, self._epoch_ns = int(t_ns), (int(t_ns) >> _EPOCH_BITS) << _EPOCH_BITS
        self._slopes_known = rate is not None
        readable = np.isfinite(flat)
        current = np.where(readable, np.maximum(flat, 0), 0) + dark
        state = np.zeros(flat.size, PIXEL)
        state["u"] = np.where(readable, np.log(current), NOT_KNOWN)
        state["v"] = np.log(current)
        state["rate"] = np.clip(at_reference * current, least, most)
        state["slope"] = NOT_KNOWN
        if rate is not None:
            slope = self._checked(rate).reshape(-1)
            known = np.where(np.isfinite(slope), slope, 0) * (flat > 0) / (current * state["rate"])
            state["slope"] = np.where(np.isfinite(slope), known, NOT_KNOWN)
        since_epoch = (self._t_ns - self._epoch_ns) * 1e-9
        state["reference"] = state["v"] + self._drawn.leak * since_epoch - self._drawn.on * self._drawn.phase
        state["w"] = state["v"]
        parasitic = self.parameters.parasitic_hz_at_reference * self._drawn.on
        state["leaked"] = -parasitic * np.where(readable, current, 0) * since_epoch
        state["refractory_left"] = ~readable
        with self._gl:
            self._states[0].write(state)
        self._clear_counters()

    @property
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""
        return self._t_ns

    @property
    def undersampled_share(self) -> float:
        """Undersampled pixel-steps over those that had to be solved."""
        return self.undersampled / max(self.candidates, 1)

    def faults(self) -> None:
        """Return None: defects and a changing leak are not supported here."""

    def step(
        self, light: _Float32s, t_ns: int, rate: _Float32s | None = None, at: PixelLight | None = None
    ) -> Crossings:
        """Move from the last time to `t_ns`; light between the frames is interpolated as in `PixelArray.step`.

        Parameters
        ----------
        light : (height, width) float32
            Relative to the reference level; values below 0 count as 0.
        t_ns : int
            Stream time of that frame. If it equals the last time, the step is empty.
        rate : (height, width) float32, optional
            Time derivative of the light at `t_ns`, per second; not finite where unknown.
        at : PixelLight, optional
            Not used: undersampled steps are not refined here.

        Raises
        ------
        ValueError
            Time goes back or too far ahead, or a frame does not have the sensor's size.
        """
        frames = [self._checked(light)] if rate is None else [self._checked(light), self._checked(rate)]
        with self._gl:
            for texture, frame in zip((self._light, self._rate), frames, strict=False):
                texture.write(frame)
        return self.step_drawn(self._light, t_ns, None if rate is None else self._rate)

    def step_drawn(self, light: moderngl.Texture, t_ns: int, rate: moderngl.Texture | None = None) -> Crossings:
        """Move as `step` does, with frames in the context's memory: R32F textures, the first row first.

        Do not call it inside `with context`, which does not nest.
        """
        t_ns, h_ns = int(t_ns), int(t_ns) - self._t_ns
        if h_ns < 0:
            raise ValueError(f"t_ns = {t_ns}: before the last step's {self._t_ns}; time does not go back")
        if h_ns > _LONGEST_NS:
            raise ValueError(
                f"a step of {h_ns * 1e-9:g} s: on the graphics card it is at most {_LONGEST_NS * 1e-9:g} s"
            )
        for texture in (light, rate):
            self._require_usable(texture)
        if h_ns == 0:
            return _in_order(_NOTHING, t_ns, 1, 0)
        with self._gl:
            self._set_step(h_ns, with_rate=rate is not None)
            light.use(0)
            (light if rate is None else rate).use(1)
            counts = self._dispatch()
            found = self._listed(min(counts["raised"], self._capacity))
        self._states.reverse()
        lost = counts["too_many"] + max(counts["raised"] - self._capacity, 0)
        self._count(counts, lost)
        t0_ns, self._t_ns = self._t_ns, t_ns
        return _in_order(found, t0_ns, h_ns, lost)

    def _set_step(self, h_ns: int, *, with_rate: bool) -> None:
        epoch_ns = (self._t_ns >> _EPOCH_BITS) << _EPOCH_BITS
        since_ns = self._t_ns - epoch_ns
        self._set(
            h=h_ns * 1e-9,
            h_ns=h_ns,
            since_epoch_0=since_ns * 1e-9,
            since_epoch_1=(since_ns + h_ns) * 1e-9,
            epoch_moved=(epoch_ns - self._epoch_ns) * 1e-9,
            second=2 * math.pi * self.parameters.source_follower_hz * h_ns * 1e-9,
            refractory=self._refractory_ns / h_ns,
            chord=not with_rate,
            slopes_known=self._slopes_known,
        )
        self._epoch_ns, self._slopes_known = epoch_ns, with_rate

    def _dispatch(self) -> dict[str, int]:
        """Compute the step, again with a longer list if its events did not fit; return the counts."""
        before, after = self._states
        groups = [-(-side // of) for side, of in zip(self._size, GROUP, strict=True)]
        while True:
            self._counts.write(_NO_COUNTS)
            self._set(capacity=self._capacity)
            buffers = before, after, self._thresholds, self._events, self._counts, self._candidates
            for binding, buffer in enumerate(buffers):
                buffer.bind_to_storage_buffer(binding)
            self._passes[0].run(*groups)
            self._gl.memory_barrier()
            self._passes[1].run_indirect(self._counts)
            self._gl.memory_barrier()
            values = np.frombuffer(self._counts.read(), COUNTS)[0]
            counts = {name: int(values[name]) for name in COUNTS.names or ()}
            if counts["raised"] <= self._capacity or self._capacity == self._largest_capacity:
                return counts
            self._events.release()
            self._reserve(2 * counts["raised"])

    def _listed(self, events: int) -> npt.NDArray[np.uint32]:
        """Return the first events of the list, (events, 2)."""
        if not events:
            return _NOTHING
        return np.frombuffer(self._events.read(events * _EVENT_BYTES), np.uint32).reshape(-1, 2)

    def _count(self, counts: dict[str, int], lost: int) -> None:
        self.lost_in_pixel += lost
        self.quiet_nan += counts["unreadable"]
        self.undersampled += counts["undersampled"]
        self.candidates += counts["candidates"]

    def _checked(self, frame: _Float32s) -> _Float32s:
        size = self._size[::-1]
        if frame.shape != size or frame.dtype != np.float32:
            raise ValueError(f"light or rate is {frame.shape} {frame.dtype}: must be {size} float32")
        return np.ascontiguousarray(frame)

    def _require_usable(self, texture: moderngl.Texture | None) -> None:
        if texture is None:
            return
        if texture.ctx is not self._gl:
            raise ValueError("a texture of another context: make the array with the context that draws")
        if (texture.size, texture.components, texture.dtype) != (self._size, 1, "f4"):
            raise ValueError(
                f"a texture of {texture.size}, {texture.components} x {texture.dtype}: must be {self._size}, 1 x f4"
            )


def _in_order(found: npt.NDArray[np.uint32], t0_ns: int, h_ns: int, lost: int) -> Crossings:
    """Sort events (n, 2) of [pixel << 1 | on, bits of the time as a share of the step] by (time, pixel)."""
    share = np.ascontiguousarray(found[:, 1]).view(np.float32)
    dt_ns = np.minimum((share.astype(np.float64) * h_ns).astype(np.int64), h_ns)
    order = np.lexsort((found[:, 0], dt_ns))
    who = found[order, 0]
    return Crossings(t0_ns + dt_ns[order], who >> np.uint32(1), (who & np.uint32(1)).astype(np.bool_), lost)


def _require_supported(p: SensorParameters) -> None:
    if p.refractory_us * 1000 > _LONGEST_NS:
        raise ValueError(
            f"refractory_us = {p.refractory_us:g}: at most {_LONGEST_NS // 1000} with the graphics card's pixels"
        )


def _require_memory(gl: moderngl.Context, size: tuple[int, int]) -> None:
    most_side, most_bytes = int(gl.info["GL_MAX_TEXTURE_SIZE"]), int(gl.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
    if max(size) > most_side or size[0] * size[1] * PIXEL.itemsize > most_bytes:
        raise MachineLacks(
            f"{size[0]} x {size[1]} pixels: {renderer_name(gl)} takes at most {most_side} a side and "
            f"{most_bytes // PIXEL.itemsize} in all"
        )
