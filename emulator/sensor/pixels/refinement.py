"""Suspects solved in halves, where their light can be had between two pictures without drawing a third.

    t0 ---------------- t1     a pixel is suspect in the step between two pictures: its state is set aside,
    t0 ------ m ------- t1     its light at m is asked for, and both halves are solved by the same kernels;
         ... m' ...            where a half is suspect still, that half alone is halved again, up to three times

All that were set aside make up an array of their own, so that a pixel's arithmetic is the one of the whole array and
does not depend on who else is halved. It costs the scene one light a pixel and halving; pictures cost nothing more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.light import PixelLight
from emulator.sensor.pixels.candidates import Table
from emulator.sensor.pixels.interpolation import HALVED
from emulator.sensor.pixels.quiet_pass import Tally, advance
from emulator.sensor.pixels.state import BLOCK, FIELDS, Pixels, StepConstants
from emulator.sensor.pixels.subset import Aside, new_aside, placed, put_back

__all__ = ["LEVELS", "SHORTEST_NS", "Halving"]

LEVELS = 3
"""How often a step may be halved."""

SHORTEST_NS = 2_000
"""No shorter step is halved: a microsecond is what a camera tells."""

_Keys = npt.NDArray[np.uint64]
_Indices = npt.NDArray[np.int64]
_Picture = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]


class _Stretch(NamedTuple):
    """A step or a half: its ends, ns, light and rate at the last of them, and the array's pixels in the whole one."""

    t0_ns: int
    t1_ns: int
    end: _Picture
    origin: _Indices


class Halving:
    """Moves an array, suspects in halves.

    Parameters
    ----------
    blocks : of the array.
    resting : (FIELDS,) float32, a pixel that nothing happens to when it sees no light.
    table : room for the candidates.
    constants : makes those of a step from its ends, ns.
    """

    def __init__(
        self,
        blocks: int,
        resting: npt.NDArray[np.float32],
        table: Table,
        constants: Callable[[int, int], StepConstants],
    ) -> None:
        self._rooms = [*(new_aside(blocks) for _ in range(LEVELS)), new_aside(0)]
        self._resting = resting[:, None]
        self._table = table
        self._constants = constants
        self._keys = np.empty(4096, np.uint64)
        self._found: list[_Keys] = []
        self._tallies: list[Tally] = []

    def step(
        self, picture: _Picture, pixels: Pixels, keys: _Keys, c: StepConstants, at: PixelLight
    ) -> tuple[_Keys, int, Tally]:
        """Do as `advance`, suspects in halves; `at` tells their light in between."""
        c = c._replace(halve=True, trust=HALVED)
        keys, found, tally = advance(picture, pixels, self._table, self._rooms[0], keys, c)
        if not tally.aside:
            return keys, found, tally
        self._found, self._tallies = [keys[:found]], [tally]
        self._whole, self._at = c, at
        self._halve(pixels, tally.aside, _Stretch(c.t0_ns, c.t0_ns + c.h_ns, picture, np.arange(picture[0].size)), 0)
        together = np.concatenate(self._found)
        return together, together.size, Tally(*(sum(column) for column in zip(*self._tallies, strict=True)))

    def _halve(self, above: Pixels, n: int, whole: _Stretch, level: int) -> None:
        """Solve in halves what the array `above` has set aside in its stretch, n pixels, and put them back."""
        room, middle_ns = self._rooms[level], (whole.t0_ns + whole.t1_ns) // 2
        listed = room.pixels[:n]
        origin, here = whole.origin[listed], self._array(room, above, n)
        last = whole.end[0][listed], whole.end[1][listed]
        self._go(here, _Stretch(whole.t0_ns, middle_ns, self._at(middle_ns, origin), origin), level)
        self._go(here, _Stretch(middle_ns, whole.t1_ns, last, origin), level)
        put_back(here, above, listed)

    def _go(self, here: Pixels, half: _Stretch, level: int) -> None:
        """Move an array over a half; what is still suspect is halved again."""
        again = level + 1 < LEVELS and half.t1_ns - half.t0_ns >= SHORTEST_NS
        c = self._constants(half.t0_ns, half.t1_ns)._replace(halve=again, trust=HALVED)
        self._keys, found, tally = advance(half.end, here, self._table, self._rooms[level + 1], self._keys, c)
        whole = self._whole
        self._found.append(placed(self._keys[:found], half.origin, half.t0_ns - whole.t0_ns, whole.pixel_bits))
        self._tallies.append(tally)
        if tally.aside:
            self._halve(here, tally.aside, half, level + 1)

    def _array(self, room: Aside, above: Pixels, n: int) -> Pixels:
        """Return the n pixels of a room as an array; its last block's other pixels rest."""
        blocks = -(-n // BLOCK)
        fields = room.fields[: blocks * FIELDS * BLOCK]
        if n % BLOCK:
            fields.reshape(-1, FIELDS, BLOCK)[-1, :, n % BLOCK :] = self._resting
        blind_until_ns = np.zeros(blocks * BLOCK, np.int64)
        blind_until_ns[:n] = above.blind_until_ns[room.pixels[:n]]
        return Pixels(fields, blind_until_ns)
