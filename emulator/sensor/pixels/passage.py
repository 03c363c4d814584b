"""Events of one pixel with noise along a piece of its curve: first passages of signal plus noise.

A piece is an interval in which the noise-free value of the comparator is a cubic in time. `pass_piece` goes along it in
windows with a bound of the hazard. The points of the pixel's random field below it (`keyed`) are tried in the order of
time, and the first one below the hazard is an event. Points do not depend on the windows, so these change no event.

    calm      a window in which few points are below the bound by the signal at both ends, as long as possible
    other     bounded by the hazard at both ends, until about two points are expected; a part that does not turn
    event     the noise's slope at the passage is drawn; value and slope are carried over the dead time exactly, with
              two normal numbers; the reference is signal plus noise at its end

Fast because half of the windows need no hazard, and `lane` keeps the fields of all these tuples in registers.
Times within a step are nanoseconds since its start. All numbers of an event are keyed by pixel and time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise import hazard
from emulator.sensor.noise.hazard import Distance, Hazard, Noise
from emulator.sensor.numerics import keyed
from emulator.sensor.numerics.compiled import kernel, lane
from emulator.sensor.pixels import state
from emulator.sensor.pixels.crossings import Keys, pack
from emulator.sensor.pixels.event_time import delay_s
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Pixels, StepConstants, noise_stream, reset_offset_at

_Float32s = npt.NDArray[np.float32]

_REF, _ON, _OFF, _LEAK, _UNTIL = (
    int(f) * BLOCK for f in (Field.REFERENCE, Field.ON, Field.OFF, Field.LEAK, Field.UNTIL)
)
_NAN, _ENDLESS = np.float32(np.nan), np.float32(np.inf)
_N, _V, SCALE = range(3)
_UNKNOWN = Hazard(*(math.nan,) * 10)  # a hazard that was not computed

MOST_PASSAGES = 1024
"""Most events of a pixel in a step. The rest of its piece is lost in the pixel, and counted at the rate until then."""

_MORE = 1.5  # bound of the hazard in a window, over that at its ends: 1.37 is the most that was seen in 10 000
_EXPONENT = 1.5  # by which the hazard's exponent grows in a window near a threshold
_MOST_POINTS = 4.0  # expected in a window, at the hazard of its start
_TOO_MANY = 8e9  # points in 1e-9: a window is divided
_BURST = 5.0  # time constants of the slower pole for which a window is no longer than the time since the reset
_FIRST = 0.2  # length of the first window after a reset, over the time of noise and signal
_OVERSHOOT = 0.4  # of the mean of the noise by its slope at the reset, at most, over slope / rate
_MOST_CALM = 3.0  # points that are expected below the bound of a calm window, at most
_POINTS = 2.0  # expected below the bound of a window of an approach
LEAST_FAR = 1.5  # deviations, of a threshold whose hazard is bounded without tables
FORGOTTEN = 10.0  # time constants of the slower pole after which the reset is forgotten
INFINITE = 1e15  # deviations: a dead pixel's threshold
_FALSE_POSITIONS, _CLOSE = 6, 0.1  # steps, at most; share of the travel
_WIDEST = 4.0  # interval of false positions, over the time that the present speed needs
_NO_POINT = 1e-3  # expected points in 1e-9
_SHORTEST_NS = 1e-3
_MOST_LOST = 1e9
_STEEPEST = 1e6  # slope of the noise of one pole, which has none, ln units a second
# Purposes of an event's random numbers.
_SLOPE, _VALUE = np.uint64(0xD6E8FEB86659FD93), np.uint64(0x9E3779B97F4A7C15)


class Piece(NamedTuple):
    """A piece of a pixel's curve, without the junction's leak, over x from 0 to 1."""

    begin_ns: float  # since the start of the step
    span_ns: float
    base: float  # value at its start
    c1: float
    c2: float
    c3: float
    rate0: float  # of the receptor's pole at both ends, 1/s
    rate1: float


class State(NamedTuple):
    """A pixel between two events."""

    on: float  # thresholds, ln units
    off: float
    stream: np.uint64
    reference: float
    n_r: float  # value and slope of the noise at the reset, ln units and a second
    v_r: float
    reset: float  # ns since the start of the step


class Curve(NamedTuple):
    """A piece, and what the light and the noise along it need of a pixel and of `StepConstants`.

    Few numbers: they are copied for each of many calls.
    """

    piece: Piece
    per_ns: float  # 1 / span
    t0_ns: int
    since_s: float  # since the epoch of the leak
    leak: float  # ln units a second
    rms: float  # of the noise behind the receptor
    pole: float  # 1/s
    high_rate: float


class _Signal(NamedTuple):
    """Value of the comparator without noise, its speed a second, and the noise of the light."""

    value: float
    speed: float
    narrowing: float
    noise: Noise


@lane
def _value(t_ns: float, curve: Curve) -> float:
    """Return the value of the comparator without noise at a time of a piece."""
    p = curve.piece
    x = (t_ns - p.begin_ns) * curve.per_ns
    return p.base + (((p.c3 * x + p.c2) * x + p.c1) * x + curve.leak * (curve.since_s + t_ns * 1e-9))


@lane
def _signal(t_ns: float, curve: Curve) -> _Signal:
    """Return the signal at a time of a piece."""
    p, high = curve.piece, curve.high_rate
    x = (t_ns - p.begin_ns) * curve.per_ns
    per_s = 1e9 * curve.per_ns
    speed = ((3 * p.c3 * x + 2 * p.c2) * x + p.c1) * per_s + curve.leak
    rate = p.rate0 + (p.rate1 - p.rate0) * x
    noise = hazard.noise_of(rate, curve.pole, curve.rms, high)
    # sigma^2 is rms^2 a2 / (a1 + a2): it shrinks as the receptor becomes faster. A high-pass then takes less of it.
    narrowing = 0.0
    if p.rate1 != p.rate0:
        faster = 0.5 * (p.rate1 - p.rate0) * per_s
        if noise.a1 != noise.a2:
            narrowing = faster / (noise.a1 + noise.a2)
        if high > 0:
            narrowing -= faster * high / (rate * (rate + high))
    return _Signal(_value(t_ns, curve), speed, narrowing, noise)


@kernel
def _time_at(t: float, limit: float, travel: float, now: _Signal, curve: Curve) -> float:
    """Return a time until which the signal goes almost `travel` from that at t, or less; `limit` where it never does.

    It must not turn before `limit`. The time is the lower end of an interval that false positions narrow.
    """
    lower, upper = t, min(limit, t + _WIDEST * travel / (abs(now.speed) + 1e-30) * 1e9)
    short, past = -travel, abs(_value(upper, curve) - now.value) - travel
    if not past > 0:
        return upper
    for _ in range(_FALSE_POSITIONS):
        between = lower - short * (upper - lower) / (past - short)
        missing = abs(_value(between, curve) - now.value) - travel
        if missing > 0:
            upper, past = between, missing
            short *= 0.5  # Illinois: or else the other end would stay
            continue
        lower, short = between, missing
        past *= 0.5
        if missing > -_CLOSE * travel:
            break
    return lower


@kernel
def _fastest(first: float, last: float, mean: float) -> float:
    """Return a bound of a speed that is a parabola in time, by its ends and its mean: its Bernstein coefficients."""
    return max(abs(first), abs(last), abs(3 * mean - first - last))


@kernel
def _nearer(c_ahead: float, nu: float) -> float:
    """Return by how many deviations a threshold, `c_ahead` away, may come nearer in a window, at the speed nu.

    The hazard is bounded by that at the window's end, e^(-c^2 / 2) times `steep` for each deviation travelled: to the
    c where the field has some _POINTS below it. Where it is large already, its exponent grows by _EXPONENT.
    """
    c_ahead, c = min(c_ahead, INFINITE), 2.0
    least = _EXPONENT / (abs(c_ahead) + 1)
    if c_ahead < 1:
        return least
    steep = (0.4 + nu) / (nu * _POINTS)
    for _ in range(2):
        c = math.sqrt(2 * math.log(max(steep * max(c_ahead - c, 0.3), 1.0)))
    return max(c_ahead - c, least)


@kernel
def _hazard_at(t_ns: float, curve: Curve, a: State, tables: _Float32s) -> tuple[_Signal, Hazard]:
    """Return signal and hazard at a time of a piece that is after the reset."""
    now = _signal(t_ns, curve)
    distance = Distance(a.reference + a.on - now.value, now.value - a.reference + a.off, now.speed, now.narrowing)
    since_s = max(t_ns - a.reset, _SHORTEST_NS) * 1e-9
    h = hazard.hazard(since_s, distance, a.n_r, a.v_r, now.noise, tables)
    if min(h.c_on, h.c_off) < hazard.BEYOND:
        # The signal has passed the threshold faster than the field can show: any next point is the event.
        is_on = h.c_on < h.c_off
        on_hz, off_hz = (keyed.CERTAIN_HZ, 0.0) if is_on else (0.0, keyed.CERTAIN_HZ)
        h = Hazard(on_hz, off_hz, h.c_on, h.c_off, h.nu_on, h.nu_off, h.mean_slope, h.deviation, h.pull, h.slope)
    return now, h


class _Room(NamedTuple):
    """Distances of a signal from both thresholds, less the mean of the noise from now on, ln units."""

    on: float
    off: float


@lane
def room_of(since_s: float, value: float, noise: Noise, a: State) -> _Room:
    """Return the room of a pixel at a time after its reset: that part of its noise's value is left, and its slope's."""
    age = since_s * min(noise.a1, noise.a2)
    left = kick = 0.0
    if age < FORGOTTEN:
        decay = math.exp(-age)
        left = (1 + age) * decay
        kick = abs(a.v_r) / noise.rate * (_OVERSHOOT if age < 1 else age * decay)
    on = a.reference + a.on - value - max(a.n_r, 0.0) * left - kick
    return _Room(on, value - a.reference + a.off + min(a.n_r, 0.0) * left - kick)


@lane
def bound_of(c: float, nu: float, noise: Noise) -> float:
    """Return a bound of the hazard of a threshold c > 0 deviations away, 1/s, without tables.

    It is half as much again as Rice's rate of crossings, which are first ones at most. With the room of a pixel for c
    it holds shortly after a reset too. One pole has no such rate: its hazard for large c and nu, with that margin.
    """
    steep = 0.25 + 0.6 * nu if noise.ratio > 0.0 else 0.5 * (1 + c + nu)
    c = min(c, 30.0)  # an exponential that is too small for a number is slow
    bound_hz: float = noise.rate * steep * math.exp(-0.5 * c * c)
    return bound_hz


class _Window(NamedTuple):
    """A part of a piece, and a bound of the hazard in it."""

    end: float  # ns since the start of the step
    bound_hz: float
    after: _Signal  # at its end
    at_end: Hazard  # or _UNKNOWN


@lane
def _calm_window(t: float, limit: float, now: _Signal, curve: Curve, a: State) -> _Window:
    """Return a window in which few points are below a bound of the hazard by signals alone, of no length if none is.

    The signal does not turn, so it is nearest to a threshold at one end. The window ends at `limit`; after a reset, if
    that is too far, when the noise has forgotten the reset, or at a quarter of that time, and so on.
    """
    to, after = limit, _signal(limit, curve)
    forgotten = a.reset + FORGOTTEN / min(now.noise.a1, now.noise.a2) * 1e9
    while True:
        calm_s, gone = (to - t) * 1e-9, after.value - now.value
        louder = now.noise if now.noise.sigma > after.noise.sigma else after.noise
        rate = max(now.noise.rate, after.noise.rate)
        slower = now.noise if now.noise.rate < after.noise.rate else after.noise  # it has forgotten less of the reset
        room = room_of((t - a.reset) * 1e-9, now.value, slower, a)
        on, off = room.on - max(gone, 0.0), room.off + min(gone, 0.0)
        c = min(min(on, off) / louder.sigma, INFINITE)
        nu = _fastest(now.speed, after.speed, gone / calm_s) / (louder.sigma * rate)
        bound_hz = bound_of(c, nu, louder) * rate / louder.rate
        if abs(on - off) < 0.5 * louder.sigma:
            bound_hz *= 2  # of both thresholds
        if c > LEAST_FAR and bound_hz * calm_s < _MOST_CALM:
            return _Window(to, bound_hz, after, _UNKNOWN)
        if t > a.reset or min(room.on, room.off) < LEAST_FAR * louder.sigma or to - t < 1:
            return _Window(t, 0.0, now, _UNKNOWN)
        to = min(forgotten, t + 0.25 * (to - t))
        after = _signal(to, curve)


@kernel
def _window_end(t: float, limit: float, now: _Signal, h: Hazard, curve: Curve, a: State) -> float:
    """Return the end of the window that begins at t, a time of the piece after the reset, with hazard h."""
    since_s, noise = (t - a.reset) * 1e-9, now.noise
    window_s: float = (limit - t) * 1e-9
    gone = _value(limit, curve) - now.value
    speed = max(abs(now.speed), abs(gone) / window_s) / noise.sigma
    # Shortly after a reset windows grow with the time since then; later the signal decides.
    if since_s * min(noise.a1, noise.a2) < _BURST:
        window_s = min(window_s, since_s)
    total = min(h.on + h.off, keyed.TOP_HZ)
    if total * window_s > _MOST_POINTS:
        window_s = _MOST_POINTS / total
    to: float = min(t + max(window_s * 1e9, 1.0), limit)
    travel = _nearer(h.c_on if gone > 0 else h.c_off, speed / noise.rate) * noise.sigma * h.deviation
    end: float = max(_time_at(t, to, travel, now, curve), min(t + 1.0, limit))
    return end


class _Event(NamedTuple):
    """An event: its stream time, its polarity, and signal and hazard at its time."""

    t_ns: int
    on: bool
    signal: _Signal
    hazard: Hazard
    slope: float  # of the noise, ln units a second


@kernel
def _event_at(t_ns: int, on: bool, now: _Signal, h: Hazard, a: State, tables: _Float32s) -> _Event:
    """Return an event with the slope of its noise: its mean by the value, and what the passage adds to it."""
    if now.noise.ratio == 0.0:
        return _Event(t_ns, on, now, h, _STEEPEST if on else -_STEEPEST)
    nu, c_event = (h.nu_on, h.c_on) if on else (h.nu_off, h.c_off)
    if c_event < hazard.BEYOND:
        return _Event(t_ns, on, now, h, h.mean_slope)
    share = keyed.unit(keyed.high(keyed.mix_word(a.stream ^ (np.uint64(t_ns) * _SLOPE))))
    beyond = hazard.exit_speed(nu, c_event, share, now.noise.ratio, tables) - nu
    outward = now.noise.sigma * h.deviation * (beyond * h.slope + c_event * h.pull)
    return _Event(t_ns, on, now, h, h.mean_slope + (outward if on else -outward))


@lane
def _first_event(t: float, w: _Window, share: float, curve: Curve, a: State, tables: _Float32s) -> _Event:
    """Return the event of the first point below `share` of the hazard in the window from t, at NEVER_NS if none is."""
    # Windows share no point: each has those from its start, included, to its end, not included.
    from_ns, to_ns = curve.t0_ns + math.ceil(t) - 1, curve.t0_ns + math.ceil(w.end) - 1
    while share * w.bound_hz * (w.end - t) > _NO_POINT:
        point = keyed.next_point(a.stream, from_ns, to_ns, share * w.bound_hz)
        if point.t_ns == keyed.NEVER_NS:
            break
        now, h = _hazard_at(np.float64(point.t_ns - curve.t0_ns), curve, a, tables)
        if point.hz < share * (h.on + h.off):
            event: _Event = _event_at(point.t_ns, point.hz < h.on, now, h, a, tables)
            return event
        from_ns = point.t_ns
    return _Event(keyed.NEVER_NS, False, w.after, _UNKNOWN, 0.0)


@kernel
def _after_event(e: _Event, dead_s: float, a: State) -> tuple[float, float]:
    """Return value and slope of the noise at the end of the dead time that follows an event."""
    noise = e.signal.noise
    first = keyed.mix_word(a.stream ^ (np.uint64(e.t_ns) * _VALUE))
    value = a.reference + (a.on if e.on else -a.off) - e.signal.value
    c_event = e.hazard.c_on if e.on else e.hazard.c_off
    if c_event < hazard.BEYOND:  # the signal has jumped: the noise is not that of a passage, but any
        inward = noise.sigma * e.hazard.deviation * (keyed.normal_from(keyed.mix_word(first ^ _SLOPE)) - c_event)
        value += inward if e.on else -inward
    if noise.ratio == 0.0:
        decay = math.exp(-noise.rate * dead_s)
        return value * decay + noise.sigma * math.sqrt(1 - decay * decay) * keyed.normal_from(first), 0.0
    if dead_s <= 0:
        return value, e.slope
    m = hazard.transition(dead_s, noise)
    deviation = math.sqrt(m.v)
    with_value = m.c / deviation
    g1, g2 = noise.sigma * keyed.normal_from(first), noise.sigma * keyed.normal_from(keyed.mix_word(first + _VALUE))
    slope = m.p21 * value + m.p22 * e.slope + with_value * g1 + math.sqrt(max(m.w - with_value * with_value, 0.0)) * g2
    return m.p11 * value + m.p12 * e.slope + deviation * g1, slope


@kernel
def _re_armed(pixels: Pixels, pixel: int, now: _Signal, a: State, c: StepConstants) -> State:
    """Return a pixel whose dead time ends: its reference is signal plus noise; without dead time, the level passed."""
    offset = reset_offset_at(a.stream, pixels.refractory_until_ns[pixel], a.on, a.off, c.reset)
    reference = np.float32((a.reference if a.reference == a.reference else now.value + a.n_r) + offset)
    pixels.fields[state.slot(pixel) + _REF] = reference
    return State(a.on, a.off, a.stream, np.float64(reference), a.n_r, a.v_r, a.reset)


@kernel
def state_of(pixels: Pixels, pixel: int, c: StepConstants) -> State:
    """Return a pixel's state."""
    at, memory = state.slot(pixel), pixel * MEMORY
    fields = pixels.fields
    return State(
        np.float64(fields[at + _ON]),
        np.float64(fields[at + _OFF]),
        noise_stream(pixels, pixel, c),
        np.float64(fields[at + _REF]),
        np.float64(pixels.memory[memory + _N]),
        np.float64(pixels.memory[memory + _V]),
        np.float64(pixels.refractory_until_ns[pixel] - c.t0_ns),
    )


@kernel
def _bound_hz(before: float, length_ns: float, now: _Signal, after: _Signal, at_end: Hazard) -> float:
    """Return a bound of the hazard in a window, at whose start it is `before`.

    It is largest where the threshold is nearest, unless the signal is faster elsewhere. A threshold that recedes at the
    end, as the noise shrinks, may have come nearer until then: there it is below twice Rice's rate.
    """
    gone = after.value - now.value
    c_end, nu_end = (at_end.c_on, at_end.nu_on) if gone > 0 else (at_end.c_off, at_end.nu_off)
    unit = after.noise.sigma * after.noise.rate
    fastest = _fastest(now.speed, after.speed, gone / length_ns * 1e9) / unit
    most_hz = (at_end.on + at_end.off) * (0.4 + fastest) / (0.4 + abs(after.speed) / unit)
    if nu_end < 0 < c_end < hazard.FARTHEST:
        most_hz = max(most_hz, after.noise.rate * math.exp(-0.5 * c_end * c_end) * (1 + c_end + fastest))
    bound_hz: float = min(_MORE * max(before, most_hz), keyed.CERTAIN_HZ)
    return bound_hz


@lane
def _window(t: float, limit: float, now: _Signal, h: Hazard, curve: Curve, a: State, tables: _Float32s) -> _Window:  # noqa: PLR0913, PLR0917
    """Return the window that begins at t. `h` is the hazard there, or _UNKNOWN where the window may be a calm one."""
    unknown, before = h.on != h.on, 0.0
    if unknown:
        calm: _Window = _calm_window(t, limit, now, curve, a)
        if calm.end > t:
            return calm
    if t <= a.reset:
        # Noise and signal stay far from both thresholds.
        moving = now.noise.rate + (abs(a.v_r) + abs(now.speed)) / min(a.on, a.off)
        to = min(t + max(_FIRST / moving * 1e9, _SHORTEST_NS), limit)
    else:
        if unknown:
            _, h = _hazard_at(t, curve, a, tables)
        before = h.on + h.off
        to = _window_end(t, limit, now, h, curve, a)
    while True:
        after, at_end = _hazard_at(to, curve, a, tables)
        bound_hz = _bound_hz(before, to - t, now, after, at_end)
        if min(bound_hz, keyed.TOP_HZ) * (to - t) <= _TOO_MANY or to - t <= 1:
            return _Window(to, bound_hz, after, at_end)
        to = t + (to - t) * 0.25  # the signal became faster


@kernel
def _turns(curve: Curve) -> tuple[float, float]:
    """Return the times at which a piece's curve turns, the end where it does not."""
    p = curve.piece
    end = p.begin_ns + p.span_ns
    first = p.c1 + curve.leak * p.span_ns * 1e-9
    middle, last = first + p.c2, first + 2 * p.c2 + 3 * p.c3
    if min(first, middle, last) >= 0 or max(first, middle, last) <= 0:  # Bernstein's coefficients of the slope
        return end, end
    square = p.c2 * p.c2 - 3 * p.c3 * first
    if square <= 0:
        return end, end
    # The larger root first, without cancellation; the other one from the product of both.
    total = -(p.c2 + math.copysign(math.sqrt(square), p.c2))
    x1, x2 = total / (3 * p.c3), first / total
    t1 = p.begin_ns + x1 * p.span_ns if 0 < x1 < 1 else end
    t2 = p.begin_ns + x2 * p.span_ns if 0 < x2 < 1 else end
    return min(t1, t2), max(t1, t2)


@kernel
def find_next(curve: Curve, a: State, share: float, tables: _Float32s) -> float:
    """Return the time of the first point below `share` of the hazard in a piece that does not turn; else its end."""
    end = curve.piece.begin_ns + curve.piece.span_ns
    t = max(curve.piece.begin_ns, a.reset)
    now, h = _signal(t, curve), _UNKNOWN
    while t < end:
        w = _window(t, end, now, h, curve, a, tables)
        event = _first_event(t, w, share, curve, a, tables)
        if event.t_ns != keyed.NEVER_NS:
            return np.float64(event.t_ns - curve.t0_ns)
        t = w.end
        now, h = w.after, w.at_end
    return end


@kernel
def pass_piece(  # noqa: PLR0913, PLR0915, PLR0917
    pixels: Pixels, pixel: int, p: Piece, keys: Keys, n_keys: int, fired: int, c: StepConstants
) -> tuple[int, int, int]:
    """Find the events of a pixel along a piece, and move its reference and noise.

    `keys` must have room for MOST_PASSAGES more events; `fired` is the number of events of the pixel in this step so
    far. Returns the number of events in `keys`, the new `fired`, and the number of events that were lost.
    """
    end, tables = p.begin_ns + p.span_ns, pixels.tables
    a = state_of(pixels, pixel, c)
    if a.reset >= end:
        return n_keys, fired, 0
    rms = c.noise_rms * np.float64(pixels.memory[pixel * MEMORY + SCALE])
    leak = np.float64(pixels.fields[state.slot(pixel) + _LEAK])
    curve = Curve(p, 1 / p.span_ns, c.t0_ns, c.since_s, leak, rms, c.noise_pole, c.high_rate)
    t = max(p.begin_ns, a.reset)
    if a.reference != a.reference:
        a = _re_armed(pixels, pixel, _signal(t, curve), a, c)
    turn, turn2 = _turns(curve)
    now = _signal(t, curve)
    if now.value != now.value:  # light that has just begun has no finite logarithm
        return n_keys, fired, 0
    h = _UNKNOWN
    while t < end:
        limit = turn if t < turn else turn2 if t < turn2 else end
        w = _window(t, limit, now, h, curve, a, tables)
        event = _first_event(t, w, 1.0, curve, a, tables)
        if event.t_ns == keyed.NEVER_NS:
            t, now = w.end, w.after
            h = w.at_end if t < limit else _UNKNOWN
            continue
        # The event, and the dead time behind it.
        late_s = delay_s(abs(event.slope + event.signal.speed), event.on, c)
        t_ns = event.t_ns + int(late_s * 1e9)
        # The event is the noise's where the signal has gone less than half of the way since the reference was set.
        gone = event.signal.value - (a.reference - a.n_r)
        of_noise = (gone / a.on if event.on else -gone / a.off) < 0.5
        keys[n_keys] = pack(t_ns - c.t0_ns, 2 * pixel + of_noise, event.on, c.pixel_bits)
        pixels.memory[pixel * MEMORY + _N], pixels.memory[pixel * MEMORY + _V] = _after_event(
            event, late_s + c.refractory_ns * 1e-9, a
        )
        dead_ns = t_ns - event.t_ns + c.refractory_ns
        level = a.reference + (a.on if event.on else -a.off)
        pixels.fields[state.slot(pixel) + _REF] = np.float32(level) if dead_ns == 0 else _NAN
        pixels.fields[state.slot(pixel) + _UNTIL] = -_ENDLESS
        pixels.refractory_until_ns[pixel] = t_ns + c.refractory_ns
        n_keys += 1
        fired += 1
        a = state_of(pixels, pixel, c)
        t = a.reset
        if t >= end:
            break
        now = _signal(t, curve)
        a = _re_armed(pixels, pixel, now, a, c)
        h = _UNKNOWN
        if fired >= MOST_PASSAGES:
            pixels.fields[state.slot(pixel) + _REF] = np.float32(_signal(end, curve).value)
            return n_keys, fired, 1 + int(min(fired * (end - t) / max(t, 1.0), _MOST_LOST))
    return n_keys, fired, 0
