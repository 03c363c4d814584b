"""A step of all pixels, or of a thread's share of them: block by block, then the candidates in batches.

A block that is idle costs a comparison of its light, or none outside the changed region (`idle`). Of a block with few
active parts only these are moved, together with those of others (`subset`). The arithmetic of a pixel does not depend
on the blocks that are moved with it, their order and their thread, so the events are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import NONE, cached_entry, cached_kernel, kernel
from emulator.sensor.numerics.elementary import aligned_zeros
from emulator.sensor.pixels.candidates import BATCH, Table, entry_at, gather, gather_rare, new_table, select, solve
from emulator.sensor.pixels.curve import completed, is_undersampled
from emulator.sensor.pixels.idle import (
    MOST_PACKED,
    Idle,
    Touched,
    block_is_touched,
    gather_parts,
    is_same,
    list_active,
    list_all,
    mark,
    may_rest,
    new_idle,
    pixel_at,
    scatter_parts,
)
from emulator.sensor.pixels.quiet_pass import (
    Ahead,
    list_flags,
    move_quietly,
    move_quietly_from_memory,
    replace_light_of_block,
)
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, FIELDS, PART, PARTS, Field, Pixels, StepConstants, slot
from emulator.threads import available_threads

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]
_Keys = npt.NDArray[np.uint64]
_Frame = tuple[_Float32s, _Float32s]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P = (int(f) * BLOCK for f in Field)
_U0, _V0, _L0, _G0, _A0, _A1, _, _, _W0, _P0, _, _ = BEFORE_ROWS
_ZERO, _NO_FLAGS = np.float32(0), np.uint64(0)

RUN = 8 * BLOCK
"""Pixels that a thread moves before it leaves the next ones to another."""

_RUN_BLOCKS = RUN // BLOCK
_END = -1
_PACK = len(BEFORE_ROWS) * BLOCK  # the places in `before` and `found` of what lies behind
_FIRSTS, _PACKED = BLOCK, BLOCK + PARTS


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
    `found` the first pixels of the parts of a block and then those of the parts of a pack behind the indices.
    """

    before: _Float32s
    light: _Float32s
    rate: _Float32s
    may_fire: _Bytes
    found: _Int64s


class Subset(NamedTuple):
    """States of some pixels of an array, laid out as `Pixels.fields`, and the numbers of these pixels."""

    fields: _Float32s
    pixels: _Int64s


def new_subset(blocks: int) -> Subset:
    """Return a subset with room for `blocks` blocks; the system provides its memory where it is written."""
    return Subset(np.zeros(blocks * FIELDS * BLOCK, np.float32), np.zeros(blocks * BLOCK, np.int64))


@kernel
def _gather_undersampled(
    found: _Int64s, s: _Float32s, before: _Float32s, subset: Subset, at: tuple[_Int64s, int], c: StepConstants
) -> tuple[int, int]:
    """Move the undersampled pixels of a block's candidates to the subset.

    Parameters
    ----------
    found : (n,) int64
        Indices of the candidates in the block; those that remain move to the front.
    at : tuple
        First pixels of the block's parts, and the number of pixels in the subset.

    Returns
    -------
    The number of candidates that remain, and of pixels in the subset. Pixels with unreadable light always remain.
    """
    firsts, n = at
    remaining = 0
    for pixel in found:
        i = np.uint64(pixel)
        found[remaining] = pixel
        u0, v0 = before[entry_at(_U0, i)], before[entry_at(_V0, i)]
        d, unseen = s[entry_at(_U, i)] - u0, c.unseen_share * min(s[entry_at(_ON, i)], s[entry_at(_OFF, i)])
        a0, a1 = completed(d, before[entry_at(_A0, i)], before[entry_at(_A1, i)])
        if not (is_undersampled(d, a0, a1, unseen) & (v0 == v0)):
            remaining += 1
            continue
        subset.pixels[n] = pixel_at(firsts, pixel)
        to = slot(n)
        n += 1
        subset.fields[to + _U], subset.fields[to + _V] = u0, v0
        subset.fields[to + _L], subset.fields[to + _G] = before[entry_at(_L0, i)], before[entry_at(_G0, i)]
        for row in (_REF, _ON, _OFF, _LEAK):
            subset.fields[to + row] = s[entry_at(row, i)]
        subset.fields[to + _W] = before[entry_at(_W0, i)] if c.second > _ZERO else s[entry_at(_W, i)]
        subset.fields[to + _P] = before[entry_at(_P0, i)] if c.parasitic > _ZERO else s[entry_at(_P, i)]
    return remaining, n


class Buffers(NamedTuple):
    """Buffers of one thread: a table for the candidates, a subset for the undersampled pixels, and scratch."""

    table: Table
    subset: Subset
    scratch: Scratch


def new_scratch() -> Scratch:
    """Return buffers with zeros where a padded block needs them."""
    before = aligned_zeros(_PACK + FIELDS * BLOCK)
    light, rate = aligned_zeros(BLOCK), aligned_zeros(BLOCK)
    return Scratch(before, light, rate, aligned_zeros(BLOCK, np.uint8), np.zeros(_PACKED + PARTS, np.int64))


class Share(NamedTuple):
    """Share of one of `of` threads: every `of`-th run of blocks; and the part of it that may be skipped."""

    number: int
    of: int
    idle: Idle
    touched: Touched


@kernel
def _padded(values: _Float32s, buffer: _Float32s) -> _Float32s:
    """Return `buffer` with the values in front, and zeros behind."""
    for i in range(values.size):
        buffer[i] = values[i]
    for i in range(values.size, buffer.size):
        buffer[i] = _ZERO
    return buffer


@kernel
def _of_block(frame: _Frame, first: int, scratch: Scratch, c: StepConstants) -> _Frame:
    """Return light and rate of the block that begins at pixel `first`."""
    here, rate_here = frame[0][first : first + BLOCK], frame[1][first : first + BLOCK]
    if here.size < BLOCK:
        here = _padded(here, scratch.light)
    if rate_here.size < BLOCK and not c.chord:
        rate_here = _padded(rate_here, scratch.rate)
    return here, rate_here


@kernel
def _list_and_mark(
    here: tuple[_Float32s, _Float32s, _Float32s],
    buffers: Buffers,
    firsts: _Int64s,
    tables: tuple[Idle, _Int64s],
    at: _Progress,
    c: StepConstants,
) -> _Progress:
    """Note which parts of a moved block or pack rest from now on, and add its pixels that may fire to the table.

    `here` are its state, light and rate, `firsts` the first pixels of its parts, `tables` those of the array: idle
    blocks, ends of refractory periods.
    """
    (s, light, _), (idle, refractory_until_ns) = here, tables
    scratch, refined, n = buffers.scratch, at.refined, firsts.size
    flags = scratch.may_fire.view(np.uint64)
    for k in range(n * (PART // 8), PARTS * (PART // 8)):
        flags[k] = _NO_FLAGS
    listed = list_flags(flags, scratch.found)
    mark(light, (s, scratch.before, flags), firsts, idle, c)
    selected = unreadable = NONE
    if listed > 0 and c.refine:
        listed, refined = _gather_undersampled(
            scratch.found[:listed], s, scratch.before, buffers.subset, (firsts, refined), c
        )
    if listed > 0:
        selected, unreadable = select(scratch.found[:listed], s, scratch.before, (firsts, refractory_until_ns), c)
        chosen = scratch.found[:selected]
        gather(chosen, s, scratch.before, firsts, buffers.table, at.n)
        if (c.second > _ZERO) | (c.parasitic > _ZERO):
            gather_rare(chosen, s, scratch.before, at.n, buffers.table, c)
    candidates, bad = at.candidates + selected, at.unreadable + unreadable
    return _Progress(at.block, at.packed, at.n + selected, candidates, bad, refined, at.moved + n)


@kernel
def _move_pack(
    frame: _Frame, pixels: Pixels, buffers: Buffers, idle: Idle, at: _Progress, c: StepConstants
) -> _Progress:
    """Move the parts that are in the pack, and empty it."""
    scratch = buffers.scratch
    s, light, rate = scratch.before[_PACK:], scratch.light, scratch.rate
    firsts = scratch.found[_PACKED : _PACKED + at.packed]
    gather_parts(frame, pixels.fields, firsts, (s, (light, rate)), c.chord)
    move_quietly(light, rate, s, scratch.before, scratch.may_fire, c)
    at = _list_and_mark((s, light, rate), buffers, firsts, (idle, pixels.refractory_until_ns), at, c)
    scatter_parts(s, pixels.fields, firsts, c.parasitic > _ZERO)
    return _Progress(at.block, NONE, at.n, at.candidates, at.unreadable, at.refined, at.moved)


@kernel
def _move_block(
    frame: _Frame, pixels: Pixels, buffers: Buffers, idle: Idle, at: tuple[int, int, _Progress], c: StepConstants
) -> _Progress:
    """Move the block that begins at pixel `at[0]` in place; the one that begins at `at[1]` is moved next."""
    first, following, progress = at
    scratch = buffers.scratch
    firsts = scratch.found[_FIRSTS:_PACKED]
    list_all(first, firsts)
    s = pixels.fields[first * FIELDS : (first + BLOCK) * FIELDS]
    light, rate = _of_block(frame, first, scratch, c)
    usual = (c.second == _ZERO) & (c.parasitic == _ZERO) & (not c.chord)
    if c.far & usual & (following + BLOCK <= frame[0].size):
        end = following + BLOCK
        ahead = Ahead(
            pixels.fields[following * FIELDS : end * FIELDS], frame[0][following:end], frame[1][following:end]
        )
        move_quietly_from_memory(light, rate, s, scratch.before, scratch.may_fire, c, ahead)
    else:
        move_quietly(light, rate, s, scratch.before, scratch.may_fire, c)
    tables = idle, pixels.refractory_until_ns
    moved: _Progress = _list_and_mark((s, light, rate), buffers, firsts, tables, progress, c)
    return moved


@kernel
def _is_skipped(frame: _Frame, scratch: Scratch, share: Share, first: int, c: StepConstants) -> bool:
    """Return whether a whole block is idle and its light has not changed."""
    if not may_rest(share.idle, first // BLOCK, c):
        return False
    if not block_is_touched(first, share.touched):
        return True
    light, rate = _of_block(frame, first, scratch, c)
    return bool(is_same(light, rate, share.idle, first, c))


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
        if first >= size or block_is_touched(first, share.touched) or not may_rest(share.idle, first // BLOCK, c):
            return block
        block += 1


@cached_kernel
def _fill(frame: _Frame, pixels: Pixels, buffers: Buffers, share: Share, at: _Progress, c: StepConstants) -> _Progress:
    """Move blocks from where the last call ended until the table is full, or all are moved.

    This loop is a function of its own because calls from a function that counts references cost 0.5 us each.
    """
    scratch, idle, block, packed = buffers.scratch, share.idle, at.block, at.packed
    while at.n <= BATCH:
        block = _past_resting(block, frame[0].size, share, c)
        first = _first_of(block, share)
        if first >= frame[0].size:
            at = _Progress(_END, packed, at.n, at.candidates, at.unreadable, at.refined, at.moved)
            return _move_pack(frame, pixels, buffers, idle, at, c) if packed > 0 else at
        if _is_skipped(frame, scratch, share, first, c):
            block += 1
            continue
        active = list_active(frame, first, idle, share.touched, scratch.found[_FIRSTS:_PACKED], c)
        if active > MOST_PACKED:
            at = _move_block(frame, pixels, buffers, idle, (first, _first_of(block + 1, share), at), c)
        elif packed + active > PARTS:
            at = _Progress(block, packed, at.n, at.candidates, at.unreadable, at.refined, at.moved)
            at, packed = _move_pack(frame, pixels, buffers, idle, at, c), NONE
            continue  # now there is room for this block's parts
        else:
            for j in range(active):
                scratch.found[_PACKED + packed + j] = scratch.found[_FIRSTS + j]
            packed += active
        block += 1
    return _Progress(block, packed, at.n, at.candidates, at.unreadable, at.refined, at.moved)


def compile_parts(which: str, pixels: Pixels, buffers: Buffers, share: Share, c: StepConstants) -> None:
    """Compile "blocks" or "candidates", the two large parts of `advance`, which finds them on disk afterwards."""
    light, keys, n = np.zeros(BLOCK, np.float32), np.empty(1, np.uint64), 0
    arguments = {
        "blocks": ((light, light), pixels, buffers, share, _Progress(n, n, n, n, n, n, n), c),
        "candidates": (pixels, buffers.table, n, keys, n, c),
    }
    kernel_of = {"blocks": _fill, "candidates": solve}
    kernel_of[which].compile(tuple(map(numba.typeof, arguments[which])))


@cached_entry
def advance(
    frame: _Frame, pixels: Pixels, buffers: Buffers, keys: _Keys, share: Share, c: StepConstants
) -> tuple[_Keys, int, Tally]:
    """Move a share of the pixels over one step. Of pixels collected for refinement only the light moves.

    Parameters
    ----------
    frame : tuple
        Light at the end of the step, (pixels,) float32, and its time derivative, per second; empty if `c.chord`.
    pixels : Pixels
        The state, changed in place.
    buffers : Buffers
        For the candidates, and for the undersampled pixels if `c.refine`.
    keys : (any,) uint64
        Buffer for the events.
    share : Share
        Which pixels; its table of idle blocks is changed in place.
    c : StepConstants
        The step.

    Returns
    -------
    The keys (a longer copy where they were too short), the number of events in them (packed as in `unpack`, unsorted),
    and the counts of the step.
    """
    n_keys = lost = undersampled = NONE
    at = _Progress(NONE, NONE, NONE, NONE, NONE, NONE, NONE)
    while at.block != _END:
        at = _fill(frame, pixels, buffers, share, at, c)
        keys, n_keys, more, more_undersampled = solve(pixels, buffers.table, at.n, keys, n_keys, c)
        lost, undersampled = lost + more, undersampled + more_undersampled
        at = _Progress(at.block, at.packed, NONE, at.candidates, at.unreadable, at.refined, at.moved)
    return keys, n_keys, Tally(lost, undersampled, at.candidates, at.unreadable, at.refined, at.moved * PART)


@kernel
def _replace_light(frame: _Frame, pixels: Pixels, scratch: Scratch, c: StepConstants) -> int:
    unreadable = NONE
    for first in range(0, frame[0].size, BLOCK):
        light, rate = _of_block(frame, first, scratch, c)
        s = pixels.fields[first * FIELDS : (first + BLOCK) * FIELDS]
        unreadable += replace_light_of_block(light, rate, s, scratch.before, c)
    return int(unreadable)


@cached_entry
def replace_light(frame: _Frame, pixels: Pixels, scratch: Scratch, c: StepConstants) -> int:
    """Let the light jump to that of `frame` at the start of a step; see `advance`. Filters and references stay.

    Returns
    -------
    The number of pixels whose light is not readable.
    """
    return int(_replace_light(frame, pixels, scratch, c))


_WORTH_A_THREAD = 100_000
"""Quiet pixels that take as long as waking a thread pays for, about 100 us."""

_CANDIDATE = 12
"""Cost of a candidate, in quiet pixels."""


class Workers:
    """The threads of one array.

    Parameters
    ----------
    blocks : int
        Blocks of the array.
    threads : int
        Always that many; 0: as the work of the last step suggests, at most those available.

    Attributes
    ----------
    idle : Idle
        The blocks that a step can skip.
    """

    def __init__(self, blocks: int, threads: int = 0) -> None:
        self.idle = new_idle(blocks)
        self._fixed, self._most = threads, threads or available_threads()
        self._buffers: list[Buffers] = []
        self._keys: list[_Keys] = []
        self._pool: ThreadPoolExecutor | None = None
        self._last = 0
        self._reserve(1)

    def buffers(self) -> Buffers:
        """Return those of the first thread."""
        return self._buffers[0]

    def step(self, frame: _Frame, pixels: Pixels, touched: Touched, c: StepConstants) -> tuple[list[_Keys], Tally]:
        """Move the array as `advance` does; return the keys in one or two sorted lists, and the counts."""
        n = self._wanted(frame[0].size)
        self._reserve(n)

        def move(number: int) -> tuple[_Keys, Tally]:
            share = Share(number, n, self.idle, touched)
            keys, found, tally = advance(frame, pixels, self._buffers[number], self._keys[number], share, c)
            self._keys[number] = keys
            keys[:found].sort()
            return keys[:found], tally

        lists, tally = _merged(self._each(move, n))
        self._last = tally.moved + _CANDIDATE * tally.candidates
        return lists, tally

    def _wanted(self, pixels: int) -> int:
        runs = -(-pixels // RUN)
        if self._fixed:
            return min(self._fixed, runs)
        return max(1, min(self._most, runs, self._last // _WORTH_A_THREAD))

    def _reserve(self, threads: int) -> None:
        while len(self._buffers) < threads:
            self._buffers.append(Buffers(new_table(), new_subset(0), new_scratch()))
            self._keys.append(np.empty(4096, np.uint64))

    def _each(self, move: Callable[[int], tuple[_Keys, Tally]], n: int) -> list[tuple[_Keys, Tally]]:
        """Return the results of all shares; the first is this thread's."""
        if n == 1:
            return [move(0)]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(max(self._most, n) - 1, thread_name_prefix="pixels")
        others = [self._pool.submit(move, number) for number in range(1, n)]
        return [move(0), *(other.result() for other in others)]


def _merged(shares: list[tuple[_Keys, Tally]]) -> tuple[list[_Keys], Tally]:
    """Return the events of all shares in at most two sorted lists, and their counts."""
    lists = [keys for keys, _ in shares]
    if len(lists) > 2:
        half = len(lists) // 2
        lists = [np.concatenate(part) for part in (lists[:half], lists[half:])]
        for part in lists:
            part.sort(kind="stable")  # merges the sorted parts
    return lists, Tally(*(sum(column) for column in zip(*(tally for _, tally in shares), strict=True)))
