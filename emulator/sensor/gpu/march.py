"""GLSL of the interpolation checks, and of a pixel's march through a step, substep by substep and event by event.

It does for one pixel what `interpolation`, `substeps` and `march` do for a table of pixels. All pixels that may fire
march; a faster way for smooth steps is not needed, because a graphics card has lanes enough.
"""

from __future__ import annotations

from emulator.sensor.gpu.arithmetic import constant
from emulator.sensor.pixels.interpolation import LARGEST_CHANGE, UNSEEN_SHARE
from emulator.sensor.pixels.packed_crossings import MOST_EVENTS

__all__ = ["INTERPOLATION", "MARCH"]

INTERPOLATION = f"""
{constant("LARGEST_CHANGE", LARGEST_CHANGE)}   // of log light in a substep
{constant("UNSEEN_SHARE", UNSEEN_SHARE)}            // of a threshold; more makes a step undersampled

bool is_smooth(float d, float a0, float a1, float unseen) {{
    float steepest = max(abs(a0), abs(a1));
    bool one_piece = max(2.0 * abs(d), steepest) <= 2.0 * LARGEST_CHANGE;
    bool seen = max(abs(2.0 * d - (a0 + a1)), 0.25 * abs(a0 - a1)) <= 2.0 * unseen;
    bool fits = steepest <= 2.1213 * abs(d) + 0.014142 || a0 * a1 < 0.0;
    return one_piece && seen && fits;
}}
"""
"""Test whether a step can be solved in one piece with the cubic as it is."""

MARCH = f"""
{constant("ABSURD", 1e9)}                      // a slope that no light has: not known
const float SHARE = 0.004, LEAST_MISS = 2e-5;  // of a threshold, and ln units: error of a substep's cubic
const float NEARLY = 1.001, SETTLED = 3e-5;
const uint MOST_EVENTS = {MOST_EVENTS}u;
const int MOST_CUTS = 64;                      // substeps that are shortened for the exponential

struct Light {{  // the log light of a step: a cubic, or a jump of d at mid-step
    float u, d, a0, a1;
    bool jump;
}};

struct Substep {{  // rates per step and log light at both ends, and its course
    float u0, u1, r0, r1;
    Course course;
}};

bool is_undersampled(float d, float a0, float a1, float unseen) {{
    bool turns = a0 * a1 < 0.0 && 0.125 * abs(a0 - a1) > unseen;
    return turns || abs(d - 0.5 * (a0 + a1)) > unseen;
}}

float limit(float d, float a0, float a1) {{
    float together = sqrt(a0 * a0 + a1 * a1);
    bool turns = min(min(a0 * d, a1 * d), a0 * a1) < 0.0;
    float not_too_steep = 64.0 / max(max(abs(a0), abs(a1)), 64.0);
    if (turns || together <= 3.0 * abs(d) + 0.02) return not_too_steep;
    return min(3.0 * abs(d) / together, not_too_steep);
}}

Light interpolated(float u0, float d, float a0, float a1, float unseen) {{  // the slopes may be unknown
    bool known0 = abs(a0) <= ABSURD, known1 = abs(a1) <= ABSURD;
    float first = known0 ? a0 : known1 ? 2.0 * d - a1 : d;
    float last = known1 ? a1 : known0 ? 2.0 * d - a0 : d;
    bool unseen_change = is_undersampled(d, first, last, unseen);
    if (unseen_change) atomicAdd(undersampled, 1u);
    bool jump = unseen_change && max(abs(first), abs(last)) < 0.3 * abs(d);
    float factor = jump ? 0.0 : limit(d, first, last);
    return Light(u0, d, factor * first, factor * last, jump);
}}

vec2 light_at(Light light, float z, bool jumped) {{  // value, and slope per step
    if (light.jump) return vec2(light.u + (jumped ? light.d : 0.0), 0.0);
    float c3 = light.a0 + light.a1 - 2.0 * light.d, c2 = 3.0 * light.d - 2.0 * light.a0 - light.a1;
    return vec2(light.u + ((c3 * z + c2) * z + light.a0) * z, (3.0 * c3 * z + 2.0 * c2) * z + light.a0);
}}

Substep substep_of(Light light, float z, float width) {{
    bool jumped = z >= 0.5;
    vec2 p0 = light_at(light, z, jumped), p1 = light_at(light, z + width, jumped);
    float l0 = clamp(rate_at_reference * exponential(p0.x), rate_min, rate_max);
    float l1 = clamp(rate_at_reference * exponential(p1.x), rate_min, rate_max);
    float s = warped_time(h * width, l0, l1, width * p0.y, width * p1.y);
    Course course = Course(s, p1.x - p0.x, s * p0.y / (h * l0), s * p1.y / (h * l1));
    return Substep(p0.x, p1.x, h * l0, h * l1, course);
}}

float share_within(float b, float s, float most) {{  // of an interval in which a cubic misses less than that of b e^-s
    float allowed = most / max(abs(b), 1e-20);
    float longest = max(sqrt(sqrt(384.0 * allowed)), (allowed - 0.2) * (1.0 / 0.16));
    return min(longest / s, 1.0);
}}

float value(vec4 g, float x) {{
    return ((g.w * x + g.z) * x + g.y) * x + g.x;
}}

vec2 turns_of(vec4 g) {{  // where a cubic turns within (0, 1), in ascending order; 1 where it does not
    float a = 3.0 * g.w, square = g.z * g.z - a * g.y, root = sqrt(max(square, 0.0));
    float other = -(g.z + (g.z > 0.0 ? root : -root));
    float x0 = a != 0.0 ? other / a : 1.0, x1 = other != 0.0 ? g.y / other : 1.0;
    x0 = x0 > 0.0 && x0 < 1.0 && square > 0.0 ? x0 : 1.0;
    x1 = x1 > 0.0 && x1 < 1.0 && square > 0.0 ? x1 : 1.0;
    return vec2(min(x0, x1), max(x0, x1));
}}

float crossing(vec4 g, float low, float high, float to, bool rising) {{  // of a monotone part of g
    float first = low, last = high, at_low = value(g, low), sign_ = rising ? 1.0 : -1.0;
    float secant = low + (high - low) * (to - at_low) / (value(g, high) - at_low);
    float x = secant >= low && secant <= high ? secant : high, moved = 0.0;
    for (int k = 0; k < 4; ++k) {{
        float beyond = sign_ * (value(g, x) - to);
        if (beyond > 0.0) high = x; else low = x;
        float newton = x - beyond / (sign_ * ((3.0 * g.w * x + 2.0 * g.z) * x + g.y));
        float better = newton >= low && newton <= high ? newton : 0.5 * (low + high);
        moved = abs(better - x);
        x = better;
    }}
    if (moved <= SETTLED) return x;
    for (int k = 0; k < 25; ++k) {{
        float middle = 0.5 * (first + last);
        if ((value(g, middle) > to) == rising) last = middle; else first = middle;
    }}
    return last;
}}

bool beyond(float g, Thresholds p) {{
    return g >= p.on || g <= -p.off;
}}

void raise(uint pixel, bool on, float z, inout uint count) {{
    if (count++ >= MOST_EVENTS) {{
        atomicAdd(too_many, 1u);
        return;
    }}
    uint k = atomicAdd(raised, 1u);
    if (k < capacity) events[k] = uvec2(pixel << 1 | uint(on), floatBitsToUint(z));
}}

void march(uint pixel, Thresholds p, Light light, inout Pixel s) {{
    float steepness = max(abs(light.d), 0.5 * max(abs(light.a0), abs(light.a1)));
    float wide = light.jump ? 0.5 : 1.0 / max(ceil(steepness / LARGEST_CHANGE), 1.0);
    float most = max(SHARE * min(p.on, p.off), LEAST_MISS);
    bool is_refractory = s.refractory_left > 0u;
    uint re_armed_ns = is_refractory ? s.refractory_left - 1u : 0u;
    float re_armed = float(re_armed_ns) / float(h_ns), v = s.v, level = 0.0, z = 0.0;
    float base = is_refractory ? v + p.leak * since_epoch_0 : s.reference;
    uint count = 0u;
    for (int k = 0; z < 1.0; ++k) {{
        float stop = light.jump && z < 0.5 ? 0.5 : 1.0;
        bool last = stop - z < NEARLY * wide;
        float whole = last ? stop - z : wide;
        Substep q = substep_of(light, z, whole);
        float share = share_within(transient(q.u0 - v, q.course).b, q.course.s, most);
        share = k < MOST_CUTS ? share : 1.0;
        float span = share * whole, z1 = last && share == 1.0 ? stop : z + span;
        if (share < 1.0) q = substep_of(light, z, span);

        float behind = q.u0 - v, v1 = v + rise_of_filter(decay(q.course.s), behind, q.course);
        Transient t = transient(behind, q.course);
        float leaked = p.leak * (h * span), rise = v1 - v + leaked;
        float m0 = span * q.r0 * (t.faint ? t.lag0 : behind) + leaked;
        float m1 = span * q.r1 * (t.faint ? t.lag1 : q.u1 - v1) + leaked;
        float d0 = (v - base) + p.leak * (since_epoch_0 + h * z);
        vec4 g = vec4(d0, m0, 3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise);
        vec2 turns = turns_of(g);
        float x = 0.0;
        while (true) {{
            if (is_refractory) {{
                x = max(x, re_armed > z ? (re_armed - z) / span : 0.0);
                if (x > 1.0) break;
                level = value(g, x);
                is_refractory = false;
            }}
            float turn = max(turns.x, x), turn2 = max(turns.y, x);
            float g0 = value(g, x) - level, g1 = value(g, turn) - level;
            float g2 = value(g, turn2) - level, g3 = value(g, 1.0) - level;
            bool by0 = beyond(g0, p), by1 = beyond(g1, p), by2 = beyond(g2, p), by3 = beyond(g3, p);
            if (!(by0 || by1 || by2 || by3)) break;
            float low = by0 || by1 ? x : by2 ? turn : turn2;
            float high = by0 ? x : by1 ? turn : by2 ? turn2 : 1.0;
            bool rising = (by0 ? g0 : by1 ? g1 : by2 ? g2 : g3) > 0.0;
            float to = level + (rising ? p.on : -p.off);
            x = crossing(g, low, high, to, rising);
            level = to;
            float when = z + x * span;
            raise(pixel, rising, when, count);
            if (refractory_ns > 0u) {{
                is_refractory = true;
                re_armed = when + refractory;
                re_armed_ns = min(uint(when * float(h_ns)), h_ns) + refractory_ns;
            }}
        }}
        v = v1;
        z = z1;
    }}
    s.v = v;
    s.reference = is_refractory ? s.reference : base + level;
    s.refractory_left = is_refractory ? 1u + (max(re_armed_ns, h_ns) - h_ns) : 0u;
}}
"""
"""Needs `INTERPOLATION`, `ARITHMETIC`, and the declarations of `step` before them."""
