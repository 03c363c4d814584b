"""Certificates: until when, and within which limits, a visited pixel takes little of what is left of its drawn number.

The quiet pass tests them in place of the thresholds (`Field`), so a pixel that noise does not fire costs as little as
one without noise. What a pixel took of its number while it rested is booked at its next visit (`visiting.book_rest`).

    moving light    limits at which a bound of the hazard, 1/4 + .6 nu times rate e^(-c^2 / 2), takes a share of what is
                    left until the pixel comes to them
    still light     until the hazard has taken almost all of it: the next event is known in advance

Behind a high-pass there is no certificate for still light, as its output still moves.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.integral import ONE_POLE, pair_factors, rate_of, slice_of
from emulator.sensor.noise.moments import noise_in, slower_rate
from emulator.sensor.numerics.columns import put, take
from emulator.sensor.numerics.compiled import Real, lane, vector_kernel
from emulator.sensor.numerics.elementary import exponential, natural_log, use_widest_vectors
from emulator.sensor.pixels.passages.rows import Visit, speed_at, value_at
from emulator.sensor.pixels.passages.visiting import Constants, curve_of_visit

_Float32s = npt.NDArray[np.float32]

_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
_ENDLESS = np.float32(np.inf)
_TAKEN, _OTHER = (
    np.float32(0.8),
    np.float32(0.1),
)  # of what is left, by the bound, while moving light comes to its limits
_LITTLE, _ALMOST = np.float32(0.2), np.float32(0.95)  # of it, in a burst, and while light stands still
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
_TINY, _LEAST_HZ = np.float32(1e-30), np.float32(1e-12)


@lane
def _limit(steep: Real, hz: Real, nearest: Real) -> Real:
    """Return the deviations at which a bound of a hazard, steep e^(-c^2 / 2), has come to a rate."""
    return max(np.sqrt(max(_TWO * natural_log(max(steep / hz, _ONE)), _ZERO)), nearest)


@vector_kernel
def certify(rows: _Float32s, tables: _Float32s, n: int, c: Constants) -> None:  # noqa: PLR0915
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
            min(max(_LEAVES * sigma * (ahead - limit) / max(abs(moving), _TINY), span), longest)
            if moves & ~ample
            else longest
        )
        limit = _limit(steep, _TAKEN * left / lasts, least)
        lasts = (
            min(max(_LEAVES * sigma * (ahead - limit) / max(abs(moving), _TINY), span), longest)
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
        still_s = min(_ALMOST * left / max(hz * noise.rate, _LEAST_HZ), horizon)
        still_s = min(still_s, _DRIFTS * noise.sigma / max(drift, _TINY))
        slack = _TWO * _STILL * noise.sigma + _ROUNDED * abs(offset)
        put(rows, Visit.ON_LIMIT + j, slack + offset + drift * still_s if quiet else on_limit)
        put(rows, Visit.OFF_LIMIT + j, slack - offset if quiet else off_limit)
        put(rows, Visit.SPEED + j, -_TWO * _STILL * noise.sigma / _LONGEST_S if quiet else speed)
        armed = reference == reference
        lasts = still_s if quiet else (lasts if holds else -_ENDLESS)
        put(rows, Visit.LASTS + j, lasts if armed & (calm | ~recent) else -_ENDLESS)
