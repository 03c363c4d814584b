"""GLSL: one step of all pixels in two passes: quiet ones, an invocation a pixel, then those that may fire, each one.

    binding 0   Pixel[n]        the state before the step
    binding 1   Pixel[n]        the state after it: a step can be taken again
    binding 2   Thresholds[n]   what is drawn once for each pixel
    binding 3   uvec2[room]     events: [pixel << 1 | on, bits of the time as a share of the step], in no order
    binding 4   Counts          the size of the second pass, how many events there were, and what else there is to tell
    binding 5   uint[n]         pixels that may fire, in no order
    texture 0, 1                light and its time derivative, R32F, the first row first

Of `room` the events beyond are counted but not listed. Nothing here knows the stream's time: blind pixels count down,
and what leaks is counted from an epoch that the processor moves.
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.gpu.arithmetic import ARITHMETIC, constant
from emulator.sensor.gpu.march import TRUST, WALK

__all__ = ["COUNTS", "CROSSINGS", "GROUP", "NOT_KNOWN", "PIXEL", "QUIET", "THRESHOLDS"]

GROUP = 16, 8
"""Pixels of a work group of the first pass, (width, height)."""

CROSSING_GROUP = 128
"""Pixels of a work group of the second pass."""

NOT_KNOWN = 3e38
"""In the place of a log light or a slope that is not known."""

PIXEL = np.dtype([(name, "<f4") for name in ("u", "v", "rate", "slope", "reference")] + [("blind", "<u4")])
"""A pixel's state: log light, filtered, its rate (rad/s), slope of u by warped time, the reference with leak times the
time since the epoch added, and 0 for a pixel that sees or 1 + the time for which it is blind, ns."""

THRESHOLDS = np.dtype([(name, "<f4") for name in ("on", "off", "leak")])
"""ON and OFF threshold, ln units, and leak, ln units a second."""

_COUNTED = "groups_x", "groups_y", "groups_z", "raised", "too_many", "candidates", "suspects", "unreadable"
COUNTS = np.dtype([(name, "<u4") for name in _COUNTED])
"""Work groups of the second pass; then crossings within a pixel's most, those beyond, pixels that may have fired,
suspects, pixels with unreadable light."""

_DECLARATIONS = f"""
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
layout(std430, binding = 4) buffer Counts {{ uint {", ".join(_COUNTED)}; }};
layout(std430, binding = 5) buffer Candidates {{ uint listed[]; }};
const uint CROSSING_GROUP = {CROSSING_GROUP}u;
{constant("NOT_KNOWN", NOT_KNOWN)}
"""

_LIGHT = """
struct Change {  // what the pictures tell of a pixel's step: the end, the change of log light, slopes per step
    float u, rate, slope, d, a0, a1;
    bool readable;
};

float per_step(float rate, float slope) {  // a slope by warped time
    return slope == NOT_KNOWN ? NOT_KNOWN : h * rate * slope;
}

Change change_of(ivec2 at, Pixel s) {
    float e = texelFetch(picture, at, 0).r, r = chord ? 0.0 : texelFetch(picture_rate, at, 0).r;
    bool readable = is_finite(e), lit = readable && e > 0.0;
    float current = (lit ? e : 0.0) + dark, u = natural_log(current), d = u - s.u;
    float rate = clamp(rate_at_reference * current, rate_min, rate_max);
    float slope = chord || !is_finite(r) ? NOT_KNOWN : lit ? r / (current * rate) : 0.0;
    float a0 = chord ? d : per_step(s.rate, slopes_known ? s.slope : NOT_KNOWN);
    return Change(u, rate, slope, d, a0, chord ? d : per_step(rate, slope), readable);
}

Pixel stored(Pixel s, Change c) {
    s.u = c.readable ? c.u : NOT_KNOWN;
    s.rate = c.rate;
    s.slope = c.slope;
    return s;
}
"""

_QUIET_MAIN = """
bool stays_quiet(Change c, float behind, float q, Pixel s, Thresholds p) {
    float first = c.a0 * (1.0 / 3.0), last = c.d - c.a1 * (1.0 / 3.0), end = max(c.d, 0.0);
    float top = max(end, max(first, last)), bottom = min(min(c.d, 0.0), min(first, last));
    float share = min(q * (1.08 + 1.2 * (top - end)), 1.0);
    float above = s.v - s.reference;
    float high = above + (share * max(behind + top, 0.0) + p.leak * since_epoch_1);
    float low = above + (share * min(behind + bottom, 0.0) + p.leak * since_epoch_0);
    return high < p.on - 5e-6 && low > 5e-6 - p.off;
}

bool moves_quietly(Change c, Thresholds p, inout Pixel s) {  // if so, s is moved
    if (!is_plain(c.d, c.a0, c.a1, TRUST * min(p.on, p.off))) return false;
    float warped = warped_time(h, s.rate, c.rate, c.a0, c.a1), q = decay(warped), behind = s.u - s.v;
    bool stays_blind = s.blind > h_ns + 1u;
    if (!stays_blind && (s.blind > 0u || !stays_quiet(c, behind, q, s, p))) return false;
    float w0 = warped * (c.a0 / (h * s.rate)), w1 = warped * (c.a1 / (h * c.rate));
    s.v += rise_of_filter(q, behind, Course(warped, c.d, w0, w1));
    s.blind = stays_blind ? s.blind - h_ns : 0u;
    return true;
}

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x || at.y >= size.y) return;
    uint pixel = uint(at.y) * uint(size.x) + uint(at.x);
    Thresholds p = drawn[pixel];
    Pixel s = before[pixel];
    s.reference -= p.leak * epoch_moved;
    Change c = change_of(at, s);
    if (!c.readable) atomicAdd(unreadable, 1u);
    if (!c.readable || s.u == NOT_KNOWN) {  // silent; the filter starts anew from the next readable light
        s.v = c.u;
        s.blind = s.blind > 0u ? 1u + (max(s.blind - 1u, h_ns) - h_ns) : 0u;
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
    Pixel s = before[pixel];
    s.reference -= p.leak * epoch_moved;
    Change c = change_of(ivec2(pixel % uint(size.x), pixel / uint(size.x)), s);
    walk(pixel, p, taken(s.u, c.d, c.a0, c.a1, TRUST * min(p.on, p.off)), s);
    after[pixel] = stored(s, c);
}
"""


def _source(width: int, height: int, *parts: str) -> str:
    layout = f"layout(local_size_x = {width}, local_size_y = {height}) in;"
    return "\n".join(["#version 430", layout, _DECLARATIONS, ARITHMETIC, TRUST, _LIGHT, *parts])


QUIET = _source(*GROUP, _QUIET_MAIN)
"""The compute shader that moves what is quiet, and lists the others."""

CROSSINGS = _source(CROSSING_GROUP, 1, WALK, _CROSSINGS_MAIN)
"""The compute shader that moves the listed ones, from crossing to crossing."""
