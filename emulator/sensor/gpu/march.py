"""GLSL of the interpolation checks, and of a pixel's march through a step, substep by substep and event by event.

It does for one pixel what `interpolation`, `substeps` and `march` do for a table of pixels. All pixels that may fire
march; a faster way for smooth steps is not needed, because a graphics card has lanes enough.
"""

from __future__ import annotations

from emulator.sensor.gpu.arithmetic import constant
from emulator.sensor.pixels.curve import LARGEST_CHANGE, UNSEEN_SHARE, WORTH_BENDING
from emulator.sensor.pixels.state import MOST_EVENTS

__all__ = ["INTERPOLATION", "MARCH"]

INTERPOLATION = f"""
{constant("LARGEST_CHANGE", LARGEST_CHANGE)}   // of log light in a substep
{constant("UNSEEN_SHARE", UNSEEN_SHARE)}            // of a threshold; more makes a step undersampled
{constant("WORTH_BENDING", WORTH_BENDING)}           // of a threshold; below, the cubic is kept

bool is_smooth(float d, float a0, float a1, float threshold) {{
    float steepest = max(abs(a0), abs(a1)), gap = abs(a0 - a1), missed = abs(2.0 * d - (a0 + a1));
    bool one_piece = max(2.0 * abs(d), steepest) <= 2.0 * LARGEST_CHANGE;
    bool seen = max(missed, 0.25 * gap) <= 2.0 * UNSEEN_SHARE * threshold;
    bool unbent = missed <= max(2.0 * WORTH_BENDING * threshold, (1.0 / 3.0) * gap);
    bool fits = a0 * a1 < 0.0 ? unbent : steepest <= 2.1213 * abs(d) + 0.014142;
    return one_piece && seen && fits;
}}
"""
"""Test whether a step can be solved in one piece with the cubic as it is."""

MARCH = f"""
{constant("ABSURD", 1e9)}                      // a slope that no light has: not known
const float SHARE = 0.004, LEAST_MISS = 2e-5;  // of a threshold, and ln units: error of a substep's cubic
const float NEARLY = 1.001, SETTLED = 3e-5;
const uint MOST_EVENTS = {MOST_EVENTS}u;
const uint MOST_PASSES = 5u;  // of a substep: three monotone parts, and what rounding leaves
const float MOST_LOST = 65536.0;  // of them each; the counter has 32 bits for all pixels
const int MOST_CUTS = 64;                      // substeps that are shortened for the exponential

const int CUBIC = 0, JUMP = 1, LATE = 2, EARLY = 3;

struct Light {{  // the log light of a step: a cubic, a jump of d at the knot, or a bend behind or before the knot
    float u, d, a0, a1, knot;
    int form;
}};

struct Substep {{  // log light, rates per step and slopes per substep at both ends, and its course
    float u0, u1, r0, r1, a0, a1;
    Course course;
}};

struct Curve {{  // a value at both ends of a substep, and its slopes per substep
    float g0, g1, m0, m1;
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

float bend_width(float d, float a0, float a1, float threshold) {{  // 1 where there is none
    float away = abs(d - 0.5 * (a0 + a1)), gap = abs(a1 - a0);
    bool opposed = a0 * a1 < 0.0;
    bool swings = min(a0 * d, a1 * d) < 0.0 || opposed || a0 * a0 + a1 * a1 > 9.0 * d * d;
    bool no_peak = min(abs(a0), abs(a1)) <= 0.1 * max(abs(a0), abs(a1)) || !opposed;
    bool possible = 6.0 * away > gap && 2.0 * away < gap;
    bool bends = away > WORTH_BENDING * threshold && possible && swings && no_peak;
    return bends ? max(3.0 * (0.5 - away / gap), 1e-4) : 1.0;
}}

Light interpolated(float u0, float d, float a0, float a1, float threshold) {{  // the slopes may be unknown
    bool known0 = abs(a0) <= ABSURD, known1 = abs(a1) <= ABSURD;
    float first = known0 ? a0 : known1 ? 2.0 * d - a1 : d;
    float last = known1 ? a1 : known0 ? 2.0 * d - a0 : d;
    bool unseen_change = is_undersampled(d, first, last, UNSEEN_SHARE * threshold);
    if (unseen_change) atomicAdd(undersampled, 1u);
    bool jump = unseen_change && max(abs(first), abs(last)) < 0.3 * abs(d);
    if (jump) return Light(u0, d, 0.0, 0.0, 0.5, JUMP);
    float cap = 64.0 / max(max(abs(first), abs(last)), 64.0);
    float width = bend_width(d, cap * first, cap * last, threshold);
    float factor = width < 1.0 ? cap : limit(d, first, last);
    first *= factor;
    last *= factor;
    if (width == 1.0) return Light(u0, d, first, last, 1.0, CUBIC);
    bool late = abs(d - first) < abs(d - last);
    return Light(u0, d, first, last, late ? 1.0 - width : width, late ? LATE : EARLY);
}}

vec2 bent(Light light, float z) {{  // change up to z and slope per step, on a line with a bend at its end or start
    bool late = light.form == LATE;
    float width = late ? 1.0 - light.knot : light.knot;
    float t = max(late ? z - light.knot : light.knot - z, 0.0) / width;
    float line = late ? light.a0 * z : light.d - light.a1 * (1.0 - z);
    float turned = (light.a1 - light.a0) * t * t;
    return vec2(line + (1.0 / 3.0) * width * t * turned, late ? light.a0 + turned : light.a1 - turned);
}}

vec2 light_at(Light light, float z, bool jumped) {{  // value, and slope per step
    if (light.form == JUMP) return vec2(light.u + (jumped ? light.d : 0.0), 0.0);
    if (light.form != CUBIC) return vec2(light.u, 0.0) + bent(light, z);
    float c3 = light.a0 + light.a1 - 2.0 * light.d, c2 = 3.0 * light.d - 2.0 * light.a0 - light.a1;
    return vec2(light.u + ((c3 * z + c2) * z + light.a0) * z, (3.0 * c3 * z + 2.0 * c2) * z + light.a0);
}}

Substep substep_of(Light light, float z, float width) {{
    bool jumped = z >= light.knot;
    vec2 p0 = light_at(light, z, jumped), p1 = light_at(light, z + width, jumped);
    float l0 = clamp(rate_at_reference * exponential(p0.x), rate_min, rate_max);
    float l1 = clamp(rate_at_reference * exponential(p1.x), rate_min, rate_max);
    float s = warped_time(h * width, l0, l1, width * p0.y, width * p1.y);
    Course course = Course(s, p1.x - p0.x, s * p0.y / (h * l0), s * p1.y / (h * l1));
    return Substep(p0.x, p1.x, h * l0, h * l1, width * p0.y, width * p1.y, course);
}}

float share_within(float b, float s, float most) {{  // of an interval in which a cubic misses less than that of b e^-s
    float allowed = most / max(abs(b), 1e-20);
    float longest = max(sqrt(sqrt(384.0 * allowed)), (allowed - 0.2) * (1.0 / 0.16));
    return min(longest / s, 1.0);
}}

Curve filtered(Substep q, float v, float span) {{
    float behind = q.u0 - v, v1 = v + rise_of_filter(decay(q.course.s), behind, q.course);
    Transient t = transient(behind, q.course);
    float m0 = span * q.r0 * (t.faint ? t.lag0 : behind), m1 = span * q.r1 * (t.faint ? t.lag1 : q.u1 - v1);
    return Curve(v, v1, m0, m1);
}}

Curve behind_second_pole(Curve v, float w, float s) {{
    Course course = Course(s, v.g1 - v.g0, v.m0, v.m1);
    float behind = v.g0 - w, w1 = w + rise_of_filter(decay(s), behind, course);
    Transient t = transient(behind, course);
    return Curve(w, w1, s * (t.faint ? t.lag0 : behind), s * (t.faint ? t.lag1 : v.g1 - w1));
}}

Curve leaking(Substep q, float leaked, float leaks) {{  // parasitic leak, the integral of i; leaks: of light 1
    float m0 = leaks * exponential(q.u0), m1 = leaks * exponential(q.u1);
    float rise = 0.5 * (m0 + m1) + (1.0 / 12.0) * (m0 * q.a0 - m1 * q.a1);
    return Curve(leaked, leaked + rise, m0, m1);
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

float pass_over(float level, float end, float threshold) {{  // the last level before a monotone part's end
    float way = abs(end - level), passed = floor(way / threshold), rest = way - passed * threshold;
    atomicAdd(too_many, uint(clamp(passed, 1.0, MOST_LOST)));
    float last = end - (rest >= 0.0 && rest < threshold ? rest : 0.0) * sign(end - level);
    return abs(end - last) < threshold ? last : end;
}}

void march(uint pixel, Thresholds p, Light light, inout Pixel s) {{
    float steepest = max(abs(light.a0), abs(light.a1));
    float steepness = max(abs(light.d), light.form > JUMP ? steepest : 0.5 * steepest);
    float wide = light.form == JUMP ? 0.5 : 1.0 / max(ceil(steepness / LARGEST_CHANGE), 1.0);
    float most = max(SHARE * min(p.on, p.off), LEAST_MISS);
    bool is_refractory = s.refractory_left > 0u;
    uint re_armed_ns = is_refractory ? s.refractory_left - 1u : 0u;
    float re_armed = float(re_armed_ns) / float(h_ns), v = s.v, level = 0.0, z = 0.0;
    float w = second > 0.0 ? s.w : v, leaked = parasitic > 0.0 ? s.leaked : 0.0;
    float base = is_refractory ? w + (p.leak * since_epoch_0 + leaked) : s.reference;
    uint count = 0u;
    for (int k = 0; z < 1.0; ++k) {{
        float stop = z < light.knot ? light.knot : 1.0;
        bool last = stop - z < NEARLY * wide;
        float whole = last ? stop - z : wide;
        Substep q = substep_of(light, z, whole);
        float share = share_within(transient(q.u0 - v, q.course).b, q.course.s, most);
        share = k < MOST_CUTS ? share : 1.0;
        float span = share * whole, z1 = last && share == 1.0 ? stop : z + span;
        if (share < 1.0) q = substep_of(light, z, span);
        Curve by_light = filtered(q, v, span), seen = by_light;
        if (second > 0.0) {{
            float s2 = second * span;
            Course course = Course(s2, by_light.g1 - v, by_light.m0, by_light.m1);
            float share2 = share_within(transient(v - w, course).b, s2, most);
            if (share2 < 1.0 && k < MOST_CUTS) {{
                span *= share2;
                z1 = z + span;
                q = substep_of(light, z, span);
                by_light = filtered(q, v, span);
            }}
            seen = behind_second_pole(by_light, w, second * span);
        }}
        Curve lost = Curve(0.0, 0.0, 0.0, 0.0);
        if (parasitic > 0.0) lost = leaking(q, leaked, parasitic * p.on * (h * span));
        float falls = p.leak * (h * span), rise = (seen.g1 - seen.g0 + falls) + (lost.g1 - lost.g0);
        float m0 = (seen.m0 + falls) + lost.m0, m1 = (seen.m1 + falls) + lost.m1;
        float d0 = (seen.g0 - base) + (p.leak * (since_epoch_0 + h * z) + leaked);
        vec4 g = vec4(d0, m0, 3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise);
        vec2 turns = turns_of(g);
        float x = 0.0;
        for (uint passes = 0u; passes <= MOST_PASSES;) {{
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
            if (count >= MOST_EVENTS && refractory_ns == 0u) {{
                level = pass_over(level, value(g, ++passes < MOST_PASSES ? high : 1.0), rising ? p.on : p.off);
                x = high;
                continue;
            }}
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
        v = by_light.g1;
        w = seen.g1;
        leaked = lost.g1;
        z = z1;
    }}
    s.v = v;
    s.w = w;
    s.reference = is_refractory ? s.reference : level == 0.0 ? base : base + (level - leaked);
    s.leaked = is_refractory || level != 0.0 ? 0.0 : leaked;
    s.refractory_left = is_refractory ? 1u + (max(re_armed_ns, h_ns) - h_ns) : 0u;
}}
"""
"""Needs `INTERPOLATION`, `ARITHMETIC`, and the declarations of `step` before them."""
