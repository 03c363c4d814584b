"""Idle blocks of pixels, and idle parts of blocks, which the pixel step skips, and the time until which they are idle.

A part is idle from a step on in which nothing moved: light, its slopes and the filter are bit for bit the same as
before, and no pixel was a candidate. Repeating such a step changes nothing, until the light changes or the leak of one
of its pixels comes near a threshold. Three numbers decide when the part must be computed again:

    until_ns    a step that ends later may bring an event of leak; at most the end of the epoch, where references move
    longest     a longer step may move a filter that rests because its distance to the light is lost in rounding
    shortest    the same for shorter steps, where there is a second pole: then only steps of one length are skipped

A block is idle if all its parts are, and has the strictest of their limits. Candidates with noise may rest at once.

The last light is one number where all pixels have the same light, as in a black sky: such a frame is compared with it
at the speed of the memory. Otherwise it is a copy.

`Touched` is the changed region of a frame, as the blocks and parts of blocks that lie in it.

A pack holds active parts of several blocks, moved as one block. Where few parts of a block are active, as where a star
passes, these are copied to a scratch block (gather), moved by the kernels of a whole one, and copied back (scatter). Of
a sky of stars at 1280x720, 1.3 % of the pixels change in a step, in 53 % of the blocks and 10 % of the parts.

Fast because light is compared bit for bit, two pixels in a word, in loops without an early end; and because a block
outside the changed region costs three comparisons.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, kernel, vector_kernel
from emulator.sensor.numerics.elementary import exponential, exponential_less_one
from emulator.sensor.pixels import state
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, FIELDS, PART, PARTS, Field, FlatLight, StepConstants

_BLOCK, _PART = np.int64(BLOCK), np.int64(PART)  # as literals, they would be compiled for one by one
_Bytes = npt.NDArray[np.uint8]


class Touched(NamedTuple):
    """The part of a light frame of `width` columns that may have changed; last row and column not included.

    `units`, (blocks * (1 + PARTS),), gives it instead, with 1 where a block or part may have changed, blocks first. It
    is empty where it is not used. One array for both, because each costs time in every call.
    """

    first_row: int
    last_row: int
    first_column: int
    last_column: int
    width: int
    units: _Bytes


@kernel
def _meets_rectangle(first: int, n: int | np.int64, touched: Touched) -> bool:
    """Return whether the n pixels from `first` on may meet the rectangle."""
    if (first + n <= touched.first_row * touched.width) | (first >= touched.last_row * touched.width):
        return False
    if touched.width < n:
        return True
    column = first % touched.width
    return bool((column + n > touched.width) | ((column < touched.last_column) & (column + n > touched.first_column)))


@kernel
def block_is_touched(first: int, touched: Touched) -> bool:
    """Return whether the block that begins at pixel `first` has pixels in the touched part."""
    if touched.units.size:
        return bool(touched.units[first // BLOCK])
    return bool(_meets_rectangle(first, _BLOCK, touched))


@kernel
def part_is_touched(first: int, touched: Touched) -> bool:
    """Return whether the part that begins at pixel `first` has pixels in the touched part."""
    if touched.units.size:
        return bool(touched.units[touched.units.size // (1 + PARTS) + first // PART])
    return bool(_meets_rectangle(first, _PART, touched))


@cached_entry
def touch(boxes: npt.NDArray[np.int64], width: int, units: _Bytes) -> None:
    """Write to `units`, see `Touched`, 1 where a block or part has pixels in one of the boxes of a `Region`, else 0."""
    units[:] = 0
    blocks = units.size // (1 + PARTS)
    for k in range(boxes.shape[0]):
        if boxes[k, 2] < boxes[k, 3]:
            for row in range(boxes[k, 0], boxes[k, 1]):
                begin, end = row * width + boxes[k, 2], row * width + boxes[k, 3]
                for part in range(begin // PART, (end - 1) // PART + 1):
                    units[blocks + part] = units[part // PARTS] = 1


_Float32s = npt.NDArray[np.float32]
_Words = npt.NDArray[np.uint64]
_Int64s = npt.NDArray[np.int64]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P, _ON_LIMIT, _, _SPEED, _UNTIL, _Y = (int(f) * BLOCK for f in Field)
_U0, _V0, _L0, _G0, _, _, _, _Q, _W0, _P0, _WAIT, _, _Y0 = BEFORE_ROWS  # the bounds are not needed any more
_WORDS, _PART_WORDS = np.int64(BLOCK // 2), PART // 2
_SIGNLESS, _SIGNLESS_HALF = np.uint64(0x7FFFFFFF7FFFFFFF), np.uint32(0x7FFFFFFF)
_NONE = np.uint64(0)
_ZERO, _LARGE, _NAN = (np.float32(x) for x in (0, 1e9, np.nan))
_MORE = np.float32(1.1)  # a rise of that much more must still be lost in rounding, so that shorter steps' rises are
_MARGIN = np.float32(2e-5)  # ln units: that of the quiet test, and rounding
_EARLY_NS = 1000

_NOT_IDLE = -(1 << 62)  # earlier than any stream time
NO_PART = _NOT_IDLE - 1
"""`until_ns` of a block that was moved whole, and none of whose parts is idle."""


class Idle(NamedTuple):
    """The idle blocks and parts of an array: the limits above, `until_ns` _NOT_IDLE for those that are not idle.

    All but `seen` have blocks * (1 + PARTS) entries, those of the blocks first; one array for both, because each costs
    time in every call. `until_ns` is NO_PART for a block without an idle part. `level` is the light of all pixels, NaN
    where they differ; `seen`, (blocks * BLOCK,), has the light of idle parts.
    """

    until_ns: _Int64s
    longest: _Float32s
    shortest: _Float32s
    level: _Float32s
    seen: _Float32s


def new_idle(blocks: int) -> Idle:
    """Return the table of an array of which no block is idle."""
    units = blocks * (1 + PARTS)
    longest, shortest, level = (np.zeros(units, np.float32) for _ in range(3))
    return Idle(np.full(units, _NOT_IDLE, np.int64), longest, shortest, level, np.empty(blocks * BLOCK, np.float32))


def wake(idle: Idle) -> None:
    """Let no block or part be idle."""
    idle.until_ns[:] = _NOT_IDLE


@kernel
def part_at(idle: Idle, first: int) -> int:
    """Return the entry of the part that begins at pixel `first`."""
    return idle.until_ns.size // (1 + PARTS) + first // PART


@kernel
def _is_zero(words: _Words) -> bool:
    """Return whether a block's values are all 0 or -0."""
    bits = _NONE  # of all words: a loop without an early end becomes vectors
    for k in range(_WORDS):
        bits |= words[k]
    return bool((bits & _SIGNLESS) == _NONE)


@kernel
def may_rest(idle: Idle, unit: int, c: StepConstants) -> bool:
    """Return whether the block or part of an entry can be skipped if its light has not changed."""
    lasts = idle.until_ns[unit] >= c.t0_ns + c.h_ns
    return bool(lasts & (c.h <= idle.longest[unit]) & (c.h >= idle.shortest[unit]))


@kernel
def is_same(light: _Float32s, rate: _Float32s, idle: Idle, first: int, c: StepConstants) -> bool:
    """Return whether the light of an idle block has not changed; `light` and `rate` are its own."""
    block = first // BLOCK
    if not c.chord and not _is_zero(rate.view(np.uint64)):
        return False
    words, differing = light.view(np.uint64), _NONE
    level = idle.level[block : block + 1]
    if level[0] == level[0]:
        value = np.uint64(level.view(np.uint32)[0])
        pair = value | (value << np.uint64(32))
        for k in range(_WORDS):
            differing |= words[k] ^ pair
    else:
        seen = idle.seen[first : first + BLOCK].view(np.uint64)
        for k in range(_WORDS):
            differing |= words[k] ^ seen[k]
    return bool(differing == _NONE)


@kernel
def part_is_same(frame: FlatLight, idle: Idle, first: int, c: StepConstants) -> bool:
    """Return whether the light of an idle part, which begins at pixel `first` of the frame, has not changed."""
    end = min(first + PART, frame.light.size)
    light, seen = frame.light[first:end].view(np.uint32), idle.seen[first:end].view(np.uint32)
    differing = np.uint32(0)
    for i in range(light.size):
        differing |= light[i] ^ seen[i]
    if not c.chord:
        rate = frame.rate[first:end].view(np.uint32)
        for i in range(rate.size):
            differing |= rate[i] & _SIGNLESS_HALF
    return bool(differing == np.uint32(0))


@kernel
def _moved(s: _Words, before: _Words, begin: int, end: int, c: StepConstants) -> bool:
    """Return whether light, slopes or filters of a block moved, in the words from `begin` to `end`."""
    differing = _NONE
    for k in range(begin, end):
        light = (s[_U // 2 + k] ^ before[_U0 // 2 + k]) | (s[_L // 2 + k] ^ before[_L0 // 2 + k])
        slopes = (s[_G // 2 + k] | before[_G0 // 2 + k]) & _SIGNLESS
        differing |= light | slopes | (s[_V // 2 + k] ^ before[_V0 // 2 + k])
    if c.second > _ZERO:
        for k in range(begin, end):
            differing |= s[_W // 2 + k] ^ before[_W0 // 2 + k]
    if c.parasitic > _ZERO:
        for k in range(begin, end):
            differing |= s[_P // 2 + k] ^ before[_P0 // 2 + k]
    if c.high > _ZERO:
        for k in range(begin, end):
            differing |= s[_Y // 2 + k] ^ before[_Y0 // 2 + k]
    return bool(differing != _NONE)


@vector_kernel
def _find_rest(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write to a scratch row when each pixel's leak may fire, s since the epoch; below 0 where its filter may move."""
    for i in range(BLOCK):
        u, v = s[_U + i], s[_V + i]
        on = s[_ON + i]
        by_light = c.parasitic * on * exponential(u) if c.parasitic > _ZERO else _ZERO
        leak = s[_LEAK + i] + by_light
        passed = s[_Y + i] if c.high > _ZERO else (s[_W + i] if c.second > _ZERO else v)
        compared = passed + (s[_P + i] if c.parasitic > _ZERO else _ZERO)
        pulled = -exponential_less_one(v - u) if c.large else u - v
        # The filter rests where its motion is lost in rounding, even in a step 1.1 times as long.
        rests = v + _MORE * (before[_Q + i] * pulled) == v
        limit = s[_ON_LIMIT + i] if c.noisy | c.offsets else on
        # The quiet test allows 1.5 times that leak.
        room = (limit - _MARGIN - by_light * c.h) - (compared - s[_REF + i])
        # The leak fires when it has filled the room between the comparator and its threshold.
        wait = room / leak if leak > _ZERO else (_LARGE if leak == _ZERO else -_LARGE)
        until = s[_UNTIL + i] if c.noisy | c.offsets else wait
        wait = min(wait, until) if until != _LARGE else _LARGE  # of a candidate, see `leave_out`
        before[_WAIT + i] = wait if rests else -_LARGE


@vector_kernel
def _least(wait: _Float32s) -> np.float32:
    """Return the least of a part's times, and overwrite them; two halves first, because one chain of minima is slow."""
    for width in (PART // 2, PART // 4, PART // 8):
        for i in range(width):
            wait[i] = min(wait[i], wait[width + i])
    least: np.float32 = _LARGE
    for i in range(PART // 8):
        least = min(least, wait[i])
    return least


@kernel
def _all_same(light: _Float32s) -> bool:
    """Return whether a part has one light, bit for bit."""
    words, differing = light.view(np.uint64), _NONE
    for k in range(_PART_WORDS):
        differing |= words[k] ^ words[0]
    return bool((differing == _NONE) & ((words[0] >> np.uint64(32)) == (words[0] & np.uint64(0xFFFFFFFF))))


@kernel
def _stands_still(s: _Float32s, before: _Float32s, flags: _Words, j: int, c: StepConstants) -> bool:
    """Return whether nothing moved in part j of a block, and none of its pixels is a candidate."""
    candidates = _NONE
    for k in range(PART // 8):
        candidates |= flags[j * (PART // 8) + k]
    first = j * _PART_WORDS
    moved = _moved(s.view(np.uint64), before.view(np.uint64), first, first + _PART_WORDS, c)
    return bool((candidates == _NONE) and not moved)


@kernel
def _until_ns(wait_s: np.float32, c: StepConstants) -> int:
    """Return the time `wait_s` seconds after the epoch's start, at most its end; _NOT_IDLE if it is past."""
    longest_ns = 1 << state.EPOCH_BITS
    wait_ns = longest_ns if wait_s * 1e9 >= longest_ns else int(wait_s * 1e9) - _EARLY_NS
    return (c.t0_ns >> state.EPOCH_BITS << state.EPOCH_BITS) + wait_ns if wait_ns > 0 else _NOT_IDLE


@kernel
def _sum_up(idle: Idle, first: int) -> None:
    """Write the limits of the block that begins at pixel `first` from those of its parts."""
    block, begin = first // BLOCK, part_at(idle, first)
    until_ns, level = idle.until_ns[begin], idle.level[begin]
    longest, shortest = idle.longest[begin], idle.shortest[begin]
    for part in range(begin + 1, begin + PARTS):
        until_ns = min(until_ns, idle.until_ns[part])
        longest, shortest = min(longest, idle.longest[part]), max(shortest, idle.shortest[part])
        level = level if idle.level[part] == level else _NAN
    idle.until_ns[block], idle.level[block] = until_ns, level
    idle.longest[block], idle.shortest[block] = longest, shortest


@kernel
def mark(  # noqa: PLR0913, PLR0917
    light: _Float32s, s: _Float32s, before: _Float32s, flags: _Words, firsts: _Int64s, idle: Idle, c: StepConstants
) -> None:
    """Note which parts of a block or pack, moved over a step just now, are idle from now on.

    `s` is its state, `before` the scratch rows, `flags` those of its candidates, eight in a word; `firsts` are the
    first pixels of its parts.
    """
    n = firsts.size
    has_idle_part = False
    blocks = idle.until_ns.size // (1 + PARTS)
    for j in range(n):
        begin, end = j * PART, (j + 1) * PART - 1
        first = firsts[j]
        idle.until_ns[blocks + first // PART] = idle.until_ns[first // BLOCK] = _NOT_IDLE
        if (s[_U + begin] != before[_U0 + begin]) | (s[_U + end] != before[_U0 + end]):
            continue  # the usual case where light changes, without a look at the other pixels
        if _stands_still(s, before, flags, j, c):
            if not has_idle_part:
                _find_rest(s, before, c)  # of all parts at once, when the first is found
            has_idle_part = True
            part = part_at(idle, first)
            seen, wait = light[begin : begin + PART], before[_WAIT + begin : _WAIT + begin + PART]
            idle.until_ns[part] = _until_ns(_least(wait), c)
            idle.longest[part] = c.h
            idle.shortest[part] = c.h if c.second > _ZERO else _ZERO
            idle.level[part] = seen[0] if _all_same(seen) else _NAN
            for i in range(PART):
                idle.seen[first + i] = seen[i]
    if has_idle_part:
        for j in range(n):
            _sum_up(idle, firsts[j] // BLOCK * BLOCK)
    elif n == PARTS and firsts[n - 1] - firsts[0] == BLOCK - PART:
        idle.until_ns[firsts[0] // BLOCK] = NO_PART


@kernel
def leave_out(chosen: _Int64s, s: _Float32s, may_fire: _Bytes) -> None:
    """Let candidates of a block that will be solved with noise not keep their parts from rest; `hold_back` follows."""
    for place in chosen:
        i = np.uint64(place)
        may_fire[i] = np.uint8(0)
        s[np.uint64(_UNTIL) + i] = _LARGE


@kernel
def hold_back(pixels: state.Pixels, solved: int, idle: Idle, c: StepConstants) -> None:
    """Let the part of the pixel that was `solved` rest no longer than it is certified for still light."""
    speed, until_s = pixels.fields[state.slot(solved) + _SPEED], pixels.fields[state.slot(solved) + _UNTIL]
    is_certified = speed < _ZERO and until_s > c.since_epoch_1
    until_ns = _until_ns(until_s, c) if is_certified else _NOT_IDLE
    for unit in (solved // BLOCK, part_at(idle, solved)):
        idle.until_ns[unit] = min(idle.until_ns[unit], until_ns)


MOST_PACKED = PARTS // 2
"""Active parts of a block up to which it is packed; with more it is moved in place, which saves the copies."""

_MOVED = tuple(int(f) * BLOCK for f in (Field.LOG_LIGHT, Field.FILTERED, Field.RATE, Field.SLOPE, Field.SECOND))
_MOVED_IN_FEW = tuple(int(f) * BLOCK for f in (Field.LEAKED, Field.HIGH_PASSED))


@kernel
def pixel_at(firsts: _Int64s, i: int) -> int:
    """Return the pixel at place i of a block or pack, `firsts` being the first pixels of its parts."""
    pixel: int = firsts[np.uint64(i) // np.uint64(PART)] + i % PART
    return pixel


@kernel
def list_all(first: int, firsts: _Int64s) -> int:
    """List the parts of the block that begins at pixel `first`; return their number."""
    for j in range(PARTS):
        firsts[j] = first + j * PART
    return PARTS


@kernel
def list_active(frame: FlatLight, first: int, idle: Idle, touched: Touched, firsts: _Int64s, c: StepConstants) -> int:
    """List the parts of the block that begins at pixel `first` that cannot be skipped; return their number."""
    if idle.until_ns[first // BLOCK] == NO_PART:
        return int(list_all(first, firsts))
    n = 0
    for j in range(PARTS):
        part = first + j * PART
        rests = may_rest(idle, part_at(idle, part), c)
        if rests and (not part_is_touched(part, touched) or part_is_same(frame, idle, part, c)):
            continue
        firsts[n] = part
        n += 1
    return n


@kernel
def _copy_values(values: _Float32s, first: int, out: _Float32s) -> None:
    """Copy a part's values of a frame, with zeros beyond its end."""
    n = min(PART, max(values.size - first, 0))
    for i in range(n):
        out[i] = values[first + i]
    for i in range(n, PART):
        out[i] = _ZERO


@vector_kernel
def _copy(source: _Float32s, target: _Float32s) -> None:
    for i in range(PART):
        target[i] = source[i]


@kernel
def gather_parts(
    frame: FlatLight, fields: _Float32s, firsts: _Int64s, s: _Float32s, pack: FlatLight, chord: bool
) -> None:
    """Copy the state of parts to the front of a scratch block `s`, and their light to `pack`; no rate if `chord`."""
    for j in range(firsts.size):
        to, at = j * PART, state.slot(firsts[j])
        _copy_values(frame.light, firsts[j], pack.light[to : to + PART])
        if not chord:
            _copy_values(frame.rate, firsts[j], pack.rate[to : to + PART])
        for row in range(0, FIELDS * BLOCK, BLOCK):
            _copy(fields[at + row : at + row + PART], s[to + row : to + row + PART])


@kernel
def scatter_parts(s: _Float32s, fields: _Float32s, firsts: _Int64s, few: bool) -> None:
    """Copy the state that a step may have changed from a scratch block back; `few`: that of few sensors as well."""
    for j in range(firsts.size):
        begin, at = j * PART, state.slot(firsts[j])
        for row in _MOVED:
            _copy(s[begin + row : begin + row + PART], fields[at + row : at + row + PART])
        if few:
            for row in _MOVED_IN_FEW:
                _copy(s[begin + row : begin + row + PART], fields[at + row : at + row + PART])
