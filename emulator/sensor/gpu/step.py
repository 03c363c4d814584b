"""GLSL: one step of all pixels, an invocation each.

    binding 0   Pixel[n]        the state before the step
    binding 1   Pixel[n]        the state after it: a step can be taken again
    binding 2   Thresholds[n]   what is drawn once for each pixel
    binding 3   uvec2[room]     events: [pixel << 1 | on, bits of the time as a share of the step], in no order
    binding 4   Counts          how many events there were, listed or not, and what else there is to tell
    texture 0, 1                light and its time derivative, R32F, the first row first

Of `room` the events beyond are counted but not listed. Nothing here knows the stream's time: blind pixels count down,
and what leaks is counted from an epoch that the processor moves.
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.gpu.arithmetic import ARITHMETIC, constant
from emulator.sensor.gpu.walk import WALK

__all__ = ["COUNTS", "GROUP", "NOT_KNOWN", "PIXEL", "STEP", "THRESHOLDS"]

GROUP = 16, 8
"""Pixels of a work group, (width, height)."""

NOT_KNOWN = 3e38
"""In the place of a log light or a slope that is not known."""

PIXEL = np.dtype([(name, "<f4") for name in ("u", "v", "rate", "slope", "reference")] + [("blind", "<u4")])
"""A pixel's state: log light, filtered, its rate (rad/s), slope of u by warped time, the reference with leak times the
time since the epoch added, and 0 for a pixel that sees or 1 + the time for which it is blind, ns."""

THRESHOLDS = np.dtype([(name, "<f4") for name in ("on", "off", "leak")])
"""ON and OFF threshold, ln units, and leak, ln units a second."""

COUNTS = np.dtype([(name, "<u4") for name in ("raised", "too_many", "candidates", "suspects", "unreadable")])
"""Crossings within a pixel's most, those beyond, pixels that may have fired, suspects, pixels with unreadable light."""

_DECLARATIONS = f"""
#version 430
layout(local_size_x = {GROUP[0]}, local_size_y = {GROUP[1]}) in;
uniform sampler2D picture, picture_rate;
uniform ivec2 size;
uniform bool chord;          // no derivative: light is a straight line in its logarithm
uniform bool slopes_known;   // those of the last picture
uniform float dark, rate_at_reference, rate_min, rate_max;
uniform float h, since_epoch_0, since_epoch_1, epoch_moved, refractory;
uniform uint h_ns, refractory_ns, room;
struct Pixel {{ float u, v, rate, slope, reference; uint blind; }};
struct Thresholds {{ float on, off, leak; }};
layout(std430, binding = 0) readonly buffer Before {{ Pixel before[]; }};
layout(std430, binding = 1) writeonly buffer After {{ Pixel after[]; }};
layout(std430, binding = 2) readonly buffer Drawn {{ Thresholds drawn[]; }};
layout(std430, binding = 3) writeonly buffer Events {{ uvec2 events[]; }};
layout(std430, binding = 4) buffer Counts {{ uint {", ".join(COUNTS.names or ())}; }};
{constant("NOT_KNOWN", NOT_KNOWN)}
"""

_MAIN = """
float per_step(float rate, float slope) {  // a slope by warped time
    return slope == NOT_KNOWN ? NOT_KNOWN : h * rate * slope;
}

bool stays_quiet(float d, float a0, float a1, float behind, float q, Pixel s, Thresholds p) {
    float first = a0 * (1.0 / 3.0), last = d - a1 * (1.0 / 3.0), end = max(d, 0.0);
    float top = max(end, max(first, last)), bottom = min(min(d, 0.0), min(first, last));
    float share = min(q * (1.08 + 1.2 * (top - end)), 1.0);
    float above = s.v - s.reference;
    float high = above + (share * max(behind + top, 0.0) + p.leak * since_epoch_1);
    float low = above + (share * min(behind + bottom, 0.0) + p.leak * since_epoch_0);
    return high < p.on - 5e-6 && low > 5e-6 - p.off;
}

// Moves s over a step in which log light goes from s.u by d, slopes per step a0 and a1, the rate to `rate`.
void follow(uint pixel, float d, float a0, float a1, float rate, inout Pixel s) {
    Thresholds p = drawn[pixel];
    s.reference -= p.leak * epoch_moved;
    float unseen = TRUST * min(p.on, p.off);
    if (is_plain(d, a0, a1, unseen)) {
        Course course;
        course.s = warped_time(h, s.rate, rate, a0, a1);
        course.d = d;
        course.w0 = course.s * (a0 / (h * s.rate));
        course.w1 = course.s * (a1 / (h * rate));
        float q = decay(course.s), behind = s.u - s.v;
        bool stays_blind = s.blind > h_ns + 1u;
        if (stays_blind || s.blind == 0u && stays_quiet(d, a0, a1, behind, q, s, p)) {
            s.v += rise_of_filter(q, behind, course);
            s.blind = stays_blind ? s.blind - h_ns : 0u;
            return;
        }
    }
    atomicAdd(candidates, 1u);
    walk(pixel, p, taken(s.u, d, a0, a1, unseen), s);
}

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x || at.y >= size.y) return;
    uint pixel = uint(at.y) * uint(size.x) + uint(at.x);
    Pixel s = before[pixel];
    float e = texelFetch(picture, at, 0).r, r = chord ? 0.0 : texelFetch(picture_rate, at, 0).r;
    bool readable = is_finite(e), lit = readable && e > 0.0;
    float current = (lit ? e : 0.0) + dark, u = natural_log(current);
    float rate = clamp(rate_at_reference * current, rate_min, rate_max);
    float slope = chord || !is_finite(r) ? NOT_KNOWN : lit ? r / (current * rate) : 0.0;
    if (readable && s.u != NOT_KNOWN) {
        float d = u - s.u;
        float a0 = chord ? d : per_step(s.rate, slopes_known ? s.slope : NOT_KNOWN);
        follow(pixel, d, a0, chord ? d : per_step(rate, slope), rate, s);
    } else {  // silent; the filter starts anew from the next readable light
        s.reference -= drawn[pixel].leak * epoch_moved;
        s.v = u;
        s.blind = s.blind > 0u ? 1u + (max(s.blind - 1u, h_ns) - h_ns) : 0u;
    }
    if (!readable) atomicAdd(unreadable, 1u);
    s.u = readable ? u : NOT_KNOWN;
    s.rate = rate;
    s.slope = slope;
    after[pixel] = s;
}
"""

STEP = _DECLARATIONS.lstrip() + ARITHMETIC + WALK + _MAIN
"""The compute shader."""
