"""Delay of a comparator: the time from the crossing of a threshold until its output has switched.

The comparator of a pixel is one transistor, driven by the amplified change of log light, against a bias current. At the
threshold both currents are equal. When the signal is beyond it by y, in ln units, the input transistor's current is
e^(-y/F) or e^(y/F) of the bias current, in subthreshold, and their difference drives the output's capacitance:

    ON    the input transistor pulls:     C dV/dt = I_on (e^(y/F) - 1)
    OFF   the bias current pulls:         C dV/dt = I_off (1 - e^(-y/F))

F, `contrast_per_e`, is the constant of the thresholds too: theta = F ln(I_on / I_diff). With tau = C V / I, the time in
which the bias current alone swings the output, and a signal that goes on with its slope s of the crossing, the delay t
is, in units of T = F / s and with q = tau / T,

    ON    e^u - 1 - u = q        OFF   u - 1 + e^-u = q        t = u T

Both have one solution. A slow signal is late by sqrt(2 tau T), a fast one by T ln(q) for ON, and for OFF by tau + T: an
OFF event cannot come faster than its bias current drives. So the comparator's bandwidth differs by polarity; the bias
currents that set the thresholds make OFF the slow one.

Source of the circuit: Lichtsteiner, Posch and Delbruck, IEEE JSSC 2008, and the biases in Graca, McReynolds and
Delbruck, arXiv 2304.04706; the law follows from them by subthreshold currents, without an output conductance. A signal
that turns back within the delay raises its event all the same.
"""

from __future__ import annotations

import math

from emulator.sensor.numerics.compiled import kernel
from emulator.sensor.pixels.state import StepConstants

LONGEST_S = 0.1
"""Longest delay: of a signal that has hardly a slope."""

_TURNS = 12
_SETTLED = 1e-9


@kernel
def _units(q: float, on: bool) -> float:
    """Return u for q > 0, by Newton's method from above: both functions are convex, so it cannot overshoot."""
    most = math.sqrt(2 * q)
    u = math.log1p(q + most) if on else q + min(1.0, most)
    for _ in range(_TURNS):
        e = math.expm1(u) if on else -math.expm1(-u)
        less = (e - u - q) / e if on else (u - e - q) / e
        u -= less
        if abs(less) <= _SETTLED * u:
            break
    return u


@kernel
def delay_s(slope: float, on: bool, c: StepConstants) -> float:
    """Return the delay, s, of an event that crosses its threshold at `slope` >= 0, ln units a second."""
    tau_s = c.on_delay if on else c.off_delay
    if tau_s <= 0:
        return 0.0
    if slope <= 0:
        return LONGEST_S
    unit_s = c.contrast_per_e / slope
    late_s: float = min(_units(tau_s / unit_s, on) * unit_s, LONGEST_S)
    return late_s
