"""A step of all pixels, in threads that each move a share of them: block by block, then the candidates in batches.

    Workers.step -> advance, one in each thread
        _fill               blocks, until the table of candidates is full
            _is_skipped     an idle block costs a comparison of its light, or none outside the changed region (`idle`)
            _move_block     a block with many active parts, in place
            _move_pack      the active parts of blocks with few, together as one block
        solve               all crossings of the candidates (`candidates`)
        solve_noisy         the same with noise (`noisy`)

The arithmetic of a pixel does not depend on the blocks that are moved with it, their order and their thread, so the
events are the same to the last bit. The number of threads follows from the work of the last step: counts, no clock.

Fast because pixels that cannot fire cost one pass of vector code (`quiet_pass`), those in still light nothing, and
because the table of candidates is large enough for long loops and small enough for the caches.

Undersampled pixels of a step are copied, unsolved, to a `Subset`, where `refinement` can solve them with more light.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import NONE, cached_entry, cached_kernel, kernel
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.pixels import idle as rest
from emulator.sensor.pixels import state
from emulator.sensor.pixels.candidate_table import (
    BATCH,
    MOST_WAITING,
    NOISY_BATCH,
    Table,
    entry_at,
    gather,
    gather_rare,
    new_table,
    select,
)
from emulator.sensor.pixels.candidates import solve
from emulator.sensor.pixels.crossings import Keys
from emulator.sensor.pixels.curve import completed, is_undersampled
from emulator.sensor.pixels.idle import Idle, Touched
from emulator.sensor.pixels.method import STOP
from emulator.sensor.pixels.noisy import solve_noisy
from emulator.sensor.pixels.quiet_pass import list_flags, move_quietly, replace_light_of_block
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, PART, Field, FlatLight, Pixels, StepConstants
from emulator.threads import ThreadPool, available_threads

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P, *_CERTIFICATE, _Y = (int(f) * BLOCK for f in Field)
_ON_LIMIT, _OFF_LIMIT, _SIGN, _UNTIL = _CERTIFICATE
_U0, _V0, _L0, _G0, _A0, _A1, _, _, _W0, _P0, _, _, _Y0 = BEFORE_ROWS
_ZERO, _PAST, _NO_FLAGS = np.float32(0), np.float32(-np.inf), np.uint64(0)

SHORTEST_NS = 2_000
"""Shortest step that is refined: a camera's timestamps are whole microseconds."""

RUN = 8 * BLOCK
"""Pixels that a thread moves before it leaves the next ones to another."""

_RUN_BLOCKS = RUN // BLOCK
_END = -1
_PACK = len(BEFORE_ROWS) * BLOCK  # the places in `before` and `indices` of what lies behind
_FIRSTS, _PACKED = BLOCK, BLOCK + state.PARTS


class Tally(NamedTuple):
    """Counts of a step beside its events: crossings in the first field, pixel-steps in the others."""

    lost: int  # crossings beyond MOST_EVENTS of a pixel
    undersampled: int  # light that changed between the frames in a way that they do not show
    candidates: int  # solved for crossings
    unreadable: int  # light not finite
    refined: int  # undersampled, and collected for refinement instead of being solved
    moved: int  # in blocks and parts that were not skipped


class _Progress(NamedTuple):
    """Progress of a share: its next block, parts in the pack, columns in the table; and the counts of `Tally` so far.

    `moved` is in parts.
    """

    block: int
    packed: int
    n: int
    candidates: int
    unreadable: int
    refined: int
    moved: int


class Scratch(NamedTuple):
    """Buffers for one block: BEFORE_ROWS, light and rate of the last block or of a pack, flags and their indices.

    They are few arrays, because each costs time in every call. `before` has the state of a pack behind those rows,
    `indices` the first pixels of the parts of a block and then those of a pack behind the indices of flagged pixels.
    """

    before: _Float32s
    light: _Float32s
    rate: _Float32s
    may_fire: _Bytes
    indices: _Int64s


class Subset(NamedTuple):
    """States of some pixels of an array, laid out as `Pixels.fields`, and the numbers of these pixels."""

    fields: _Float32s
    pixels: _Int64s


def new_subset(blocks: int) -> Subset:
    """Return a subset with room for `blocks` blocks; the system provides its memory where it is written."""
    return Subset(np.zeros(blocks * state.FIELDS * BLOCK, np.float32), np.zeros(blocks * BLOCK, np.int64))


@kernel
def _gather_undersampled(  # noqa: PLR0913, PLR0917
    flagged: _Int64s, s: _Float32s, before: _Float32s, firsts: _Int64s, subset: Subset, n: int, c: StepConstants
) -> tuple[int, int]:
    """Move the undersampled pixels of a block's candidates to the subset, behind its first n.

    `flagged`, (any,), are the candidates' indices in the block: those that remain, unreadable ones too, move to the
    front. `firsts` are the first pixels of its parts. Returns the numbers of those and of pixels in the subset.
    """
    remaining = 0
    for place in flagged:
        i = np.uint64(place)
        flagged[remaining] = place
        u0, v0 = before[entry_at(_U0, i)], before[entry_at(_V0, i)]
        d = s[entry_at(_U, i)] - u0
        unseen = c.unseen_share * min(s[entry_at(_ON, i)], s[entry_at(_OFF, i)])
        a0, a1 = completed(d, before[entry_at(_A0, i)], before[entry_at(_A1, i)])
        if not (is_undersampled(d, a0, a1, unseen) & (v0 == v0)):
            remaining += 1
            continue
        # The state before the step, because the quiet pass has moved the pixel already.
        subset.pixels[n] = rest.pixel_at(firsts, place)
        to = state.slot(n)
        n += 1
        subset.fields[to + _U] = u0
        subset.fields[to + _V] = v0
        subset.fields[to + _L] = before[entry_at(_L0, i)]
        subset.fields[to + _G] = before[entry_at(_G0, i)]
        for row in (_REF, _ON, _OFF, _LEAK, _ON_LIMIT, _OFF_LIMIT, _SIGN, _UNTIL):
            subset.fields[to + row] = s[entry_at(row, i)]
        subset.fields[to + _W] = before[entry_at(_W0, i)] if c.second > _ZERO else s[entry_at(_W, i)]
        subset.fields[to + _Y] = before[entry_at(_Y0, i)] if c.high > _ZERO else s[entry_at(_Y, i)]
        subset.fields[to + _P] = before[entry_at(_P0, i)] if c.parasitic > _ZERO else s[entry_at(_P, i)]
        if c.noisy:
            subset.fields[to + _UNTIL] = _PAST  # it has left its certificate
    return remaining, n


class Buffers(NamedTuple):
    """Buffers of one thread: a table for the candidates, a subset for the undersampled pixels, and scratch."""

    table: Table
    subset: Subset
    scratch: Scratch


def new_scratch() -> Scratch:
    """Return buffers with zeros where a padded block needs them."""
    before = aligned_zeros(_PACK + state.FIELDS * BLOCK)
    light, rate = aligned_zeros(BLOCK), aligned_zeros(BLOCK)
    return Scratch(before, light, rate, aligned_zeros(BLOCK, np.uint8), np.zeros(_PACKED + state.PARTS, np.int64))


class Share(NamedTuple):
    """Share of one of `of` threads: every `of`-th run of blocks; the part of it that may be skipped; and `STOP`."""

    number: int
    of: int
    idle: Idle
    touched: Touched
    stop: _Bytes


@kernel
def _padded(values: _Float32s, buffer: _Float32s) -> _Float32s:
    """Return `buffer` with the values in front, and zeros behind."""
    for i in range(values.size):
        buffer[i] = values[i]
    for i in range(values.size, buffer.size):
        buffer[i] = _ZERO
    return buffer


@kernel
def _of_block(frame: FlatLight, first: int, scratch: Scratch, c: StepConstants) -> FlatLight:
    """Return light and rate of the block that begins at pixel `first`: views, and copies of a last block's."""
    light = frame.light[first : first + BLOCK]
    rate = frame.rate[first : first + BLOCK]
    if light.size < BLOCK:
        light = _padded(light, scratch.light)
    if rate.size < BLOCK and not c.chord:
        rate = _padded(rate, scratch.rate)
    return FlatLight(light, rate)


@kernel
def _list_and_mark(  # noqa: PLR0913, PLR0917
    s: _Float32s, light: _Float32s, firsts: _Int64s, pixels: Pixels, buffers: Buffers, idle: Idle, at: _Progress,
    c: StepConstants,
) -> _Progress:  # fmt: skip
    """Note which parts of a moved block or pack rest from now on, and add its pixels that may fire to the table.

    `s` is its state, `firsts` the first pixels of its parts.
    """
    scratch, n = buffers.scratch, firsts.size
    flags = scratch.may_fire.view(np.uint64)
    for k in range(n * (PART // 8), state.PARTS * (PART // 8)):
        flags[k] = _NO_FLAGS  # of the empty places of a pack
    listed = list_flags(flags, scratch.indices)
    selected = unreadable = NONE
    refined = at.refined
    if listed > 0 and c.refine:
        flagged = scratch.indices[:listed]
        listed, refined = _gather_undersampled(flagged, s, scratch.before, firsts, buffers.subset, refined, c)
    if listed > 0:
        flagged = scratch.indices[:listed]
        selected, unreadable = select(flagged, s, scratch.before, firsts, pixels.refractory_until_ns, c)
        chosen = scratch.indices[:selected]
        gather(chosen, s, scratch.before, firsts, buffers.table, at.n)
        if (c.second > _ZERO) | (c.parasitic > _ZERO) | (c.high > _ZERO):
            gather_rare(chosen, s, scratch.before, at.n, buffers.table, c)
        if c.noisy:
            rest.leave_out(chosen, s, scratch.may_fire)  # their new certificates decide, see `rest.hold_back`
    rest.mark(light, s, scratch.before, flags, firsts, idle, c)
    candidates, bad = at.candidates + selected, at.unreadable + unreadable
    return _Progress(at.block, at.packed, at.n + selected, candidates, bad, refined, at.moved + n)


@kernel
def _move_pack(
    frame: FlatLight, pixels: Pixels, buffers: Buffers, idle: Idle, at: _Progress, c: StepConstants
) -> _Progress:
    """Move the parts that are in the pack, and empty it."""
    scratch = buffers.scratch
    s = scratch.before[_PACK:]
    firsts = scratch.indices[_PACKED : _PACKED + at.packed]
    rest.gather_parts(frame, pixels.fields, firsts, s, FlatLight(scratch.light, scratch.rate), c.chord)
    move_quietly(scratch.light, scratch.rate, s, scratch.before, scratch.may_fire, c)
    at = _list_and_mark(s, scratch.light, firsts, pixels, buffers, idle, at, c)
    rest.scatter_parts(s, pixels.fields, firsts, (c.parasitic > _ZERO) | (c.high > _ZERO))
    return _Progress(at.block, NONE, at.n, at.candidates, at.unreadable, at.refined, at.moved)


@kernel
def _move_block(  # noqa: PLR0913, PLR0917
    frame: FlatLight, pixels: Pixels, buffers: Buffers, idle: Idle, first: int, at: _Progress, c: StepConstants
) -> _Progress:  # fmt: skip
    """Move the block that begins at pixel `first` in place."""
    scratch = buffers.scratch
    firsts = scratch.indices[_FIRSTS:_PACKED]
    rest.list_all(first, firsts)
    s = pixels.fields[first * state.FIELDS : (first + BLOCK) * state.FIELDS]
    block = _of_block(frame, first, scratch, c)
    move_quietly(block.light, block.rate, s, scratch.before, scratch.may_fire, c)
    moved: _Progress = _list_and_mark(s, block.light, firsts, pixels, buffers, idle, at, c)
    return moved


@kernel
def _is_skipped(frame: FlatLight, scratch: Scratch, share: Share, first: int, c: StepConstants) -> bool:
    """Return whether a whole block is idle and its light has not changed."""
    if not rest.may_rest(share.idle, first // BLOCK, c):
        return False
    if not rest.block_is_touched(first, share.touched):
        return True
    block = _of_block(frame, first, scratch, c)
    return bool(rest.is_same(block.light, block.rate, share.idle, first, c))


@kernel
def _first_of(block: int, share: Share) -> int:
    """Return the first pixel of a share's block."""
    return (share.number + block // _RUN_BLOCKS * share.of) * RUN + block % _RUN_BLOCKS * BLOCK


@kernel
def _past_resting(block: int, size: int, share: Share, c: StepConstants) -> int:
    """Return the next of a share's blocks, from `block` on, that is not both idle and outside the touched part.

    A separate loop, so that still light needs few values in registers.
    """
    while True:
        first = _first_of(block, share)
        if (
            first >= size
            or rest.block_is_touched(first, share.touched)
            or not rest.may_rest(share.idle, first // BLOCK, c)
        ):
            return block
        block += 1


@cached_kernel
def _fill(
    frame: FlatLight, pixels: Pixels, buffers: Buffers, share: Share, at: _Progress, c: StepConstants
) -> _Progress:
    """Move blocks from where the last call ended until the table is full, or all are moved.

    This loop is a function of its own because calls from a function that counts references cost 0.5 us each.
    """
    scratch, idle = buffers.scratch, share.idle
    block, packed = at.block, at.packed
    while at.n <= (NOISY_BATCH if c.noisy | c.offsets else BATCH):
        block = _past_resting(block, frame.light.size, share, c)
        first = _first_of(block, share)
        if first >= frame.light.size:
            at = _Progress(_END, packed, at.n, at.candidates, at.unreadable, at.refined, at.moved)
            return _move_pack(frame, pixels, buffers, idle, at, c) if packed > 0 else at
        if _is_skipped(frame, scratch, share, first, c):
            block += 1
            continue
        active = rest.list_active(frame, first, idle, share.touched, scratch.indices[_FIRSTS:_PACKED], c)
        if active > rest.MOST_PACKED:
            at = _move_block(frame, pixels, buffers, idle, first, at, c)
        elif packed + active > state.PARTS:
            at = _Progress(block, packed, at.n, at.candidates, at.unreadable, at.refined, at.moved)
            at, packed = _move_pack(frame, pixels, buffers, idle, at, c), NONE
            continue  # now there is room for this block's parts
        else:
            for j in range(active):
                scratch.indices[_PACKED + packed + j] = scratch.indices[_FIRSTS + j]
            packed += active
        block += 1
    return _Progress(block, packed, at.n, at.candidates, at.unreadable, at.refined, at.moved)


def compile_parts(part: str, pixels: Pixels, buffers: Buffers, share: Share, c: StepConstants) -> None:
    """Compile "blocks", "candidates" or "noise", the large parts of `advance`, which finds them on disk afterwards."""
    light, keys = np.zeros(BLOCK, np.float32), np.empty(1, np.uint64)
    arguments = {
        "blocks": (FlatLight(light, light), pixels, buffers, share, _Progress(0, 0, 0, 0, 0, 0, 0), c),
        "candidates": (pixels, buffers.table, 0, keys, 0, c),
        "noise": (pixels, buffers.table, 0, 0, 0, keys, 0, share.idle, share.stop, c),
    }
    kernel_of = {"blocks": _fill, "candidates": solve, "noise": solve_noisy}
    kernel_of[part].compile(tuple(map(numba.typeof, arguments[part])))


@cached_entry
def advance(
    frame: FlatLight, pixels: Pixels, buffers: Buffers, keys: Keys, share: Share, c: StepConstants
) -> tuple[Keys, int, tuple[int, ...]]:
    """Move a share of the pixels to the time of `frame`. Of pixels collected for refinement only the light moves.

    `pixels` and the share's table of idle blocks change; `buffers` are for candidates, and undersampled pixels. Returns
    the keys of the events, packed as in `unpack`, unsorted (a longer array where it was too short), their number, and
    the counts of a `Tally`: numba crashes where a signal raises while Python makes a named tuple within a tuple.
    """
    n_keys = lost = undersampled = waiting = NONE
    at = _Progress(NONE, NONE, NONE, NONE, NONE, NONE, NONE)
    while at.block != _END and share.stop[0] == 0:
        at = _fill(frame, pixels, buffers, share, at, c)
        if c.noisy:
            may_wait = NONE if at.block == _END else np.int64(MOST_WAITING)
            keys, n_keys, lost_now, undersampled_now, waiting = solve_noisy(
                pixels, buffers.table, at.n, waiting, may_wait, keys, n_keys, share.idle, share.stop, c
            )
        else:
            keys, n_keys, lost_now, undersampled_now = solve(pixels, buffers.table, at.n, keys, n_keys, c)
        lost += lost_now
        undersampled += undersampled_now
        at = _Progress(at.block, at.packed, NONE, at.candidates, at.unreadable, at.refined, at.moved)
    return keys, n_keys, (lost, undersampled, at.candidates, at.unreadable, at.refined, at.moved * PART)


@kernel
def _replace_light(frame: FlatLight, pixels: Pixels, scratch: Scratch, c: StepConstants) -> int:
    unreadable = NONE
    for first in range(0, frame.light.size, BLOCK):
        block = _of_block(frame, first, scratch, c)
        s = pixels.fields[first * state.FIELDS : (first + BLOCK) * state.FIELDS]
        unreadable += replace_light_of_block(block.light, block.rate, s, scratch.before, c)
    return int(unreadable)


@cached_entry
def replace_light(frame: FlatLight, pixels: Pixels, scratch: Scratch, c: StepConstants) -> int:
    """Let the light jump to that of `frame` at the start of a step; return the number of pixels with unreadable light.

    Filters and references stay. The loop is apart because kernels do not count references to the arrays they return.
    """
    return int(_replace_light(frame, pixels, scratch, c))


_WORTH_A_THREAD = 100_000
"""Quiet pixels that take as long as waking a thread pays for, about 100 us."""

_CANDIDATE, _NOISY_CANDIDATE = 12, 2000
"""Cost of a candidate, in quiet pixels, without noise and with it."""


MoveShare = Callable[[int, Share, Keys], tuple[Keys, int, tuple[int, ...]]]
"""(thread, its share, room for keys) -> keys, their number, and counts."""


class Workers:
    """The threads of one array.

    Parameters
    ----------
    blocks : blocks of the array.
    threads : always that many; 0: as the work of the last step suggests, at most those available.

    Attributes
    ----------
    idle : the blocks that a step can skip.
    buffers : those of each thread.
    """

    def __init__(self, blocks: int, threads: int = 0) -> None:
        self.idle = rest.new_idle(blocks)
        self._fixed, self._most = threads, threads or available_threads()
        self.buffers: list[Buffers] = []
        self._keys: list[Keys] = []
        self._pool = ThreadPool(self._most)
        self._last = 0
        self._reserve(1)

    def step(
        self, frame: FlatLight, pixels: Pixels, touched: Touched, c: StepConstants, refine: MoveShare | None = None
    ) -> tuple[Keys, Tally]:
        """Move the array as `advance` does, shares by `refine` if given; return the keys, sorted, and the counts."""
        n = self._wanted(frame.light.size)
        self._reserve(n)
        shares: list[tuple[Keys, tuple[int, ...]]] = [(self._keys[0], (0,) * 6)] * n

        def move(number: int, _: int) -> None:
            share = Share(number, n, self.idle, touched, STOP)
            if refine is None:
                keys, n_keys, tally = advance(frame, pixels, self.buffers[number], self._keys[number], share, c)
            else:
                keys, n_keys, tally = refine(number, share, self._keys[number])
            self._keys[number] = keys
            keys[:n_keys].sort()
            shares[number] = keys[:n_keys], tally

        self._pool.each(move, n)
        lists, tallies = zip(*shares, strict=True)
        tally = Tally(*(sum(column) for column in zip(*tallies, strict=True)))
        self._last = tally.moved + (_NOISY_CANDIDATE if c.noisy else _CANDIDATE) * tally.candidates
        together = np.concatenate(lists)
        together.sort(kind="stable")  # merges the sorted parts
        return together, tally

    def _wanted(self, pixels: int) -> int:
        runs = -(-pixels // RUN)
        if self._fixed:
            return min(self._fixed, runs)
        return max(1, min(self._most, runs, self._last // _WORTH_A_THREAD))

    def _reserve(self, threads: int) -> None:
        while len(self.buffers) < threads:
            self.buffers.append(Buffers(new_table(), new_subset(0), new_scratch()))
            self._keys.append(np.empty(4096, np.uint64))
