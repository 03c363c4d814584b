"""GLSL of logarithm, decay, exponential, and the photoreceptor's low-pass, as in the processor's kernel.

The formulas, their names and their limits are those of `elementary` and `lowpass`, where they are explained. Logarithm
and exponential are polynomials here too, because GLSL's own are good to 1e-6 on one driver and to less on another.
"""

from __future__ import annotations

import numpy as np

__all__ = ["ARITHMETIC", "constant"]


def constant(name: str, value: float | np.float32) -> str:
    """Return the GLSL that defines a float constant, exact in float32."""
    return f"const float {name} = {np.float32(value):.9e};"


_TWO_TO_THE = "\n".join(
    constant(f"E{k}", float(np.log(2) ** k / np.prod(np.arange(1, k + 1, dtype=float)))) for k in range(1, 8)
)

ARITHMETIC = f"""
const uint INFINITE = 0x7f800000u;
{constant("LOG2_E", float(np.log2(np.e)))}
{_TWO_TO_THE}

bool is_finite(float x) {{  // by its bits: compilers may assume that there is no NaN
    return (floatBitsToUint(x) & 0x7fffffffu) < INFINITE;
}}

float natural_log(float x) {{  // of positive, finite x
    int bits = floatBitsToInt(x);
    int e = (bits - 0x3F3504F3) >> 23;
    float f = intBitsToFloat(bits - (e << 23)) - 1.0;
    float p = 7.0376836292e-2;
    p = p * f - 1.1514610310e-1;
    p = p * f + 1.1676998740e-1;
    p = p * f - 1.2420140846e-1;
    p = p * f + 1.4249322787e-1;
    p = p * f - 1.6668057665e-1;
    p = p * f + 2.0000714765e-1;
    p = p * f - 2.4999993993e-1;
    p = p * f + 3.3333331174e-1;
    float f2 = f * f;
    return ((p * f) * f2 - float(e) * 2.12194440e-4 - 0.5 * f2) + f + float(e) * 0.693359375;
}}

vec2 two_to_the(float y) {{  // 2^k and 2^f - 1, where y = k + f, k whole and |f| <= 1/2
    float k = floor(y + 0.5), f = y - k;
    float less_one = ((((((E7 * f + E6) * f + E5) * f + E4) * f + E3) * f + E2) * f + E1) * f;
    return vec2(intBitsToFloat((int(k) + 127) << 23), less_one);
}}

float decay(float s) {{  // 1 - e^-s, s >= 0
    vec2 p = two_to_the(-min(s, 80.0) * LOG2_E);
    return (1.0 - p.x) - p.x * p.y;
}}

float exponential(float x) {{
    vec2 p = two_to_the(clamp(x, -80.0, 80.0) * LOG2_E);
    return p.x + p.x * p.y;
}}

struct Course {{  // log light over an interval: its warped length, its change, its slopes at both ends per interval
    float s, d, w0, w1;
}};

struct Transient {{  // the weight of e^-s in the answer, 0 where it is rounding noise, and the steady lags at both ends
    float b, lag0, lag1;
    bool faint;
}};

float warped_time(float length_s, float l0, float l1, float a0, float a1) {{
    float bend0 = l0 > rate_min && l0 < rate_max ? l0 * a0 : 0.0;
    float bend1 = l1 > rate_min && l1 < rate_max ? l1 * a1 : 0.0;
    return length_s * max(0.5 * (l0 + l1) + (1.0 / 12.0) * (bend0 - bend1), min(l0, l1));
}}

float rise_of_filter(float q, float behind, Course u) {{
    float s = u.s, inverse = 1.0 / s;
    bool is_short = s < 0.5;
    float series = ((-0.00120679 * s + 0.00827807) * s - 0.04166122) * s + 0.16666658;
    float less_i0 = is_short ? s * (0.5 - s * series) : 1.0 - q * inverse;
    float less_i1 = is_short ? s * series : 0.5 - less_i0 * inverse;
    float k = is_short ? series : less_i1 * inverse;
    float bent = (6.0 * u.d - 4.0 * u.w0 - 2.0 * u.w1) * less_i1
               + (3.0 * (u.w0 + u.w1) - 6.0 * u.d) * (1.0 / 3.0 - 2.0 * k);
    return q * behind + (u.w0 * less_i0 + bent);
}}

Transient transient(float behind, Course u) {{
    float inverse = 1.0 / max(u.s, 0.01);
    float third = 6.0 * (u.w0 + u.w1 - 2.0 * u.d);
    float second = 2.0 * (3.0 * u.d - 2.0 * u.w0 - u.w1);
    float lag0 = inverse * (u.w0 - inverse * (second - inverse * third));
    float lag1 = inverse * (u.w1 - inverse * (second + third - inverse * third));
    float b = lag0 - behind;
    bool faint = u.s > 100.0 && abs(b) < 1e-5;
    return Transient(faint ? 0.0 : b, lag0, lag1, faint);
}}

float passed_by_second_pole(float s, float r0, float second) {{
    float lead = s - second, r = r0 + (s - r0) * (2.0 + max(-lead, 0.0)) / (3.0 + abs(lead));
    float gap = max(abs(second - r), 1e-6);
    return second * exponential(-min(r, second)) * (decay(gap) / gap);
}}

struct Filtered {{  // the filter over an interval: its lags at both ends, its rise, and rates times the length
    float behind0, behind1, rise, r0, r1;
}};

float rise_behind_second_pole(float behind, float second, Course u, Filtered v) {{  // behind = v0 - w0
    Transient t = transient(v.behind0, u);
    bool slow = u.s < 1.0;
    float b = slow ? 0.0 : t.b, rise = slow ? v.rise : u.d - (t.lag1 - t.lag0);
    float m0 = v.r0 * (slow ? v.behind0 : t.lag0), m1 = v.r1 * (slow ? v.behind1 : t.lag1);
    float followed = rise_of_filter(decay(second), behind - b, Course(second, rise, m0, m1));
    return followed + b * passed_by_second_pole(u.s, v.r0, second);
}}
"""
"""Needs the uniforms `rate_min` and `rate_max`."""
