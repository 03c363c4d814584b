"""The pixel step in float32: one quiet pass over every pixel, then work for the few that may fire.

The equations (photocurrent i relative to the reference light, u = ln i, natural logarithms throughout):

    rate      lambda = 2 pi f(i), f proportional to i within its bounds
    filter    dv/dt = lambda (u - v), or the large-signal law of `receptor`; if there is a second pole, then
              dw/dt = lambda2 (v - w), else w is v
    leak      the reference falls by l each second, and by the parasitic l' i; here the filtered value rises instead:
              g = w + l T + the parasitic part, T seconds since the epoch; the stored reference moves at events only
    high-pass if there is one: y = w - h, dh/dt = a (w - h), in place of w
    crossing  ON when g - reference >= threshold_on, OFF when <= -threshold_off

Between two frames u is the cubic through its values and time derivatives at both; the filter is solved over S, the
integral of lambda dt, as in `curve`, and so is the second pole.

A pixel's step is *quiet* when by bounds it cannot fire: v stays between v0 and v0 + q (U - v0), with q = 1 - e^-S and U
the highest (lowest) of u, which the cubic's Bernstein coefficients bound. Most are quiet and cost one pass of plain
arithmetic. A step is *smooth* when the cubic describes its light well: known slopes, less than 0.5 of change in log
light, no sign of unseen change between frames. One that is not quiet or not smooth goes to `candidates`.

These measures make it fast, as measured:

- State is kept in blocks of 512 pixels, field after field within a block (see `Field`), in one flat array. A block
  stays in the nearest caches with its scratch, and all its fields lie at distances known when compiled: LLVM gives up
  on a loop with many separate arrays, because it would have to check each pair for overlap.
- Loops run from 0 over BLOCK, a constant: no test for negative indices, no remainder, the same arithmetic at any place.
- Short loops instead of one long: their constants stay in registers.
- No integer arithmetic in vector loops (numba widens it to 64 bits); logarithm and exponential are polynomials
  (`elementary`), and `compiled` lists the compiler options that matter.
- Slopes are stored by warped time, which saves the divisions by the rate.
- The second pole and parasitic leak, which few sensors have, are loops of their own, entered once a block or never.
- The list of candidates is made without a branch, `flagged[k] = i; k += flag`, and only where a word of flags has any.
- Candidates are collected while their block is in the first cache, and solved in batches (`candidates`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import Real, kernel, lane, vector_kernel
from emulator.sensor.numerics.elementary import decay, lowest_bit, natural_log, use_widest_vectors
from emulator.sensor.pixels import curve, receptor
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, Field, StepConstants

_Float32s = npt.NDArray[np.float32]
_Int64s = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]

_U, _V, _L, _G, _REF, _ON, _OFF, _LEAK, _W, _P, *_CERTIFICATE, _Y = (int(f) * BLOCK for f in Field)
_ON_LIMIT, _OFF_LIMIT, _SPEED, _UNTIL = _CERTIFICATE
_U0, _V0, _L0, _G0, _A0, _A1, _S, _Q, _W0, _P0, _HIGH, _LOW, _Y0 = BEFORE_ROWS

_COLLECT = np.uint64(0x0102040810204080)
_NAN = np.float32(np.nan)
_ZERO, _ONE, _THREE, _HALF = (np.float32(x) for x in (0, 1, 3, 0.5))
_THIRD, _TWELFTH = np.float32(1 / 3), np.float32(1 / 12)
_BRIGHTEST = np.finfo(np.float32).max
_ENDLESS = np.float32(np.inf)
_MARGIN = np.float32(5e-6)  # rounding of the quiet test, ln units
_WIDER = np.float32(1.08)  # covers the error of S for the largest smooth change, bounds of the rate included
_MORE = np.float32(1.5)  # the same for the integral of light
_SHORT_LIVED = np.float32(3)  # length of a step, in time constants, from which the exponential counts as a part of it
_LEFT_OUT = np.float32(0.004)  # of a threshold: exponential that a high-pass may see without being solved with it
_FASTER = np.float32(1.65)  # slopes behind a filter whose rate changes, over those of its light
_BULGE = np.float32(1.2)  # ... and for light that is higher inside the step than at its ends: e^x < 1 + 1.2 x


@vector_kernel
def _take_light(light: _Float32s, rate: _Float32s, s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write each pixel's new log light (NaN where it is not finite), slope and rate; the old ones to scratch rows."""
    use_widest_vectors()
    for i in range(BLOCK):
        e, r = light[i], rate[i]
        lit = e > _ZERO
        current = (e if lit else _ZERO) + c.dark
        before[_U0 + i] = s[_U + i]
        before[_L0 + i] = s[_L + i]
        before[_G0 + i] = s[_G + i]
        rate_after = min(max(c.rate_at_reference * current, c.rate_min), c.rate_max)
        s[_U + i] = natural_log(current) if abs(e) <= _BRIGHTEST else _NAN
        s[_L + i] = rate_after
        # d ln i / ds; 0 * r keeps an unknown rate unknown
        s[_G + i] = (r if lit else _ZERO * r) / (current * rate_after)


@vector_kernel
def _take_light_alone(light: _Float32s, s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write a block's new log light as `_take_light` does, without a rate: the slopes are those of a straight line."""
    use_widest_vectors()
    for i in range(BLOCK):
        e = light[i]
        u0 = s[_U + i]
        l0 = s[_L + i]
        current = (e if e > _ZERO else _ZERO) + c.dark
        u1 = natural_log(current) if abs(e) <= _BRIGHTEST else _NAN
        l1 = min(max(c.rate_at_reference * current, c.rate_min), c.rate_max)
        slope = (u1 - u0) / (c.h * l0 * l1)  # one division for both ends
        before[_U0 + i] = u0
        before[_L0 + i] = l0
        before[_G0 + i] = slope * l1
        s[_U + i] = u1
        s[_L + i] = l1
        s[_G + i] = slope * l0


@vector_kernel
def _warp(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write each pixel's S, q = 1 - e^-S, and the slopes of u per step."""
    use_widest_vectors()
    for i in range(BLOCK):
        l0, l1 = before[_L0 + i], s[_L + i]
        a0, a1 = c.h * l0 * before[_G0 + i], c.h * l1 * s[_G + i]
        warped = curve.warped_time(c.h, l0, l1, a0, a1, c)
        before[_A0 + i], before[_A1 + i] = a0, a1
        before[_S + i], before[_Q + i] = warped, decay(warped)


@lane
def _course_at(i: int, s: _Float32s, before: _Float32s) -> curve.Course:
    """Return the course of a pixel's light over the step; the slopes are stored by warped time."""
    warped = before[_S + i]
    return curve.Course(warped, s[_U + i] - before[_U0 + i], warped * before[_G0 + i], warped * s[_G + i])


@vector_kernel
def _filter(s: _Float32s, before: _Float32s) -> None:
    """Write a block's new filtered values to the state, the old ones to the scratch rows."""
    use_widest_vectors()
    for i in range(BLOCK):
        v0 = s[_V + i]
        before[_V0 + i] = v0
        s[_V + i] = v0 + curve.rise_of_filter(before[_Q + i], before[_U0 + i] - v0, _course_at(i, s, before))


@lane
def _filter_bounds(q: Real, behind: Real, d: Real, a0: Real, a1: Real) -> tuple[Real, Real]:
    """Return bounds of the filtered value's rise and fall (<= 0), from the light's Bernstein coefficients."""
    # A cubic lies within its Bernstein coefficients 0, a0 / 3, d - a1 / 3 and d. The filter goes q of the way to the
    # highest (lowest) of them at most; `share` has a margin for the error of S.
    first, last = _THIRD * a0, d - _THIRD * a1
    end = max(d, _ZERO)
    top, bottom = max(end, max(first, last)), min(min(d, _ZERO), min(first, last))
    share = min(q * (_WIDER + _BULGE * (top - end)), _ONE)
    return share * max(behind + top, _ZERO), share * min(behind + bottom, _ZERO)


@vector_kernel
def _receive(s: _Float32s, before: _Float32s) -> None:
    """Write the outputs of the large-signal law and their bounds; a pixel far behind its light has no upper bound."""
    use_widest_vectors()
    for i in range(BLOCK):
        v0, q = s[_V + i], before[_Q + i]
        course = _course_at(i, s, before)
        behind = before[_U0 + i] - v0
        excess = receptor.excess_of(behind)
        before[_V0 + i] = v0
        s[_V + i] = v0 + receptor.rise_of_receptor(q, excess, course)
        rise, fall = receptor.bounds_of_receptor(q, behind, excess, course.d, before[_A0 + i], before[_A1 + i])
        before[_HIGH + i], before[_LOW + i] = (v0 + rise if behind < receptor.MOST_BEHIND else _ENDLESS), v0 + fall


@vector_kernel
def _bound(s: _Float32s, before: _Float32s) -> None:
    """Write bounds of a block's filtered values during the step, for the stages behind the filter."""
    use_widest_vectors()
    for i in range(BLOCK):
        u0, v0 = before[_U0 + i], before[_V0 + i]
        rise, fall = _filter_bounds(before[_Q + i], u0 - v0, s[_U + i] - u0, before[_A0 + i], before[_A1 + i])
        before[_HIGH + i], before[_LOW + i] = v0 + rise, v0 + fall


@lane
def _filtered_at(i: int, s: _Float32s, before: _Float32s, c: StepConstants) -> curve.Filtered:
    """Return the filter's course over the step, which the second pole follows."""
    v0, v1 = before[_V0 + i], s[_V + i]
    return curve.Filtered(before[_U0 + i] - v0, s[_U + i] - v1, v1 - v0, c.h * before[_L0 + i], c.h * s[_L + i])


@vector_kernel
def _add_second_pole(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write a block's output of the second pole to the state; its bounds replace those of the filter."""
    use_widest_vectors()
    q = decay(c.second)
    for i in range(BLOCK):
        v0, w0 = before[_V0 + i], s[_W + i]
        filtered = _filtered_at(i, s, before, c)
        before[_W0 + i] = w0
        s[_W + i] = w0 + curve.rise_behind_second_pole(q, v0 - w0, c.second, _course_at(i, s, before), filtered)
        # A low-pass stays between where it is and q of the way to the bounds of what it follows.
        before[_HIGH + i] = w0 + q * max(before[_HIGH + i] - w0, _ZERO)
        before[_LOW + i] = w0 + q * min(before[_LOW + i] - w0, _ZERO)


@vector_kernel
def _add_second_pole_of_receptor(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write the second pole behind the large-signal law; a pixel without a closed form has no upper bound."""
    use_widest_vectors()
    q = decay(c.second)
    for i in range(BLOCK):
        v0, w0 = before[_V0 + i], s[_W + i]
        filtered = _filtered_at(i, s, before, c)
        rise, inaccurate = receptor.rise_behind_second_pole_of_receptor(
            v0 - w0, c.second, _course_at(i, s, before), filtered
        )
        high = w0 + q * max(before[_HIGH + i] - w0, _ZERO)
        before[_W0 + i], s[_W + i] = w0, w0 + rise
        before[_HIGH + i] = high if inaccurate == _ZERO else _ENDLESS
        before[_LOW + i] = w0 + q * min(before[_LOW + i] - w0, _ZERO)


@lane
def _slopes_of_output(r0: Real, r1: Real, pull0: Real, pull1: Real, a0: Real, a1: Real) -> tuple[Real, Real, Real]:
    """Return the slopes of a filter at both ends of the step, and the weight of an exponential that these leave out.

    `pull` is the slope in time constants. A fast filter has the slopes of its input, a0 and a1, but for an exponential.
    """
    fast = min(r0, r1) > _SHORT_LIVED
    return (a0 if fast else r0 * pull0), (a1 if fast else r1 * pull1), (abs(pull0 - a0 / r0) if fast else _ZERO)


@vector_kernel
def _add_high_pass(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Write a block's output of the high-pass to the state; its bounds replace those of its input.

    Where an exponential counts, the pixel has no upper bound: it becomes a candidate, which is solved with that.
    """
    use_widest_vectors()
    q = decay(c.high)
    for i in range(BLOCK):
        v0, v1 = before[_V0 + i], s[_V + i]
        y0 = s[_Y + i]
        behind0, behind1 = before[_U0 + i] - v0, s[_U + i] - v1
        pull0, pull1 = (-receptor.excess_of(behind0), -receptor.excess_of(behind1)) if c.large else (behind0, behind1)
        r0, r1 = c.h * before[_L0 + i], c.h * s[_L + i]
        m0, m1, left_out = _slopes_of_output(r0, r1, pull0, pull1, before[_A0 + i], before[_A1 + i])
        w0, w1 = v0, v1
        if c.second > _ZERO:
            w0, w1 = before[_W0 + i], s[_W + i]
            m0, m1, of_second = _slopes_of_output(c.second, c.second, v0 - w0, v1 - w1, m0, m1)
            left_out += of_second
        top, bottom = (before[_HIGH + i] - w0) + y0, (before[_LOW + i] - w0) + y0
        clear = q * left_out <= _LEFT_OUT * min(s[_ON + i], s[_OFF + i])
        before[_Y0 + i], s[_Y + i] = y0, curve.behind_high_pass(q, y0, curve.Course(c.high, w1 - w0, m0, m1))
        before[_HIGH + i] = top - q * min(bottom, _ZERO) if clear else _ENDLESS
        before[_LOW + i] = bottom - q * max(top, _ZERO)


@vector_kernel
def _add_parasitic(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Add a block's parasitic leak, the integral of i, to its pixels' sums and to the bounds.

    The sums are stored without the leak by the present light since the epoch: they do not change under still light.
    """
    use_widest_vectors()
    for i in range(BLOCK):
        u0, u1 = before[_U0 + i], s[_U + i]
        i0, i1 = curve.photocurrent(u0), curve.photocurrent(u1)
        stored = s[_P + i]
        # The mean light of the step: the trapezium rule with end correction, at least the lower one of both ends.
        mean = max(_HALF * (i0 + i1) + _TWELFTH * (i0 * before[_A0 + i] - i1 * before[_A1 + i]), min(i0, i1))
        leaks = c.parasitic * s[_ON + i]
        p0 = stored + leaks * i0 * c.since_epoch_0
        p1 = leaks * c.h * mean
        moved = stored + leaks * (c.h * (mean - i1) - c.since_epoch_0 * (i1 - i0))
        before[_P0 + i] = stored
        s[_P + i] = moved if (u0 == u0) & (u1 == u1) else p0 - leaks * i1 * c.since_epoch_1
        before[_HIGH + i], before[_LOW + i] = before[_HIGH + i] + _MORE * p1 + p0, before[_LOW + i] + p0


@vector_kernel
def _test(s: _Float32s, before: _Float32s, may_fire: _Bytes, c: StepConstants) -> None:
    """Write 1 to `may_fire` where a pixel's bounds meet a threshold or its step is not smooth, else 0."""
    use_widest_vectors()
    for i in range(BLOCK):
        on, off = s[_ON + i], s[_OFF + i]
        leak, reference = s[_LEAK + i], s[_REF + i]
        high = (before[_HIGH + i] - reference) + leak * c.since_epoch_1
        low = (before[_LOW + i] - reference) + leak * c.since_epoch_0
        quiet = (high < on - _MARGIN) & (low > _MARGIN - off)
        d = s[_U + i] - before[_U0 + i]
        smooth = curve.is_smooth(d, before[_A0 + i], before[_A1 + i], min(on, off), c.unseen_share)
        may_fire[i] = 0 if quiet & smooth else 1


@vector_kernel
def _test_limits(s: _Float32s, before: _Float32s, may_fire: _Bytes, c: StepConstants) -> None:
    """Write 1 to `may_fire` where a pixel may meet a drawn level, its clock runs out, or its step is not smooth."""
    use_widest_vectors()
    for i in range(BLOCK):
        leak, reference = s[_LEAK + i], s[_REF + i]
        high = (before[_HIGH + i] - reference) + leak * c.since_epoch_1
        low = (before[_LOW + i] - reference) + leak * c.since_epoch_0
        inside = (high < s[_ON_LIMIT + i] - _MARGIN) & (low > _MARGIN - s[_OFF_LIMIT + i])
        d, threshold = s[_U + i] - before[_U0 + i], min(s[_ON + i], s[_OFF + i])
        smooth = curve.is_smooth(d, before[_A0 + i], before[_A1 + i], threshold, c.unseen_share)
        may_fire[i] = 0 if inside & (c.since_epoch_1 < s[_UNTIL + i]) & smooth else 1


@vector_kernel
def _test_certificates(s: _Float32s, before: _Float32s, may_fire: _Bytes, c: StepConstants) -> None:
    """Write 1 to `may_fire` where a pixel with noise leaves its certificate or its step is not smooth, else 0.

    The value moves no faster than `curve.fastest` has it, times 1.65 where the rate of the low-pass changes.
    """
    use_widest_vectors()
    for i in range(BLOCK):
        reference, leak = s[_REF + i], s[_LEAK + i]
        high = (before[_HIGH + i] - reference) + leak * c.since_epoch_1
        low = (before[_LOW + i] - reference) + leak * c.since_epoch_0
        inside = (high < s[_ON_LIMIT + i] - _MARGIN) & (low > _MARGIN - s[_OFF_LIMIT + i])
        a0, a1 = before[_A0 + i], before[_A1 + i]
        d = s[_U + i] - before[_U0 + i]
        swing = curve.Swing(d, a0, a1, abs(before[_U0 + i] - before[_V0 + i]))
        steepest = curve.fastest(swing, c.h * before[_L0 + i], c.h * s[_L + i])
        if_second = c.second * abs(before[_V0 + i] - before[_W0 + i]) if c.second > _ZERO else _ZERO
        if_high = c.high * max(abs(before[_HIGH + i]), abs(before[_LOW + i])) if c.high > _ZERO else _ZERO
        # A speed below 0 holds in still light alone; so does 0, behind a high-pass.
        speed, still = s[_SPEED + i], max(abs(d), max(abs(a0), abs(a1))) == _ZERO
        slow = (_FASTER * max(steepest, if_second) + if_high <= abs(speed) * c.h) & (still | (speed > _ZERO))
        slow |= (c.high > _ZERO) & (speed == _ZERO) & still
        smooth = curve.is_smooth(d, a0, a1, min(s[_ON + i], s[_OFF + i]), c.unseen_share)
        holds = inside & slow & (c.since_epoch_1 < s[_UNTIL + i])
        may_fire[i] = 0 if holds & smooth else 1


@kernel
def list_flags(eights: npt.NDArray[np.uint64], flagged: _Int64s) -> int:
    """Write the indices of a block's pixels that may fire into `flagged`; return their number.

    `eights` is `may_fire` seen as words, eight flags in each.
    """
    k = 0
    for word in range(BLOCK // 64):  # of the bits of 64 pixels: most words are 0, and cost nothing more
        bits = np.uint64(0)
        for eight in range(8):  # each byte is 0 or 1; the product collects them in the top byte
            bits |= ((eights[8 * word + eight] * _COLLECT) >> np.uint64(56)) << np.uint64(8 * eight)
        while bits != 0:
            flagged[k] = 64 * word + np.int64(lowest_bit(bits))
            k += 1
            bits &= bits - np.uint64(1)
    return k


@kernel
def move_quietly(
    light: _Float32s, rate: _Float32s, s: _Float32s, before: _Float32s, may_fire: _Bytes, c: StepConstants
) -> None:
    """Move a block over the step as if no pixel fired, and flag the pixels that may fire."""
    if c.chord:
        _take_light_alone(light, s, before, c)
    else:
        _take_light(light, rate, s, before, c)
    _warp(s, before, c)
    if c.large:
        _receive(s, before)
        if c.second > _ZERO:
            _add_second_pole_of_receptor(s, before, c)
    else:
        _filter(s, before)
        _bound(s, before)
        if c.second > _ZERO:
            _add_second_pole(s, before, c)
    if c.high > _ZERO:
        _add_high_pass(s, before, c)
    if c.parasitic > _ZERO:
        _add_parasitic(s, before, c)
    if c.noisy:
        _test_certificates(s, before, may_fire, c)
    elif c.offsets:
        _test_limits(s, before, may_fire, c)
    else:
        _test(s, before, may_fire, c)


@vector_kernel
def _keep_state(s: _Float32s, before: _Float32s, c: StepConstants) -> None:
    """Keep a block's filters and parasitic leak when its light has jumped.

    Filters start again where the light is not readable, or was not. The sums of the leak are stored without the leak by
    the present light, which has changed.
    """
    for i in range(BLOCK):
        u0, u1 = before[_U0 + i], s[_U + i]
        readable = (u0 == u0) & (u1 == u1)
        s[_V + i], s[_W + i] = s[_V + i] if readable else u1, s[_W + i] if readable else u1
        s[_Y + i] = s[_Y + i] if readable else u1 - u1
    if c.parasitic > _ZERO:
        for i in range(BLOCK):
            brighter = curve.photocurrent(s[_U + i]) - curve.photocurrent(before[_U0 + i])
            s[_P + i] -= c.parasitic * s[_ON + i] * brighter * c.since_epoch_0


@kernel
def replace_light_of_block(light: _Float32s, rate: _Float32s, s: _Float32s, before: _Float32s, c: StepConstants) -> int:
    """Change a block's light at the start of a step; return the number of pixels in which it is not readable."""
    if c.chord:
        _take_light_alone(light, s, before, c)
    else:
        _take_light(light, rate, s, before, c)
    _keep_state(s, before, c)
    unreadable = 0
    for i in range(BLOCK):
        unreadable += s[_U + i] != s[_U + i]
    return unreadable
