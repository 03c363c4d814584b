"""Refinement of undersampled steps: they are solved in two halves, with the pixel's light between two frames.

    t0 ---------------- t1     a pixel is undersampled between two frames: its state is copied to a subset,
    t0 ------ m ------- t1     its light at m is computed, and the same kernels solve both halves;
         ... m' ...            a half that is still undersampled is divided again, up to three times; light that is
                               moved between drawings is worth two

All pixels of a subset form an array of their own. The arithmetic of a pixel is that of the whole array, and does not
depend on which other pixels are refined. A refinement costs the scene the light of one pixel, and no further frame:
that is what makes it fast, as few pixels are undersampled at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor.numerics.compiled import cached_entry
from emulator.sensor.pixels.candidate_table import Table
from emulator.sensor.pixels.crossings import Keys
from emulator.sensor.pixels.curve import MOVED_UNSEEN_SHARE, REFINED_UNSEEN_SHARE
from emulator.sensor.pixels.idle import Touched, new_idle, wake
from emulator.sensor.pixels.method import STOP
from emulator.sensor.pixels.state import BLOCK, FIELDS, MEMORY, Field, FlatLight, Memory, Pixels, StepConstants, slot
from emulator.sensor.pixels.step import SHORTEST_NS, Buffers, Share, Subset, Tally, advance, new_scratch, new_subset

LEVELS = 3
"""Most refinements of a step."""

_LEVELS_OF_MOVED = 2

_Int64s = npt.NDArray[np.int64]

_ONE = np.uint64(1)
_EVERYWHERE = Touched(0, 1, 0, 1, 1 << 40, np.empty(0, np.uint8))
_ROWS = tuple(
    int(f) * BLOCK
    for f in (
        Field.FILTERED, Field.REFERENCE, Field.SECOND, Field.LEAKED,
        Field.ON_LIMIT, Field.OFF_LIMIT, Field.SPEED_LIMIT, Field.UNTIL, Field.HIGH_PASSED,
    )
)  # fmt: skip


@cached_entry
def _scatter(subset: Pixels, above: Pixels, listed: _Int64s) -> None:
    """Write the state of the subset, at the step's end, back to its pixels of `above`, where light is up to date."""
    for k in range(listed.size):
        at, to = slot(k), slot(listed[k])
        for row in _ROWS:
            above.fields[to + row] = subset.fields[at + row]
        above.refractory_until_ns[listed[k]] = subset.refractory_until_ns[k]
    if subset.refractory_until_ns.size > subset.fields.size // FIELDS:  # positions in the streams of reset noise follow
        begin, to = subset.refractory_until_ns.size // 2, above.refractory_until_ns.size // 2
        for k in range(listed.size):
            above.refractory_until_ns[to + listed[k]] = subset.refractory_until_ns[begin + k]
    if above.memory.size:
        for k in range(listed.size):
            for row in range(MEMORY):
                above.memory[listed[k] * MEMORY + row] = subset.memory[k * MEMORY + row]


@cached_entry
def _renumbered(keys: Keys, origin: _Int64s, later_ns: int, pixel_bits: int, flag_bits: int) -> Keys:
    """Return packed events with the pixel numbers `origin`, and times counted from `later_ns` earlier.

    Behind a pixel's number are `flag_bits` more, which stay.
    """
    out = np.empty(keys.size, np.uint64)
    shift = np.uint64(pixel_bits + 1)
    mask = np.uint64((1 << pixel_bits) - 1)
    for k in range(keys.size):
        number = (keys[k] >> _ONE) & mask
        flags = number & np.uint64((1 << flag_bits) - 1)
        pixel = (np.uint64(origin[number >> np.uint64(flag_bits)]) << np.uint64(flag_bits)) | flags
        dt = (keys[k] >> shift) + np.uint64(later_ns)
        out[k] = (dt << shift) | (pixel << _ONE) | (keys[k] & _ONE)
    return out


class _Interval(NamedTuple):
    """A step or a half of one: its ends, ns, light and rate at its end, and its pixels' numbers in the whole array."""

    t0_ns: int
    t1_ns: int
    end: FlatLight
    origin: _Int64s


class Refinement:
    """Moves an array over steps, and refines the steps of undersampled pixels.

    Parameters
    ----------
    blocks : blocks of the array.
    resting : state of a pixel to which nothing happens while it sees no light, (FIELDS,) float32.
    table : buffer for the candidates of one thread.
    constants : makes the constants of a step from its ends, ns.
    """

    def __init__(
        self,
        blocks: int,
        resting: npt.NDArray[np.float32],
        table: Table,
        constants: Callable[[int, int], StepConstants],
    ) -> None:
        self._subsets = [*(new_subset(blocks) for _ in range(LEVELS)), new_subset(0)]
        self._resting = resting[:, None]
        self._buffers = [Buffers(table, subset, new_scratch()) for subset in self._subsets]
        self._share = Share(0, 1, new_idle(blocks), _EVERYWHERE, STOP)
        self._constants = constants
        self._keys = np.empty(4096, np.uint64)
        self._lists: list[Keys] = []
        self._tallies: list[Tally] = []

    def step(
        self, frame: FlatLight, pixels: Pixels, share: Share, keys: Keys, c: StepConstants, light_frame: LightFrame
    ) -> tuple[Keys, int, Tally]:
        """Move a share of the array as `advance` does, and refine with the light of single pixels of `light_frame`."""
        assert light_frame.at is not None
        self._at = light_frame.at
        self._levels, self._unseen_share = LEVELS, REFINED_UNSEEN_SHARE
        if light_frame.at_is_moved:
            self._levels, self._unseen_share = _LEVELS_OF_MOVED, MOVED_UNSEEN_SHARE
        c = c._replace(refine=True, unseen_share=self._unseen_share)
        keys, n_keys, counts = advance(frame, pixels, self._buffers[0], keys, share, c)
        self._lists, self._tallies = [keys[:n_keys]], [Tally(*counts)]
        if not (refined := self._tallies[0].refined):
            return keys, n_keys, self._tallies[0]
        self._step = c
        interval = _Interval(c.t0_ns, c.t0_ns + c.h_ns, frame, np.arange(frame.light.size))
        self._refine(pixels, refined, interval, 0)
        together = np.concatenate(self._lists)
        return together, together.size, Tally(*(sum(column) for column in zip(*self._tallies, strict=True)))

    def _refine(self, above: Pixels, n: int, interval: _Interval, level: int) -> None:
        """Solve in halves the n pixels that the array `above` has collected in an interval, and scatter them back."""
        subset, middle_ns = self._subsets[level], (interval.t0_ns + interval.t1_ns) // 2
        listed = subset.pixels[:n]
        origin, pixels = interval.origin[listed], self._array(subset, above, n)
        middle = FlatLight(*self._at(middle_ns, origin))
        end = FlatLight(interval.end.light[listed], interval.end.rate[listed])
        self._advance(pixels, _Interval(interval.t0_ns, middle_ns, middle, origin), level)
        self._advance(pixels, _Interval(middle_ns, interval.t1_ns, end, origin), level)
        _scatter(pixels, above, listed)

    def _advance(self, pixels: Pixels, half: _Interval, level: int) -> None:
        """Move an array over a half; pixels that are still undersampled are refined again."""
        again = level + 1 < self._levels and half.t1_ns - half.t0_ns >= SHORTEST_NS
        c = self._constants(half.t0_ns, half.t1_ns)._replace(refine=again, unseen_share=self._unseen_share)
        wake(self._share.idle)  # these are other pixels each time
        buffers = self._buffers[level + 1]
        self._keys, n_keys, counts = advance(half.end, pixels, buffers, self._keys, self._share, c)
        later_ns = half.t0_ns - self._step.t0_ns
        flag_bits = int(self._step.noisy or self._step.offsets)
        self._lists.append(_renumbered(self._keys[:n_keys], half.origin, later_ns, self._step.pixel_bits, flag_bits))
        self._tallies.append(Tally(*counts))
        if refined := self._tallies[-1].refined:
            self._refine(pixels, refined, half, level + 1)

    def _array(self, subset: Subset, above: Pixels, n: int) -> Pixels:
        """Return the n pixels of a subset as an array; the other pixels of its last block are at rest."""
        blocks = -(-n // BLOCK)
        fields = subset.fields[: blocks * FIELDS * BLOCK]
        if n % BLOCK:
            fields.reshape(-1, FIELDS, BLOCK)[-1, :, n % BLOCK :] = self._resting
        parts = above.refractory_until_ns.size // (above.fields.size // FIELDS)  # 2 with positions of reset noise
        refractory_until_ns = np.zeros((parts, blocks * BLOCK), np.int64)
        refractory_until_ns[:, :n] = above.refractory_until_ns.reshape(parts, -1)[:, subset.pixels[:n]]
        memory = np.empty(0, np.float32)
        if above.memory.size:
            memory = np.zeros((blocks * BLOCK, MEMORY), np.float32)
            memory[:, Memory.LEFT] = np.inf  # those beyond the n never fire
            memory[:n] = above.memory.reshape(-1, MEMORY)[subset.pixels[:n]]
        return Pixels(fields, refractory_until_ns.reshape(-1), memory.reshape(-1), above.tables)
