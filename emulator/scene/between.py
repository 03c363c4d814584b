"""Light between two drawings of a scene: both are moved along the flow of its surfaces, and weighted by time.

An exact drawing of bodies or terrain costs ten to twenty times as much as this. Drawings lie on multiples of a period P
of stream time, so the light of any instant can be computed alone, from the drawings around it:

    before, at t0 = k P                after, at t1 = t0 + P               u = (t - t0) / P
    light   L = (1 - u) L0(x - V0 (t - t0)) + u L1(x - V1 (t - t1))        V: flow, px/s
    rate    (L1 - L0) / P - (1 - u) V0 . grad L0 - u V1 . grad L1          each at its place above

Places x - V dt follow the flow upstream, by two steps of a fixed point iteration. L0 and L1 there are cubic B-splines
through the pixels. At the edges of the frame a place may lie outside one of the drawings: then the other one counts.

Flow is that of surfaces. An outline moves with the body in front, so the sky around a body has the flow of its nearest
pixel. Shadows that move over the ground are blended; their own velocities at their edges gained nothing.

Where the image moves by less than two pixels a period, the exact rates of both drawings are better than blending. What
the rates of the law above lack, e0 at t0 and e1 at t1, is added as the cubic without values at both ends,

    P (e0 u (1 - u)^2 - e1 u^2 (1 - u))

so that light is, without any motion, the cubic through values and rates of both drawings.

Drawings are made ahead by a thread of their own, while the sensor computes. Results do not depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock
from typing import Any, NamedTuple, TypeVar

import numpy as np

from emulator.geometry.camera import Rays, SceneGeometry, ScenePoses, Seen
from emulator.light import NOTHING, LastArrays, Light, OtherLight, PixelLight, Region, Scene, SceneError
from emulator.scene.moved_light import (
    BLOCK,
    MARGIN,
    MOVED_ABOVE_PX,
    ROOM,
    Drawing,
    Pair,
    carry_into_sky,
    lit_blocks,
    speeds,
    spline,
    write_lacking,
    write_pixels,
    write_rows,
)
from emulator.threads import ThreadPool, available_threads
from emulator.trajectory.pose import TrajectoryError
from firmware_protocol.events import Bytes, Float32s, Int64s

_T = TypeVar("_T")

OFTEN, SELDOM = 2, 4
"""Steps from one drawing to the next one, where the image moves by up to FAST_PX a step, and where by more."""
FAST_PX = 1.0
WINDOW = 64
"""Steps after which the motion decides anew: a multiple of OFTEN and SELDOM."""

_MOST_DRAWINGS, _LAST_WINDOWS = 4, 8
_BAND = 16  # rows that a thread takes at a time


class _WhereDrawn(SceneGeometry):
    """A geometry whose looks are taken by the thread that draws."""

    def __init__(self, geometry: SceneGeometry, submit: Callable[..., Future[Any]]) -> None:
        self.names, self.gives = geometry.names, geometry.gives
        self._geometry, self._submit = geometry, submit

    def look(self, t_ns: int, out: Seen) -> None:
        self._submit(self._geometry.look, t_ns, out).result()

    def places(self, t_ns: int) -> ScenePoses | None:
        return self._geometry.places(t_ns)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A drawing; the blocks with its light; the mean and the greatest speed of its lit pixels, px/s."""

    drawing: Drawing
    blocks: Bytes
    mean_px_s: float
    greatest_px_s: float


class _Slot(NamedTuple):
    """Stream times of two drawings, one after the other."""

    begin_ns: int
    end_ns: int

    def share(self, t_ns: int) -> float:
        """Return the share of the slot before an instant."""
        return (t_ns - self.begin_ns) / (self.end_ns - self.begin_ns)


class LightBetween(OtherLight):
    """Light of `scene`, drawn now and then, and in between moved along the flow of its surfaces.

    The poses of the scene must be known in advance. The light at an instant does not depend on what was drawn before.

    Parameters
    ----------
    step_ns : usual time between two light frames.
    period_ns : time between two drawings. 0: every OFTEN or every SELDOM steps, by the motion in the drawing that
        begins each part of the stream, of WINDOW steps.
    threads : compute the light in between, 0: those available. Another thread makes drawings ahead, except by GL.
    """

    refines = True

    def __init__(self, scene: Scene, step_ns: int, period_ns: int = 0, threads: int = 0) -> None:
        super().__init__(scene)
        self.has_rate = True
        self._step_ns, self._period_ns = step_ns, period_ns
        self._geometry: SceneGeometry | None = None
        self._whole = Region(0, scene.size[1], 0, scene.size[0])
        threads = threads or available_threads()
        self._room = np.zeros((threads, ROOM), np.float32)
        self._lock = Lock()
        self._pool, self._drawer = ThreadPool(threads), ThreadPoolExecutor(1)
        shape = scene.size[::-1]
        self._depth, self._labels = np.zeros(shape, np.float32), np.zeros(shape, np.uint16)
        self._aways, self._spare = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32)
        self._drawn: dict[int, Future[_Drawn]] = {}  # by stream time
        self._pairs: dict[_Slot, Pair] = {}  # the last two
        self._window_ns = period_ns or WINDOW * step_ns
        self._fast: dict[int, bool] = {}  # of the last windows, by their begin
        self._is_fast = False
        self._arrays, self._region = LastArrays(), NOTHING

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns`."""
        self.light_and_rate(t_ns, out, self._spare)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write light and rate at `t_ns`: exact at a drawing, else moved."""
        slot = self._slot(t_ns)
        self._is_fast = self._moves_fast(slot.begin_ns - slot.begin_ns % self._window_ns)
        if slot.begin_ns == t_ns and self.scene.has_rate:
            exact = self._at(t_ns)
            self._request(slot.end_ns, t_ns)
            window = self._window(exact.blocks, light, rate)
            part = slice(*window.bounds[:2]), slice(*window.bounds[2:])
            light[part], rate[part] = exact.drawing.light[part], exact.drawing.rate[part]
            return
        if (pair := self._between(slot)) is None:
            self._submit(self._draw_frame, t_ns, light, rate).result()
            self.changed, self._region = None, self._whole
            return
        first_row, last_row, first, last = self._window(pair.blocks, light, rate).bounds

        def write(band: int, thread: int) -> None:
            rows = first_row + band * _BAND, min(first_row + (band + 1) * _BAND, last_row)
            write_rows(pair, slot.share(t_ns), (*rows, first, last), self._room[thread], light, rate)

        self._pool.each(write, -(-(last_row - first_row) // _BAND))

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the scene."""
        return self._submit(lambda: self.scene.notes).result()

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return the geometry of the scene, for any thread."""
        geometry = self.scene.geometry(rays)
        return None if geometry is None else _WhereDrawn(geometry, self._submit)

    @property
    def pixel_light(self) -> PixelLight | None:
        """Light of single pixels, as moved, while the image moves fast; else a step needs none."""
        return self.pixels if self._is_fast else None

    def wait(self) -> None:
        """Wait until all drawings are made that were begun; to measure."""
        self._submit(lambda: None).result()

    def close(self) -> None:
        """End the threads and close the scene; a second call does nothing."""
        self._drawer.shutdown(cancel_futures=True)
        self._pool.close()
        super().close()

    def pixels(self, t_ns: int, pixels: Int64s) -> tuple[Float32s, Float32s]:
        """Return light and rate of the pixels row * width + column at `t_ns`, (n,) each; for several threads."""
        with self._lock:
            slot = self._slot(t_ns)
            pair = self._between(slot)
        light, rate = np.zeros((2, len(pixels)), np.float32)
        if pair is not None:
            write_pixels(pair, slot.share(t_ns), pixels, np.zeros(ROOM, np.float32), light, rate)
            return light, rate
        frame = np.zeros((2, *self.size[::-1]), np.float32)
        self._submit(self._draw_frame, t_ns, frame[0], frame[1]).result()
        return frame[0].reshape(-1)[pixels], frame[1].reshape(-1)[pixels]

    def _window(self, blocks: Bytes, light: Light, rate: Light) -> Region:
        """Return the part of two arrays to write: light, and that of the last call if it wrote into the same arrays."""
        region, is_same = _bounds(blocks, self.size), self._arrays.are(light, rate)
        self.changed = region.union(self._region) if is_same else None
        self._region = region
        return self._whole if self.changed is None else self.changed

    def _slot(self, t_ns: int) -> _Slot:
        """Return the times of the drawings around an instant: the last one up to it, and the next one."""
        window_ns = t_ns - t_ns % self._window_ns
        period_ns = self._period_ns or (SELDOM if self._moves_fast(window_ns) else OFTEN) * self._step_ns
        begin_ns = t_ns - (t_ns - window_ns) % period_ns
        return _Slot(begin_ns, begin_ns + period_ns)

    def _moves_fast(self, window_ns: int) -> bool:
        """Return whether the image moves by more than FAST_PX a step in the drawing that begins a window."""
        if window_ns not in self._fast:
            moved_px = self._at(window_ns).mean_px_s * self._step_ns * 1e-9
            self._fast = {**dict([*self._fast.items()][-_LAST_WINDOWS:]), window_ns: moved_px > FAST_PX}
        return self._fast[window_ns]

    def _between(self, slot: _Slot) -> Pair | None:
        """Return the drawings of a slot, the one after them on its way; None where the later one cannot be drawn."""
        if slot not in self._pairs:
            while len(self._pairs) > 1:
                del self._pairs[next(iter(self._pairs))]
            before = self._at(slot.begin_ns)
            try:
                after = self._at(slot.end_ns, slot.begin_ns)
            except (SceneError, TrajectoryError):  # the stream may end before: each of its frames is drawn
                return None
            self._pairs[slot] = self._pair_of(before, after, (slot.end_ns - slot.begin_ns) * 1e-9)
            self._request(self._slot(slot.end_ns).end_ns)
        return self._pairs[slot]

    def _pair_of(self, before: _Drawn, after: _Drawn, period_s: float) -> Pair:
        moved_px = period_s * max(before.greatest_px_s, after.greatest_px_s)
        blocks = _grown(np.maximum(before.blocks, after.blocks), math.ceil((moved_px + 2 * MARGIN) / BLOCK))
        pair = Pair(before.drawing, after.drawing, np.zeros(0, np.float32), blocks, period_s)
        if not self.scene.has_rate or min(before.mean_px_s, after.mean_px_s) * period_s > 2 * MOVED_ABOVE_PX:
            return pair
        lacking = np.zeros(2 * before.drawing.light.size, np.float32)

        def write(band: int, thread: int) -> None:
            rows = band * _BAND, min((band + 1) * _BAND, self.size[1])
            write_lacking(pair, rows, self._room[thread], lacking)

        self._pool.each(write, -(-self.size[1] // _BAND))
        return pair._replace(lacking=lacking)

    def _at(self, t_ns: int, in_use_ns: int = -1) -> _Drawn:
        """Return the drawing at a time; that at `in_use_ns` stays."""
        self._request(t_ns, in_use_ns)
        return self._drawn[t_ns].result()

    def _request(self, t_ns: int, in_use_ns: int = -1) -> None:
        """Begin the drawing at a time, in the room of one that is not needed any more; that at `in_use_ns` stays."""
        if t_ns in self._drawn:
            return
        room = None
        if len(self._drawn) >= _MOST_DRAWINGS:
            pinned = {in_use_ns, *(t for slot in self._pairs for t in slot)}
            free = [t for t in self._drawn if t not in pinned]
            old = self._drawn.pop(max(free, key=lambda t: abs(t - t_ns))) if free else None
            if old is not None and old.done() and old.exception() is None:
                room = old.result().drawing
        self._drawn[t_ns] = self._submit(self._draw, t_ns, room or Drawing.of(*self.size))

    def _submit(self, work: Callable[..., _T], *arguments: Any) -> Future[_T]:
        """Let the thread that draws do work with the scene; of GL that is the caller's."""
        if self.painter == "cpu":
            return self._drawer.submit(work, *arguments)
        done: Future[_T] = Future()
        done.set_result(work(*arguments))
        return done

    def _draw_frame(self, t_ns: int, light: Light, rate: Light) -> None:
        if self.scene.has_rate:
            self.scene.light_and_rate(t_ns, light, rate)
        else:
            self.scene.light(t_ns, light)
            rate.fill(np.nan)

    def _draw(self, t_ns: int, room: Drawing) -> _Drawn:
        self._draw_frame(t_ns, room.light, room.rate)
        height, width = self._labels.shape
        flow = room.flow.reshape(height, width, 2)
        seen = Seen(self._depth, flow, self._labels)
        if not self.scene.flow(seen):
            self._geometry = self._geometry or self.scene.geometry()
            if self._geometry is None:
                raise SceneError("the scene gives no flow: draw each light frame, with run.drawing_us = 1")
            self._geometry.look(t_ns, seen)
        mean_px_s, greatest_px_s = speeds(flow, room.light)
        reach_px = greatest_px_s * (self._period_ns or SELDOM * self._step_ns) * 1e-9 + 2 * MARGIN
        carry_into_sky(self._labels, flow, self._aways, reach_px)
        spline(room.light, room.coefficients.reshape(height + 2 * MARGIN, width + 2 * MARGIN))
        blocks = np.zeros([-(-n // BLOCK) for n in room.light.shape], np.uint8)
        lit_blocks(room.light, blocks)
        return _Drawn(room, blocks, mean_px_s, greatest_px_s)


def _grown(blocks: Bytes, by: int) -> Bytes:
    """Return blocks with `by` more around each."""
    if by > max(blocks.shape):
        return np.full_like(blocks, blocks.max())
    for axis in range(2):
        wide = np.pad(blocks, [(by, by) if k == axis else (0, 0) for k in range(2)])
        blocks = np.lib.stride_tricks.sliding_window_view(wide, 2 * by + 1, axis).max(axis=-1)
    return blocks


def _bounds(blocks: Bytes, size: tuple[int, int]) -> Region:
    """Return the part of the frame with all blocks that are 1."""
    rows, columns = np.flatnonzero(blocks.any(axis=1)) * BLOCK, np.flatnonzero(blocks.any(axis=0)) * BLOCK
    if not len(rows):
        return NOTHING
    last_row, last = min(int(rows[-1]) + BLOCK, size[1]), min(int(columns[-1]) + BLOCK, size[0])
    return Region(int(rows[0]), last_row, int(columns[0]), last)
