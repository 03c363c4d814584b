"""The time shortly after a reset, when the noise is near the value at which it left: a burst of events may follow.

A burst lasts 9 times of the slower pole, and each of its parts between turns of the curve is first bounded
(`bound_of`):

    calm      a bound of its integral is below .9 (one pole: .5) of what is left: the settled hazard, which the noise's
              mean lessens by e^(-A e^-s) at the age s, counts for as long as the integral of that factor, by E1
    fast      the curve passes a threshold swiftly: `direct` finds the c = c* from afar, with the distances, speed and
              poles of that age
    other     slices between ages .35, .8, 1.4, 2.2, 3.3, 5 and 9: exact distances and speeds at both ends, and a
              parabola of the hazard in time, by one more look-up in the middle; the first one, and fast approaches,
              over the distance

All of it follows the exact mean and variance of the noise since the reset (`moments`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import (
    CERTAIN,
    FARTHEST,
    ONE_POLE,
    density_or_integral,
    farther,
    integral_beyond,
    pair_factors,
    place_of,
    rate_of,
    rho_of,
    slice_of,
    steeper_beyond,
)
from emulator.sensor.noise.moments import Nearness, Signal, Start, nearness, slower_rate
from emulator.sensor.numerics.columns import Packed, put, take
from emulator.sensor.numerics.compiled import Real, lane, vector_kernel
from emulator.sensor.numerics.elementary import exponential, natural_log, use_widest_vectors
from emulator.sensor.pixels.passages.rows import (
    BURST,
    CUT,
    DIRECT,
    DONE,
    FIRST,
    PART,
    PLACED,
    SEEK,
    SLICE,
    Column,
    chosen,
    curve_of,
    noise_at,
    replace,
    speed_at,
    value_at,
)
from emulator.sensor.pixels.passages.settled import Bracket, root_of

_Float32s = npt.NDArray[np.float32]

_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX, _NINE = (np.float32(x) for x in (0, 0.5, 1, 2, 3, 4, 6, 9))
_QUARTER, _EIGHTH, _SIXTH, _THIRD, _LIKELY = (np.float32(x) for x in (0.25, 0.125, 1 / 6, 1 / 3, 4 / 6))
LASTS = _NINE
"""Length of a burst, in times of the slower pole."""

_AGE1, _AGE2, _AGE3, _AGE4, _AGE5, _AGE6, _AGE7 = (np.float32(x) for x in (0.35, 0.8, 1.4, 2.2, 3.3, 5, 9))
_EARLY = np.float32(2.5)  # age up to which the first of two bounds holds
_KICK, _LATER_KICK = np.float32(0.4), np.float32(0.2)  # of slope and value, left at most
_LATER = np.float32(0.29)
_CROSSINGS, _CARRIED = np.float32(0.25), np.float32(0.6)  # Rice's rate, bounded: .25 by the noise, .6 by the travel
_NEAREST = np.float32(1.5)  # deviations from which on the bounds hold
_NEGLIGIBLE, _LEAST_SHARE = np.float32(0.01), np.float32(0.01)
_CALM = np.float32(0.9)  # of what is left, below which a bound is calm
_CLOSER, _LEAST_DEFICIT = np.float32(0.75), np.float32(1e-6)
_E0, _E1, _E2, _E3, _E4, _E5 = (
    np.float32(x) for x in (-0.57721566, 0.99999193, -0.24991055, 0.05519968, -0.00976004, 0.00107857)
)
_N0, _N1, _D0, _D1 = (np.float32(x) for x in (0.250621, 2.334733, 1.681534, 3.330657))
_PASSED, _APART = np.float32(-2), np.float32(6)  # deviations of a fast approach behind its threshold, and to the other
_BEGUN, _NO_AGE = np.float32(1e-7), np.float32(1e-9)
_NEXT_AGE, _LEAST_AGE = np.float32(1.001), np.float32(1e-5)  # so that a slice has a length
_AFAR = np.float32(1e3)
_FAST, _FAST_END = np.float32(0.5), np.float32(0.1)
_FAST_TRAVEL = np.float32(0.8)
_LEAST_START, _LEAST_NU = np.float32(0.05), np.float32(0.02)
_BEYOND, _UNRESOLVED = np.float32(-4), np.float32(16)
_STEADY_OF_ONE = np.float32(3)
_HALVED, _MOST_HALVINGS = np.float32(0.08), np.float32(4)
_SHORTEST = np.float32(0.05)
_LEAST_HAZARD = np.float32(1e-30)
_STEEP, _STILL_STEEP = np.float32(0.7), np.float32(0.4)
_CONVERGED = np.float32(0.3)
_RESOLVED, _FASTEST = np.float32(4e-7), np.float32(1e3)
_BEND_C, _BEND_NU = np.float32(1.5), np.float32(0.25)
_ON, _OFF = np.float32(1), np.float32(2)  # bits of TELESCOPED


@lane
def exponential_integral(u: Real) -> Real:
    """Return E1(u), u > 0, within 1e-4 (Hastings 1955; Abramowitz and Stegun 5.1.53, 5.1.54)."""
    small = min(u, _ONE)
    closeness = ((((_E5 * small + _E4) * small + _E3) * small + _E2) * small + _E1) * small + _E0 - natural_log(small)
    large = max(u, _ONE)
    distant = exponential(-large) * (large * (large + _N1) + _N0) / ((large * (large + _D1) + _D0) * large)
    return closeness if u < _ONE else distant


@lane
def mean_factor(c: Real, inward: Real, age0: Real, age1: Real) -> Real:
    """Return the mean factor of a settled hazard between two ages: while the noise's mean decays, it is e^(-A e^-s).

    `c` is the nearer threshold's distance, `inward` by how much the noise was farther from it at the reset.
    """
    deficit = max((_TWO * max(inward, _ZERO) + _CLOSER * c) * c, _LEAST_DEFICIT)
    later, earlier = (
        exponential_integral(deficit * exponential(-age1)),
        exponential_integral(deficit * exponential(-age0)),
    )
    return (later - earlier) / max(age1 - age0, _LEAST_DEFICIT)


class Bound(NamedTuple):
    """The bound of a part of a burst."""

    calm: Real
    settles: Real  # time from which on the settled hazard counts
    end: Real
    skipped: Real  # time up to which little can happen; -1: none
    fast: Real


@lane
def bound_of(rows: _Float32s, i: int, x: Real, reset: Real, reference: Real, left: Real, start: Start) -> Bound:  # noqa: PLR0913, PLR0917
    """Return the bound of column i's burst from x to the burst's end, or the end of the part between two turns."""
    turn, turn2 = take(rows, Column.TURN + i), take(rows, Column.TURN2 + i)
    curve = curve_of(rows, i)
    part_end = turn if x < turn else (turn2 if x < turn2 else _ONE)
    end = min(reset + take(rows, Column.BURST + i), part_end)
    noise, slow = noise_at(rows, i, _ZERO), slower_rate(noise_at(rows, i, x))
    on, off = take(rows, Column.ON + i) + reference, take(rows, Column.OFF + i) - reference
    inverse = _ONE / (noise.sigma + max(take(rows, Column.D_SIGMA + i), _ZERO))
    # Two phases, up to an age of 2.5 and behind it: the nearest that signal and mean of the noise come.
    w0, w2 = value_at(curve, x), value_at(curve, end)
    middle = min(max(x, reset + _EARLY / slow), end)
    w1 = value_at(curve, middle)
    kick = abs(start.v) / noise.rate * inverse
    up, down = max(start.n, _ZERO), min(start.n, _ZERO)
    c = min(on - max(w0, w1) - up, off + min(w0, w1) + down) * inverse - _KICK * kick
    later = min(on - max(w1, w2) - _LATER * up, off + min(w1, w2) + _LATER * down) * inverse - _LATER_KICK * kick
    gone, gone_later = abs(w1 - w0) * inverse, abs(w2 - w1) * inverse
    q, q_later = (middle - x) * noise.rate, (end - middle) * noise.rate
    two = noise.z < ONE_POLE
    weight = _CROSSINGS * q + _CARRIED * gone if two else _HALF * ((_ONE + c) * q + gone)
    weight_later = (
        _CROSSINGS * q_later + _CARRIED * gone_later if two else _HALF * ((_ONE + later) * q_later + gone_later)
    )
    closeness, near_later = min(max(c, _ZERO), _NINE), min(max(later, _ZERO), _NINE)
    early = weight * exponential(-_HALF * closeness * closeness)
    total = early + weight_later * exponential(-_HALF * near_later * near_later)
    distant = (c > _NEAREST) & (later > _NEAREST)
    # The settled hazard errs by a share of the bound: a part of a burst may take its share of half of what is left.
    share = max((end - x) / take(rows, Column.BURST + i), _LEAST_SHARE)
    calm = distant & (total < (_CALM if two else _HALF) * share * left)
    skips = distant & ~calm & (early < _NEGLIGIBLE * share * left) & (middle < end)
    # Calm: while the mean decays by e^-s, the hazard is less by e^(-A e^-s). As much of the part's end counts.
    c_on, c_off = (on - w2) * inverse, (off + w2) * inverse
    inward = (start.n + start.v / max(noise.rate, slow)) * inverse
    inward, age0 = -inward if c_on < c_off else inward, (x - reset) * slow
    age1 = (end - reset) * slow
    counts = mean_factor(min(c_on, c_off), inward, age0, age1) * (end - x)
    settles = min(max(end - counts, x), end)
    rises = w2 > w0
    passed, other = (on - w2 if rises else off + w2) * inverse, (off + w0 if rises else on - w0) * inverse
    return Bound(calm, settles, end, middle if skips else -_ONE, (passed < _PASSED) & (other > _APART))


class Next(NamedTuple):
    """State of a column whose burst was bounded, the time from which on it goes on, and whether it is at the reset."""

    state: Real
    x: Real
    begins: Real


@lane
def after_bound(bound: Bound, x: Real, reset: Real, burst: Real) -> Next:
    """Return how a column goes on at x, whose burst lasts `burst`."""
    begun = x > reset + _BEGUN
    goes_on = (bound.settles >= bound.end) & (bound.end < reset + burst)
    settled = DONE if bound.settles >= _ONE else (BURST if goes_on else PART)
    sliced = FIRST if (bound.skipped > _ZERO) | begun else SLICE
    state = settled if bound.calm else (DIRECT if bound.fast else sliced)
    from_x = x if bound.fast | (bound.skipped < _ZERO) else bound.skipped
    return Next(state, bound.settles if bound.calm else from_x, _ONE if state == SLICE else _ZERO)


@lane
def store_bound(rows: _Float32s, i: int, bound: Bound, after: Next, selected: Real) -> None:
    """Store how column i goes on in a burst."""
    replace(rows, Column.BURST_END + i, bound.end, selected)
    replace(rows, Column.SKIPPED + i, bound.skipped, selected)
    replace(rows, Column.BEGINS + i, after.begins, selected)
    replace(rows, Column.CUT_AT + i, _TWO, selected)
    replace(rows, Column.HALVINGS + i, _ZERO, selected)


@vector_kernel
def bound(rows: _Float32s, n: int) -> None:
    """Bound the next part of the burst of each column in state BURST."""
    use_widest_vectors()
    for i in range(n):
        state, x = take(rows, Column.STATE + i), take(rows, Column.AT + i)
        reset = take(rows, Column.RESET + i)
        selected = state == BURST
        start = Start(take(rows, Column.N + i), take(rows, Column.V + i))
        b = bound_of(rows, i, x, reset, take(rows, Column.REFERENCE + i), take(rows, Column.LEFT + i), start)
        after = after_bound(b, x, reset, take(rows, Column.BURST + i))
        put(rows, Column.STATE + i, after.state if selected else state)
        put(rows, Column.AT + i, after.x if selected else x)
        store_bound(rows, i, b, after, selected)


@lane
def near_at(rows: _Float32s, i: int, x: Real) -> Nearness:
    """Return distances and speeds of column i at a time after its reset."""
    noise, curve = noise_at(rows, i, x), curve_of(rows, i)
    w, reference = value_at(curve, x), take(rows, Column.REFERENCE + i)
    on, off = take(rows, Column.ON + i) + reference - w, take(rows, Column.OFF + i) - reference + w
    signal = Signal(on, off, speed_at(curve, x), -take(rows, Column.D_SIGMA + i) / noise.sigma)
    start = Start(take(rows, Column.N + i), take(rows, Column.V + i))
    closeness: Nearness = nearness(max(x - take(rows, Column.RESET + i), _NO_AGE), signal, start, noise)
    return closeness


class Point(NamedTuple):
    """A threshold at an instant: distance, speed, hazard over s."""

    c: Real
    nu: Real
    hazard: Real


class Along(NamedTuple):
    """Integral of a threshold over a slice, and the hazard in its middle."""

    value: Real
    middle: Real


@lane
def along(  # noqa: PLR0913, PLR0917
    tables: Packed, k: Real, apart: Real, a: Point, b: Point, q: Real, begins: Real, fast: Real, needed: Real
) -> Along:
    """Return a threshold's integral over a slice of q time constants from a to b; 0 if not `needed`.

    By one look-up either way: over the distance with the speed at b where the slice begins at the reset or is fast,
    else by Simpson's rule. Place and speed of the middle are those of the cubic through both ends.
    """
    over_distance = begins | fast
    c_middle = _HALF * (a.c + b.c) + _EIGHTH * q * (b.nu - a.nu)
    nu_middle = _BEND_C * (a.c - b.c) / q - _BEND_NU * (a.nu + b.nu)
    nu = (max(b.nu, _LEAST_START) if begins else b.nu) if over_distance else nu_middle
    c = b.c if over_distance else c_middle
    steep = _ONE + abs(nu)
    rho, at = nu / steep, c + farther(c, nu, apart)
    distant = a.c + farther(a.c, nu, apart)
    counted = needed & (min(a.c, b.c) < FARTHEST)
    value = density_or_integral(tables, over_distance, k, rho, at, counted)
    resolved = counted & over_distance & ~begins & ((a.c - b.c) * (a.c + b.c) < _UNRESOLVED)
    beyond = integral_beyond(tables, k, rho, distant, resolved)
    middle = value * steep * steeper_beyond(at)
    middle = middle if c < FARTHEST else _ZERO
    telescoped = CERTAIN if b.c < _BEYOND else (value - beyond) / rho
    total = telescoped if over_distance else q * _SIXTH * (a.hazard + _FOUR * middle + b.hazard)
    return Along(total if counted else _ZERO, middle)


@lane
def next_age(age: Real) -> Real:
    """Return the age at which the slice from `age` on ends."""
    late = _AGE5 if age < _AGE5 else (_AGE6 if age < _AGE6 else _AGE7)
    middle = _AGE3 if age < _AGE3 else (_AGE4 if age < _AGE4 else late)
    return _AGE1 if age < _AGE1 else (_AGE2 if age < _AGE2 else middle)


@vector_kernel
def slice_(rows: _Float32s, tables: Packed, n: int) -> None:  # noqa: PLR0915
    """Integrate the next slice of each column in state SLICE; of one in state FIRST, find the values at its start."""
    use_widest_vectors()
    for i in range(n):
        state = take(rows, Column.STATE + i)
        first = state == FIRST
        selected = (state == SLICE) | first
        x, reset = take(rows, Column.AT + i), take(rows, Column.RESET + i)
        last = take(rows, Column.BURST_END + i)
        cut_at, left = take(rows, Column.CUT_AT + i), take(rows, Column.LEFT + i)
        begins = take(rows, Column.BEGINS + i) > _ZERO
        slow, apart = slower_rate(noise_at(rows, i, x)), take(rows, Column.APART + i)
        # The slice: to the next of the ages. A slower pole that changes may bring the last one before the burst's end,
        # or the next one before x.
        age = (x - reset) * slow * _NEXT_AGE + _LEAST_AGE
        end = min(min(reset + next_age(age) / slow, cut_at), last)
        end = x if first else (end if (age < _AGE7) & (end > x) else last)
        # Distances, speeds and hazards at its end, the factor of two thresholds included.
        at_end = near_at(rows, i, end)
        k = slice_of(at_end.z)
        on1 = rate_of(tables, k, apart, at_end.c_on, at_end.nu_on, selected)
        off1 = rate_of(tables, k, apart, at_end.c_off, at_end.nu_off, selected)
        rise, variance = _HALF * (at_end.nu_on - at_end.nu_off), at_end.deviation * at_end.deviation
        share = variance * variance / (_ONE + rise * rise)
        on_factor, off_factor = pair_factors(tables, at_end.c_on, at_end.c_off, at_end.z, share, selected)
        on1, off1 = on1 * on_factor, off1 * off_factor
        # Both integrals, from the values at its start.
        slope0, z0 = take(rows, Column.SLOPE0 + i), take(rows, Column.Z0 + i)
        q = max(_ONE if begins else _HALF * (slope0 + at_end.slope) * (end - x), _NO_AGE)
        k = slice_of(at_end.z if begins | (at_end.z > ONE_POLE) else _HALF * (z0 + at_end.z))
        on_c0, off_c0 = take(rows, Column.ON_C0 + i), take(rows, Column.OFF_C0 + i)
        on_a = Point(_AFAR if begins else on_c0, take(rows, Column.ON_NU0 + i), take(rows, Column.ON_RATE0 + i))
        off_a = Point(_AFAR if begins else off_c0, take(rows, Column.OFF_NU0 + i), take(rows, Column.OFF_RATE0 + i))
        on_fast = (
            (max(on_a.nu, at_end.nu_on) > _FAST) & (at_end.nu_on > _FAST_END) & (on_a.c - at_end.c_on > _FAST_TRAVEL)
        )
        off_fast = (max(off_a.nu, at_end.nu_off) > _FAST) & (at_end.nu_off > _FAST_END)
        off_fast = off_fast & (off_a.c - at_end.c_off > _FAST_TRAVEL) & ~begins
        on_fast = on_fast & ~begins
        on = along(tables, k, apart, on_a, Point(at_end.c_on, at_end.nu_on, on1), q, begins, on_fast, selected)
        off = along(tables, k, apart, off_a, Point(at_end.c_off, at_end.nu_off, off1), q, begins, off_fast, selected)
        on_telescoped, off_telescoped = begins | on_fast, begins | off_fast
        in_middle = q * _LIKELY
        on_total = on.value * on_factor if on_telescoped else on.value + in_middle * on.middle * (on_factor - _ONE)
        off_total = (
            off.value * off_factor if off_telescoped else off.value + in_middle * off.middle * (off_factor - _ONE)
        )
        total, halvings = on_total + off_total, take(rows, Column.HALVINGS + i)
        # A first slice that takes much is halved, as its speed at the end stands for all of it.
        steady = max(at_end.nu_on, at_end.nu_off) < (_STEADY_OF_ONE if at_end.z > ONE_POLE else _ONE)
        steady = steady & (halvings < _MOST_HALVINGS)
        halved = begins & (total > _HALVED) & steady & ((end - x) * slow > _SHORTEST)
        fired = ~(total < left) & ~halved & ~first
        over = DONE if end >= _ONE else (PART if end >= reset + take(rows, Column.BURST + i) else BURST)
        after = SLICE if first | halved else (CUT if fired else (over if end >= last else SLICE))
        go, moves_on = selected & ~first & ~halved & ~fired, selected & ~halved & ~fired
        put(rows, Column.STATE + i, after if selected else state)
        put(rows, Column.AT + i, end if go else x)
        put(rows, Column.LEFT + i, left - total if go else left)
        put(rows, Column.CUT_AT + i, (_HALF * (x + end) if halved else _TWO) if selected else cut_at)
        put(rows, Column.HALVINGS + i, (halvings + _ONE if halved else _ZERO) if selected else halvings)
        replace(rows, Column.BEGINS + i, _ONE if begins & (halved | fired) else _ZERO, selected)
        replace(rows, Column.END + i, end, selected)
        replace(rows, Column.ON_INTEGRAL + i, on_total, selected)
        replace(rows, Column.OFF_INTEGRAL + i, off_total, selected)
        replace(rows, Column.ON_MIDDLE + i, on.middle, selected)
        replace(rows, Column.OFF_MIDDLE + i, off.middle, selected)
        bits = (_ON if on_telescoped else _ZERO) + (_OFF if off_telescoped else _ZERO)
        replace(rows, Column.TELESCOPED + i, bits, selected)
        # The values of its end are those of the next one's start.
        replace(rows, Column.ON_RATE0 + i, on1, moves_on)
        replace(rows, Column.OFF_RATE0 + i, off1, moves_on)
        replace(rows, Column.ON_C0 + i, at_end.c_on, moves_on)
        replace(rows, Column.OFF_C0 + i, at_end.c_off, moves_on)
        replace(rows, Column.ON_NU0 + i, at_end.nu_on, moves_on)
        replace(rows, Column.OFF_NU0 + i, at_end.nu_off, moves_on)
        replace(rows, Column.SLOPE0 + i, at_end.slope, moves_on)
        replace(rows, Column.Z0 + i, at_end.z, moves_on)
        replace(rows, Column.ON_RATE1 + i, on1, selected)
        replace(rows, Column.OFF_RATE1 + i, off1, selected)


@lane
def nearer_share(f: Real, h0: Real, p: Real, r: Real, sought: Real) -> Real:
    """Return a step of Newton's method for the share at which the integral of h0 + p x + r x^2 is `wanted`."""
    slope = max(h0 + (p + r * f) * f, _LEAST_HAZARD)
    return min(max(f - (((_THIRD * r * f + _HALF * p) * f + h0) * f - sought) / slope, _ZERO), _ONE)


class Seen(NamedTuple):
    """A threshold at the present guess of an event's time."""

    c: Real
    nu: Real
    slope: Real
    z: Real


@lane
def seen_at(closeness: Nearness, up: Real) -> Seen:
    """Return what an approach sees of one threshold."""
    return Seen(
        closeness.c_on if up else closeness.c_off,
        closeness.nu_on if up else closeness.nu_off,
        closeness.slope,
        closeness.z,
    )


@lane
def store_event(rows: _Float32s, i: int, closeness: Nearness, c: Real, nu: Real, selected: Real) -> None:
    """Store the noise of column i's event."""
    replace(rows, Column.C + i, c, selected)
    replace(rows, Column.NU + i, nu, selected)
    replace(rows, Column.SLOPE + i, closeness.slope, selected)
    replace(rows, Column.DEVIATION + i, closeness.deviation, selected)
    replace(rows, Column.PULL + i, closeness.pull, selected)
    replace(rows, Column.MEAN_SLOPE + i, closeness.mean_slope, selected)
    replace(rows, Column.EVENT_Z + i, closeness.z, selected)


@vector_kernel
def choose(rows: _Float32s, n: int) -> None:
    """Choose the polarity of each column in state CUT, and its time by the parabola of the hazard where it has one.

    In an approach, the values at the slice's end are the first guess of `seek`.
    """
    use_widest_vectors()
    for i in range(n):
        state, x = take(rows, Column.STATE + i), take(rows, Column.AT + i)
        end = take(rows, Column.END + i)
        selected, left = state == CUT, take(rows, Column.LEFT + i)
        on_integral = take(rows, Column.ON_INTEGRAL + i)
        total = on_integral + take(rows, Column.OFF_INTEGRAL + i)
        on = take(rows, Column.POLARITY + i) * total < on_integral
        bits = take(rows, Column.TELESCOPED + i)
        over_distance = (bits == _ON + _OFF) | (bits == (_ON if on else _OFF))
        of_on = _ONE if on else _ZERO
        h0 = chosen(rows, Column.ON_RATE0 + i, Column.OFF_RATE0 + i, of_on)
        middle = chosen(rows, Column.ON_MIDDLE + i, Column.OFF_MIDDLE + i, of_on)
        h1 = chosen(rows, Column.ON_RATE1 + i, Column.OFF_RATE1 + i, of_on)
        p, r = _FOUR * middle - _THREE * h0 - h1, _TWO * (h0 - _TWO * middle + h1)
        f = left / total
        sought = f * (h0 + _HALF * p + _THIRD * r)
        f = nearer_share(f, h0, p, r, sought)
        f = nearer_share(f, h0, p, r, sought)
        f = nearer_share(f, h0, p, r, sought)
        event = end if over_distance else x + f * (end - x)
        replace(rows, Column.EVENT + i, event, selected)
        replace(rows, Column.SIGN + i, _ONE if on else -_ONE, selected)
        closeness = near_at(rows, i, event)
        seen = seen_at(closeness, on)
        store_event(rows, i, closeness, seen.c, seen.nu, selected)
        put(rows, Column.STATE + i, (SEEK if over_distance else PLACED) if selected else state)


class Approach(NamedTuple):
    """An approach in a burst: c at its start, and the integral that is left there."""

    c0: Real
    left: Real
    apart: Real


class Target(NamedTuple):
    """The next guess with its bounds, the c of the event by the present speed, and whether Newton's step was used."""

    at: Bracket
    c: Real
    inside: Real


@lane
def nearer_event(tables: Packed, at: Bracket, seen: Seen, approach: Approach, needed: Real) -> Target:
    """Return a step of Newton's method for c(x) = c*; any if not `needed`."""
    nu, k = max(seen.nu, _LEAST_NU), slice_of(seen.z)
    rho = rho_of(nu)
    first = approach.c0 + farther(approach.c0, nu, approach.apart)
    before = integral_beyond(tables, k, rho, first, needed & (approach.c0 < FARTHEST))
    c = place_of(tables, k, rho, approach.left * rho + before, needed)
    c -= farther(c, nu, approach.apart)
    low, high = at.low if seen.c < c else at.x, at.x if seen.c < c else at.high
    x = at.x + (seen.c - c) / (nu * seen.slope)
    inside = (low <= x) & (x <= high)
    return Target(Bracket(x if inside else _HALF * (low + high), low, high), c, inside)


@vector_kernel
def seek(rows: _Float32s, tables: Packed, n: int) -> None:
    """Find the time of the event of each column in state SEEK, by four steps of Newton's method."""
    use_widest_vectors()
    for i in range(n):
        state = take(rows, Column.STATE + i)
        selected, up = state == SEEK, take(rows, Column.SIGN + i) > _ZERO
        c0 = chosen(rows, Column.ON_C0 + i, Column.OFF_C0 + i, _ONE if up else _ZERO)
        c0 = _AFAR if take(rows, Column.BEGINS + i) > _ZERO else c0
        approach = Approach(c0, take(rows, Column.LEFT + i), take(rows, Column.APART + i))
        seen = Seen(
            take(rows, Column.C + i),
            take(rows, Column.NU + i),
            take(rows, Column.SLOPE + i),
            take(rows, Column.EVENT_Z + i),
        )
        low, high = take(rows, Column.AT + i), take(rows, Column.END + i)
        at = Bracket(min(max(take(rows, Column.EVENT + i), low), high), low, high)
        at = nearer_event(tables, at, seen, approach, selected).at
        at = nearer_event(tables, at, seen_at(near_at(rows, i, at.x), up), approach, selected).at
        at = nearer_event(tables, at, seen_at(near_at(rows, i, at.x), up), approach, selected).at
        at = nearer_event(tables, at, seen_at(near_at(rows, i, at.x), up), approach, selected).at
        closeness = near_at(rows, i, at.x)
        seen = seen_at(closeness, up)
        replace(rows, Column.EVENT + i, at.x, selected)
        store_event(rows, i, closeness, seen.c, seen.nu, selected)
        put(rows, Column.STATE + i, PLACED if selected else state)


@vector_kernel
def direct(rows: _Float32s, tables: Packed, n: int) -> None:
    """Find the event of each column in state DIRECT by three steps of Newton's method, or leave it to slices."""
    use_widest_vectors()
    for i in range(n):
        state, x = take(rows, Column.STATE + i), take(rows, Column.AT + i)
        end = take(rows, Column.BURST_END + i)
        selected, curve = state == DIRECT, curve_of(rows, i)
        reset = take(rows, Column.RESET + i)
        w0, w1 = value_at(curve, x), value_at(curve, end)
        up = w1 > w0
        sign, reference = _ONE if up else -_ONE, take(rows, Column.REFERENCE + i)
        on_threshold, off_threshold = take(rows, Column.ON + i), take(rows, Column.OFF + i)
        level = reference + (on_threshold if up else -off_threshold)
        # The first guess is where the signal alone passes the level; there it must be fast.
        ahead = sign * (level - w0) >= _ZERO
        guess = min(max(x + (end - x) * (level - w0) / (w1 - w0), x), end)
        at = root_of(Bracket(guess, x, end), -level, curve)
        sigma = take(rows, Column.SIGMA + i) + max(take(rows, Column.D_SIGMA + i), _ZERO)
        good = sign * speed_at(curve, at.x) > _STEEP * take(rows, Column.RATE + i) * sigma
        # A signal that crosses all of the noise within the resolution of the time needs no more.
        passes, at_end = at.x, near_at(rows, i, at.x)
        swift = ahead & (sign * speed_at(curve, passes) * _RESOLVED > sigma * at_end.deviation)
        begun, closeness = x > reset + _BEGUN, near_at(rows, i, x)
        c0 = closeness.c_on if up else closeness.c_off
        approach = Approach(c0 if begun else _AFAR, take(rows, Column.LEFT + i), take(rows, Column.APART + i))
        at = Bracket(at.x, x, end)
        seen = seen_at(at_end, up)
        good = good & (seen.nu > _STILL_STEEP)
        at = nearer_event(tables, at, seen, approach, selected).at
        seen = seen_at(near_at(rows, i, at.x), up)
        good = good & (seen.nu > _STILL_STEEP)
        at = nearer_event(tables, at, seen, approach, selected).at
        closeness = near_at(rows, i, at.x)
        seen = seen_at(closeness, up)
        target = nearer_event(tables, at, seen, approach, selected)
        good = (good & (seen.nu > _STILL_STEEP) & target.inside & (abs(seen.c - target.c) < _CONVERGED)) | swift
        skipped = take(rows, Column.SKIPPED + i)
        skips = skipped > _ZERO
        replace(rows, Column.EVENT + i, passes if swift else target.at.x, selected)
        replace(rows, Column.SIGN + i, sign, selected)
        store_event(rows, i, closeness, _ZERO if swift else target.c, _FASTEST if swift else seen.nu, selected)
        replace(rows, Column.BEGINS + i, _ZERO if begun | skips else _ONE, selected)
        put(rows, Column.AT + i, skipped if selected & ~good & skips else x)
        put(rows, Column.STATE + i, (PLACED if good else (FIRST if begun | skips else SLICE)) if selected else state)
