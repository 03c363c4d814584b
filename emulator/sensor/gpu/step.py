"""GLSL of a step of all pixels in two passes: quiet pixels, one invocation each; then the pixels that may fire.

    binding 0   Pixel[n]        the state before the step
    binding 1   Pixel[n]        the state after it: a step can be repeated
    binding 2   Thresholds[n]   figures drawn once for each pixel
    binding 3   uvec2[capacity] events: [pixel << 1 | on, bits of the time as a share of the step], unsorted
    binding 4   Counts          size of the second pass, number of events, and the other counts of the step
    binding 5   uint[n]         pixels that may fire, unsorted
    texture 0, 1                light and its time derivative, R32F, the first row first

Events beyond `capacity` are counted but not listed. The shaders do not use stream time: refractory periods count down,
and leak is counted from an epoch that the processor moves.
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.gpu.arithmetic import ARITHMETIC, constant
from emulator.sensor.gpu.march import INTERPOLATION, MARCH

__all__ = ["COUNTS", "CROSSINGS", "GROUP", "NOT_KNOWN", "PIXEL", "QUIET", "THRESHOLDS"]

GROUP = 16, 8
"""Pixels of a work group of the first pass, (width, height)."""

CROSSING_GROUP = 128
"""Pixels of a work group of the second pass."""

NOT_KNOWN = 3e38
"""Value that stands for an unknown log light or slope."""

_FLOATS = "u", "v", "rate", "slope", "reference", "w", "leaked"
PIXEL = np.dtype([(name, "<f4") for name in _FLOATS] + [("refractory_left", "<u4")])
"""A pixel's state: log light, filter, its rate (rad/s), slope of u by warped time, the reference with leak times the
time since the epoch added, output of the second pole, parasitic leak since the pixel's last event less what the present
light leaks since the epoch, and 0 for an armed pixel or 1 + the rest of its refractory period, ns."""

THRESHOLDS = np.dtype([(name, "<f4") for name in ("on", "off", "leak")])
"""ON and OFF threshold, ln units, and leak, ln units a second."""

_COUNTED = "groups_x", "groups_y", "groups_z", "raised", "too_many", "candidates", "undersampled", "unreadable"
COUNTS = np.dtype([(name, "<u4") for name in _COUNTED])
"""Work groups of the second pass; then crossings up to the most of a pixel, those beyond, pixels that may have fired,
undersampled pixels, pixels with unreadable light."""

_DECLARATIONS = f"""
uniform sampler2D light, light_rate;
uniform ivec2 size;
uniform bool chord;          // no derivative: light is a straight line in its logarithm
uniform bool slopes_known;   // of the last frame
uniform float dark, rate_at_reference, rate_min, rate_max;
uniform float h, since_epoch_0, since_epoch_1, epoch_moved, refractory;
uniform float second;        // length of the step in time constants of the second pole; 0: no such pole
uniform float parasitic;     // thresholds a second that light 1 leaks; 0: none
uniform uint h_ns, refractory_ns, capacity;
struct Pixel {{ float {", ".join(_FLOATS)}; uint refractory_left; }};
struct Thresholds {{ float on, off, leak; }};
layout(std430, binding = 0) readonly buffer Before {{ Pixel before[]; }};
layout(std430, binding = 1) writeonly buffer After {{ Pixel after[]; }};
layout(std430, binding = 2) readonly buffer Drawn {{ Thresholds drawn[]; }};
layout(std430, binding = 3) writeonly buffer Events {{ uvec2 events[]; }};
layout(std430, binding = 4) buffer Counts {{ uint {", ".join(_COUNTED)}; }};
layout(std430, binding = 5) buffer Candidates {{ uint listed[]; }};
const uint CROSSING_GROUP = {CROSSING_GROUP}u;
{constant("NOT_KNOWN", NOT_KNOWN)}
"""

_LIGHT = """
struct Change {  // light of a pixel over the step: values at the end, change of log light, slopes per step
    float u, rate, slope, d, a0, a1;
    bool readable;
};

float per_step(float rate, float slope) {  // a slope by warped time
    return slope == NOT_KNOWN ? NOT_KNOWN : h * rate * slope;
}

Change change_of(ivec2 at, Pixel s) {
    float e = texelFetch(light, at, 0).r, r = chord ? 0.0 : texelFetch(light_rate, at, 0).r;
    bool readable = is_finite(e), lit = readable && e > 0.0;
    float current = (lit ? e : 0.0) + dark, u = natural_log(current), d = u - s.u;
    float rate = clamp(rate_at_reference * current, rate_min, rate_max);
    float slope = chord || !is_finite(r) ? NOT_KNOWN : lit ? r / (current * rate) : 0.0;
    float a0 = chord ? d : per_step(s.rate, slopes_known ? s.slope : NOT_KNOWN);
    return Change(u, rate, slope, d, a0, chord ? d : per_step(rate, slope), readable);
}

float photocurrent(float u) {
    return u == NOT_KNOWN ? 0.0 : exponential(u);
}

float leaked_before(Pixel s, Thresholds p) {  // by parasitic leak, since the last event
    return s.leaked + parasitic * p.on * photocurrent(s.u) * since_epoch_0;
}

float leaked_to_store(float leaked, Thresholds p, Change c) {
    return leaked - parasitic * p.on * photocurrent(c.readable ? c.u : NOT_KNOWN) * since_epoch_1;
}

Pixel loaded(uint pixel, Thresholds p) {
    Pixel s = before[pixel];
    s.reference -= p.leak * epoch_moved;
    s.leaked += parasitic * p.on * photocurrent(s.u) * epoch_moved;
    return s;
}

Pixel stored(Pixel s, Change c) {
    s.u = c.readable ? c.u : NOT_KNOWN;
    s.rate = c.rate;
    s.slope = c.slope;
    return s;
}
"""

_QUIET_MAIN = """
bool stays_quiet(Change c, float behind, float q, float leaks, Pixel s, Thresholds p) {
    float first = c.a0 * (1.0 / 3.0), last = c.d - c.a1 * (1.0 / 3.0), end = max(c.d, 0.0);
    float top = max(end, max(first, last)), bottom = min(min(c.d, 0.0), min(first, last));
    float share = min(q * (1.08 + 1.2 * (top - end)), 1.0);
    float rise = share * max(behind + top, 0.0), fall = share * min(behind + bottom, 0.0);
    float above = (second > 0.0 ? s.w : s.v) - s.reference;
    if (second > 0.0) {
        float passed = decay(second);
        rise = passed * max(s.v - s.w + rise, 0.0);
        fall = passed * min(s.v - s.w + fall, 0.0);
    }
    if (parasitic > 0.0) above += leaked_before(s, p);
    float high = above + (rise + 1.5 * leaks + p.leak * since_epoch_1);
    float low = above + (fall + p.leak * since_epoch_0);
    return high < p.on - 5e-6 && low > 5e-6 - p.off;
}

float mean_photocurrent(Change c, float i0, float i1) {
    return max(0.5 * (i0 + i1) + (1.0 / 12.0) * (i0 * c.a0 - i1 * c.a1), min(i0, i1));
}

bool moves_quietly(Change c, Thresholds p, inout Pixel s) {  // if so, s is moved
    if (!is_smooth(c.d, c.a0, c.a1, min(p.on, p.off))) return false;
    float warped = warped_time(h, s.rate, c.rate, c.a0, c.a1), q = decay(warped), behind = s.u - s.v;
    bool stays_refractory = s.refractory_left > h_ns + 1u;
    float leaks = parasitic * p.on, i0 = 0.0, i1 = 0.0, mean = 0.0;
    if (parasitic > 0.0) {
        i0 = exponential(s.u);
        i1 = exponential(c.u);
        mean = mean_photocurrent(c, i0, i1);
    }
    bool fires = s.refractory_left > 0u || !stays_quiet(c, behind, q, leaks * h * mean, s, p);
    if (!stays_refractory && fires) return false;
    Course u = Course(warped, c.d, warped * (c.a0 / (h * s.rate)), warped * (c.a1 / (h * c.rate)));
    float rise = rise_of_filter(q, behind, u), behind1 = c.u - (s.v + rise);
    Filtered v = Filtered(behind, behind1, rise, h * s.rate, h * c.rate);
    s.w = second > 0.0 ? s.w + rise_behind_second_pole(s.v - s.w, second, u, v) : s.v + rise;
    s.leaked += leaks * (h * (mean - i1) - since_epoch_0 * (i1 - i0));
    s.v += rise;
    s.refractory_left = stays_refractory ? s.refractory_left - h_ns : 0u;
    return true;
}

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x || at.y >= size.y) return;
    uint pixel = uint(at.y) * uint(size.x) + uint(at.x);
    Thresholds p = drawn[pixel];
    Pixel s = loaded(pixel, p);
    Change c = change_of(at, s);
    if (!c.readable) atomicAdd(unreadable, 1u);
    if (!c.readable || s.u == NOT_KNOWN) {  // silent; the filter starts again from the next readable light
        s.v = s.w = c.u;
        s.leaked = leaked_to_store(leaked_before(s, p), p, c);
        s.refractory_left = s.refractory_left > 0u ? 1u + (max(s.refractory_left - 1u, h_ns) - h_ns) : 0u;
    } else if (!moves_quietly(c, p, s)) {
        uint k = atomicAdd(candidates, 1u);
        listed[k] = pixel;
        atomicMax(groups_x, k / CROSSING_GROUP + 1u);
        return;
    }
    after[pixel] = stored(s, c);
}
"""

_CROSSINGS_MAIN = """
void main() {
    if (gl_GlobalInvocationID.x >= candidates) return;
    uint pixel = listed[gl_GlobalInvocationID.x];
    Thresholds p = drawn[pixel];
    Pixel s = loaded(pixel, p);
    Change c = change_of(ivec2(pixel % uint(size.x), pixel / uint(size.x)), s);
    s.leaked = leaked_before(s, p);
    march(pixel, p, interpolated(s.u, c.d, c.a0, c.a1, min(p.on, p.off)), s);
    s.leaked = leaked_to_store(s.leaked, p, c);
    after[pixel] = stored(s, c);
}
"""


def _source(width: int, height: int, *parts: str) -> str:
    layout = f"layout(local_size_x = {width}, local_size_y = {height}) in;"
    return "\n".join(["#version 430", layout, _DECLARATIONS, ARITHMETIC, INTERPOLATION, _LIGHT, *parts])


QUIET = _source(*GROUP, _QUIET_MAIN)
"""The compute shader that moves the quiet pixels, and lists the others."""

CROSSINGS = _source(CROSSING_GROUP, 1, MARCH, _CROSSINGS_MAIN)
"""The compute shader that moves the listed pixels, from crossing to crossing."""
