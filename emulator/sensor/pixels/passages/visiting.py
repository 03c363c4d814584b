"""Visits of pixels: what their hazard has taken since the last one, and in which of them an event may come in a piece.

A pixel rests while its certificate holds. At its next visit the integral over the rest is booked as
that of a straight way from the value then to the value now, with today's noise: the certificate bounds it, and for
light that stands still, or that moves evenly, this is exact.

`look` integrates a whole piece for all pixels at once. Most of them have no event, which costs a pixel two dozen
look-ups. The others go to columns: those whose integral reaches what is left, which turn near a threshold, in which
both thresholds take much, which are in a burst, or whose noise changes with the light.

A certificate is a time and limits within which a pixel takes little of what is left of its drawn number. The
quiet pass tests them in place of the thresholds (`Field`), so a pixel that noise does not fire costs as little as one
without noise. What it took while it rested is booked at its next visit.

    moving light    limits at which a bound of the hazard, 1/4 + .6 nu times rate e^(-c^2 / 2), takes a share of what is
                    left until the pixel comes to them
    still light     until the hazard has taken almost all of it: the next event is known in advance

Behind a high-pass there is no certificate for still light, as its output still moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import FARTHEST, ONE_POLE, pair_factors, rate_of, slice_of
from emulator.sensor.noise.moments import Noise, noise_in, slower_rate
from emulator.sensor.numerics.columns import Packed, pick, put, take
from emulator.sensor.numerics.compiled import Real, lane, vector_kernel
from emulator.sensor.numerics.elementary import exponential, natural_log, use_widest_vectors
from emulator.sensor.pixels.passages.bursts import LASTS, mean_factor
from emulator.sensor.pixels.passages.rows import BURST, PART, Column, Curve, Visit, speed_at, value_at
from emulator.sensor.pixels.passages.settled import Ends, Span, Widening, both_count, integral_of, integrals

_Float32s = npt.NDArray[np.float32]
_Int32s = npt.NDArray[np.int32]

_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(x) for x in (0, 0.5, 1, 2, 3))
_ALMOST = np.float32(0.98)  # of what is left: nearer to it, the column decides
_CHANGES = np.float32(0.1)  # of a rate over a piece, from which on its noise changes along it
_TINY, _THIRD = np.float32(1e-9), np.float32(1 / 3)
_KEPT = np.float32(0.02)  # of what is left: a rest takes no more than the other part
# Of certificates.
_ENDLESS = np.float32(np.inf)
_TAKEN, _OTHER = (
    np.float32(0.8),
    np.float32(0.1),
)  # of what is left, by the bound, while moving light comes to its limits
_LITTLE, _UNTIL_DUE = np.float32(0.2), np.float32(0.95)  # of it, in a burst, and while light stands still
_FORGOTTEN = np.float32(10)  # times of the slower pole after which a reset is forgotten
_FEW_STEPS = np.float32(4)  # of a certificate before that, at least
_KICK = np.float32(0.4)  # of the mean of the noise by its slope at the reset, at most, over slope / rate
_SLOW, _FASTER = np.float32(0.1), np.float32(2)  # least speed of a certificate; its speed over the present one
_COMES = np.float32(0.25)  # deviations that a pixel may come nearer
_SWIFTER = np.float32(2.5)  # over the bound of the present one
_NEAREST, _NEAREST_SETTLED = np.float32(1.5), np.float32(0.75)  # deviations from which on the bound holds
_CROSSINGS, _CARRIED = np.float32(0.25), np.float32(0.6)
_FARTHEST = np.float32(30)  # deviations at which a hazard is still a number
_ANY_SPEED, _AMPLE = np.float32(9.5), np.float32(12.5)  # limits of a pixel so far away that its speed does not matter
_LONGEST_S, _LONGEST_STEPS = np.float32(2.0**33 * 1e-9), np.float32(256)
_LEAVES = np.float32(1.5)  # over the time in which a pixel leaves its limits at its present speed
_STILL = np.float32(0.05)  # deviations that the value of a pixel at rest may move in the longest time
_DRIFTS = np.float32(0.1)  # deviations that leak may move it
_ROUNDED = np.float32(1e-6)  # share of a number, more than float32 rounds
_SLOWEST = np.float32(0.1)  # 1/s: forgets in more than the longest time
_LEAK = np.float32(1.5)  # of it, that the quiet test allows
_LEAST_SPEED, _LEAST_HZ = np.float32(1e-30), np.float32(1e-12)


class Constants(NamedTuple):
    """Constants of a step that its noise needs, from `StepConstants`, in float32."""

    pole: np.float32
    high: np.float32
    dead_s: np.float32


@lane
def curve_of_visit(rows: _Float32s, j: int) -> Curve:
    """Return the curve of visited pixel j."""
    return Curve(take(rows, Visit.C1 + j), take(rows, Visit.C2 + j), take(rows, Visit.C3 + j))


@lane
def in_pieces(noise: Noise, span: Real) -> Noise:
    """Return a noise with rates in units of a piece of `span` seconds."""
    return Noise(noise.sigma, noise.rate * span, noise.z, noise.apart, noise.a1 * span, noise.a2 * span)


@vector_kernel
def book_rest(rows: _Float32s, tables: Packed, n: int, c: Constants) -> None:
    """Lessen what is left of each visited pixel by the integral of the time in which it rested."""
    use_widest_vectors()
    for j in range(n):
        span, rested = take(rows, Visit.SPAN + j), take(rows, Visit.RESTED + j)
        left = take(rows, Visit.LEFT + j)
        noise = in_pieces(noise_in(take(rows, Visit.RATE0 + j), c.pole, take(rows, Visit.RMS + j), c.high), span)
        reference, seen = take(rows, Visit.REFERENCE + j), take(rows, Visit.SEEN + j)
        on, off = take(rows, Visit.ON + j), take(rows, Visit.OFF + j)
        inverse = _ONE / noise.sigma
        k, q = slice_of(noise.z), max(rested * noise.rate, _TINY)
        on0, on1, off0, off1 = (
            (on - seen) * inverse,
            (on + reference) * inverse,
            (off + seen) * inverse,
            (off - reference) * inverse,
        )
        nu = (on0 - on1) / q
        rests = (rested > _ZERO) & (reference == reference)
        of_on = integral_of(tables, k, noise.apart, Ends(on0, on1, nu, nu, _ZERO, _ZERO), q, rests)
        of_off = integral_of(tables, k, noise.apart, Ends(off0, off1, -nu, -nu, _ZERO, _ZERO), q, rests)
        c_on, c_off = _HALF * (on0 + on1), _HALF * (off0 + off1)
        on_factor, off_factor = pair_factors(tables, c_on, c_off, noise.z, _ONE, rests)
        taken = of_on.value * on_factor + of_off.value * off_factor
        # After a recent reset the mean of the noise lessens the hazard, see `bursts.bound_of`.
        slow, n_r = slower_rate(noise), take(rows, Visit.N + j)
        age1 = -take(rows, Visit.RESET + j) * slow
        age0 = max(age1 - rested * slow, _ZERO)
        lessened = mean_factor(min(c_on, c_off), (-n_r if c_on < c_off else n_r) * inverse, age0, age1)
        taken *= lessened if age0 < LASTS else _ONE
        put(rows, Visit.LEFT + j, max(left - taken, _KEPT * left) if rests else left)


@vector_kernel
def look(rows: _Float32s, tables: Packed, n: int, c: Constants) -> None:
    """Book the integral of a piece for each visited pixel, or flag it. The noise is that of the piece's middle."""
    use_widest_vectors()
    for j in range(n):
        reference, left, reset = (
            take(rows, Visit.REFERENCE + j),
            take(rows, Visit.LEFT + j),
            take(rows, Visit.RESET + j),
        )
        rate0, rate1 = take(rows, Visit.RATE0 + j), take(rows, Visit.RATE1 + j)
        rms = take(rows, Visit.RMS + j)
        span, middle = take(rows, Visit.SPAN + j), _HALF * (rate0 + rate1)
        noise = in_pieces(noise_in(middle, c.pole, rms, c.high), span)
        # The chord of sigma behind two poles, by its derivative: sigma^2 is rms^2 a2 / (a1 + a2).
        widens = -_HALF * noise.sigma * (rate1 - rate0) / (middle + c.pole) if noise.z < ONE_POLE else _ZERO
        widening, curve = Widening(noise.sigma - _HALF * widens, widens), curve_of_visit(rows, j)
        on, off = take(rows, Visit.ON + j) + reference, take(rows, Visit.OFF + j) - reference
        alive = reset < _ONE  # the dead time ends in this piece, or has ended
        pair = integrals(tables, curve, Span(_ZERO, _ONE, on, off), widening, noise, alive)
        total = pair.on_value + pair.off_value
        # A curve that turns may come nearer than its ends: it stays within its Bernstein coefficients.
        b1, b2 = _THIRD * curve.c1, _THIRD * (_TWO * curve.c1 + curve.c2)
        b3 = curve.c1 + curve.c2 + curve.c3
        highest, lowest = max(max(b1, b2), max(b3, _ZERO)), min(min(b1, b2), min(b3, _ZERO))
        is_near = min(on - highest, off + lowest) < FARTHEST * (noise.sigma + _HALF * abs(widens))
        end = curve.c1 + _TWO * curve.c2 + _THREE * curve.c3
        turns = (curve.c1 * end < _ZERO) | (curve.c1 * (curve.c1 + curve.c2) < _ZERO)
        changes = abs(rate1 - rate0) > _CHANGES * middle
        in_burst = -reset * slower_rate(noise) < LASTS
        settled = (total < _ALMOST * left) & ~both_count(pair) & ~(is_near & (turns | changes))
        quiet = settled & ~in_burst
        put(rows, Visit.FLAG + j, _ZERO if quiet | ~alive else _ONE)
        put(rows, Visit.LEFT + j, left - total if quiet & alive else left)


@vector_kernel
def fill(rows: _Float32s, visits: _Float32s, listed: _Int32s, n: int, c: Constants) -> None:  # noqa: PLR0915
    """Set up columns for the listed pixels, with the noise at both ends of the piece, and the turns of the curve."""
    use_widest_vectors()
    for i in range(n):
        j = take(listed, i)
        c1, c2 = pick(visits, Visit.C1, j), pick(visits, Visit.C2, j)
        c3 = pick(visits, Visit.C3, j)
        span, rms = pick(visits, Visit.SPAN, j), pick(visits, Visit.RMS, j)
        rate0, rate1 = pick(visits, Visit.RATE0, j), pick(visits, Visit.RATE1, j)
        n0 = in_pieces(noise_in(rate0, c.pole, rms, c.high), span)
        n1 = in_pieces(noise_in(rate1, c.pole, rms, c.high), span)
        # Where the poles change from two to one, those of the middle hold for the whole piece.
        middle = in_pieces(noise_in(_HALF * (rate0 + rate1), c.pole, rms, c.high), span)
        alike = (n0.z > ONE_POLE) == (n1.z > ONE_POLE)
        a_sigma, b_sigma = n0.sigma if alike else middle.sigma, n1.sigma if alike else middle.sigma
        a_rate, b_rate = n0.rate if alike else middle.rate, n1.rate if alike else middle.rate
        a_z, b_z = n0.z if alike else middle.z, n1.z if alike else middle.z
        apart = n0.apart if alike else middle.apart
        a_a1, b_a1 = n0.a1 if alike else middle.a1, n1.a1 if alike else middle.a1
        a_a2, b_a2 = n0.a2 if alike else middle.a2, n1.a2 if alike else middle.a2
        single = a_z > ONE_POLE
        slowest = min(a_rate, b_rate) if single else min(min(a_a1, b_a1), min(a_a2, b_a2))
        # The turns: the larger root first, without cancellation, the other one from the product of both.
        last, half = c1 + _TWO * c2 + _THREE * c3, c1 + c2
        square = c2 * c2 - _THREE * c3 * c1
        root = np.sqrt(max(square, _ZERO))
        pair = -(c2 + (root if c2 > _ZERO else -root))
        x1, x2 = pair / (_THREE * c3), c1 / pair
        turns = (min(min(c1, half), last) < _ZERO) & (max(max(c1, half), last) > _ZERO) & (square > _ZERO)
        x1 = x1 if turns & (x1 > _ZERO) & (x1 < _ONE) else _ONE
        x2 = x2 if turns & (x2 > _ZERO) & (x2 < _ONE) else _ONE
        # A pixel whose dead time ends in the piece takes its reference there.
        reset, noise_there = pick(visits, Visit.RESET, j), pick(visits, Visit.N, j)
        x, burst = max(reset, _ZERO), LASTS / slowest
        stored = pick(visits, Visit.REFERENCE, j)
        armed = ((c3 * x + c2) * x + c1) * x + noise_there + take(rows, Column.OFFSET + i)
        put(rows, Column.STATE + i, BURST if reset + burst > _ZERO else PART)
        put(rows, Column.C1 + i, c1)
        put(rows, Column.C2 + i, c2)
        put(rows, Column.C3 + i, c3)
        put(rows, Column.TURN + i, min(x1, x2))
        put(rows, Column.TURN2 + i, max(x1, x2))
        put(rows, Column.ON + i, pick(visits, Visit.ON, j))
        put(rows, Column.OFF + i, pick(visits, Visit.OFF, j))
        put(rows, Column.SIGMA + i, a_sigma)
        put(rows, Column.D_SIGMA + i, b_sigma - a_sigma)
        put(rows, Column.RATE + i, a_rate)
        put(rows, Column.D_RATE + i, b_rate - a_rate)
        put(rows, Column.A1 + i, a_a1)
        put(rows, Column.D_A1 + i, b_a1 - a_a1)
        put(rows, Column.A2 + i, a_a2)
        put(rows, Column.D_A2 + i, b_a2 - a_a2)
        put(rows, Column.Z + i, a_z)
        put(rows, Column.D_Z + i, b_z - a_z)
        put(rows, Column.APART + i, apart)
        put(rows, Column.BURST + i, burst)
        put(rows, Column.DEAD + i, c.dead_s / span)
        put(rows, Column.LATE + i, _ZERO)
        put(rows, Column.SPAN + i, span)
        put(rows, Column.REFERENCE + i, stored if stored == stored else armed)
        put(rows, Column.LEFT + i, pick(visits, Visit.LEFT, j))
        put(rows, Column.N + i, noise_there)
        put(rows, Column.V + i, pick(visits, Visit.V, j) * span)
        put(rows, Column.RESET + i, reset)
        put(rows, Column.AT + i, x)
        put(rows, Column.LIMIT + i, _TWO)


@lane
def _limit(steep: Real, hz: Real, nearest: Real) -> Real:
    """Return the deviations at which a bound of a hazard, steep e^(-c^2 / 2), has come to a rate."""
    return max(np.sqrt(max(_TWO * natural_log(max(steep / hz, _ONE)), _ZERO)), nearest)


@vector_kernel
def certify(rows: _Float32s, tables: Packed, n: int, c: Constants) -> None:  # noqa: PLR0915
    """Write the certificate of each visited pixel at the end of its piece."""
    use_widest_vectors()
    for j in range(n):
        reference, left = take(rows, Visit.REFERENCE + j), take(rows, Visit.LEFT + j)
        span = take(rows, Visit.SPAN + j)
        rate, rms = take(rows, Visit.RATE1 + j), take(rows, Visit.RMS + j)
        curve = curve_of_visit(rows, j)
        leak, lit = take(rows, Visit.LEAK + j), take(rows, Visit.LIT + j)
        value, moving = value_at(curve, _ONE), speed_at(curve, _ONE) / span - leak
        noise = noise_in(rate, c.pole, rms, c.high)
        # What the noise's mean may still use up of the room, if a reset is not forgotten.
        slow = slower_rate(noise)
        age = (_ONE - take(rows, Visit.RESET + j)) * span * slow
        fading = exponential(-age)
        n_r, v_r = take(rows, Visit.N + j), take(rows, Visit.V + j)
        recent = age < _FORGOTTEN
        kick = abs(v_r) / noise.rate * (_KICK if age < _ONE else age * fading) if recent else _ZERO
        # It keeps the other threshold away for some time, at least as long as the slower pole lets it.
        mean = (_ONE + age) * fading if recent else _ZERO
        horizon = max(_ONE / slow, _FEW_STEPS * span) if recent else _LONGEST_S
        kept = fading * exponential(-slow * horizon) if recent else _ZERO
        up, down = max(n_r, _ZERO), max(-n_r, _ZERO)
        offset = value - reference
        on, off = take(rows, Visit.ON + j) - offset, take(rows, Visit.OFF + j) + offset
        on_room, off_room = on - up * mean + down * kept - kick, off - down * mean + up * kept - kick
        # Light that falls may make the noise louder, no more than behind the receptor alone.
        single = (c.pole == _ZERO) | (rate > np.float32(1e11))
        slower = _ZERO if single else noise.a1 / (noise.a1 + noise.a2)
        behind = c.high / (rate + c.high) if c.high > _ZERO else _ZERO
        reach = _TWO * max(on_room, off_room) if c.high > _ZERO else max(off_room, _ZERO)
        fixed = single & (c.high == _ZERO)
        sigma = noise.sigma if fixed else min(noise.sigma * (_ONE + _HALF * max(slower, behind) * reach), rms)
        # Moving light.
        moves = abs(moving) * _LONGEST_S > _STILL * noise.sigma
        unit = sigma * noise.rate
        nu = max(_SLOW, max(_FASTER * abs(moving), _SWIFTER * take(rows, Visit.FASTEST + j)) / unit)
        c_on, c_off = min(on_room / sigma, _FARTHEST), min(off_room / sigma, _FARTHEST)
        nearest = _NEAREST if recent else _NEAREST_SETTLED
        of_one = _HALF * (_ONE + max(c_on, c_off) + nu)
        steep = noise.rate * (_CROSSINGS + _CARRIED * nu if noise.z < ONE_POLE else of_one)
        ample = (c.high == _ZERO) & (min(c_on, c_off) > _AMPLE)
        least = _ANY_SPEED if ample else nearest
        longest_moving = min(_ONE / max(c.high, _SLOWEST), _LONGEST_STEPS * span)
        longest = min(longest_moving, horizon) if moves else horizon
        rises = moving > _ZERO
        ahead, behind = c_on if rises else c_off, c_off if rises else c_on
        # No longer than a pixel may stay that comes nearer by a margin.
        comes_ahead, comes_behind = max(ahead - _COMES, nearest), max(behind - _COMES, nearest)
        bounded = min(
            _TAKEN * exponential(_HALF * comes_ahead * comes_ahead),
            _OTHER * exponential(_HALF * comes_behind * comes_behind),
        )
        longest = longest if ample else min(longest, max(bounded * left / steep, span))
        # The longer a rest, the nearer must its limits be, and the sooner the pixel comes to them: two steps to a
        # balance.
        lasts = longest
        limit = _limit(steep, _TAKEN * left / lasts, least)
        lasts = (
            min(max(_LEAVES * sigma * (ahead - limit) / max(abs(moving), _LEAST_SPEED), span), longest)
            if moves & ~ample
            else longest
        )
        limit = _limit(steep, _TAKEN * left / lasts, least)
        lasts = (
            min(max(_LEAVES * sigma * (ahead - limit) / max(abs(moving), _LEAST_SPEED), span), longest)
            if moves & ~ample
            else longest
        )
        limit = _limit(steep, _TAKEN * left / lasts, least)
        farther = _limit(steep, _OTHER * left / lasts, least)
        on_least, off_least = limit if rises else farther, farther if rises else limit
        holds = (c_on > on_least) & (c_off > off_least)
        on_limit, off_limit = on_room + offset - sigma * on_least, off_room - offset - sigma * off_least
        fastest = _ENDLESS if ample else nu * unit
        speed = fastest if moves | (c.high == _ZERO) else _ZERO
        # Still light: a filter that settles may still move the value by little, and leak too.
        quiet = (take(rows, Visit.STILL + j) > _ZERO) & (c.high == _ZERO)
        quiet = quiet & (abs(moving - lit) * _LONGEST_S <= _STILL * noise.sigma)
        inverse, k = _ONE / noise.sigma, slice_of(noise.z)
        drift = _LEAK * (leak + lit)
        # The ON threshold is taken where leak will have brought it: a rest never takes more than is left.
        still_on = on * inverse - min(_DRIFTS, drift * _LONGEST_S * inverse)
        still_off = off * inverse
        used = quiet | recent
        on_factor, off_factor = pair_factors(tables, still_on, still_off, noise.z, _ONE, used)
        speed_now = moving * inverse / noise.rate
        hz = rate_of(tables, k, noise.apart, still_on, speed_now, used) * on_factor
        hz += rate_of(tables, k, noise.apart, still_off, -speed_now, used) * off_factor
        # What a rest after a recent reset takes is known less well: all of a burst must take little.
        calm = hz * noise.rate * (_FORGOTTEN - age) / slow < _LITTLE * left
        still_s = min(_UNTIL_DUE * left / max(hz * noise.rate, _LEAST_HZ), horizon)
        still_s = min(still_s, _DRIFTS * noise.sigma / max(drift, _LEAST_SPEED))
        slack = _TWO * _STILL * noise.sigma + _ROUNDED * abs(offset)
        put(rows, Visit.ON_LIMIT + j, slack + offset + drift * still_s if quiet else on_limit)
        put(rows, Visit.OFF_LIMIT + j, slack - offset if quiet else off_limit)
        put(rows, Visit.SPEED + j, -_TWO * _STILL * noise.sigma / _LONGEST_S if quiet else speed)
        armed = reference == reference
        lasts = still_s if quiet else (lasts if holds else -_ENDLESS)
        put(rows, Visit.LASTS + j, lasts if armed & (calm | ~recent) else -_ENDLESS)
